"""Building MCAP records."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import zstandard

from pipeline.logs import records as rec

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.logs.spool import Batch


@dataclass(frozen=True, slots=True)
class ChunkSummary:
    """What the summary says of a chunk; ``index_offsets`` count from the chunk's record."""

    offset: int
    length: int
    start_ns: int
    end_ns: int
    index_offsets: Mapping[int, int]
    index_length: int
    compression: str
    compressed_size: int
    uncompressed_size: int
    counts: Mapping[int, int]


def number(value: int, size: int) -> bytes:
    """An unsigned little-endian number."""
    return value.to_bytes(size, "little")


def pack_text(text: str) -> bytes:
    """A string: u32 length, UTF-8."""
    data = text.encode()
    return number(len(data), 4) + data


def pack_texts(texts: Mapping[str, str]) -> bytes:
    """A map of strings."""
    body = b"".join(pack_text(key) + pack_text(value) for key, value in texts.items())
    return number(len(body), 4) + body


def pack_counts(counts: Mapping[int, int]) -> bytes:
    """A map from u16 to u64."""
    body = b"".join(number(key, 2) + number(value, 8) for key, value in sorted(counts.items()))
    return number(len(body), 4) + body


def pack_record(opcode: int, body: bytes) -> bytes:
    """A record."""
    return rec.HEAD.pack(opcode, len(body)) + body


def pack_schema(schema_id: int, name: str, encoding: str, data: bytes) -> bytes:
    """A schema record."""
    body = number(schema_id, 2) + pack_text(name) + pack_text(encoding) + number(len(data), 4) + data
    return pack_record(rec.SCHEMA, body)


def pack_channel(channel_id: int, schema_id: int, topic: str, encoding: str) -> bytes:
    """A channel record without metadata."""
    body = number(channel_id, 2) + number(schema_id, 2) + pack_text(topic) + pack_text(encoding)
    return pack_record(rec.CHANNEL, body + pack_texts({}))


def pack_metadata(name: str, record: Mapping[str, str]) -> bytes:
    """A metadata record."""
    return pack_record(rec.METADATA, pack_text(name) + pack_texts(record))


def pack_chunk(batch: Batch, side: bytes, compression: str) -> tuple[bytes, bytes, ChunkSummary]:
    """A chunk with its message indexes.

    Args:
        batch: the messages, by log time.
        side: schema and channel records that come before them.
        compression: ``"zstd"``, ``"lz4"`` or ``""``.

    Returns:
        The chunk record, its message index records, and what the summary says of it (offset 0).
    """
    records = side + batch.records
    stored = _compress(records, compression)
    start, end = int(batch.log_time[0]), int(batch.log_time[-1])
    body = number(start, 8) + number(end, 8) + number(len(records), 8) + number(zlib.crc32(records), 4)
    body += pack_text(compression) + number(len(stored), 8)
    chunk = pack_record(rec.CHUNK, body + stored)
    indexes: list[bytes] = []
    offsets: dict[int, int] = {}
    counts: dict[int, int] = {}
    place = len(chunk)
    for channel in np.unique(batch.channel).tolist():
        chosen = batch.channel == channel
        entries = np.stack((batch.log_time[chosen], batch.offset[chosen] + len(side)), axis=1).astype("<u8")
        offsets[channel], counts[channel] = place, entries.shape[0]
        body = number(channel, 2) + number(entries.nbytes, 4) + entries.tobytes()
        indexes.append(pack_record(rec.MESSAGE_INDEX, body))
        place += len(indexes[-1])
    summary = ChunkSummary(
        0, len(chunk), start, end, offsets, place - len(chunk), compression, len(stored), len(records), counts
    )
    return chunk, b"".join(indexes), summary


def pack_summary(
    offset: int,
    schemas: Sequence[bytes],
    channels: Sequence[bytes],
    chunks: Sequence[ChunkSummary],
    metadata: Sequence[tuple[int, int, str]],
) -> bytes:
    """The summary section, its offsets and the footer.

    Args:
        offset: where it starts in the file.
        schemas: schema records.
        channels: channel records.
        chunks: what to say of every chunk.
        metadata: offset, length and name of every metadata record.
    """
    counts: dict[int, int] = {}
    for chunk in chunks:
        for channel, count in chunk.counts.items():
            counts[channel] = counts.get(channel, 0) + count
    statistics = (
        number(sum(counts.values()), 8)
        + number(len(schemas), 2)
        + number(len(channels), 4)
        + number(0, 4)
        + number(len(metadata), 4)
        + number(len(chunks), 4)
        + number(min((chunk.start_ns for chunk in chunks), default=0), 8)
        + number(max((chunk.end_ns for chunk in chunks), default=0), 8)
        + pack_counts(counts)
    )
    groups = {
        rec.SCHEMA: b"".join(schemas),
        rec.CHANNEL: b"".join(channels),
        rec.STATISTICS: pack_record(rec.STATISTICS, statistics),
        rec.CHUNK_INDEX: b"".join(_pack_chunk_index(chunk) for chunk in chunks),
        rec.METADATA_INDEX: b"".join(
            pack_record(rec.METADATA_INDEX, number(start, 8) + number(length, 8) + pack_text(name))
            for start, length, name in metadata
        ),
    }
    body, offsets = b"", b""
    for opcode, group in groups.items():
        if group:
            place = number(opcode, 1) + number(offset + len(body), 8) + number(len(group), 8)
            offsets += pack_record(rec.SUMMARY_OFFSET, place)
            body += group
    footer = rec.HEAD.pack(rec.FOOTER, 20) + number(offset, 8) + number(offset + len(body), 8)
    return body + offsets + footer + number(zlib.crc32(body + offsets + footer), 4)


def _pack_chunk_index(chunk: ChunkSummary) -> bytes:
    offsets = {channel: chunk.offset + place for channel, place in chunk.index_offsets.items()}
    body = (
        number(chunk.start_ns, 8)
        + number(chunk.end_ns, 8)
        + number(chunk.offset, 8)
        + number(chunk.length, 8)
    )
    body += pack_counts(offsets) + number(chunk.index_length, 8) + pack_text(chunk.compression)
    body += number(chunk.compressed_size, 8) + number(chunk.uncompressed_size, 8)
    return pack_record(rec.CHUNK_INDEX, body)


def _compress(records: bytes, compression: str) -> bytes:
    if compression == "zstd":
        return zstandard.ZstdCompressor(level=3).compress(records)
    if compression == "lz4":
        import pyarrow as pa  # noqa: PLC0415 - heavy, and few logs use lz4

        return pa.Codec("lz4").compress(records, asbytes=True)  # type: ignore[no-any-return]
    return records
