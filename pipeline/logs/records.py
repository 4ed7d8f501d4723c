"""The records of an MCAP file: opcodes, and mcap's own records read from bodies whose lengths nobody trusts.

Layout after the MCAP specification, version 0x30: a record is an opcode (u8), a length (u64) and the body.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

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
"""Fewest bytes of the body of every kind of record."""

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


class RecordError(ValueError):
    """A record whose body does not hold what its opcode promises."""


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


class _Body(ReadDataStream):
    """One record's body; where mcap takes what is there, this refuses what is too short."""

    def __init__(self, body: Buffer) -> None:
        super().__init__(BytesIO(body))
        self._left = len(body)

    def read(self, length: int) -> bytes:
        """The next bytes.

        Raises:
            RecordError: the body ends before.
        """
        if length > self._left:
            raise RecordError("a length points beyond the end of its record")
        self._left -= length
        return super().read(length)

    def read_prefixed_string(self) -> str:
        """The next string (u32 length, UTF-8).

        Raises:
            RecordError: it is none.
        """
        try:
            return super().read_prefixed_string()
        except UnicodeDecodeError:
            raise RecordError("a string is no UTF-8") from None


def parse_record(opcode: int, body: Buffer) -> records.McapRecord | None:
    """The record of a kind that says what a file holds; None for other kinds.

    Raises:
        RecordError: the body does not hold what the opcode promises.
    """
    kind = _KINDS.get(opcode)
    return None if kind is None else cast("records.McapRecord", kind.read(_Body(body)))


def parse_metadata(body: Buffer, most: int) -> tuple[str, dict[str, str] | None]:
    """Name and entries of a metadata record; None in place of more than ``most`` entries.

    Raises:
        RecordError: the body does not hold what the opcode promises.
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
        RecordError: they do not hold it.
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
