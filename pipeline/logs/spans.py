"""Reading the spans of a log that contain messages, on several threads, and verifying their checksums."""

import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Final, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.core import map_in_order
from pipeline.logs import chunks
from pipeline.logs import records as rec
from pipeline.logs.chunks import Messages, locate_messages
from pipeline.logs.records import Buffer, ByteSource, Loss

# Spans of a log, and reading one of them.
#
# A span is a chunk with the message indexes after it, or a range of message records outside chunks.

Entries: TypeAlias = tuple[int, NDArray[np.uint64]]
FileCheck: TypeAlias = Callable[[], bool]

_CRC_IN_HEAD: Final = 24
_INVERTED: Final = 0xFFFFFFFF

_ZERO_TAIL: Final = 64
"""Minimum number of zero bytes at the end of a chunk, without a record after it, that count as unwritten."""

_MAX_SPAN: Final = chunks.MAX_CHUNK + (64 << 20)
"""Maximum size of one read [bytes]: the largest chunk and its message indexes."""

_MOST_STRETCHES: Final = 100
"""Maximum number of damaged ranges of a span that are reported individually; more are summarized."""

_NEVER: Final = np.iinfo(np.int64).max


class SpanKind(Enum):
    """Kind of a span."""

    CHUNK = "chunk"
    LOOSE = "loose"
    CUT_CHUNK = "cut chunk"


@dataclass(frozen=True, slots=True)
class StoredAs:
    """Compression and sizes [bytes] of a chunk as stated in the summary."""

    compression: str
    compressed_size: int
    uncompressed_size: int


@dataclass(frozen=True, slots=True)
class Span:
    """A range of the file that contains messages.

    Attributes:
        kind: kind of the span.
        offset: offset of its first byte in the file.
        length: size without its message indexes [bytes].
        index_length: size of the message indexes after it [bytes].
        start_ns: first log time as stated by the summary or the chunk, None if unknown.
        end_ns: last log time, None if unknown.
        channels: numbers of the channels in it, None if unknown.
        stored_as: compression and sizes stated in the summary, None if it is not listed there.
        inflated: inflated size of a chunk as stated by the summary or its header [bytes].
    """

    kind: SpanKind
    offset: int
    length: int
    index_length: int = 0
    start_ns: int | None = None
    end_ns: int | None = None
    channels: frozenset[int] | None = None
    stored_as: StoredAs | None = None
    inflated: int = 0


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


def no_file_checksum() -> bool:
    """Default check for files whose data section has no valid checksum: always False."""
    return False


class _SpanError(Exception):
    """A chunk that cannot be read: kind of loss and reason."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind
        self.reason = reason


def load_span(
    source: ByteSource,
    span: Span,
    file_holds: FileCheck = no_file_checksum,
) -> Loaded:
    """Read, inflate and check one span.

    Args:
        source: the file.
        span: the span.
        file_holds: called if a chunk's checksum differs; returns whether that of the whole file is valid.
    """
    if span.length + span.index_length > _MAX_SPAN:
        return _lost(span, "too_large", f"more than {_MAX_SPAN >> 20} MiB at once are not read")
    blob = memoryview(source.read_at(span.offset, span.length + span.index_length))
    if span.kind is SpanKind.LOOSE:
        messages = locate_messages(blob, None, len(blob))
        return Loaded(blob, messages, _damage_losses(span, messages, len(blob)), unchecked=True)
    try:
        head, losses = _open_chunk(span, blob)
    except _SpanError as error:
        return _lost(span, error.kind, error.reason)
    if span.start_ns is None and head.start_ns <= head.end_ns:
        span = replace(span, start_ns=head.start_ns, end_ns=head.end_ns)
    stored = blob[head.body : head.body + head.compressed_size]
    try:
        return _load_chunk(span, blob, head, losses, file_holds)
    except _SpanError as error:
        if not _is_unwritten(source, span, stored):
            return _lost(span, error.kind, error.reason)
    written = memoryview(bytes(stored).rstrip(b"\0"))
    return _load_start(span, head, written, f"its last {len(stored) - len(written)} bytes are zero")


def _load_chunk(
    span: Span,
    blob: memoryview,
    head: rec.ChunkHead,
    losses: list[Loss],
    file_holds: FileCheck,
) -> Loaded:
    """Inflate and check a chunk whose header is parsed; ``losses`` are those of its header."""
    stored = blob[head.body : head.body + head.compressed_size]
    if span.kind is SpanKind.CUT_CHUNK:
        return _load_start(span, head, stored, "the file ends inside it")
    entries = _read_entries(blob[span.length :])
    unchecked = head.crc == 0 and not chunks.holds_own_checksum(stored, head.compression)
    chunk = _inflate_checked(span, head, stored, file_holds, losses)
    messages = locate_messages(chunk, entries, len(stored))
    losses += _damage_losses(span, messages, len(chunk))
    if unchecked:
        losses += _compare_times(span, head, messages)
    index_damaged = span.index_length > 0 and messages.walked and messages.start.size > 0
    return Loaded(chunk, messages, losses, unchecked=unchecked, index_damaged=index_damaged)


def _open_chunk(span: Span, blob: memoryview) -> tuple[rec.ChunkHead, list[Loss]]:
    """Header of a chunk; from the summary if the chunk's own header is damaged."""
    head: rec.ChunkHead | None = None
    reason = "the header of the chunk disagrees with the summary"
    try:
        opcode, size = rec.HEAD.unpack_from(blob, 0)
        head = rec.parse_chunk_head(blob[rec.HEAD_SIZE : span.length], size)
        whole = opcode == rec.CHUNK and head.body + head.compressed_size <= rec.HEAD_SIZE + size
        whole &= span.kind is SpanKind.CUT_CHUNK or rec.HEAD_SIZE + size == span.length <= len(blob)
    except (rec.RecordError, struct.error) as error:
        whole, reason = False, str(error)
    stored = span.stored_as
    if stored is None:
        if head is None or not whole:
            raise _SpanError("damaged_record", reason)
        return head, []
    expected = rec.ChunkHead(
        span.start_ns or 0,
        span.end_ns or 0,
        stored.uncompressed_size,
        head.crc if head is not None else 0,
        stored.compression,
        stored.compressed_size,
        rec.HEAD_SIZE + rec.LEAST_BODY[rec.CHUNK] + len(stored.compression),
    )
    if whole and expected == head:
        return expected, []
    crc_at = rec.HEAD_SIZE + _CRC_IN_HEAD
    crc = int.from_bytes(blob[crc_at : crc_at + 4], "little")
    if crc == 0 or expected.body + expected.compressed_size > len(blob):
        raise _SpanError("damaged_record", reason)
    text = f"{reason}; its records are intact and were kept"
    return replace(expected, crc=crc), [_loss(span, "damaged_record", text, bytes_lost=0)]


