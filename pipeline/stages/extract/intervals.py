"""When commands are live: a state topic or given times."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.stages.errors import StageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.vehicles.configuration import IntervalSection

Floats = NDArray[np.float64]
Span = tuple[float, float]


def find_spans_of_state(times: Floats, states: Sequence[str], value: str) -> list[Span]:
    """Spans [s] in which a state topic says ``value``; the last one is open."""
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
    return spans


def find_spans_given(sections: Sequence[IntervalSection], where: str) -> list[Span]:
    """Spans [s] that the configuration gives by time.

    Raises:
        StageError: a span ends before it starts.
    """
    spans = []
    for section in sections:
        if section.topic is not None:
            continue
        start = -np.inf if section.start_s is None else section.start_s
        end = np.inf if section.end_s is None else section.end_s
        if end <= start:
            raise StageError(
                "bad_interval",
                f"an interval ends at {end} s, before it starts at {start} s",
                where=where,
                hint="Give [[interval]] a start_s below its end_s, in seconds from the run's start.",
            )
        spans.append((start, end))
    return spans


def is_inside(times: Floats, spans: Sequence[Span] | None) -> NDArray[np.bool_]:
    """Whether each time lies in any of the spans; everything does when there are no spans at all (None)."""
    if spans is None:
        return np.ones(times.size, dtype=bool)
    inside = np.zeros(times.size, dtype=bool)
    for start, end in spans:
        inside |= (times >= start) & (times < end)
    return inside
