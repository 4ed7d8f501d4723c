"""What logs are made of: kinds of files by their first bytes, records of an MCAP file, losses and errors."""

import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any, Final, Protocol, cast

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from numpy.typing import NDArray

from pipeline.core import LONGEST_TEXT, SlipError, shorten


class LogError(SlipError):
    """A log, topic or field that cannot be read.

    Codes: ``log_not_found``, ``log_empty``, ``not_mcap``, ``not_a_recording``, ``log_unreadable``,
    ``log_unreachable`` (its disk or store does not give it, for now),
    ``topic_not_found``, ``field_not_found``, ``frame_not_found``, ``unknown_type``, ``bad_column``,
    ``unsupported_encoding``, ``no_object_store``.
    """


def unsupported(what: str, where: str, hint: str = "Leave the topic out") -> LogError:
    """Error for messages that cannot be decoded."""
    return LogError("unsupported_encoding", what, where=where, hint=hint)


OTHER_VERSION: Final = "other_version"
"""Kind of the loss of messages of another version of their type than the definition that is known."""


@dataclass(frozen=True, slots=True)
class Loss:
    """Part of a log that could not be read completely.

    Attributes:
        kind: stable identifier, for example ``truncated``, ``chunk_crc``, ``damaged_record``,
            ``undecodable``, ``unsupported_encoding``, ``unchecked``.
        text: description, one line.
        bytes: number of affected bytes of the file.
        chunks: number of affected chunks.
        start_ns: first affected log time, None if unknown.
        end_ns: last affected log time, None if unknown.
    """

    kind: str
    text: str
    bytes: int = 0
    chunks: int = 0
    start_ns: int | None = None
    end_ns: int | None = None

    def __post_init__(self) -> None:
        # Losses quote files, whose texts may have any length.
        object.__setattr__(self, "text", shorten(self.text, LONGEST_TEXT))


class ByteSource(Protocol):
    """Bytes with random access, readable from several threads at once."""

    size: int
    """Count of bytes."""
    name: str
    """Name used in messages."""

    def read_at(self, offset: int, length: int) -> bytes:
        """The bytes from ``offset``; fewer than ``length`` only at the end."""


ROS1_BAG: Final = "ROS 1 bag"
SQLITE_BAG: Final = "rosbag2 SQLite file"
_MAGICS: Final = {b"#ROSBAG V": ROS1_BAG, b"SQLite format 3\0": SQLITE_BAG}

LONGEST_MAGIC: Final = max(map(len, _MAGICS))
LONGEST_HEAD: Final = 1 << 12
"""Number of bytes at the start of a bag that state its kind and its length."""

_INDEX_PLACE: Final = re.compile(rb"index_pos=(.{8})", re.DOTALL)


def detect_container(head: bytes) -> str:
    """Kind of bag of a file that starts with ``head``; empty for other files."""
    return next((kind for magic, kind in _MAGICS.items() if head.startswith(magic)), "")


def is_whole(head: bytes, size: int) -> bool:
    """Whether a bag is at least as long as its head states.

    Args:
        head: its first `LONGEST_HEAD` bytes.
        size: size of the file [bytes].
    """
    if detect_container(head) == ROS1_BAG:
        # The recorder states the position of the index once it has written it.
        match = _INDEX_PLACE.search(head)
        return match is not None and 0 < int.from_bytes(match[1], "little") <= size
    page = int.from_bytes(head[16:18], "big")
    pages = int.from_bytes(head[28:32], "big")
    # A page size of 64 KiB is stored as 1.
    return size >= max(pages, 1) * (page if page > 1 else 1 << 16)


# The records of an MCAP file: opcodes, and mcap's own records parsed from bodies with untrusted lengths.
#
# Layout as in the MCAP specification, version 0x30: a record is an opcode (u8), a length (u64), the body.

Buffer = bytes | memoryview

MAGIC: Final = b"\x89MCAP0\r\n"
HEAD: Final = struct.Struct("<BQ")
HEAD_SIZE: Final = HEAD.size
FOOTER_SIZE: Final = HEAD_SIZE + 20

# Opcodes, from 0x01 to 0x0F.
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)

LEAST_BODY: Final[Mapping[int, int]] = {
    HEADER: 8,
    FOOTER: 20,
    SCHEMA: 14,
    CHANNEL: 16,
    MESSAGE: 22,
    CHUNK: 40,
    MESSAGE_INDEX: 6,
    CHUNK_INDEX: 64,
    ATTACHMENT: 36,
    ATTACHMENT_INDEX: 48,
    STATISTICS: 46,
    METADATA: 8,
    METADATA_INDEX: 20,
    SUMMARY_OFFSET: 17,
    DATA_END: 4,
}
"""Minimum size of the body by kind of record [bytes]."""

