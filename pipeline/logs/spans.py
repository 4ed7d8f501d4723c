"""Reading the spans of a log that contain messages, on several threads, and verifying their checksums."""

import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.core import map_in_order
from pipeline.logs import chunks
from pipeline.logs import records as rec
from pipeline.logs.chunks import ByteSpan, Messages, SpanKind, locate_messages
from pipeline.logs.records import Buffer, ByteSource, Loss
from pipeline.logs.ros1 import load_ros1

Entries: TypeAlias = tuple[int, NDArray[np.uint64]]

_MAX_SPAN: Final = chunks.MAX_CHUNK + (64 << 20)
"""Maximum size of one read [bytes]: the largest chunk and its message indexes."""


@dataclass(frozen=True, slots=True)
class Loaded:
    """A span in memory.

    Attributes:
        chunk: inflated records; empty if none could be read.
        messages: positions of its messages.
        losses: losses in it.
        unchecked: whether no checksum of the chunk covers the records.
        index_damaged: whether its message index is invalid; no messages are lost by this.
    """

    chunk: Buffer
    messages: Messages
    losses: list[Loss] = field(default_factory=list)
    unchecked: bool = False
    index_damaged: bool = False


def load_span(source: ByteSource, span: ByteSpan) -> Loaded:
    """Read, inflate and check one span: a chunk is whole, or lost."""
    if span.length + span.index_length > _MAX_SPAN:
        return _lost(span, "too_large", f"more than {_MAX_SPAN >> 20} MiB at once are not read")
    blob = memoryview(source.read_at(span.offset, span.length + span.index_length))
    try:
        if span.kind is SpanKind.BAG_CHUNK:
            return Loaded(*load_ros1(span, blob), unchecked=True)
        if span.kind is not SpanKind.LOOSE:
            return _load_chunk(span, blob)
    except (rec.RecordError, struct.error) as error:
        return _lost(span, "damaged_record", str(error))
    except chunks.InflateError as error:
        return _lost(span, "damaged_chunk", f"it cannot be decompressed: {error}")
    messages = locate_messages(blob)
    return Loaded(blob, messages, _damage_losses(span, messages, len(blob)), unchecked=True)


def _load_chunk(span: ByteSpan, blob: memoryview) -> Loaded:
    """Inflate and check a chunk.

    Raises:
        RecordError, struct.error, InflateError: it is damaged.
    """
    opcode, size = rec.HEAD.unpack_from(blob, 0)
    head = rec.parse_chunk_head(blob[rec.HEAD_SIZE : span.length], size)
    stored = blob[head.body : head.body + head.compressed_size]
    if span.kind is SpanKind.CUT_CHUNK:
        return _load_start(span, head, stored)
    if (opcode, rec.HEAD_SIZE + size, head.uncompressed_size) != (rec.CHUNK, span.length, span.inflated):
        raise rec.RecordError("the header of the chunk disagrees with the summary")
    chunk = chunks.inflate(stored, head.compression, head.uncompressed_size)
    if head.crc and zlib.crc32(chunk) != head.crc:
        return _lost(span, "chunk_crc", "its checksum does not match its records")
    messages = locate_messages(chunk, _read_entries(blob[span.length :]))
    return Loaded(
        chunk,
        messages,
        _damage_losses(span, messages, len(chunk)),
        unchecked=head.crc == 0 and not chunks.holds_own_checksum(stored, head.compression),
        index_damaged=span.index_length > 0 and messages.walked and messages.start.size > 0,
    )


def _load_start(span: ByteSpan, head: rec.ChunkHead, stored: Buffer) -> Loaded:
    """Read the messages of a chunk that are before the end of the file, where it is cut off."""
    chunks.check_size(head.compressed_size, head.compression, head.uncompressed_size)
    chunk = chunks.inflate_start(stored, head.compression, head.uncompressed_size)
    messages = locate_messages(chunk)
    if not messages.start.size:
        return _lost(span, "truncated", "the file ends inside it")
    last = int(messages.log_time.max())
    text = (
        f"the chunk at byte {span.offset} is truncated (the file ends inside it): "
        f"{messages.start.size} messages before the cut were read, unchecked"
    )
    loss = Loss("truncated", text, bytes=span.length, chunks=1, start_ns=last, end_ns=span.end_ns)
    return Loaded(chunk, messages, [loss], unchecked=True)


def _read_entries(blob: Buffer) -> list[Entries] | None:
    """Channels and entries of the message indexes after a chunk; None if there are none that can be read."""
    entries: list[Entries] = []
    for opcode, position, end in rec.split_records(blob, 0, len(blob)):
        if opcode != rec.MESSAGE_INDEX:
            return None
        try:
            entries.append(rec.parse_message_index(blob[position + rec.HEAD_SIZE : end]))
        except rec.RecordError:
            return None
    return entries or None


def _damage_losses(span: ByteSpan, messages: Messages, size: int) -> list[Loss]:
    """The loss of bytes that hold no record, from the log time before them to that after them."""
    if not messages.damage:
        return []
    starts, ends = np.array(messages.damage, dtype=np.int64).T
    before = messages.log_time[messages.start < starts.min()]
    after = messages.log_time[messages.start > ends.max()]
    text = (
        f"{(ends - starts).sum()} bytes between {starts.min()} and {ends.max()} of the {size} of the "
        f"{span.kind.value} at {span.offset} hold no record"
    )
    return [
        Loss(
            "damaged_record",
            text,
            int((ends - starts).sum()),
            1,
            int(before.max()) if before.size else span.start_ns,
            int(after.min()) if after.size else span.end_ns,
        )
    ]


def _lost(span: ByteSpan, kind: str, reason: str) -> Loaded:
    text = f"{span.kind.value} of {span.length} bytes at {span.offset}: {reason}"
    loss = Loss(kind, text, bytes=span.length, chunks=1, start_ns=span.start_ns, end_ns=span.end_ns)
    return Loaded(b"", locate_messages(b""), [loss])


Result = TypeVar("Result")

_IN_FLIGHT: Final = 1 << 30
"""Maximum inflated size in memory over all threads [bytes], unless a single chunk is larger."""


def load_spans(
    source: ByteSource,
    spans: Sequence[ByteSpan],
    use: Callable[[ByteSpan, Loaded], Result],
    *,
    threads: int,
) -> Iterator[Result]:
    """Read spans in order.

    Args:
        source: the file.
        spans: the spans.
        use: processes a loaded span, on the reading threads so that the chunk is freed early.
        threads: number of spans that are read at once.

    Yields:
        The results of ``use``.
    """

    def read(span: ByteSpan) -> Result:
        return use(span, load_span(source, span))

    yield from map_in_order(
        read, spans, threads, weigh=lambda span: max(span.inflated, span.length), limit=_IN_FLIGHT
    )
