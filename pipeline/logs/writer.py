"""Atomic writing of indexed MCAP files from columns, with messages in the order of their log times.

The accepted forms of a column are normalized, and columns serialized as CDR in blocks.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import pairwise, repeat
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pipeline.core import PACKAGE, Ints, group_by, name_first
from pipeline.logs.columns import Column, Ragged, RaggedStrings, Strings
from pipeline.logs.decode import Leaf, plan_fields, wanted_leaves
from pipeline.logs.records import LogError, unsupported
from pipeline.logs.schema import (
    NUMBER_TYPES,
    SEQUENCE,
    SIZES,
    Member,
    Structure,
    definition_text,
    leaf_paths,
    parse_msg,
)

Given: TypeAlias = "NDArray[np.generic] | Ragged | RaggedStrings | Strings | float | str | Sequence[object]"
"""One value for all messages, or one per message."""


def encode_rows(structure: Structure, rows: int, fields: Mapping[str, Given], *, where: str) -> list[bytes]:
    """Serialize messages as CDR: little-endian XCDR1, as ROS 2 recorders write.

    A single number or string applies to all messages, and so does one list of strings for a sequence of
    strings. For a field in a sequence of structures, one value per message gives sequences of length one, an
    array (n, k) sequences of length k; the sequences of one message have equal lengths.

    Args:
        structure: type of the messages.
        rows: number of messages.
        fields: values by leaf path; absent fields are zero or empty.
        where: topic named in errors.

    Raises:
        LogError: ``field_not_found``, ``bad_column``.
    """
    leaves = tuple(leaf_paths(structure))
    for path in fields:
        if path not in leaves:
            hint = f"The type has: {name_first(leaves)}"
            raise LogError("field_not_found", f"there is not a field {path}", where=where, hint=hint)
    if rows == 0:
        return []
    columns: dict[str, Column] = {}
    for path, leaf in wanted_leaves(plan_fields(structure, set(fields))):
        try:
            columns[path] = _normalize(fields[path], leaf, rows, inside="[]." in path)
        except (ValueError, TypeError, OverflowError) as error:
            hint = f"Give one value, or {rows} of the field's type"
            raise LogError("bad_column", f"field {path}: {error}", where=where, hint=hint) from None
    _match_sequences(columns, rows, where)
    texts = {
        path: [text.encode() + b"\0" for text in column.values]
        for path, column in columns.items()
        if isinstance(column, Strings | RaggedStrings)
    }
    payloads = [b""] * rows
    for chosen in _group_by_layout(columns, texts, rows):
        writer = _RowWriter(
            {path: _select(column, chosen) for path, column in columns.items()}, texts, chosen
        )
        writer.write(structure, "", None)
        for row, payload in zip(chosen.tolist(), writer.fill(), strict=True):
            payloads[row] = payload.tobytes()
    return payloads


def _normalize(given: Given, leaf: Leaf, rows: int, *, inside: bool) -> Column:
    """Column of a field as reading would return it."""
    if leaf.text:
        return _normalize_texts(given, leaf, rows, inside=inside)
    kind, width = leaf.nothing.dtype, leaf.nothing.shape[1:]
    if leaf.ragged and isinstance(given, Sequence) and not isinstance(given, str):
        each_row = [np.atleast_1d(np.asarray(each)) for each in given]
        sizes = [row.size for row in each_row]
        if len(set(sizes)) > 1:
            given = Ragged(np.concatenate(each_row), np.r_[0, np.cumsum(sizes)])
    if isinstance(given, Ragged):
        if len(given) != rows:
            raise ValueError(f"sequences of {len(given)} messages for {rows}")
        return Ragged(_cast(given.values, kind), given.offsets.astype(np.int64))
    values = _cast(np.asarray(given), kind)
    if not leaf.ragged:
        return np.broadcast_to(values, (rows, *width))
    if not values.ndim or values.shape[0] != rows:
        values = np.broadcast_to(values, (rows, values.size))
    values = values.reshape(rows, -1)
    return Ragged(values.reshape(-1), np.arange(rows + 1, dtype=np.int64) * values.shape[1])


def _normalize_texts(given: Given, leaf: Leaf, rows: int, *, inside: bool) -> Column:
    column = given
    if not isinstance(column, RaggedStrings):
        if not isinstance(given, Strings | Sequence | np.ndarray):
            raise TypeError(f"{given!r} is not a string")
        items: list[Any] = given.to_list() if isinstance(given, Strings) else list(given)
        if isinstance(given, str):
            items = [[given]] * rows
        elif (
            leaf.ragged
            and not (inside and len(items) == rows)
            and all(isinstance(each, str) for each in items)
        ):
            items = [items] * rows
        column = RaggedStrings.of_texts(
            [[each] if isinstance(each, str) else list(map(str, each)) for each in items]
        )
    if len(column) != rows:
        raise ValueError(f"{len(column)} strings for {rows} messages")
    return column if leaf.ragged else column.at(0)


def _cast(values: NDArray[np.generic], kind: np.dtype[np.generic]) -> NDArray[np.generic]:
    with np.errstate(invalid="ignore"):
        cast = values.astype(kind, copy=False)
    if kind.kind in "iu" and not (cast == values).all():
        raise ValueError(f"the values do not fit {kind.name}")
    return cast


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


def _group_by_layout(
    columns: Mapping[str, Column], texts: Mapping[str, list[bytes]], rows: int
) -> list[Ints]:
    """Rows whose strings and sequences have equal lengths: in them every field has one place."""
    layouts: list[tuple[object, ...]] = [()] * rows
    for path, column in columns.items():
        lengths = np.array([len(text) for text in texts.get(path, ())], dtype=np.int64)
        keys: list[Any] = []
        if isinstance(column, Strings):
            keys = lengths[column.codes].tolist()
        elif isinstance(column, RaggedStrings) and np.unique(lengths).size > 1:
            each = lengths[column.codes]
            keys = [each[a:b].tobytes() for a, b in pairwise(column.offsets.tolist())]
        elif isinstance(column, Ragged | RaggedStrings):
            keys = np.diff(column.offsets).tolist()
        if any(key != keys[0] for key in keys):
            layouts = [(*layout, key) for layout, key in zip(layouts, keys, strict=True)]
    return [np.array(each) for each in group_by(zip(layouts, range(rows), strict=True)).values()]


def _select(column: Column, rows: Ints) -> NDArray[np.generic]:
    """Numbers or codes of strings of rows of one layout, shape (n, ...)."""
    if isinstance(column, np.ndarray):
        return column[rows]
    values = column.values if isinstance(column, Ragged) else column.codes
    if isinstance(column, Strings):
        return values[rows]
    start, count = column.offsets[rows], np.diff(column.offsets)[rows[0]]
    return values[start[:, None] + np.arange(count)]


_ENCAPSULATION: Final = b"\x00\x01\x00\x00"


class _RowWriter:
    """Writes rows of one layout: every field is one block of bytes at one offset after the encapsulation.

    Args:
        columns: numbers or codes of strings by leaf path, shape (n, ...).
        texts: encoded strings by leaf path and code.
        rows: the rows, shape (n,).
    """

    def __init__(
        self, columns: Mapping[str, NDArray[np.generic]], texts: Mapping[str, list[bytes]], rows: Ints
    ) -> None:
        self._columns, self._texts, self._rows = columns, texts, rows.size
        self._written: list[tuple[int, NDArray[np.uint8]]] = []
        self._end = 0

    def write(self, structure: Structure, prefix: str, element: int | None) -> None:
        """Write one structure of every row; ``element`` is its index in the enclosing sequence."""
        if not structure.members:
            self._put("uint8", np.zeros(self._rows))
        for member in structure.members:
            path = f"{prefix}{member.name}"
            if not isinstance(member.element, Structure):
                self._write_leaf(member, member.element, path, element)
            elif member.count is None:
                self.write(member.element, f"{path}.", element)
            else:
                below = (column for name, column in self._columns.items() if name.startswith(f"{path}[]."))
                count = next((column.shape[1] for column in below), 0)
                if member.count == SEQUENCE:
                    self._put("uint32", np.full(self._rows, count))
                for number in range(count if member.count == SEQUENCE else member.count):
                    self.write(member.element, f"{path}[].", number)

    def _write_leaf(self, member: Member, kind: str, path: str, element: int | None) -> None:
        values = self._columns.get(path)
        if values is None:
            width = {None: 1, SEQUENCE: 0}.get(member.count, member.count)
            values = np.zeros((self._rows, width or 0), dtype=np.int64)
        elif element is not None:
            values = values[:, element]
        values = values.reshape(self._rows, -1)
        if member.count == SEQUENCE:
            self._put("uint32", np.full(self._rows, values.shape[1]))
        if kind != "string":
            self._put(kind, values)
            return
        for codes in values.T:
            present, position = np.unique(codes, return_inverse=True)
            texts = [self._texts.get(path, [b"\0"])[code] for code in present.tolist()]
            table = np.frombuffer(b"".join(texts), dtype=np.uint8).reshape(len(texts), -1)
            self._put("uint32", np.full(self._rows, table.shape[1]))
            self._put("uint8", table[position.reshape(-1)])

    def _put(self, kind: str, values: NDArray[np.generic]) -> None:
        """Append aligned numbers, the same number to every row."""
        if values.size:
            size = SIZES[kind]
            stored = np.ascontiguousarray(
                values.reshape(self._rows, -1), dtype=NUMBER_TYPES[kind].newbyteorder("<")
            )
            block = stored.view(np.uint8).reshape(self._rows, -1)
            start = -(-self._end // size) * size
            self._written.append((start, block))
            self._end = start + block.shape[1]

    def fill(self) -> NDArray[np.uint8]:
        """The payloads as bytes, shape (n, length)."""
        head = len(_ENCAPSULATION)
        filled = np.zeros((self._rows, head + self._end), dtype=np.uint8)
        filled[:, :head] = np.frombuffer(_ENCAPSULATION, dtype=np.uint8)
        for start, block in self._written:
            filled[:, head + start : head + start + block.shape[1]] = block
        return filled


LIBRARY: Final = PACKAGE
COMPRESSIONS: Final = {"": "NONE", "lz4": "LZ4", "zstd": "ZSTD"}
_SECOND: Final = 1_000_000_000


class _Type(NamedTuple):
    schema_id: int
    structure: Structure


class LogWriter:
    """Writes one MCAP file under a temporary name, and renames it when it is complete.

    Args:
        path: the file; an existing one is replaced.
        chunk_size: size of a chunk before compression [bytes].
        compression: ``"zstd"``, ``"lz4"`` or ``""``.

    Raises:
        LogError: ``unsupported_encoding`` for another compression, ``log_unreadable`` if the file cannot
            be written.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, chunk_size: int = 1 << 20, compression: str = "zstd"
    ) -> None:
        if compression not in COMPRESSIONS:
            hint = f"Use one of {', '.join(map(repr, COMPRESSIONS))}"
            raise unsupported(f"chunks cannot be compressed with {compression!r}", str(path), hint)
        from mcap.writer import CompressionType, Writer  # noqa: PLC0415 - only writing needs it

        self._path = Path(path)
        self._draft = self._path.with_name(f".{self._path.name}.{os.getpid()}.part")
        self._types: dict[str, _Type] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._sequences: dict[int, int] = {}
        self._waiting: list[tuple[int, int, int, bytes]] = []
        try:
            self._file: BinaryIO = self._draft.open("wb")
        except OSError as error:
            raise LogError(
                "log_unreadable",
                f"nothing can be written there ({error.strerror})",
                where=str(path),
                hint="Choose another folder or check its permissions",
            ) from None
        self._mcap = Writer(
            self._file,
            chunk_size=chunk_size,
            compression=CompressionType[COMPRESSIONS[compression]],
            enable_data_crcs=True,
        )
        self._mcap.start(profile="ros2", library=LIBRARY)

    def metadata(self, name: str, record: Mapping[str, str]) -> None:
        """Add a metadata record."""
        self._mcap.add_metadata(name, dict(record))

    def write_columns(
        self,
        topic: str,
        type_name: str,
        log_time: Ints,
        fields: Mapping[str, Given],
        *,
        header_time: Ints | None = None,
        definition: str | None = None,
    ) -> None:
        """Add messages to a topic; may be called again for the same topic.

        Args:
            topic: name of the topic.
            type_name: ``package/msg/Name``.
            log_time: [ns], int64, shape (n,), in any order.
            fields: values by leaf path (see ``encode_rows``); absent fields are zero or empty.
            header_time: stamps [ns] for ``header.stamp``, or for ``transforms[].header.stamp``.
            definition: ``ros2msg`` definition of a type that is not bundled.

        Raises:
            LogError: ``unknown_type``, ``field_not_found``, ``bad_column``.
        """
        log = np.asarray(log_time, dtype=np.int64).reshape(-1)
        if log.min(initial=0) < 0:
            hint = "Times are nanoseconds since 1970, zero or later"
            raise LogError("bad_column", "a log time lies before 1970", where=topic, hint=hint)
        kind = self._type(type_name, definition)
        given = dict(fields)
        if header_time is not None:
            given = {**_stamp_fields(kind.structure, np.asarray(header_time, dtype=np.int64), topic), **given}
        channel = self._channel(topic, kind)
        first = self._sequences[channel]
        self._sequences[channel] += log.size
        payloads = encode_rows(kind.structure, log.size, given, where=topic)
        rows = range(first, first + log.size)
        self._waiting += zip(log.tolist(), repeat(channel), rows, payloads, strict=False)

    def close(self) -> None:
        """Write all remaining messages and rename the file to its final name."""
        # Messages with equal times stay in the order in which they were added.
        for time, channel, number, payload in sorted(self._waiting, key=itemgetter(0)):
            self._mcap.add_message(channel, time, payload, time, number)
        self._waiting = []
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        self._draft.replace(self._path)

    def discard(self) -> None:
        """Delete the unfinished file."""
        self._file.close()
        self._draft.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self.discard()
            return
        try:
            self.close()
        except BaseException:
            self.discard()
            raise

    def _type(self, name: str, definition: str | None) -> _Type:
        known = self._types.get(name)
        if known is not None:
            return known
        text = definition_text(name) if definition is None else definition
        if text is None:
            hint = "Give `definition`, or use one of the standard types"
            raise LogError(
                "unknown_type", f"no definition of {name} is bundled", where=str(self._path), hint=hint
            )
        number = self._mcap.register_schema(name, "ros2msg", text.encode())
        self._types[name] = _Type(number, parse_msg(name, text))
        return self._types[name]

    def _channel(self, topic: str, kind: _Type) -> int:
        key = (topic, kind.structure.name)
        if key not in self._channels:
            channel = self._mcap.register_channel(topic, "cdr", kind.schema_id)
            self._channels[key], self._sequences[channel] = channel, 0
        return self._channels[key]


def _stamp_fields(structure: Structure, stamp: Ints, where: str) -> dict[str, Given]:
    leaves = set(leaf_paths(structure))
    for prefix in ("header.stamp.", "transforms[].header.stamp."):
        if f"{prefix}sec" in leaves:
            return {f"{prefix}sec": stamp // _SECOND, f"{prefix}nanosec": stamp % _SECOND}
    hint = "Leave header_time out"
    raise LogError(
        "field_not_found", f"{structure.name} has no header for the stamps", where=where, hint=hint
    )