_KINDS: Final[Mapping[int, Any]] = {
    HEADER: records.Header,
    SCHEMA: records.Schema,
    CHANNEL: records.Channel,
    CHUNK_INDEX: records.ChunkIndex,
    ATTACHMENT_INDEX: records.AttachmentIndex,
    STATISTICS: records.Statistics,
    METADATA_INDEX: records.MetadataIndex,
}
_CHUNK_HEAD: Final = struct.Struct("<QQQII")
_INDEX_HEAD: Final = struct.Struct("<HI")
_ENTRY_SIZE: Final = 16


LATEST_NS: Final = 1 << 62
"""Latest time of a clock [ns], in the year 2116: the difference of any two times then has 64 bits."""


def clip_time(time: int) -> int:
    """A time of a recorder's clock [ns], which is 0 or `LATEST_NS` where no clock shows it."""
    return min(max(time, 0), LATEST_NS)


def split_records(content: Buffer, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, offset and end of the records of a stretch, up to the first bytes that cannot be one."""
    while start + HEAD_SIZE <= end:
        opcode, length = HEAD.unpack_from(content, start)
        after = start + HEAD_SIZE + length
        if after > end or length < LEAST_BODY.get(opcode, 0):
            return
        yield opcode, start, after
        start = after


class RecordError(ValueError):
    """A record whose body does not match its opcode."""


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """Head of a chunk, before its compressed records.

    ``body`` is the distance from the start of the record to the compressed records.
    """

    start_ns: int
    end_ns: int
    uncompressed_size: int
    crc: int
    compression: str
    compressed_size: int
    body: int


class _Body(ReadDataStream):
    """Body of one record; raises an error on a read beyond its end, where mcap returns fewer bytes."""

    def __init__(self, body: Buffer) -> None:
        super().__init__(BytesIO(body))
        self._remaining = len(body)

    def read(self, length: int) -> bytes:
        """The next bytes.

        Raises:
            RecordError: the body has fewer bytes.
        """
        if length > self._remaining:
            raise RecordError("a length points beyond the end of its record")
        self._remaining -= length
        return super().read(length)

    def read_prefixed_string(self) -> str:
        """The next string (u32 length, UTF-8).

        Raises:
            RecordError: it is not a valid string.
        """
        try:
            return super().read_prefixed_string()
        except UnicodeDecodeError:
            raise RecordError("a string is not UTF-8") from None


def parse_record(opcode: int, body: Buffer) -> records.McapRecord | None:
    """Parsed record of a kind that describes the contents of a file; None for other kinds.

    Raises:
        RecordError: the body does not match the opcode.
    """
    kind = _KINDS.get(opcode)
    return None if kind is None else cast("records.McapRecord", kind.read(_Body(body)))


def parse_metadata(body: Buffer, most: int) -> tuple[str, dict[str, str] | None]:
    """Name and entries of a metadata record; None instead of more than ``most`` entries.

    Raises:
        RecordError: the body does not match the opcode.
    """
    stream = _Body(body)
    name = stream.read_prefixed_string()
    end = stream.read4() + stream.count
    entries: dict[str, str] = {}
    for _ in range(most):
        if stream.count >= end:
            break
        key = stream.read_prefixed_string()
        entries[key] = stream.read_prefixed_string()
    return name, entries if stream.count >= end else None


def parse_attachment_name(body: Buffer) -> str:
    """Name of an attachment, from the first bytes of its record's body.

    Raises:
        RecordError: they do not contain it.
    """
    stream = _Body(body)
    stream.read(16)
    return stream.read_prefixed_string()


def parse_chunk_head(body: Buffer, body_size: int) -> ChunkHead:
    """The head of a chunk.

    Args:
        body: at least the first bytes of the record's body.
        body_size: length of the whole body.
    """
    if len(body) < LEAST_BODY[CHUNK]:
        raise RecordError("the header of a chunk is truncated")
    start, end, size, crc, named = _CHUNK_HEAD.unpack_from(body)
    position = _CHUNK_HEAD.size + named
    if position + 8 > len(body):
        raise RecordError("the header of a chunk is truncated")
    try:
        compression = str(body[_CHUNK_HEAD.size : position], "utf-8")
    except UnicodeDecodeError:
        raise RecordError("a chunk's compression is not UTF-8") from None
    stored = int.from_bytes(body[position : position + 8], "little")
    if stored > body_size - position - 8:
        raise RecordError("a chunk says it is longer than its record")
    return ChunkHead(
        clip_time(start), clip_time(end), size, crc, compression, stored, HEAD_SIZE + position + 8
    )


def parse_message_index(body: Buffer) -> tuple[int, NDArray[np.uint64]]:
    """Channel and entries of a message index: log time [ns] and offset in the chunk, shape (n, 2)."""
    if len(body) < _INDEX_HEAD.size:
        raise RecordError("a message index is truncated")
    channel, size = _INDEX_HEAD.unpack_from(body)
    if size > len(body) - _INDEX_HEAD.size:
        raise RecordError("a message index says it is longer than its record")
    count = size // _ENTRY_SIZE * 2
    return channel, np.frombuffer(body, dtype="<u8", count=count, offset=_INDEX_HEAD.size).reshape(-1, 2)