def _inflate_checked(
    span: Span, head: rec.ChunkHead, stored: Buffer, file_holds: FileCheck, losses: list[Loss]
) -> Buffer:
    """Inflated records of a chunk; appends a loss if only the stored checksum is damaged."""
    try:
        chunk = chunks.inflate(stored, head.compression, head.uncompressed_size)
    except chunks.InflateError as error:
        raise _SpanError("damaged_chunk", f"it cannot be decompressed: {error}") from None
    computed = zlib.crc32(chunk) if head.crc else 0
    if computed == head.crc:
        return chunk
    reason = explain_checksum(head.crc, computed, stored, head.compression)
    if reason is None and file_holds():
        reason = "the checksum of the whole file holds"
    if reason is None:
        raise _SpanError("chunk_crc", "its checksum does not match its records")
    text = f"its checksum is wrong but its records are intact ({reason}); they were kept"
    losses.append(_loss(span, "wrong_crc", text, bytes_lost=0))
    return chunk


def _is_unwritten(source: ByteSource, span: Span, stored: Buffer) -> bool:
    """Whether the end of a chunk was never written: it is zero, and so is the next record header.

    Zeros at the end alone are no evidence: many messages end in zeros, such as odometry without covariance.
    """
    if len(stored) < _ZERO_TAIL or any(stored[-_ZERO_TAIL:]):
        return False
    return not any(source.read_at(span.offset + span.length, rec.HEAD_SIZE))


def explain_checksum(stored_crc: int, computed: int, stored: Buffer, compression: str) -> str | None:
    """Evidence that a chunk whose checksum does not match is undamaged, None if there is none.

    A damaged byte in the records changes several bytes of the CRC, except with a probability of 2.4e-7; a
    difference in only one byte is therefore damage to the stored CRC itself.
    """
    difference = stored_crc ^ computed
    if chunks.holds_own_checksum(stored, compression):
        return "the compression's checksum holds"
    if sum(1 for shift in (0, 8, 16, 24) if difference >> shift & 0xFF) == 1:
        return "one byte of the stored checksum differs"
    if difference == _INVERTED:
        return "it is stored inverted"
    if stored_crc == int.from_bytes(computed.to_bytes(4, "little"), "big"):
        return "it is stored in the other byte order"
    if compression and stored_crc == zlib.crc32(stored):
        return "it was taken over the compressed bytes"
    return None


