"""Sequential scan of the records that no index covers, and detection of missing chunks."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np
from mcap.records import Channel, Header, Schema
from numpy.typing import NDArray

from pipeline.core import Ints, name_first
from pipeline.logs import records as rec
from pipeline.logs.catalog import Catalog
from pipeline.logs.chunks import FIRST_PRIVATE
from pipeline.logs.records import ByteSource, Loss
from pipeline.logs.spans import Loaded, Span, SpanKind

_FIRST_WINDOW: Final = 1 << 12
_WINDOW: Final = 1 << 18
_LOOSE_SPAN: Final = 1 << 22
_CHAIN: Final = 3
"""Number of successive records that must be possible; a random position passes one with p < 1e-4."""

_FIRST_BLOCK: Final = 1 << 12
_LAST_BLOCK: Final = 1 << 20
"""First and largest block of a search [bytes]: blocks grow, so that dense damage does not make it slow."""

_MAX_SIDE_RECORD: Final = 1 << 26


class Window:
    """A read buffer over a source that combines small adjacent reads."""

    def __init__(self, source: ByteSource) -> None:
        self._source = source
        self._start = 0
        self._bytes = memoryview(b"")
        # Gaps between chunks are small, and reads from an object store are expensive: the buffer grows.
        self._next = _FIRST_WINDOW

    def view(self, offset: int, length: int) -> memoryview:
        """Bytes at ``offset``; fewer than ``length`` only at the end of the file."""
        inner = offset - self._start
        if inner < 0 or inner + length > len(self._bytes):
            self._bytes = memoryview(self._source.read_at(offset, max(length, self._next)))
            self._start, inner = offset, 0
            self._next = min(2 * self._next, _WINDOW)
        return self._bytes[inner : inner + length]


class Scanner:
    """Scans records into a catalog.

    Args:
        source: the file.
        catalog: receives the records.
    """

    def __init__(self, source: ByteSource, catalog: Catalog) -> None:
        self._source = source
        self._window = Window(source)
        self._catalog = catalog
        self._known = {span.offset for span in catalog.spans}
        self._last_ns: int | None = None

    def scan(self, start: int, stop: int) -> None:
        """Scan the records in [start, stop); damage is recorded as a loss and skipped."""
        position = start
        previous = start
        while position < stop:
            after = self._take(position, stop)
            if after is None:
                after, position = self._recover(previous, position, stop)
            previous, position = position, after

    def _take(self, position: int, stop: int) -> int | None:
        """Add the record at ``position`` to the catalog; returns the offset after it, None if invalid."""
        head = self._window.view(position, rec.HEAD_SIZE)
        if len(head) < rec.HEAD_SIZE or position + rec.HEAD_SIZE > stop:
            return None
        opcode, length = rec.HEAD.unpack(head)
        after: int = position + rec.HEAD_SIZE + length
        if after > stop or length < rec.LEAST_BODY.get(opcode, 0):
            return None
        if opcode not in rec.LEAST_BODY:
            return after if opcode >= FIRST_PRIVATE and self._goes_on(after, stop) else None
        try:
            return after if self._note(opcode, position, length) else None
        except rec.RecordError:
            return None

    def _note(self, opcode: int, position: int, length: int) -> bool:
        catalog = self._catalog
        body_at = position + rec.HEAD_SIZE
        if opcode == rec.MESSAGE:
            self._note_message(position, rec.HEAD_SIZE + length)
        elif opcode == rec.CHUNK:
            head = rec.parse_chunk_head(self._window.view(body_at, min(length, 128)), length)
            if head.body + head.compressed_size != rec.HEAD_SIZE + length:
                return False
            if position not in self._known:
                self._note_chunk(SpanKind.CHUNK, position, rec.HEAD_SIZE + length, head)
        elif opcode == rec.MESSAGE_INDEX:
            self._note_index(position, rec.HEAD_SIZE + length)
        elif opcode == rec.ATTACHMENT:
            name = rec.parse_attachment_name(self._window.view(body_at, min(length, 1 << 12)))
            catalog.side_records.add((position, rec.HEAD_SIZE + length, name))
            if catalog.extras.take(0, len(name)):
                catalog.attachments.append(name)
        elif length <= _MAX_SIDE_RECORD:
            if opcode == rec.DATA_END:
                catalog.data_end = position
            self._note_small(opcode, position, self._window.view(body_at, length))
        return True

    def _note_chunk(self, kind: SpanKind, position: int, length: int, head: rec.ChunkHead) -> None:
        self._catalog.compressions.add(head.compression)
        times = (head.start_ns, head.end_ns)
        self._last_ns = max(head.end_ns, self._last_ns or 0)
        self._catalog.spans.append(Span(kind, position, length, 0, *times, inflated=head.uncompressed_size))

    def _note_small(self, opcode: int, position: int, body: memoryview) -> None:
        catalog = self._catalog
        if opcode == rec.METADATA:
            name, entries = rec.parse_metadata(body, catalog.extras.most)
            catalog.side_records.add((position, rec.HEAD_SIZE + len(body), name))
            if catalog.extras.take(catalog.extras.most if entries is None else len(entries), len(body)):
                catalog.metadata.append((name, entries or {}))
            return
        record = rec.parse_record(opcode, body)
        if isinstance(record, Schema | Channel):
            if catalog.data_end is None:
                catalog.add_description(record, covered=False)
            else:
                catalog.repeated.append(record)
        elif isinstance(record, Header):
            catalog.profile, catalog.library = record.profile, record.library
        elif opcode == rec.DATA_END:
            catalog.data_crc = int.from_bytes(body[:4], "little")

    def _note_message(self, position: int, length: int) -> None:
        spans = self._catalog.spans
        if spans and spans[-1].kind is SpanKind.LOOSE:
            last = spans[-1]
            if last.offset + last.length == position and last.length + length <= _LOOSE_SPAN:
                spans[-1] = replace(last, length=last.length + length)
                return
        spans.append(Span(SpanKind.LOOSE, position, length))

    def _note_index(self, position: int, length: int) -> None:
        spans = self._catalog.spans
        if not spans or spans[-1].kind is not SpanKind.CHUNK:
            return
        last = spans[-1]
        if last.offset + last.length + last.index_length == position:
            spans[-1] = replace(last, index_length=last.index_length + length)

    def _goes_on(self, position: int, stop: int) -> bool:
        for _ in range(_CHAIN):
            if position == stop:
                return True
            head = self._window.view(position, rec.HEAD_SIZE)
            if len(head) < rec.HEAD_SIZE:
                return False
            opcode, length = rec.HEAD.unpack(head)
            if length < rec.LEAST_BODY.get(opcode, 1 << 62):
                return False
            position += rec.HEAD_SIZE + length
            if position > stop:
                return False
            if opcode == rec.FOOTER:
                return True
        return True

    def _recover(self, previous: int, position: int, stop: int) -> tuple[int, int]:
        """Record damage at ``position``; returns the offset of the next record and that of the damage."""
        if self._take_cut_chunk(position, stop):
            return stop, position
        last = self._catalog.spans[-1] if self._catalog.spans else None
        again = self._find(position + 1, stop)
        if (
            last is not None
            and last.kind is SpanKind.LOOSE
            and last.offset <= previous < position == last.offset + last.length
        ):
            inside = self._find(previous + 1, stop)
            if inside < position:
                self._drop_message(previous)
                position, again = previous, inside
        self._note_damage(position, again, stop)
        return again, position

    def _drop_message(self, position: int) -> None:
        last = self._catalog.spans.pop()
        if position > last.offset:
            self._catalog.spans.append(replace(last, length=position - last.offset))

    def _find(self, start: int, stop: int) -> int:
        low, size = start, _FIRST_BLOCK
        while low <= stop - rec.HEAD_SIZE:
            block = np.frombuffer(self._source.read_at(low, size + rec.HEAD_SIZE - 1), dtype=np.uint8)
            high = min(block.size, stop - low) - rec.HEAD_SIZE + 1
            if high <= 0:
                break
            for inner in _possible_places(block, high, stop - low).tolist():
                if self._goes_on(low + inner, stop):
                    return low + int(inner)
            low, size = low + high, min(2 * size, _LAST_BLOCK)
        return stop

    def _take_cut_chunk(self, position: int, stop: int) -> bool:
        """Add the chunk at ``position`` if its end is missing; returns whether there is such a chunk."""
        head = self._window.view(position, 128)
        if len(head) < rec.HEAD_SIZE or position + rec.HEAD_SIZE > stop:
            return False
        opcode, length = rec.HEAD.unpack_from(head, 0)
        if opcode != rec.CHUNK or position + rec.HEAD_SIZE + length <= stop:
            return False
        try:
            chunk = rec.parse_chunk_head(head[rec.HEAD_SIZE : stop - position], length)
        except rec.RecordError:
            return False
        if chunk.body + chunk.compressed_size != rec.HEAD_SIZE + length:
            return False
        self._note_chunk(SpanKind.CUT_CHUNK, position, stop - position, chunk)
        return True

    def _note_damage(self, start: int, end: int, stop: int) -> None:
        truncated = end == stop == self._source.size
        kind = "truncated" if truncated else "damaged_record"
        text = (
            f"the file is truncated: its last {end - start} bytes are no complete record"
            if truncated
            else f"bytes {start} to {end} hold no record"
        )
        self._catalog.losses.append(Loss(kind, text, bytes=end - start, start_ns=self._last_ns))


def _possible_places(data: NDArray[np.uint8], high: int, end: int) -> Ints:
    """Positions below ``high`` whose opcode and length are possible for a record that ends by ``end``."""
    least = np.full(256, np.iinfo(np.int64).max, dtype=np.int64)
    least[list(rec.LEAST_BODY)] = list(rec.LEAST_BODY.values())
    # Most bytes are not an opcode: lengths are checked only after those that may be one.
    places = np.flatnonzero(data[:high] - np.uint8(1) < np.uint8(len(rec.LEAST_BODY)))
    heads: NDArray[np.uint64] = np.ndarray((data.size - 8,), "<u8", data, offset=1, strides=(1,))
    length = heads[places]
    room = (end - rec.HEAD_SIZE - places).astype(np.uint64)
    return places[(length <= room) & (length >= least[data[places]].astype(np.uint64))]


_STEPS_PER_JUMP: Final = 20
"""Minimum number of increments by one per jump; below it, sequence numbers do not count messages."""


_WHOLE_FILE: Final = -1
"""Channel number for the sequence over all channels, for writers that number all messages together."""


@dataclass(frozen=True, slots=True)
class _Jump:
    """A gap in the sequence numbers of a channel: offsets of the chunks, numbers and log times [ns]."""

    between: tuple[int, int]
    before: int
    after: int
    start_ns: int
    end_ns: int


class _Piece(NamedTuple):
    """Sequence numbers of one channel in one chunk, and log times [ns] of its first and last message."""

    size: int
    steps: int
    first: int
    last: int
    low: int
    high: int
    start_ns: int
    end_ns: int


def _cut(channel: NDArray[np.uint16], sequence: Ints, log_time: Ints) -> Iterator[tuple[int, _Piece]]:
    """Split messages that are sorted by channel into one piece per channel."""
    if not channel.size:
        return
    low = np.flatnonzero(np.append(True, channel[1:] != channel[:-1]))
    high = np.append(low[1:], channel.size)
    by_one = np.append(0, np.diff(sequence) == 1)
    # The first message of a channel has no predecessor in it.
    by_one[low] = 0
    columns = (
        high - low,
        np.add.reduceat(by_one, low),
        sequence[low],
        sequence[high - 1],
        np.minimum.reduceat(sequence, low),
        np.maximum.reduceat(sequence, low),
        log_time[low],
        log_time[high - 1],
    )
    pieces = map(_Piece, *(column.tolist() for column in columns))
    yield from zip(channel[low].tolist(), pieces, strict=True)


@dataclass(slots=True)
class _Series:
    """Sequence numbers of one channel so far.

    Attributes:
        steps: number of increments by one.
        regular: whether all other increments are gaps between one chunk and the next.
        jumps: these gaps.
        low: smallest number.
        high: largest number.
        last: number, log time [ns] and offset of the chunk of the last message; None if unknown.
    """

    steps: int = 0
    regular: bool = True
    jumps: list[_Jump] = field(default_factory=list)
    low: int = 1 << 32
    high: int = -1
    last: tuple[int, int, int] | None = None

    @property
    def counts(self) -> bool:
        """Whether the writer certainly numbers messages consecutively."""
        return self.regular and self.steps >= _STEPS_PER_JUMP * max(1, len(self.jumps))

    def add(self, piece: _Piece, position: int) -> None:
        """Add the messages of the next chunk."""
        self.steps += piece.steps
        self.regular &= piece.steps == piece.size - 1
        self.low, self.high = min(self.low, piece.low), max(self.high, piece.high)
        if self.last is not None:
            number, time, before = self.last
            step = piece.first - number
            self.steps += step == 1
            self.regular &= step >= 1
            if step > 1:
                self.jumps.append(_Jump((before, position), number, piece.first, time, piece.start_ns))
        self.last = piece.last, piece.end_ns, position


class SequenceCheck:
    """Compares the sequence numbers of messages between successive chunks."""

    def __init__(self) -> None:
        self._series: dict[int, _Series] = {}
        self._end: int | None = None

    def add(self, span: Span, loaded: Loaded) -> None:
        """Add the next span of the file; losses in it or before it explain missing messages."""
        if span.kind is not SpanKind.CHUNK or loaded.losses or span.offset != self._end:
            for series in self._series.values():
                series.last = None
        self._end = None
        if span.kind is SpanKind.CHUNK and not loaded.losses:
            self._end = span.offset + span.length + span.index_length
            messages = loaded.messages
            sequence = messages.sequence.astype(np.int64)
            everything = np.zeros(sequence.size, dtype=np.uint16)
            order = np.argsort(messages.channel, kind="stable")
            pieces = [
                *((_WHOLE_FILE, piece) for _, piece in _cut(everything, sequence, messages.log_time)),
                *_cut(messages.channel[order], sequence[order], messages.log_time[order]),
            ]
            for number, piece in pieces:
                self._series.setdefault(number, _Series()).add(piece, span.offset)

    def find_losses(self, channels: Mapping[int, Channel]) -> list[Loss]:
        """Losses of messages missing between two chunks, if the writer certainly numbers consecutively.

        Args:
            channels: channels by number.
        """
        together = self._series.pop(_WHOLE_FILE, _Series())
        counting = {_WHOLE_FILE: together} if together.counts else self._series
        # Numbers that another channel may have used are no gap: the writer may number both together.
        other = [series for series in self._series.values() if not series.counts and not together.counts]
        jumps_of: dict[tuple[int, int], dict[int, _Jump]] = {}
        for number, series in counting.items():
            for jump in series.jumps if series.counts else ():
                if all(each.high <= jump.before or each.low >= jump.after for each in other):
                    jumps_of.setdefault(jump.between, {})[number] = jump
        return [_note_jumps(position, jumps, channels) for position, jumps in sorted(jumps_of.items())]


def _note_jumps(
    position: tuple[int, int], jumps: Mapping[int, _Jump], channels: Mapping[int, Channel]
) -> Loss:
    missing = sum(jump.after - jump.before - 1 for jump in jumps.values())
    topics = [channels[number].topic for number in jumps if number in channels]
    listed = name_first(topics)
    text = (
        f"{missing} messages{f' of {listed}' if listed else ''} are missing between the chunks at "
        f"{position[0]} and {position[1]}: their numbers, which count by one everywhere else, jump there"
    )
    start, end = (min(jump.start_ns for jump in jumps.values()), max(jump.end_ns for jump in jumps.values()))
    return Loss("missing_messages", text, start_ns=start, end_ns=end)
