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
from pipeline.logs.chunks import FIRST_PRIVATE, ByteSpan, SpanKind
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
_CHUNK_HEAD: Final = 128
"""Bytes of a chunk that hold its head."""


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
    """Scans a file into a catalog.

    Args:
        source: the file.
        catalog: receives the records.
    """

    def __init__(self, source: ByteSource, catalog: Catalog) -> None:
        self._source = source
        self._window = Window(source)
        self._catalog = catalog
        self._last_ns: int | None = None

    def scan(self, start: int, stop: int, listed: Sequence[ByteSpan]) -> None:
        """Take the listed chunks, and scan the records in [start, stop) that they leave.

        Damage is recorded as a loss and skipped.
        """
        for span in listed:
            self._scan_gap(start, span.offset)
            self._catalog.spans.append(span)
            start = span.end
        self._scan_gap(start, stop)

    def _scan_gap(self, start: int, stop: int) -> None:
        position = previous = start
        while position < stop:
            after = self._take(position, stop)
            if after is None:
                after, position = self._recover(previous, position, stop)
            previous, position = position, after

    def _take(self, position: int, stop: int) -> int | None:
        """Add the record at ``position`` to the catalog; returns the offset after it, None if invalid."""
        if position + rec.HEAD_SIZE > stop:
            return None
        head = self._window.view(position, rec.HEAD_SIZE)
        opcode, length = rec.HEAD.unpack(head) if len(head) == rec.HEAD_SIZE else (0, 0)
        after: int = position + rec.HEAD_SIZE + length
        is_cut = after > stop
        if length < rec.LEAST_BODY.get(opcode, 0) or (is_cut and opcode != rec.CHUNK):
            return None
        if opcode not in rec.LEAST_BODY:
            return after if opcode >= FIRST_PRIVATE and self._goes_on(after, stop) else None
        try:
            return min(after, stop) if self._note(opcode, position, after, stop) else None
        except rec.RecordError:
            return None

    def _note(self, opcode: int, position: int, after: int, stop: int) -> bool:
        catalog, body_at = self._catalog, position + rec.HEAD_SIZE
        last = catalog.spans[-1] if catalog.spans else None
        if opcode == rec.MESSAGE:
            if (
                last is not None
                and last.kind is SpanKind.LOOSE
                and last.end == position
                and after - last.offset <= _LOOSE_SPAN
            ):
                catalog.spans[-1] = replace(last, length=after - last.offset)
            else:
                catalog.spans.append(ByteSpan(SpanKind.LOOSE, position, after - position))
        elif opcode == rec.CHUNK:
            start = self._window.view(body_at, min(after - body_at, _CHUNK_HEAD, stop - body_at))
            head = rec.parse_chunk_head(start, after - body_at)
            if position + head.body + head.compressed_size != after:
                return False
            kind = SpanKind.CHUNK if after <= stop else SpanKind.CUT_CHUNK
            times = head.start_ns, head.end_ns
            length, size = min(after, stop) - position, head.uncompressed_size
            catalog.spans.append(ByteSpan(kind, position, length, 0, *times, inflated=size))
            catalog.compressions.add(head.compression)
            self._last_ns = max(head.end_ns, self._last_ns or 0)
        elif opcode == rec.MESSAGE_INDEX:
            if last is not None and last.kind is SpanKind.CHUNK and last.end == position:
                catalog.spans[-1] = replace(last, index_length=after - last.offset - last.length)
        elif opcode == rec.ATTACHMENT:
            name = rec.parse_attachment_name(self._window.view(body_at, min(after - body_at, 1 << 12)))
            catalog.side_records.add((position, after - position, name))
            if catalog.extras.take(0, len(name)):
                catalog.attachments.append(name)
        elif after - body_at <= _MAX_SIDE_RECORD:
            self._note_small(opcode, position, self._window.view(body_at, after - body_at))
        return True

    def _note_small(self, opcode: int, position: int, body: memoryview) -> None:
        catalog = self._catalog
        if opcode == rec.METADATA:
            name, entries = rec.parse_metadata(body, catalog.extras.most)
            catalog.side_records.add((position, rec.HEAD_SIZE + len(body), name))
            if catalog.extras.take(catalog.extras.most if entries is None else len(entries), len(body)):
                catalog.metadata.append((name, entries or {}))
        elif opcode == rec.DATA_END:
            catalog.data_end, catalog.data_crc = position, int.from_bytes(body[:4], "little")
        record = rec.parse_record(opcode, body)
        if isinstance(record, Header):
            catalog.profile, catalog.library = record.profile, record.library
        elif isinstance(record, Schema | Channel) and catalog.data_end is not None:
            catalog.repeated.append(record)
        elif isinstance(record, Schema | Channel):
            catalog.add_description(record, covered=False)

    def _goes_on(self, position: int, stop: int) -> bool:
        """Whether the next records are possible."""
        for _ in range(_CHAIN):
            if position == stop:
                return True
            head = self._window.view(position, rec.HEAD_SIZE)
            opcode, length = rec.HEAD.unpack(head) if len(head) == rec.HEAD_SIZE else (0, 0)
            position += rec.HEAD_SIZE + length
            if length < rec.LEAST_BODY.get(opcode, 1 << 62) or position > stop:
                return False
            if opcode == rec.FOOTER:
                break
        return True

    def _recover(self, previous: int, position: int, stop: int) -> tuple[int, int]:
        """Record damage at ``position``; returns the offset of the next record and that of the damage."""
        spans, again = self._catalog.spans, self._find(position + 1, stop)
        last = spans[-1] if spans else None
        if (
            last is not None
            and last.kind is SpanKind.LOOSE
            and last.offset <= previous < position == last.end
        ):
            inside = self._find(previous + 1, stop)
            if inside < position:
                # The length of the message before is damaged.
                position, again = previous, inside
                spans[-1:] = [replace(last, length=previous - last.offset)] if previous > last.offset else []
        truncated = again == stop == self._source.size
        kind = "truncated" if truncated else "damaged_record"
        text = (
            f"the file is truncated: its last {again - position} bytes are no complete record"
            if truncated
            else f"bytes {position} to {again} hold no record"
        )
        self._catalog.losses.append(Loss(kind, text, bytes=again - position, start_ns=self._last_ns))
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

Numbered: TypeAlias = tuple[ByteSpan, NDArray[np.integer], NDArray[np.uint32], Ints]
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
    apart = [a.end != b.offset for a, b in pairwise(spans)]
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
