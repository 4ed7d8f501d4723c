"""Chunks that are missing from a file that nothing counts: the numbers of its messages jump there."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

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

    def add(self, numbers: Ints, log_time: Ints, place: int) -> None:
        """Take the messages of the next chunk."""
        by_one = np.diff(numbers) == 1
        self.steps += int(by_one.sum())
        self.regular &= bool(by_one.all())
        self.low, self.high = min(self.low, int(numbers.min())), max(self.high, int(numbers.max()))
        if self.last is not None:
            number, time, before = self.last
            step = int(numbers[0]) - number
            self.steps += step == 1
            self.regular &= step >= 1
            if step > 1:
                self.jumps.append(_Jump((before, place), number, int(numbers[0]), time, int(log_time[0])))
        self.last = int(numbers[-1]), int(log_time[-1]), place


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
            self._add(_WHOLE_FILE, messages.sequence, messages.log_time, span.offset)
            order = np.argsort(messages.channel, kind="stable")
            sequence, log_time = messages.sequence[order], messages.log_time[order]
            numbers, counts = np.unique(messages.channel, return_counts=True)
            ends = np.cumsum(counts)
            for number, low, high in zip(numbers.tolist(), ends - counts, ends, strict=True):
                self._add(number, sequence[low:high], log_time[low:high], span.offset)

    def _add(self, number: int, sequence: NDArray[np.uint32], log_time: Ints, place: int) -> None:
        if sequence.size:
            series = self._series.setdefault(number, _Series())
            series.add(sequence.astype(np.int64), log_time, place)

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
