"""Atomic writing of indexed MCAP files from columns, with messages in the order of their log times."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from pipeline.core.arrays import Flags, Ints
from pipeline.logs.encode import Given, encode_rows
from pipeline.logs.records import LogError, unsupported
from pipeline.logs.schema import Structure, definition_text, leaf_paths, parse_msg

LIBRARY: Final = "slip-pipeline"
COMPRESSIONS: Final = {"": "NONE", "lz4": "LZ4", "zstd": "ZSTD"}
_SECOND: Final = 1_000_000_000


class _Type(NamedTuple):
    schema_id: int
    structure: Structure


class _Rows(NamedTuple):
    """Messages of one channel and one length: times [ns] and sequence numbers (n,), payloads (n, length)."""

    channel: int
    log_time: Ints
    publish_time: Ints
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
        publish_time: Ints | None = None,
        header_time: Ints | None = None,
        definition: str | None = None,
    ) -> None:
        """Add messages to a topic; may be called again for the same topic.

        Args:
            topic: name of the topic.
            type_name: ``package/msg/Name``.
            log_time: [ns], int64, shape (n,), in any order.
            fields: values by leaf path (see ``normalize_columns``); absent fields are zero or empty.
            publish_time: [ns]; the log times by default.
            header_time: stamps [ns] for ``header.stamp``, or for ``transforms[].header.stamp``.
            definition: ``ros2msg`` definition of a type that is not bundled.

        Raises:
            LogError: ``unknown_type``, ``field_not_found``, ``bad_column``.
        """
        log = np.asarray(log_time, dtype=np.int64).reshape(-1)
        publish = log if publish_time is None else np.asarray(publish_time, dtype=np.int64).reshape(-1)
        if publish.size != log.size:
            what = f"{publish.size} publish times for {log.size} messages"
            raise LogError("bad_column", what, where=topic, hint="Give one a message")
        if log.size and min(log.min(), publish.min()) < 0:
            hint = "Times are nanoseconds since 1970, zero or later"
            raise LogError("bad_column", "a log or publish time lies before 1970", where=topic, hint=hint)
        kind = self._type(type_name, definition)
        given = dict(fields)
        if header_time is not None:
            given = {**_stamp_fields(kind.structure, np.asarray(header_time, dtype=np.int64), topic), **given}
        channel = self._channel(topic, kind)
        first = self._sequences[channel]
        self._sequences[channel] += log.size
        for rows, payloads in encode_rows(kind.structure, log.size, given, where=topic):
            self._waiting.append(_Rows(channel, log[rows], publish[rows], first + rows, payloads))

    def write_before(self, log_time: int) -> None:
        """Write the messages logged before a time and free their memory.

        Messages added afterwards should be later: earlier ones are written too, but in a chunk that overlaps
        the previous ones.

        Args:
            log_time: [ns].
        """
        waiting = self._waiting
        self._write([rows.select(rows.log_time < log_time) for rows in waiting])
        later = [rows.select(rows.log_time >= log_time) for rows in waiting]
        self._waiting = [rows for rows in later if rows.log_time.size]

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
            self._mcap.add_message(
                rows.channel,
                int(rows.log_time[row]),
                rows.payloads[row].tobytes(),
                int(rows.publish_time[row]),
                int(rows.sequence[row]),
            )

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
