"""Walking the records of a file where no index vouches for them."""

from dataclasses import replace
from typing import Final

import numpy as np
from mcap.records import Channel, Header, Schema

from pipeline.logs import records as rec
from pipeline.logs.catalog import Catalog, Cover
from pipeline.logs.errors import Loss
from pipeline.logs.messages import FIRST_PRIVATE
from pipeline.logs.resync import FIRST_BLOCK, LAST_BLOCK, possible_places
from pipeline.logs.source import ByteSource
from pipeline.logs.spans import Span, SpanKind

_FIRST_WINDOW: Final = 1 << 12
_WINDOW: Final = 1 << 18
_LOOSE_SPAN: Final = 1 << 22
_KNOWN: Final = tuple(rec.LEAST_BODY)
_CHAIN: Final = 3
_MAX_SIDE_RECORD: Final = 1 << 26


class Window:
    """A moving view of a source, so that small neighbouring reads cost one."""

    def __init__(self, source: ByteSource) -> None:
        self._source = source
        self._start = 0
        self._bytes = memoryview(b"")
        # Gaps between chunks are small, and bytes from an object store are dear: reads grow as they go on.
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
    """Walks records into a catalog.

    Args:
        source: the file.
        catalog: filled with what is found.
    """

    def __init__(self, source: ByteSource, catalog: Catalog) -> None:
        self._source = source
        self._window = Window(source)
        self._catalog = catalog
        self._known = {span.offset for span in catalog.spans}
        self._last_ns: int | None = None

    def scan(self, start: int, stop: int) -> None:
        """Walk the records in [start, stop); damage is noted and stepped over."""
        place = start
        previous = start
        while place < stop:
            after = self._take(place, stop)
            if after is None:
                after, place = self._recover(previous, place, stop)
            previous, place = place, after

    def _take(self, place: int, stop: int) -> int | None:
        """Take the record at ``place`` into the catalog; None when there is none."""
        head = self._window.view(place, rec.HEAD_SIZE)
        if len(head) < rec.HEAD_SIZE or place + rec.HEAD_SIZE > stop:
            return None
        opcode, length = rec.HEAD.unpack(head)
        after: int = place + rec.HEAD_SIZE + length
        if after > stop or length < rec.LEAST_BODY.get(opcode, 0):
            return None
        if opcode not in rec.LEAST_BODY:
            return after if opcode >= FIRST_PRIVATE and self._goes_on(after, stop) else None
        try:
            return after if self._note(opcode, place, length) else None
        except rec.RecordError:
            return None

    def _note(self, opcode: int, place: int, length: int) -> bool:
        catalog = self._catalog
        body_at = place + rec.HEAD_SIZE
        if opcode == rec.MESSAGE:
            self._note_message(place, rec.HEAD_SIZE + length)
        elif opcode == rec.CHUNK:
            head = rec.parse_chunk_head(self._window.view(body_at, min(length, 128)), length)
            if head.body + head.compressed_size != rec.HEAD_SIZE + length:
                return False
            if place not in self._known:
                self._note_chunk(SpanKind.CHUNK, place, rec.HEAD_SIZE + length, head)
        elif opcode == rec.MESSAGE_INDEX:
            self._note_index(place, rec.HEAD_SIZE + length)
        elif opcode == rec.ATTACHMENT:
            name = rec.parse_attachment_name(self._window.view(body_at, min(length, 1 << 12)))
            catalog.side_records.add((place, rec.HEAD_SIZE + length, name))
            if catalog.extras.take(0, len(name)):
                catalog.attachments.append(name)
        elif length <= _MAX_SIDE_RECORD:
            if opcode == rec.DATA_END:
                catalog.data_end = place
            self._note_small(opcode, place, self._window.view(body_at, length))
        return True

    def _note_chunk(self, kind: SpanKind, place: int, length: int, head: rec.ChunkHead) -> None:
        self._catalog.compressions.add(head.compression)
        times = (head.start_ns, head.end_ns)
        self._last_ns = max(head.end_ns, self._last_ns or 0)
        self._catalog.spans.append(Span(kind, place, length, 0, *times, inflated=head.uncompressed_size))

    def _note_small(self, opcode: int, place: int, body: memoryview) -> None:
        catalog = self._catalog
        if opcode == rec.METADATA:
            name, entries = rec.parse_metadata(body, catalog.extras.most)
            catalog.side_records.add((place, rec.HEAD_SIZE + len(body), name))
            if (
                catalog.extras.take(None if entries is None else len(entries), len(body))
                and entries is not None
            ):
                catalog.metadata.append((name, entries))
            return
        record = rec.parse_record(opcode, body)
        if isinstance(record, Schema | Channel):
            # Behind the end of the data section stands the summary, here one that is not believed.
            catalog.add_description(record, Cover.DATA if catalog.data_end is None else Cover.SUMMARY)
        elif isinstance(record, Header):
            catalog.profile, catalog.library = record.profile, record.library
        elif opcode == rec.DATA_END:
            catalog.data_crc = int.from_bytes(body[:4], "little")

    def _note_message(self, place: int, length: int) -> None:
        spans = self._catalog.spans
        if spans and spans[-1].kind is SpanKind.LOOSE:
            last = spans[-1]
            if last.offset + last.length == place and last.length + length <= _LOOSE_SPAN:
                spans[-1] = replace(last, length=last.length + length)
                return
        spans.append(Span(SpanKind.LOOSE, place, length))

    def _note_index(self, place: int, length: int) -> None:
        spans = self._catalog.spans
        if not spans or spans[-1].kind is not SpanKind.CHUNK:
            return
        last = spans[-1]
        if last.offset + last.length + last.index_length == place:
            spans[-1] = replace(last, index_length=last.index_length + length)

    def _goes_on(self, place: int, stop: int) -> bool:
        for _ in range(_CHAIN):
            if place == stop:
                return True
            head = self._window.view(place, rec.HEAD_SIZE)
            if len(head) < rec.HEAD_SIZE:
                return False
            opcode, length = rec.HEAD.unpack(head)
            if length < rec.LEAST_BODY.get(opcode, 1 << 62):
                return False
            place += rec.HEAD_SIZE + length
            if place > stop:
                return False
            if opcode == rec.FOOTER:
                return True
        return True

    def _recover(self, previous: int, place: int, stop: int) -> tuple[int, int]:
        """Note damage at ``place``: (where records go on, where the damage starts)."""
        if self._take_cut_chunk(place, stop):
            return stop, place
        last = self._catalog.spans[-1] if self._catalog.spans else None
        again = self._find(place + 1, stop)
        if (
            last is not None
            and last.kind is SpanKind.LOOSE
            and last.offset <= previous < place == last.offset + last.length
        ):
            inside = self._find(previous + 1, stop)
            if inside < place:
                self._drop_message(previous)
                place, again = previous, inside
        self._note_damage(place, again, stop)
        return again, place

    def _drop_message(self, place: int) -> None:
        last = self._catalog.spans.pop()
        if place > last.offset:
            self._catalog.spans.append(replace(last, length=place - last.offset))

    def _find(self, start: int, stop: int) -> int:
        low, size = start, FIRST_BLOCK
        while low <= stop - rec.HEAD_SIZE:
            block = np.frombuffer(self._source.read_at(low, size + rec.HEAD_SIZE - 1), dtype=np.uint8)
            high = min(block.size, stop - low) - rec.HEAD_SIZE + 1
            if high <= 0:
                break
            for inner in possible_places(block, 0, high, stop - low, _KNOWN).tolist():
                if self._goes_on(low + inner, stop):
                    return low + int(inner)
            low, size = low + high, min(2 * size, LAST_BLOCK)
        return stop

    def _take_cut_chunk(self, place: int, stop: int) -> bool:
        """Whether a chunk stands at ``place`` whose end is missing."""
        head = self._window.view(place, 128)
        if len(head) < rec.HEAD_SIZE or place + rec.HEAD_SIZE > stop:
            return False
        opcode, length = rec.HEAD.unpack_from(head, 0)
        if opcode != rec.CHUNK or place + rec.HEAD_SIZE + length <= stop:
            return False
        try:
            chunk = rec.parse_chunk_head(head[rec.HEAD_SIZE : stop - place], length)
        except rec.RecordError:
            return False
        if chunk.body + chunk.compressed_size != rec.HEAD_SIZE + length:
            return False
        self._note_chunk(SpanKind.CUT_CHUNK, place, stop - place, chunk)
        return True

    def _note_damage(self, start: int, end: int, stop: int) -> None:
        truncated = end == stop == self._source.size
        kind = "truncated" if truncated else "damaged_record"
        text = (
            f"the file breaks off: its last {end - start} bytes hold no whole record"
            if truncated
            else f"bytes {start} to {end} hold no record"
        )
        self._catalog.losses.append(Loss(kind, text, bytes=end - start, start_ns=self._last_ns))
