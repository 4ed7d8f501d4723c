"""Chunks of an MCAP file or a bag: inflating them within size limits, and locating the messages in them."""

import bz2
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from enum import Enum
from typing import IO, Final

import numpy as np
import zstandard
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from pipeline.core import Ints
from pipeline.logs import records as rec
from pipeline.logs.records import Buffer

MAX_CHUNK: Final = 1 << 30
"""Maximum inflated size of a chunk [bytes]; recorders write 1 to 100 MB."""

_PLAUSIBLE: Final = 256 << 20
_PLAUSIBLE_RATIO: Final = 1000
"""Maximum inflation ratio of a chunk larger than `_PLAUSIBLE` bytes; only malicious files exceed it."""

_LZ4_FLAGS: Final = 4
_LZ4_HAS_CHECKSUM: Final = 0x04
"""Bit in the flags after the magic number of an LZ4 frame."""


class InflateError(ValueError):
    """Stored bytes that do not inflate to the size stated by their chunk."""


@contextmanager
def _naming_damage() -> Iterator[None]:
    try:
        yield
    except InflateError:
        raise
    except (zstandard.ZstdError, OSError, ValueError) as error:
        raise InflateError(str(error)) from None


def inflate(stored: Buffer, compression: str, size: int) -> Buffer:
    """Inflate the records of a chunk.

    Args:
        stored: compressed bytes.
        compression: ``""``, ``"zstd"``, ``"lz4"``, or ``"bz2"`` of bags.
        size: expected inflated size [bytes].

    Raises:
        InflateError: the inflated size differs, the bytes are damaged, or the size is implausible.
    """
    check_size(len(stored), compression, size)
    inflated = stored if compression == "" else b""
    if compression and size:
        with _naming_damage():
            inflated = _INFLATERS[compression](stored, size)
    if len(inflated) != size:
        raise InflateError(f"{len(inflated)} bytes came out in place of {size}")
    return inflated


def check_size(stored: int, compression: str, size: int) -> None:
    """Check that an inflated size is plausible, before memory is allocated.

    Raises:
        InflateError: it is not, or the compression is unknown.
    """
    if compression not in ("", *_INFLATERS):
        raise InflateError(f"the compression {compression[:20]!r} is not known")
    if size > largest_plausible(stored):
        raise InflateError(f"{stored} bytes say they hold {size}, as no recording does")


def largest_plausible(stored: int) -> int:
    """Maximum plausible inflated size of ``stored`` bytes [bytes]."""
    return min(MAX_CHUNK, max(_PLAUSIBLE, stored * _PLAUSIBLE_RATIO))


def inflate_message(stored: bytes) -> Buffer:
    """Inflate a message that rosbag2 compressed individually; other messages are returned unchanged.

    Raises:
        InflateError: as ``inflate``.
    """
    if not stored.startswith(zstandard.FRAME_HEADER):
        return stored
    with _naming_damage():
        return inflate(stored, "zstd", max(zstandard.frame_content_size(stored), 0))


def inflate_start(stored: Buffer, compression: str, size: int) -> Buffer:
    """Inflate up to ``size`` bytes that precede the first damage; damage raises no error."""
    if compression == "":
        return stored[:size]
    start = bytearray()
    with suppress(zstandard.ZstdError, OSError, ValueError), _open_damaged(stored, compression) as reader:
        while len(start) < size and (part := reader.read(min(1 << 12, size - len(start)))):
            start += part
    return bytes(start)


def holds_own_checksum(stored: Buffer, compression: str) -> bool:
    """Whether the compression format stores a checksum of the content, verified by inflating all bytes."""
    if compression == "lz4":
        return len(stored) > _LZ4_FLAGS and bool(stored[_LZ4_FLAGS] & _LZ4_HAS_CHECKSUM)
    if compression == "zstd":
        try:
            return bool(zstandard.get_frame_parameters(bytes(stored[:32])).has_checksum)
        except zstandard.ZstdError:
            return False
    return False


def _inflate_zstd(stored: Buffer, size: int) -> bytes:
    said = zstandard.frame_content_size(stored)
    if said not in (-1, size):
        raise InflateError(f"the zstd frame says {said} bytes, its chunk {size}")
    return zstandard.ZstdDecompressor().decompress(stored, max_output_size=size)


def _inflate_bz2(stored: Buffer, size: int) -> bytes:
    decompressor = bz2.BZ2Decompressor()
    # One more byte than there should be tells content that is longer.
    inflated = decompressor.decompress(stored, max_length=size + 1)
    if not decompressor.eof and len(inflated) <= size:
        raise InflateError("its end is missing")
    return inflated