def _load_start(span: Span, head: rec.ChunkHead, stored: Buffer, reason: str) -> Loaded:
    """Read the messages before the position where a chunk is cut off."""
    try:
        chunks.check_size(head.compressed_size, head.compression, head.uncompressed_size)
    except chunks.InflateError as error:
        return _lost(span, "truncated", str(error))
    chunk = chunks.inflate_start(stored, head.compression, head.uncompressed_size)
    messages = locate_messages(chunk, None, len(stored))
    if not messages.start.size:
        return _lost(span, "truncated", reason)
    last = int(messages.log_time.max())
    text = (
        f"the chunk at byte {span.offset} is truncated ({reason}): "
        f"{messages.start.size} messages before the cut were read, unchecked"
    )
    loss = Loss("truncated", text, bytes=span.length, chunks=1, start_ns=last, end_ns=span.end_ns)
    return Loaded(chunk, replace(messages, damage=[]), [loss], unchecked=True)


def _read_entries(blob: Buffer) -> list[Entries] | None:
    entries: list[Entries] = []
    position = 0
    while position + rec.HEAD_SIZE <= len(blob):
        opcode, length = rec.HEAD.unpack_from(blob, position)
        position += rec.HEAD_SIZE
        if opcode != rec.MESSAGE_INDEX or length > len(blob) - position:
            return None
        try:
            entries.append(rec.parse_message_index(blob[position : position + length]))
        except rec.RecordError:
            return None
        position += length
    return entries or None


def _damage_losses(span: Span, messages: Messages, size: int) -> list[Loss]:
    if not messages.damage:
        return []
    what = f"of {size} of the {span.kind.value} at {span.offset} hold no record"
    start, end = np.array(messages.damage, dtype=np.int64).T
    # Log times around each range: the latest before it and the earliest after it.
    latest = np.maximum.accumulate(np.append(0, messages.log_time))
    earliest = np.minimum.accumulate(np.append(messages.log_time, _NEVER)[::-1])[::-1]
    first = latest[np.searchsorted(messages.start, start)]
    last = earliest[np.searchsorted(messages.start, end)]
    if start.size > _MOST_STRETCHES:
        what = f"{start.size} stretches between bytes {start.min()} and {end.max()} {what}"
        return [_lose_bytes(span, what, (end - start).sum(), first.min(), last.max())]
    rows = zip(*(each.tolist() for each in (start, end, first, last)), strict=True)
    return [
        _lose_bytes(span, f"bytes {a} to {b} {what}", b - a, before, after) for a, b, before, after in rows
    ]


def _lose_bytes(span: Span, text: str, lost: int, first: int, last: int) -> Loss:
    """Loss of bytes between two log times; the span's own time on a side without messages."""
    before = int(first) or span.start_ns
    return Loss("damaged_record", text, int(lost), 1, before, span.end_ns if last == _NEVER else int(last))


def _compare_times(span: Span, head: rec.ChunkHead, messages: Messages) -> list[Loss]:
    """Loss if a chunk without a checksum has messages outside the time range stated in its header."""
    log_time = messages.log_time
    if not log_time.size or (head.start_ns <= int(log_time.min()) and int(log_time.max()) <= head.end_ns):
        return []
    reason = "messages lie outside the times in its header: one of the two is damaged, both were kept"
    return [_loss(span, "contradiction", reason, bytes_lost=0)]


def _loss(span: Span, kind: str, reason: str, *, bytes_lost: int | None = None) -> Loss:
    text = f"{span.kind.value} of {span.length} bytes at {span.offset}: {reason}"
    lost = span.length if bytes_lost is None else bytes_lost
    return Loss(kind, text, bytes=lost, chunks=1, start_ns=span.start_ns, end_ns=span.end_ns)


def _lost(span: Span, kind: str, reason: str) -> Loaded:
    return Loaded(b"", locate_messages(b"", None, 0), [_loss(span, kind, reason)])


Result = TypeVar("Result")

_IN_FLIGHT: Final = 1 << 30
"""Maximum inflated size in memory over all threads [bytes], unless a single chunk is larger."""

_CRC_BLOCK: Final = 1 << 20


def load_spans(
    source: ByteSource,
    spans: Sequence[Span],
    use: Callable[[Span, Loaded], Result],
    *,
    threads: int,
    file_holds: FileCheck = no_file_checksum,
) -> Iterator[Result]:
    """Read spans in order.

    Args:
        source: the file.
        spans: the spans.
        use: processes a loaded span, on the reading threads so that the chunk is freed early.
        threads: number of spans that are read at once.
        file_holds: called if a chunk's checksum differs; returns whether that of the whole file is valid.

    Yields:
        The results of ``use``.
    """

    def read(span: Span) -> Result:
        return use(span, load_span(source, span, file_holds))

    yield from map_in_order(
        read, spans, threads, weigh=lambda span: max(span.inflated, span.length), limit=_IN_FLIGHT
    )


def checksum_holds(source: ByteSource, end: int, crc: int) -> bool:
    """Whether the checksum of the data section, the first ``end`` bytes of a file, is valid."""
    computed = 0
    for offset in range(0, end, _CRC_BLOCK):
        computed = zlib.crc32(source.read_at(offset, min(_CRC_BLOCK, end - offset)), computed)
    return computed == crc
