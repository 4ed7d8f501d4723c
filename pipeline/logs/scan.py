"""Sequential scan of the records that no index covers, and detection of missing chunks."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final, TypeAlias

import numpy as np
from mcap.records import Channel, Header, Schema
from numpy.typing import NDArray

from pipeline.core import Ints, group_rows, name_first
from pipeline.logs import records as rec
from pipeline.logs.catalog import Catalog
from pipeline.logs.chunks import FIRST_PRIVATE, Span, SpanKind
from pipeline.logs.records import ByteSource, Loss

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
                # The length of the message before is damaged.
                self._catalog.spans.pop()
                if previous > last.offset:
                    self._catalog.spans.append(replace(last, length=previous - last.offset))
                position, again = previous, inside
        self._note_damage(position, again, stop)
        return again, position

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

Numbered: TypeAlias = tuple[Span, NDArray[np.integer], NDArray[np.uint32], Ints]
"""A whole chunk with channels, sequence numbers and log times [ns] of its messages."""


def find_missing(chunks: Sequence[Numbered], channels: Mapping[int, Channel]) -> list[Loss]:
    """Losses of messages missing between two chunks, if the writer certainly numbers consecutively.

    It may number the messages of each channel, or all of a file together. Only chunks that follow one another
    are compared: damage between them is told already.

    Args:
        chunks: the chunks in the order of the file.
        channels: channels by number.
    """
    if not any(channel.size for _, channel, *_ in chunks):
        return []
    spans, *columns = zip(*chunks, strict=True)
    channel, sequence, time = (np.concatenate(column) for column in columns)
    sequence = sequence.astype(np.int64)
    chunk = np.repeat(np.arange(len(spans)), [len(column) for column in columns[0]])
    apart = [a.offset + a.length + a.index_length != b.offset for a, b in pairwise(spans)]
    stretch = np.append(0, np.cumsum(apart))[chunk]

    def find_jumps(rows: Ints) -> Ints | None:
        """Rows before a jump; None where the numbers do not count."""
        step, joined = np.diff(sequence[rows]), np.diff(stretch[rows]) == 0
        by_one, jump = joined & (step == 1), joined & (step > 1) & (np.diff(chunk[rows]) > 0)
        regular = (by_one | jump | ~joined).all()
        counts = regular and by_one.sum() >= _STEPS_PER_JUMP * max(1, int(jump.sum()))
        return np.flatnonzero(jump) if counts else None

    every = np.arange(channel.size)
    is_common = find_jumps(every) is not None
    jumps_of: dict[tuple[int, int], list[tuple[int, int]]] = {}
    series = [every] if is_common else group_rows(channel)
    judged = [(rows, find_jumps(rows)) for rows in series]
    # Numbers that another channel may have used are no gap: the writer may number both together.
    ranges = [(sequence[rows].min(), sequence[rows].max()) for rows, jumps in judged if jumps is None]
    for rows, jumps in judged:
        for a, b in () if jumps is None else zip(rows[jumps].tolist(), rows[jumps + 1].tolist(), strict=True):
            if all(high <= sequence[a] or low >= sequence[b] for low, high in ranges):
                jumps_of.setdefault((chunk[a], chunk[b]), []).append((a, b))
    losses = []
    for (before, after), pairs in sorted(jumps_of.items()):
        missing = sum(int(sequence[b] - sequence[a]) - 1 for a, b in pairs)
        numbers = [] if is_common else [int(channel[a]) for a, _ in pairs]
        listed = name_first([channels[number].topic for number in numbers if number in channels])
        text = (
            f"{missing} messages{f' of {listed}' if listed else ''} are missing between the chunks at "
            f"{spans[before].offset} and {spans[after].offset}: their numbers, which count by one everywhere "
            "else, jump there"
        )
        start, end = min(int(time[a]) for a, _ in pairs), max(int(time[b]) for _, b in pairs)
        losses.append(Loss("missing_messages", text, start_ns=start, end_ns=end))
    return losses
