"""Columns to CDR: normalizes the accepted forms of a column, then serializes in blocks."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pipeline.core.arrays import Ints, group_rows
from pipeline.logs.columns import Column, Ragged, RaggedStrings, Strings
from pipeline.logs.decode import Leaf, plan_fields, wanted_leaves
from pipeline.logs.records import LogError
from pipeline.logs.schema import NUMBER_TYPES, SEQUENCE, SIZES, Member, Structure, leaf_paths

Given: TypeAlias = "NDArray[np.generic] | Ragged | RaggedStrings | Strings | float | str | Sequence[object]"
"""One value for all messages, or one per message."""


def normalize_columns(
    structure: Structure, rows: int, fields: Mapping[str, Given], *, where: str
) -> dict[str, Column]:
    """Convert given values to the columns that reading would return.

    A single number or string applies to all messages, and so does one list of strings for a sequence of
    strings. For a field in a sequence of structures, one value per message gives sequences of length one, an
    array (n, k) sequences of length k; the sequences of one message have equal lengths.

    Args:
        structure: the type.
        rows: number of messages.
        fields: values by leaf path.
        where: topic named in errors.

    Raises:
        LogError: ``field_not_found``, ``bad_column``.
    """
    leaves = tuple(leaf_paths(structure))
    for path in fields:
        if path not in leaves:
            hint = f"The type has: {', '.join(leaves)}"
            raise LogError("field_not_found", f"there is not a field {path}", where=where, hint=hint)
    if rows == 0:
        return {}
    wanted = dict(wanted_leaves(plan_fields(structure, set(fields))))
    columns: dict[str, Column] = {}
    for path, leaf in wanted.items():
        try:
            columns[path] = _normalize(fields[path], leaf, rows, inside="[]." in path)
        except (ValueError, TypeError, OverflowError) as error:
            hint = f"Give one value, or {rows} of the field's type"
            raise LogError("bad_column", f"field {path}: {error}", where=where, hint=hint) from None
    _match_sequences(columns, rows, where)
    return columns


def _normalize(given: Given, leaf: Leaf, rows: int, *, inside: bool) -> Column:
    if leaf.text:
        return _normalize_texts(given, leaf, rows, inside=inside)
    if isinstance(given, Ragged):
        return Ragged(_cast(given.values, leaf.nothing.dtype), _check_offsets(given.offsets, rows))
    if leaf.ragged and isinstance(given, Sequence) and not isinstance(given, str):
        each_row = [np.atleast_1d(np.asarray(each)) for each in given]
        sizes = [row.size for row in each_row]
        if len(set(sizes)) > 1:
            joined = np.concatenate(each_row)
            return Ragged(_cast(joined, leaf.nothing.dtype), _check_offsets(np.r_[0, np.cumsum(sizes)], rows))
    values = _cast(np.asarray(given), leaf.nothing.dtype)
    width = leaf.nothing.shape[1:]
    if leaf.ragged:
        values = (
            values.reshape(rows, -1)
            if values.ndim and values.shape[0] == rows
            else np.broadcast_to(values, (rows, values.size if values.ndim else 1))
        )
        count = values.shape[1]
        return Ragged(values.reshape(-1), np.arange(rows + 1, dtype=np.int64) * count)
    return np.broadcast_to(values, (rows, *width))


def _normalize_texts(given: Given, leaf: Leaf, rows: int, *, inside: bool) -> Column:
    if isinstance(given, RaggedStrings):
        _check_offsets(given.offsets, rows)
        return given if leaf.ragged else Strings(given.codes, given.values)
    if isinstance(given, Strings):
        if given.codes.size != rows:
            raise ValueError(f"{given.codes.size} strings for {rows} messages")
        if not leaf.ragged:
            return given
        return RaggedStrings(given.codes, given.values, np.arange(rows + 1, dtype=np.int64))
    if isinstance(given, str):
        codes = np.zeros(rows, dtype=np.int32)
        return _normalize_texts(Strings(codes, (given,)), leaf, rows, inside=inside)
    if not isinstance(given, Sequence | np.ndarray):
        raise TypeError(f"{given!r} is not a string")
    items = given.tolist() if isinstance(given, np.ndarray) else list(given)
    nested = bool(items) and not isinstance(items[0], str)
    if leaf.ragged and not nested and (not inside or len(items) != rows):
        items, nested = [items] * rows, True
    if len(items) != rows:
        raise ValueError(f"{len(items)} strings for {rows} messages")
    lists = [_as_list(each) for each in items]
    numbers: dict[str, int] = {}
    codes = np.array([numbers.setdefault(t, len(numbers)) for each in lists for t in each], dtype=np.int32)
    if not leaf.ragged:
        return Strings(codes, tuple(numbers))
    offsets = np.r_[0, np.cumsum([len(each) for each in lists], dtype=np.int64)]
    return RaggedStrings(codes, tuple(numbers), offsets)


def _as_list(given: object) -> list[str]:
    if isinstance(given, Sequence | np.ndarray) and not isinstance(given, str):
        return [str(text) for text in given]
    return [str(given)]


def _cast(values: NDArray[np.generic], kind: np.dtype[np.generic]) -> NDArray[np.generic]:
    if kind == values.dtype:
        return values
    with np.errstate(invalid="ignore"):
        cast = values.astype(kind)
    if kind.kind in "iu" and not (cast == values).all():
        raise ValueError(f"the values do not fit {kind.name}")
    return cast


def _check_offsets(offsets: Ints, rows: int) -> Ints:
    if offsets.size != rows + 1:
        raise ValueError(f"sequences of {offsets.size - 1} messages for {rows}")
    return offsets.astype(np.int64)


def _match_sequences(columns: Mapping[str, Column], rows: int, where: str) -> None:
    counts: dict[str, tuple[str, Ints]] = {}
    for path, column in columns.items():
        owner, inside, _ = path.rpartition("[].")
        if not inside or not isinstance(column, Ragged | RaggedStrings):
            continue
        known = counts.setdefault(owner, (path, np.diff(column.offsets)))
        if not np.array_equal(known[1], np.diff(column.offsets)):
            raise LogError(
                "bad_column",
                f"fields {known[0]} and {path} have sequences of different lengths",
                where=where,
                hint=f"Give both for the same elements of the {rows} messages",
            )


# Serializing columns as CDR, rows of the same layout as one block.
#
# The rows are grouped by the lengths of their strings and sequences; within a group every field has one
# offset, and writing it is one strided copy. Little-endian XCDR1, as ROS 2 recorders write.

_ENCAPSULATION: Final = b"\x00\x01\x00\x00"


@dataclass(slots=True)
class _Buffer:
    """Rows of one layout being written: blocks of bytes with their offsets after the encapsulation."""

    rows: int
    position: int = 0
    written: list[tuple[int, NDArray[np.uint8]]] = field(default_factory=list)

    def put(self, kind: str, values: NDArray[np.generic]) -> None:
        size = SIZES[kind]
        self.position = -(-self.position // size) * size
        stored = np.ascontiguousarray(
            values.reshape(self.rows, -1), dtype=NUMBER_TYPES[kind].newbyteorder("<")
        )
        self.put_bytes(stored.view(np.uint8).reshape(self.rows, -1))

    def put_bytes(self, block: NDArray[np.uint8]) -> None:
        self.written.append((self.position, block))
        self.position += block.shape[1]

    def put_length(self, length: int) -> None:
        self.put("uint32", np.full((self.rows, 1), length, dtype=np.uint32))

    def fill(self) -> NDArray[np.uint8]:
        head = len(_ENCAPSULATION)
        block = np.zeros((self.rows, head + self.position), dtype=np.uint8)
        block[:, :head] = np.frombuffer(_ENCAPSULATION, dtype=np.uint8)
        for position, part in self.written:
            block[:, head + position : head + position + part.shape[1]] = part
        return block


def encode_rows(
    structure: Structure, rows: int, fields: Mapping[str, Given], *, where: str
) -> Iterator[tuple[Ints, NDArray[np.uint8]]]:
    """Serialize messages.

    Args:
        structure: type of the messages.
        rows: number of messages.
        fields: values by leaf path; absent fields are zero or empty.
        where: topic named in errors.

    Yields:
        Indices of the rows of one layout, and their payloads as (m, length) bytes.

    Raises:
        LogError: ``field_not_found``, ``bad_column``.
    """
    columns = normalize_columns(structure, rows, fields, where=where)
    texts = {path: _encode_texts(column) for path, column in columns.items()}
    for chosen in _group_by_layout(columns, texts, rows):
        buffer = _Buffer(chosen.size)
        _Writer(columns, texts, buffer).write(structure, chosen, "", None)
        yield chosen, buffer.fill()


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
    buffer: _Buffer

    def write(self, structure: Structure, rows: Ints, prefix: str, element: int | None) -> None:
        """Write one structure of every row; ``element`` is its index in the enclosing sequence."""
        if not structure.members:
            self.buffer.put("uint8", np.zeros((rows.size, 1), dtype=np.uint8))
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
            self.buffer.put_length(count or 0)
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
                self.buffer.put(kind, column.values[start + element])
                return
            count = int(column.offsets[rows[0] + 1] - start[0])
            self.buffer.put_length(count)
            if count:
                self.buffer.put(kind, column.values[start[:, None] + np.arange(count)])
        elif isinstance(column, np.ndarray):
            self.buffer.put(kind, column[rows])
        elif member.count == SEQUENCE:
            self.buffer.put_length(0)
        else:
            width = 1 if member.count is None else member.count
            self.buffer.put(kind, np.zeros((rows.size, width), dtype=NUMBER_TYPES[kind]))

    def _write_texts(self, member: Member, rows: Ints, path: str, element: int | None) -> None:
        column = self.columns.get(path)
        if isinstance(column, RaggedStrings):
            start = column.offsets[rows]
            if element is not None:
                self._write_codes(path, column.codes[start + element])
                return
            count = int(column.offsets[rows[0] + 1] - start[0])
            if member.count == SEQUENCE:
                self.buffer.put_length(count)
            for number in range(count):
                self._write_codes(path, column.codes[start + number])
        elif isinstance(column, Strings):
            self._write_codes(path, column.codes[rows])
        elif member.count == SEQUENCE:
            self.buffer.put_length(0)
        else:
            for _ in range(1 if member.count is None else member.count):
                self.buffer.put_length(1)
                self.buffer.put_bytes(np.zeros((rows.size, 1), dtype=np.uint8))

    def _write_codes(self, path: str, codes: NDArray[np.int32]) -> None:
        present, position = np.unique(codes, return_inverse=True)
        texts = [self.texts[path][code] for code in present.tolist()]
        length = len(texts[0])
        table = np.frombuffer(b"".join(texts), dtype=np.uint8).reshape(len(texts), length)
        self.buffer.put_length(length)
        self.buffer.put_bytes(table[position.reshape(-1)])
