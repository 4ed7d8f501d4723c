"""When commands are live: a state topic or given times."""

from collections.abc import Sequence

import numpy as np

from pipeline.core.arrays import Flags, Floats
from pipeline.stages.errors import StageError
from pipeline.vehicles import DEFAULT_INTERVAL
from pipeline.vehicles.configuration import IntervalSection

Span = tuple[float, float]


def find_spans_of_state(times: Floats, states: Sequence[str], section: IntervalSection) -> list[Span]:
    """Spans [s] in which a state topic says what a section asks for, within the section's own times.

    The last span is open: the topic need not be repeated while its state lasts.
    """
    value = section.equals or DEFAULT_INTERVAL[1]
    spans: list[Span] = []
    begin: float | None = None
    for time, state in zip(times.tolist(), states, strict=True):
        if state == value and begin is None:
            begin = time
        elif state != value and begin is not None:
            spans.append((begin, time))
            begin = None
    if begin is not None:
        spans.append((begin, np.inf))
    earliest, latest = _limits_of(section)
    cut = [(max(start, earliest), min(end, latest)) for start, end in spans]
    return [(start, end) for start, end in cut if start < end]


def _limits_of(section: IntervalSection) -> Span:
    start = -np.inf if section.start_s is None else section.start_s
    end = np.inf if section.end_s is None else section.end_s
    return start, end


def find_spans_given(sections: Sequence[IntervalSection], where: str) -> list[Span]:
    """Spans [s] that the configuration gives by time.

    Raises:
        StageError: a span ends before it starts.
    """
    spans = []
    for section in sections:
        start, end = _limits_of(section)
        if end <= start:
            what = f"an interval ends at {end} s, before it starts at {start} s"
            hint = "Give [[interval]] a start_s below its end_s, in seconds from the run's start."
            raise StageError("bad_interval", what, where=where, hint=hint)
        if section.topic is None:
            spans.append((start, end))
    return spans


def is_inside(times: Floats, spans: Sequence[Span] | None) -> Flags:
    """Whether each time lies in any of the spans; everything does when there are no spans at all (None)."""
    if spans is None:
        return np.ones(times.size, dtype=bool)
    inside = np.zeros(times.size, dtype=bool)
    for start, end in spans:
        inside |= (times >= start) & (times < end)
    return inside
