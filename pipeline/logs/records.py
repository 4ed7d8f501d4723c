"""The records of an MCAP file: opcodes and parsers that trust no length.

Layout after the MCAP specification, version 0x30: a record is an opcode (u8), a length (u64) and the body.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    Buffer = bytes | memoryview

MAGIC: Final = b"\x89MCAP0\r\n"
HEAD: Final = struct.Struct("<BQ")
HEAD_SIZE: Final = HEAD.size
FOOTER_SIZE: Final = HEAD_SIZE + 20

HEADER: Final = 0x01
FOOTER: Final = 0x02
SCHEMA: Final = 0x03
CHANNEL: Final = 0x04
MESSAGE: Final = 0x05
CHUNK: Final = 0x06
MESSAGE_INDEX: Final = 0x07
CHUNK_INDEX: Final = 0x08
ATTACHMENT: Final = 0x09
ATTACHMENT_INDEX: Final = 0x0A
STATISTICS: Final = 0x0B
METADATA: Final = 0x0C
METADATA_INDEX: Final = 0x0D
SUMMARY_OFFSET: Final = 0x0E
DATA_END: Final = 0x0F

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
"""Fewest bytes of the body of every kind of record."""

_CHUNK_HEAD: Final = struct.Struct("<QQQII")
_INDEX_HEAD: Final = struct.Struct("<HI")
_ENTRY_SIZE: Final = 16


class RecordError(ValueError):
    """A record whose body does not hold what its opcode promises."""


@dataclass(frozen=True, slots=True)
class SchemaRecord:
    """A schema: number, type name, encoding, definition."""

    id: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class ChannelRecord:
    """A channel: number, schema number, topic, encoding of its messages, metadata."""

    id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """What a chunk says of itself before its compressed records.

    ``body`` is the distance from the start of the record to the compressed records.
    """

    start_ns: int
    end_ns: int
    uncompressed_size: int
    crc: int
    compression: str
    compressed_size: int
    body: int


@dataclass(frozen=True, slots=True)
class ChunkIndexRecord:
    """What the summary says of a chunk."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    index_offsets: Mapping[int, int]
    index_length: int
    compression: str
    compressed_size: int
    uncompressed_size: int


@dataclass(frozen=True, slots=True)
class StatisticsRecord:
    """Counts over the whole file."""

    message_count: int
    chunk_count: int
    attachment_count: int
    metadata_count: int
    start_ns: int
    end_ns: int
    message_counts: Mapping[int, int] = field(default_factory=dict)


class Parser:
    """Reads the fields of one record's body in order.

    Raises:
        RecordError: from every method, when the body ends too early.
    """

    def __init__(self, body: Buffer) -> None:
        self.body = memoryview(body)
        self.place = 0

    def take(self, size: int) -> memoryview:
        """The next ``size`` bytes."""
        if size > len(self.body) - self.place:
            raise RecordError("a length points beyond the end of its record")
        self.place += size
        return self.body[self.place - size : self.place]

    def number(self, size: int) -> int:
        """The next unsigned little-endian number of ``size`` bytes."""
        return int.from_bytes(self.take(size), "little")

    def text(self) -> str:
        """The next string (u32 length, UTF-8)."""
        try:
            return str(self.take(self.number(4)), "utf-8")
        except UnicodeDecodeError:
            raise RecordError("a string is no UTF-8") from None

    def texts(self) -> dict[str, str]:
        """The next map of strings."""
        below = Parser(self.take(self.number(4)))
        found: dict[str, str] = {}
        while below.place < len(below.body):
            key = below.text()
            found[key] = below.text()
        return found

    def counts(self, size: int) -> dict[int, int]:
        """The next map from u16 to numbers of ``size`` bytes."""
        below = Parser(self.take(self.number(4)))
        found: dict[int, int] = {}
        while below.place < len(below.body):
            key = below.number(2)
            found[key] = below.number(size)
        return found