def _inflate_lz4(stored: Buffer, size: int) -> Buffer:
    import pyarrow as pa  # noqa: PLC0415 - heavy, and few logs use lz4

    return memoryview(pa.Codec("lz4").decompress(stored, decompressed_size=size))


_INFLATERS: Final[dict[str, Callable[[Buffer, int], Buffer]]] = {
    "zstd": _inflate_zstd,
    "lz4": _inflate_lz4,
    "bz2": _inflate_bz2,
}


def _open_damaged(stored: Buffer, compression: str) -> AbstractContextManager[IO[bytes]]:
    """A stream that returns the bytes before damage, then raises."""
    if compression == "zstd":
        return zstandard.ZstdDecompressor().stream_reader(stored)
    import pyarrow as pa  # noqa: PLC0415 - heavy, and few logs use lz4

    stream: AbstractContextManager[IO[bytes]] = pa.input_stream(
        pa.py_buffer(stored), compression=compression, buffer_size=0
    )
    return stream


# Locating the messages among the records of one inflated chunk.
#
# The message indexes after a chunk state the offsets of its messages, so that Python need not visit every
# record. They are used only if all entries agree with the records; uncovered ranges are scanned, each up to
# the first bytes that are no record.

FIRST_PRIVATE: Final = 0x80
"""First private opcode; the specification requires that such records are skipped."""

MESSAGE_HEAD: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
"""Layout of a message record before its payload."""

MESSAGE_OVERHEAD: Final = MESSAGE_HEAD.itemsize
"""Size of a message record before its payload [bytes]."""


class SpanKind(Enum):
    """Kind of a span."""

    CHUNK = "chunk"
    LOOSE = "loose"
    CUT_CHUNK = "cut chunk"
    BAG_CHUNK = "chunk of a bag"


@dataclass(frozen=True, slots=True)
class ByteSpan:
    """A range of the file that contains messages: a chunk, or message records outside chunks.

    Attributes:
        kind: kind of the span.
        offset: offset of its first byte in the file.
        length: size without its message indexes [bytes]; with them of a bag.
        index_length: size of the message indexes after it [bytes].
        start_ns: first log time as stated by the summary or the chunk, None if unknown.
        end_ns: last log time, None if unknown.
        channels: numbers of the channels in it, None if unknown.
        inflated: inflated size of a chunk as stated by the summary or its header [bytes].
    """

    kind: SpanKind
    offset: int
    length: int
    index_length: int = 0
    start_ns: int | None = None
    end_ns: int | None = None
    channels: frozenset[int] | None = None
    inflated: int = 0

    @property
    def end(self) -> int:
        """Offset after it and its message indexes."""
        return self.offset + self.length + self.index_length


@dataclass(frozen=True, slots=True, eq=False)
class Messages:
    """The messages of a chunk, in the order of their offsets.

    Attributes:
        start: offset of each payload in the chunk, int64, shape (n,).
        size: size of each payload [bytes], int64.
        channel: channel number, uint16 (int64 of a bag).
        sequence: sequence number assigned by the writer, uint32.
        log_time: [ns], int64.
        publish_time: [ns], int64.
        descriptions: schema and channel records of the chunk.
        damage: ranges (start, end) of the chunk without a readable record.
        walked: whether the chunk was scanned because no message index agrees with its records.
    """

    start: Ints
    size: Ints
    channel: NDArray[np.integer]
    sequence: NDArray[np.uint32]
    log_time: Ints
    publish_time: Ints
    descriptions: list[Schema | Channel] = field(default_factory=list)
    damage: list[tuple[int, int]] = field(default_factory=list)
    walked: bool = False


@dataclass(slots=True)
class _WalkedChunk:
    known: set[tuple[int, bytes]] = field(default_factory=set)
    offsets: list[int] = field(default_factory=list)
    descriptions: list[Schema | Channel] = field(default_factory=list)
    damage: list[tuple[int, int]] = field(default_factory=list)


