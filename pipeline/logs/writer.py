"""Atomic writing of indexed MCAP files from columns, with messages in the order of their log times.

The accepted forms of a column are normalized, and columns serialized as CDR in blocks.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pipeline.core import Flags, Ints, group_rows, name_first
from pipeline.logs.cdr import RowBuffer, RowWriter
from pipeline.logs.columns import Column, Ragged, RaggedStrings, Strings
from pipeline.logs.decode import Leaf, plan_fields, wanted_leaves
from pipeline.logs.records import LogError, unsupported
from pipeline.logs.schema import Structure, definition_text, leaf_paths, parse_msg

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
            hint = f"The type has: {name_first(leaves)}"
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
    column = RaggedStrings.of_texts([_as_list(each) for each in items])
    return column if leaf.ragged else Strings(column.codes, column.values)


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
        buffer = RowBuffer(chosen.size)
        RowWriter(columns, texts, buffer).write(structure, chosen, "", None)
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


LIBRARY: Final = "slip-pipeline"
COMPRESSIONS: Final = {"": "NONE", "lz4": "LZ4", "zstd": "ZSTD"}
_SECOND: Final = 1_000_000_000


class _Type(NamedTuple):
    schema_id: int
    structure: Structure


class _Rows(NamedTuple):
    """Messages of one channel and length: log times [ns], sequence numbers (n,), payloads (n, length)."""

    channel: int
    log_time: Ints
    sequence: Ints
    payloads: NDArray[np.uint8]

    def select(self, chosen: Flags) -> _Rows:
        return _Rows(self.channel, *(getattr(self, name)[chosen] for name in self._fields[1:]))


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
        self._waiting: list[_Rows] = []
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
            fields: values by leaf path (see ``normalize_columns``); absent fields are zero or empty.
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
        for rows, payloads in encode_rows(kind.structure, log.size, given, where=topic):
            self._waiting.append(_Rows(channel, log[rows], first + rows, payloads))

    def close(self) -> None:
        """Write all remaining messages and rename the file to its final name."""
        self._write(self._waiting)
        self._waiting = []
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        self._draft.replace(self._path)

    def _write(self, waiting: list[_Rows]) -> None:
        empty = np.empty(0, dtype=np.int64)
        log = np.concatenate([empty, *(rows.log_time for rows in waiting)])
        owner = np.concatenate([empty, *(np.full(rows.log_time.size, n) for n, rows in enumerate(waiting))])
        inside = np.concatenate([empty, *(np.arange(rows.log_time.size) for rows in waiting)])
        # Messages with equal times stay in the order in which they were added.
        order = np.argsort(log, kind="stable")
        for number, row in zip(owner[order].tolist(), inside[order].tolist(), strict=True):
            rows = waiting[number]
            time, payload = int(rows.log_time[row]), rows.payloads[row].tobytes()
            self._mcap.add_message(rows.channel, time, payload, time, int(rows.sequence[row]))

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
