"""Writing MCAP from columns: messages in the order of their log times, indexed, atomically."""

from __future__ import annotations

import os
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final

import numpy as np

from pipeline.logs import records as rec
from pipeline.logs.definitions import definition_text
from pipeline.logs.encode import encode_rows
from pipeline.logs.errors import LogError
from pipeline.logs.messages import MESSAGE_HEAD, MESSAGE_OVERHEAD
from pipeline.logs.pack import (
    ChunkSummary,
    pack_channel,
    pack_chunk,
    pack_metadata,
    pack_record,
    pack_schema,
    pack_summary,
    pack_text,
)
from pipeline.logs.schema import leaf_paths, parse_msg
from pipeline.logs.spool import Spool

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import TracebackType
    from typing import Self

    from numpy.typing import NDArray

    from pipeline.logs.normalize import Given
    from pipeline.logs.schema import Structure

    Ints = NDArray[np.int64]

LIBRARY: Final = "slip-pipeline"
COMPRESSIONS: Final = ("", "lz4", "zstd")
_SECOND: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class _Type:
    number: int
    structure: Structure
    record: bytes


@dataclass(slots=True)
class _Channel:
    number: int
    kind: _Type
    record: bytes
    messages: int = 0


class LogWriter:
    """Writes one MCAP file; it appears under its name when it is whole.

    Args:
        path: the file; an existing one is replaced.
        chunk_size: bytes of records in a chunk before compression.
        compression: ``"zstd"``, ``"lz4"`` or ``""``.

    Raises:
        LogError: ``unsupported_encoding`` for another compression, ``log_unreadable`` where nothing can be
            written.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, chunk_size: int = 1 << 20, compression: str = "zstd"
    ) -> None:
        if compression not in COMPRESSIONS:
            raise LogError(
                "unsupported_encoding",
                f"chunks cannot be compressed with {compression!r}",
                where=str(path),
                hint=f"Use one of {', '.join(map(repr, COMPRESSIONS))}",
            )
        self._path = Path(path)
        self._draft = self._path.with_name(f".{self._path.name}.{os.getpid()}.part")
        self._chunk_size = chunk_size
        self._compression = compression
        self._types: dict[str, _Type] = {}
        self._channels: dict[tuple[str, str], _Channel] = {}
        self._crc = 0
        self._has_begun = False
        self._metadata: list[tuple[str, Mapping[str, str]]] = []
        self._places: list[tuple[int, int, str]] = []
        self._chunks: list[ChunkSummary] = []
        self._written: set[bytes] = set()
        self._spool = Spool(self._path)
        try:
            self._file: BinaryIO = self._draft.open("wb")
        except OSError as error:
            raise LogError(
                "log_unreadable",
                f"nothing can be written there ({error.strerror})",
                where=str(path),
                hint="Choose another folder or check its permissions",
            ) from None

    def metadata(self, name: str, record: Mapping[str, str]) -> None:
        """Add a metadata record."""
        self._metadata.append((name, dict(record)))

    def write_columns(
        self,
        topic: str,
        type_name: str,
        log_time: NDArray[np.int64],
        fields: Mapping[str, Given],
        *,
        publish_time: NDArray[np.int64] | None = None,
        header_time: NDArray[np.int64] | None = None,
        definition: str | None = None,
    ) -> None:
        """Add messages to a topic; may be called again for the same topic.

        Args:
            topic: name of the topic.
            type_name: ``package/msg/Name``.
            log_time: [ns], int64, shape (n,), in any order.
            fields: values by leaf path (see ``normalize_columns``); what is absent is zero or empty.
            publish_time: [ns]; the log times by default.
            header_time: stamps [ns] for ``header.stamp``, or for ``transforms[].header.stamp``.
            definition: ``ros2msg`` definition of a type that is not bundled.

        Raises:
            LogError: ``unknown_type``, ``field_not_found``, ``bad_column``.
        """
        log = np.asarray(log_time, dtype=np.int64).reshape(-1)
        publish = log if publish_time is None else np.asarray(publish_time, dtype=np.int64).reshape(-1)
        if publish.size != log.size:
            raise LogError(
                "bad_column",
                f"{publish.size} publish times for {log.size} messages",
                where=topic,
                hint="Give one a message",
            )
        if log.size and min(log.min(), publish.min()) < 0:
            raise LogError(
                "bad_column",
                "a log or publish time lies before 1970",
                where=topic,
                hint="Times are nanoseconds since 1970, zero or later",
            )
        kind = self._type(type_name, definition)
        given = dict(fields)
        if header_time is not None:
            given = {**_stamp_fields(kind.structure, np.asarray(header_time, dtype=np.int64), topic), **given}
        channel = self._channel(topic, kind)
        first, channel.messages = channel.messages, channel.messages + log.size
        for rows, payloads in encode_rows(kind.structure, log.size, given, where=topic):
            records = np.empty((rows.size, MESSAGE_OVERHEAD + payloads.shape[1]), dtype=np.uint8)
            head = np.empty(rows.size, dtype=MESSAGE_HEAD)
            head["opcode"], head["length"] = rec.MESSAGE, records.shape[1] - rec.HEAD_SIZE
            head["channel"], head["sequence"] = channel.number, first + rows
            head["log_time"], head["publish_time"] = log[rows], publish[rows]
            records[:, :MESSAGE_OVERHEAD] = head.view(np.uint8).reshape(rows.size, -1)
            records[:, MESSAGE_OVERHEAD:] = payloads
            self._spool.add(records, channel.number, log[rows])

    def write_before(self, log_time: int) -> None:
        """Write what was logged before a time, so that memory holds only what comes later.

        Messages that are added afterwards should be later: earlier ones are written too, but then stand in a
        chunk that overlaps those before it.

        Args:
            log_time: [ns].
        """
        self._begin()
        self._write_chunks(log_time)

    def close(self) -> None:
        """Write everything and put the file in its place."""
        self._begin()
        self._write_chunks(None)
        kinds = [kind.record for kind in self._types.values()]
        channels = [channel.record for channel in self._channels.values()]
        for record in [*kinds, *channels]:
            self._put(b"" if record in self._written else record)
        self._put_metadata()
        self._put(pack_record(rec.DATA_END, self._crc.to_bytes(4, "little")))
        self._put(pack_summary(self._file.tell(), kinds, channels, self._chunks, self._places))
        self._put(rec.MAGIC)
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        self._spool.close()
        self._draft.replace(self._path)

    def _begin(self) -> None:
        if self._has_begun:
            return
        self._has_begun = True
        self._put(rec.MAGIC)
        self._put(pack_record(rec.HEADER, pack_text("ros2") + pack_text(LIBRARY)))
        self._put_metadata()

    def _put_metadata(self) -> None:
        for name, entries in self._metadata:
            packed = pack_metadata(name, entries)
            self._places.append((self._file.tell(), len(packed), name))
            self._put(packed)
        self._metadata = []

    def _write_chunks(self, before: int | None) -> None:
        by_number = {channel.number: channel for channel in self._channels.values()}
        for batch in self._spool.batches(self._chunk_size, before):
            side = b""
            for number in np.unique(batch.channel).tolist():
                for record in (by_number[number].kind.record, by_number[number].record):
                    side += b"" if record in self._written else record
                    self._written.add(record)
            packed, indexes, summary = pack_chunk(batch, side, self._compression)
            self._chunks.append(replace(summary, offset=self._file.tell()))
            self._put(packed)
            self._put(indexes)

    def discard(self) -> None:
        """Leave no trace."""
        self._file.close()
        self._spool.close()
        self._draft.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self.discard()
            return
        try:
            self.close()
        except BaseException:
            self.discard()
            raise

    def _put(self, packed: bytes) -> None:
        self._crc = zlib.crc32(packed, self._crc)
        self._file.write(packed)

    def _type(self, name: str, definition: str | None) -> _Type:
        known = self._types.get(name)
        if known is not None:
            return known
        text = definition_text(name) if definition is None else definition
        if text is None:
            raise LogError(
                "unknown_type",
                f"no definition of {name} is bundled",
                where=str(self._path),
                hint="Give `definition`, or use one of the standard types",
            )
        number = len(self._types) + 1
        record = pack_schema(number, name, "ros2msg", text.encode())
        self._types[name] = _Type(number, parse_msg(name, text), record)
        return self._types[name]

    def _channel(self, topic: str, kind: _Type) -> _Channel:
        key = (topic, kind.structure.name)
        if key not in self._channels:
            number = len(self._channels) + 1
            self._channels[key] = _Channel(number, kind, pack_channel(number, kind.number, topic, "cdr"))
        return self._channels[key]


def _stamp_fields(structure: Structure, stamp: Ints, where: str) -> dict[str, Given]:
    leaves = set(leaf_paths(structure))
    for prefix in ("header.stamp.", "transforms[].header.stamp."):
        if f"{prefix}sec" in leaves:
            return {f"{prefix}sec": stamp // _SECOND, f"{prefix}nanosec": stamp % _SECOND}
    raise LogError(
        "field_not_found",
        f"{structure.name} has no header for the stamps",
        where=where,
        hint="Leave header_time out",
    )