def locate_messages(
    chunk: Buffer, entries: Sequence[tuple[int, NDArray[np.uint64]]] | None = None
) -> Messages:
    """Locate all messages of a chunk.

    Args:
        chunk: its inflated records.
        entries: channel and entries of every message index after it; None if there are none.
    """
    data = np.frombuffer(chunk, dtype=np.uint8)
    located = _WalkedChunk()
    agreed = None if entries is None else _agreeing_messages(data, entries)
    if agreed is None:
        _walk(chunk, 0, data.size, located)
        offsets = np.array(located.offsets, dtype=np.int64)
        heads = _heads(data, offsets)
    else:
        offsets, heads = agreed
        ends = offsets + rec.HEAD_SIZE + heads["length"].astype(np.int64)
        gaps = np.flatnonzero(np.append(offsets, data.size) > np.append(0, ends))
        for gap in gaps.tolist():
            start = int(ends[gap - 1]) if gap else 0
            _walk(chunk, start, int(offsets[gap]) if gap < offsets.size else data.size, located)
        if located.offsets:
            offsets = np.sort(np.append(offsets, np.array(located.offsets, dtype=np.int64)))
            heads = _heads(data, offsets)
    absurd = heads["log_time"] > rec.LATEST_NS
    # Most of the messages are recorded by a clock that was not set; a few are damaged.
    if 0 < 2 * int(absurd.sum()) <= absurd.size:
        located.damage += [(int(offset), int(offset) + MESSAGE_OVERHEAD) for offset in offsets[absurd]]
        offsets, heads = offsets[~absurd], heads[~absurd]
    return Messages(
        start=offsets + MESSAGE_OVERHEAD,
        size=heads["length"].astype(np.int64) - (MESSAGE_OVERHEAD - rec.HEAD_SIZE),
        channel=heads["channel"].copy(),
        sequence=heads["sequence"].copy(),
        log_time=np.minimum(heads["log_time"], rec.LATEST_NS).astype(np.int64),
        publish_time=np.minimum(heads["publish_time"], rec.LATEST_NS).astype(np.int64),
        descriptions=located.descriptions,
        damage=located.damage,
        walked=agreed is None,
    )


def _heads(data: NDArray[np.uint8], offsets: Ints) -> NDArray[np.void]:
    if offsets.size == 0:
        return np.empty(0, dtype=MESSAGE_HEAD)
    window: NDArray[np.void] = np.ndarray(
        (data.size - MESSAGE_HEAD.itemsize + 1,), dtype=MESSAGE_HEAD, buffer=data.data, strides=(1,)
    )
    return window[offsets]


def _agreeing_messages(
    data: NDArray[np.uint8], entries: Sequence[tuple[int, NDArray[np.uint64]]]
) -> tuple[Ints, NDArray[np.void]] | None:
    """Sorted offsets and heads of the indexed messages, None unless all entries agree with the records."""
    joined = np.concatenate([np.empty((0, 2), dtype=np.uint64), *(entry for _, entry in entries)])
    if joined.size == 0 or data.size < MESSAGE_HEAD.itemsize:
        return None
    if joined[:, 1].max() > data.size - MESSAGE_HEAD.itemsize:
        return None
    channel = np.repeat([channel for channel, _ in entries], [entry.shape[0] for _, entry in entries])
    order = np.argsort(joined[:, 1], kind="stable")
    offsets = joined[order, 1].astype(np.int64)
    heads = _heads(data, offsets)
    length = heads["length"]
    agrees = (heads["opcode"] == rec.MESSAGE) & (heads["channel"] == channel[order])
    agrees &= heads["log_time"] == joined[order, 0]
    agrees &= (length >= MESSAGE_HEAD.itemsize - rec.HEAD_SIZE) & (length <= data.size)
    if not agrees.all():
        return None
    ends = offsets + rec.HEAD_SIZE + length.astype(np.int64)
    apart = ends[-1] <= data.size and (offsets[1:] >= ends[:-1]).all()
    return (offsets, heads) if apart else None


def _walk(chunk: Buffer, start: int, end: int, located: _WalkedChunk) -> None:
    """Note the records from ``start`` on; what follows the first bytes that are none is damage."""
    after = start
    for opcode, position, following in rec.split_records(chunk, start, end):
        if opcode == rec.MESSAGE:
            located.offsets.append(position)
        elif not _take_side_record(opcode, chunk[position + rec.HEAD_SIZE : following], located):
            break
        after = following
    if after < end:
        located.damage.append((after, end))


def _take_side_record(opcode: int, body: Buffer, located: _WalkedChunk) -> bool:
    if opcode not in (rec.SCHEMA, rec.CHANNEL):
        return opcode >= FIRST_PRIVATE
    # Some writers repeat these records before every message; differing ones cannot be compressed to nothing.
    content = opcode, bytes(body)
    if content in located.known:
        return True
    try:
        record = rec.parse_record(opcode, body)
    except rec.RecordError:
        return False
    if not isinstance(record, Schema | Channel):
        return False
    located.descriptions.append(record)
    located.known.add(content)
    return True