def parse_header(body: Buffer) -> tuple[str, str]:
    """Profile and library."""
    parser = Parser(body)
    return parser.text(), parser.text()


def parse_schema(body: Buffer) -> SchemaRecord:
    """A schema record."""
    parser = Parser(body)
    number, name, encoding = parser.number(2), parser.text(), parser.text()
    return SchemaRecord(number, name, encoding, bytes(parser.take(parser.number(4))))


def parse_channel(body: Buffer) -> ChannelRecord:
    """A channel record."""
    parser = Parser(body)
    number, schema_id = parser.number(2), parser.number(2)
    return ChannelRecord(number, schema_id, parser.text(), parser.text(), parser.texts())


def parse_chunk_head(body: Buffer, body_size: int) -> ChunkHead:
    """The head of a chunk.

    Args:
        body: at least the first bytes of the record's body.
        body_size: length of the whole body.
    """
    if len(body) < LEAST_BODY[CHUNK]:
        raise RecordError("the head of a chunk is cut")
    start, end, size, crc, named = _CHUNK_HEAD.unpack_from(body)
    place = _CHUNK_HEAD.size + named
    if place + 8 > len(body):
        raise RecordError("the head of a chunk is cut")
    try:
        compression = str(body[_CHUNK_HEAD.size : place], "utf-8")
    except UnicodeDecodeError:
        raise RecordError("a chunk's compression is no UTF-8") from None
    stored = int.from_bytes(body[place : place + 8], "little")
    if stored > body_size - place - 8:
        raise RecordError("a chunk says it is longer than its record")
    return ChunkHead(start, end, size, crc, compression, stored, HEAD_SIZE + place + 8)


def parse_message_index(body: Buffer) -> tuple[int, NDArray[np.uint64]]:
    """Channel and entries of a message index: log time [ns] and offset in the chunk, shape (n, 2)."""
    if len(body) < _INDEX_HEAD.size:
        raise RecordError("a message index is cut")
    channel, size = _INDEX_HEAD.unpack_from(body)
    if size > len(body) - _INDEX_HEAD.size:
        raise RecordError("a message index says it is longer than its record")
    count = size // _ENTRY_SIZE * 2
    return channel, np.frombuffer(body, dtype="<u8", count=count, offset=_INDEX_HEAD.size).reshape(-1, 2)


def parse_chunk_index(body: Buffer) -> ChunkIndexRecord:
    """A chunk index record."""
    parser = Parser(body)
    start, end, offset, length = (parser.number(8) for _ in range(4))
    offsets, index_length, compression = parser.counts(8), parser.number(8), parser.text()
    return ChunkIndexRecord(
        start, end, offset, length, offsets, index_length, compression, parser.number(8), parser.number(8)
    )


def parse_side_index(opcode: int, body: Buffer) -> tuple[int, int, str]:
    """Where the summary says that a metadata record or an attachment stands, its length, and its name."""
    parser = Parser(body)
    place, length = parser.number(8), parser.number(8)
    if opcode == ATTACHMENT_INDEX:
        parser.take(24)
    return place, length, parser.text()


def parse_statistics(body: Buffer) -> StatisticsRecord:
    """The statistics record."""
    parser = Parser(body)
    messages = parser.number(8)
    parser.take(2)
    _channels, attachments, metadata, chunks = (parser.number(4) for _ in range(4))
    start, end = parser.number(8), parser.number(8)
    return StatisticsRecord(messages, chunks, attachments, metadata, start, end, parser.counts(8))


def parse_metadata(body: Buffer) -> tuple[str, dict[str, str]]:
    """Name and entries of a metadata record."""
    parser = Parser(body)
    return parser.text(), parser.texts()


def parse_attachment_name(body: Buffer) -> str:
    """Name of an attachment, from the first bytes of its record's body."""
    parser = Parser(body)
    parser.take(16)
    return parser.text()
