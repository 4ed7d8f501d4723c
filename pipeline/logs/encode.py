"""Serializing columns as CDR, rows that are laid out alike as one block.

The rows are grouped by the lengths of their strings and sequences; within a group every field stands at one
place, and writing it is one strided copy. Little-endian XCDR1, as ROS 2 recorders write.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pipeline.core.arrays import Ints, group_rows
from pipeline.logs.columns import Column, Ragged, RaggedStrings, Strings
from pipeline.logs.normalize import Given, normalize_columns
from pipeline.logs.schema import NUMBER_TYPES, SEQUENCE, SIZES, Member, Structure

_ENCAPSULATION: Final = b"\x00\x01\x00\x00"


@dataclass(slots=True)
class _Sheet:
    """Rows of one layout being written: what goes where, from the start of the payload."""

    rows: int
    place: int = 0
    written: list[tuple[int, NDArray[np.uint8]]] = field(default_factory=list)

    def put(self, kind: str, values: NDArray[np.generic]) -> None:
        size = SIZES[kind]
        self.place = -(-self.place // size) * size
        stored = np.ascontiguousarray(
            values.reshape(self.rows, -1), dtype=NUMBER_TYPES[kind].newbyteorder("<")
        )
        self.put_bytes(stored.view(np.uint8).reshape(self.rows, -1))

    def put_bytes(self, block: NDArray[np.uint8]) -> None:
        self.written.append((self.place, block))
        self.place += block.shape[1]

    def put_length(self, length: int) -> None:
        self.put("uint32", np.full((self.rows, 1), length, dtype=np.uint32))

    def fill(self) -> NDArray[np.uint8]:
        head = len(_ENCAPSULATION)
        block = np.zeros((self.rows, head + self.place), dtype=np.uint8)
        block[:, :head] = np.frombuffer(_ENCAPSULATION, dtype=np.uint8)
        for place, part in self.written:
            block[:, head + place : head + place + part.shape[1]] = part
        return block


def encode_rows(
    structure: Structure, rows: int, fields: Mapping[str, Given], *, where: str
) -> Iterator[tuple[Ints, NDArray[np.uint8]]]:
    """Serialize messages.

    Args:
        structure: their type.
        rows: how many.
        fields: values by leaf path; what is absent is zero or empty.
        where: topic, for messages.

    Yields:
        Numbers of the rows of one layout, and their payloads as (m, length) bytes.

    Raises:
        LogError: ``field_not_found``, ``bad_column``.
    """
    columns = normalize_columns(structure, rows, fields, where=where)
    texts = {path: _encode_texts(column) for path, column in columns.items()}
    for chosen in _group_by_layout(columns, texts, rows):
        sheet = _Sheet(chosen.size)
        _Writer(columns, texts, sheet).write(structure, chosen, "", None)
        yield chosen, sheet.fill()


def _encode_texts(column: Column) -> list[bytes]:
    if isinstance(column, Strings | RaggedStrings):
        return [text.encode() + b"\0" for text in column.values]
    return []


def _group_by_layout(
    columns: Mapping[str, Column], texts: Mapping[str, list[bytes]], rows: int
) -> list[Ints]:
    keys: list[Ints] = []
    for path, column in columns.items():
        lengths = np.array([len(text) for text in texts[path]], dtype=np.int64)
        if isinstance(column, Strings):
            keys.append(lengths[column.codes])
        elif isinstance(column, Ragged | RaggedStrings):
            keys.append(np.diff(column.offsets))
            if isinstance(column, RaggedStrings) and np.unique(lengths).size > 1:
                keys.append(_number_rows(lengths[column.codes], column.offsets))
    varying = [key for key in keys if rows and (key != key[0]).any()]
    everyone = np.arange(rows)
    if not varying:
        return [everyone] if rows else []
    _, group = np.unique(np.stack(varying, axis=1), axis=0, return_inverse=True)
    group = group.reshape(-1)
    return group_rows(group)


def _number_rows(values: Ints, offsets: Ints) -> Ints:
    counts = np.diff(offsets)
    if (counts == counts[0]).all():
        _, number = np.unique(values.reshape(counts.size, -1), axis=0, return_inverse=True)
        return number.reshape(-1).astype(np.int64)
    numbers: dict[bytes, int] = {}
    return np.array(
        [
            numbers.setdefault(values[a:b].tobytes(), len(numbers))
            for a, b in zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True)
        ],
        dtype=np.int64,
    )


@dataclass(slots=True)
class _Writer:
    columns: Mapping[str, Column]
    texts: Mapping[str, list[bytes]]
    sheet: _Sheet

    def write(self, structure: Structure, rows: Ints, prefix: str, element: int | None) -> None:
        """Write one structure of every row; ``element`` is its number within the sequence it stands in."""
        if not structure.members:
            self.sheet.put("uint8", np.zeros((rows.size, 1), dtype=np.uint8))
        for member in structure.members:
            path = f"{prefix}{member.name}"
            if isinstance(member.element, Structure):
                if member.count is None:
                    self.write(member.element, rows, f"{path}.", element)
                else:
                    self._write_structures(member, member.element, rows, path)
            elif member.element == "string":
                self._write_texts(member, rows, path, element)
            else:
                self._write_numbers(member, member.element, rows, path, element)

    def _write_structures(self, member: Member, below: Structure, rows: Ints, path: str) -> None:
        count = (
            member.count if member.count not in (None, SEQUENCE) else self._count_below(f"{path}[].", rows)
        )
        if member.count == SEQUENCE:
            self.sheet.put_length(count or 0)
        for number in range(count or 0):
            self.write(below, rows, f"{path}[].", number)

    def _count_below(self, prefix: str, rows: Ints) -> int:
        for path, column in self.columns.items():
            if path.startswith(prefix) and isinstance(column, Ragged | RaggedStrings):
                first = int(rows[0])
                return int(column.offsets[first + 1] - column.offsets[first])
        return 0

    def _write_numbers(self, member: Member, kind: str, rows: Ints, path: str, element: int | None) -> None:
        column = self.columns.get(path)
        if isinstance(column, Ragged):
            start = column.offsets[rows]
            if element is not None:
                self.sheet.put(kind, column.values[start + element])
                return
            count = int(column.offsets[rows[0] + 1] - start[0])
            self.sheet.put_length(count)
            if count:
                self.sheet.put(kind, column.values[start[:, None] + np.arange(count)])
        elif isinstance(column, np.ndarray):
            self.sheet.put(kind, column[rows])
        elif member.count == SEQUENCE:
            self.sheet.put_length(0)
        else:
            width = 1 if member.count is None else member.count
            self.sheet.put(kind, np.zeros((rows.size, width), dtype=NUMBER_TYPES[kind]))

    def _write_texts(self, member: Member, rows: Ints, path: str, element: int | None) -> None:
        column = self.columns.get(path)
        if isinstance(column, RaggedStrings):
            start = column.offsets[rows]
            if element is not None:
                self._write_codes(path, column.codes[start + element])
                return
            count = int(column.offsets[rows[0] + 1] - start[0])
            if member.count == SEQUENCE:
                self.sheet.put_length(count)
            for number in range(count):
                self._write_codes(path, column.codes[start + number])
        elif isinstance(column, Strings):
            self._write_codes(path, column.codes[rows])
        elif member.count == SEQUENCE:
            self.sheet.put_length(0)
        else:
            for _ in range(1 if member.count is None else member.count):
                self.sheet.put_length(1)
                self.sheet.put_bytes(np.zeros((rows.size, 1), dtype=np.uint8))

    def _write_codes(self, path: str, codes: NDArray[np.int32]) -> None:
        present, position = np.unique(codes, return_inverse=True)
        texts = [self.texts[path][code] for code in present.tolist()]
        length = len(texts[0])
        table = np.frombuffer(b"".join(texts), dtype=np.uint8).reshape(len(texts), length)
        self.sheet.put_length(length)
        self.sheet.put_bytes(table[position.reshape(-1)])
