"""Chunks that are missing from a file that nothing counts: the numbers of its messages jump there."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from pipeline.core.arrays import Ints
from pipeline.logs.errors import Loss
from pipeline.logs.spans import Loaded, Span, SpanKind

_STEPS_PER_JUMP: Final = 20
"""Steps by one that a channel takes for every jump; fewer are no counting."""

_LISTED: Final = 6
"""So many topics are named."""

_WHOLE_FILE: Final = -1
"""Stands for a channel: of writers that count the messages of all channels together."""


@dataclass(frozen=True, slots=True)
class _Jump:
    """Where the numbers of a channel do not go on: places of the chunks, numbers, log times [ns]."""

    place: tuple[int, int]
    before: int
    after: int
    start_ns: int
    end_ns: int


class _Piece(NamedTuple):
    """The numbers of one channel in one chunk, and the log times [ns] of its first and last message."""

    size: int
    steps: int
    first: int
    last: int
    low: int
    high: int
    start_ns: int
    end_ns: int


def _cut(channel: NDArray[np.uint16], sequence: Ints, log_time: Ints) -> Iterator[tuple[int, _Piece]]:
    """Cut messages that are sorted by channel into the pieces of each."""
    if not channel.size:
        return
    low = np.flatnonzero(np.append(True, channel[1:] != channel[:-1]))
    high = np.append(low[1:], channel.size)
    by_one = np.append(0, np.diff(sequence) == 1)
    # A step into a channel is none of it.
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
    """The numbers of one channel so far.

    Attributes:
        steps: by one.
        regular: whether all others are jumps ahead from one chunk to the next.
        jumps: those.
        low: smallest number.
        high: largest number.
        last: number, log time [ns] and chunk of the last message; None where it is not known.
    """

    steps: int = 0
    regular: bool = True
    jumps: list[_Jump] = field(default_factory=list)
    low: int = 1 << 32
    high: int = -1
    last: tuple[int, int, int] | None = None

    @property
    def counts(self) -> bool:
        """Whether its writer has certainly counted."""
        return self.regular and self.steps >= _STEPS_PER_JUMP * max(1, len(self.jumps))

    def add(self, piece: _Piece, place: int) -> None:
        """Take the messages of the next chunk."""
        self.steps += piece.steps
        self.regular &= piece.steps == piece.size - 1
        self.low, self.high = min(self.low, piece.low), max(self.high, piece.high)
        if self.last is not None:
            number, time, before = self.last
            step = piece.first - number
            self.steps += step == 1
            self.regular &= step >= 1
            if step > 1:
                self.jumps.append(_Jump((before, place), number, piece.first, time, piece.start_ns))
        self.last = piece.last, piece.end_ns, place


class SequenceCheck:
    """Compares the numbers of messages from chunk to chunk."""

    def __init__(self) -> None:
        self._series: dict[int, _Series] = {}
        self._end: int | None = None

    def add(self, span: Span, loaded: Loaded) -> None:
        """Take the next stretch of the file; what is lost in it or before it explains what is missing."""
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
            found = [
                *((_WHOLE_FILE, piece) for _, piece in _cut(everything, sequence, messages.log_time)),
                *_cut(messages.channel[order], sequence[order], messages.log_time[order]),
            ]
            for number, piece in found:
                self._series.setdefault(number, _Series()).add(piece, span.offset)

    def find_losses(self, channels: Mapping[int, Channel]) -> list[Loss]:
        """Messages that are missing between two chunks, where it is certain that their writer counted.

        Args:
            channels: by number.
        """
        together = self._series.pop(_WHOLE_FILE, _Series())
        counting = {_WHOLE_FILE: together} if together.counts else self._series
        # Numbers that another channel may have used are no jump: its writer may count them together.
        other = [series for series in self._series.values() if not series.counts and not together.counts]
        found: dict[tuple[int, int], dict[int, _Jump]] = {}
        for number, series in counting.items():
            for jump in series.jumps if series.counts else ():
                if all(each.high <= jump.before or each.low >= jump.after for each in other):
                    found.setdefault(jump.place, {})[number] = jump
        return [_describe(place, jumps, channels) for place, jumps in sorted(found.items())]


def _describe(place: tuple[int, int], jumps: Mapping[int, _Jump], channels: Mapping[int, Channel]) -> Loss:
    missing = sum(jump.after - jump.before - 1 for jump in jumps.values())
    topics = [channels[number].topic for number in jumps if number in channels]
    listed = ", ".join(topics[:_LISTED]) + (", ..." if len(topics) > _LISTED else "")
    text = (
        f"{missing} messages{f' of {listed}' if listed else ''} are missing between the chunks at {place[0]} "
        f"and {place[1]}: their numbers, which count by one everywhere else, jump there"
    )
    start, end = (min(jump.start_ns for jump in jumps.values()), max(jump.end_ns for jump in jumps.values()))
    return Loss("missing_messages", text, start_ns=start, end_ns=end)
