"""Events in motion: wheels that spin or dig in, a body that slides, and the incidents, as a table."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import arrays
from pipeline.core.tables import tabulate
from pipeline.run.signals import ANSWERS_S
from pipeline.run.traction import Limits, find_limits, trace_traction
from pipeline.stages.finding import Finding
from pipeline.stages.incidents import LIVE, USUAL_S, gather_rims, mark_excluded, measure_gain

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import polars as pl

    from pipeline.core.arrays import Flags, Floats
    from pipeline.sources import Vehicle
    from pipeline.stages.incidents import Span
    from pipeline.stages.slip_stage import Ideal

_WIDTH = 5
"""Samples over which the size of an event is averaged: shorter peaks are noise of the poses."""
_JOINED_S = 1.0
"""Events of a kind that are this near are one."""
_KINDS = {1: "digging_in", 2: "spinning", 3: "sliding"}
_MEANS = {
    "digging_in": "the wheels brought less and less of their usual motion: the vehicle dug itself in",
    "spinning": "the wheels turned and brought almost nothing of their usual motion: they spun",
    "sliding": "the body moved faster than its wheels turned: it slid",
}


@dataclass(frozen=True)
class MotionEvents:
    """Table `events`, and a finding for every event that is no incident."""

    table: pl.DataFrame = field(default_factory=lambda: tabulate("events", []))
    findings: tuple[Finding, ...] = ()


def find_events(
    velocities: pl.DataFrame,
    inputs: Mapping[str, Ideal],
    vehicle: Vehicle,
    bad: Flags,
    incidents: Sequence[Span],
) -> MotionEvents:
    """Everything that happened in a run, in order.

    Args:
        velocities: table `velocities`, of poses alone.
        inputs: ideal velocities by input; without measured wheels there are incidents only.
        vehicle: whose track makes rims of yaw rates.
        bad: samples with wrong poses, shape (n,).
        incidents: kind, begin and end [s] of each.
    """
    times = velocities["t"].to_numpy()
    rims = gather_rims(velocities, inputs, vehicle)
    loss, events = np.zeros(times.size), list[_Event]()
    if rims is not None and rims.wheels is not None:
        unknown = bad | mark_excluded(times, [span for span in incidents if span[0] != "stuck"])
        gain = measure_gain(rims, 0)
        limits = find_limits(rims.top, gain)
        signals = _Signals(
            times,
            np.where(unknown, 0.0, gain * rims.driven[:, 0]),
            rims.driven[:, 2],
            np.where(unknown, 0.0, rims.moved[:, 0]),
        )
        events = _leave_out_usual(_find_traction(signals, limits), times, rims.wheels > LIVE * rims.top)
        events = _end_where_stuck(events, times, incidents)
        wheels = np.where(signals.wheels == 0.0, np.inf, signals.wheels)
        loss = 1.0 - signals.body / wheels
    rows = [
        _make_row(velocities, kind, (times[a], times[b], times[known]), _measure_size(kind, loss[a : b + 1]))
        for kind, a, b, known in events
    ]
    for kind, start, end in incidents:
        rows.append(_make_row(velocities, kind, (start, end, min(start + ANSWERS_S, end)), None))
    findings = [
        Finding(kind, "warning", _MEANS[kind], t_start=float(times[a]), t_end=float(times[b]))
        for kind, a, b, _ in events
    ]
    rows.sort(key=lambda row: (row["t_start"], row["kind"]))
    return MotionEvents(tabulate("events", rows), tuple(findings))


_Event = tuple[str, int, int, int]
"""Kind of an event, its first and last sample, and the sample at which it is known."""


@dataclass(frozen=True)
class _Signals:
    """What `trace_traction` reads, on the grid, shape (n,) each; zero where nothing is known."""

    times: Floats
    wheels: Floats
    turning: Floats
    body: Floats


def _find_traction(signals: _Signals, limits: Limits) -> list[_Event]:
    times, wheels, body = signals.times, signals.wheels, signals.body
    step = float(np.median(np.diff(times)))
    codes = trace_traction(wheels.tolist(), signals.turning.tolist(), body.tolist(), step, **vars(limits))
    events: list[_Event] = []
    joined, index = arrays.count_steps(times, _JOINED_S), 0
    while index < len(codes):
        if codes[index] == 0:
            index += 1
            continue
        first, kind = index, _KINDS[codes[index]]
        # Wheels that dig themselves in spin in the end.
        while (
            index < len(codes) and codes[index] and (_KINDS[codes[index]] == "sliding") == (kind == "sliding")
        ):
            index += 1
        begin = _go_back(first, kind, signals, limits)
        if events and events[-1][0] == kind and begin - events[-1][2] <= joined:
            events[-1] = (kind, events[-1][1], index - 1, events[-1][3])
        else:
            events.append((kind, begin, index - 1, first))
    return events


def _go_back(first: int, kind: str, signals: _Signals, limits: Limits) -> int:
    """The sample at which an event began that is known at another."""
    least = 1.0 - limits.drop if kind == "digging_in" else limits.half
    for index in range(first, 0, -1):
        wheel, speed = signals.wheels[index - 1], signals.body[index - 1]
        slides = abs(speed) > limits.excess * abs(wheel) + 0.5 * limits.margin
        slips = abs(wheel) > limits.live and speed * np.sign(wheel) < least * abs(wheel)
        if not (slides if kind == "sliding" else slips):
            return index
    return 0


def _leave_out_usual(events: Sequence[_Event], times: Floats, driven: Flags) -> list[_Event]:
    """The events of which there are few: what happens again and again is how this ground is."""
    driven_s = float(np.sum(np.diff(times)[driven[1:]]))
    counts = Counter(kind for kind, *_ in events)
    return [event for event in events if counts[event[0]] <= max(driven_s / USUAL_S, 1.0)]


def _end_where_stuck(events: Sequence[_Event], times: Floats, incidents: Sequence[Span]) -> list[_Event]:
    """The events up to where the vehicle is stuck: from there on that is what happens."""
    for kind, start, end in incidents:
        if kind == "stuck":
            last = int(np.searchsorted(times, start))
            events = [
                (name, a, min(b, max(last, a)) if times[a] < end else b, known)
                for name, a, b, known in events
                if not start <= times[a] < end
            ]
    return list(events)


def _measure_size(kind: str, loss: Floats) -> float:
    """The largest share of motion that is lost, or of a sliding body's that the wheels did not make."""
    width = min(_WIDTH, loss.size)
    smooth = np.convolve(loss, np.full(width, 1.0 / width), mode="valid")
    if kind == "sliding":
        # Body over wheels is one minus the loss: what the wheels did not make is one minus its inverse.
        return float(np.clip(1.0 - 1.0 / max(float(np.abs(1.0 - smooth).max()), 1.0), 0.0, 1.0))
    return float(np.clip(smooth.max(), 0.0, 1.0))


def _make_row(
    velocities: pl.DataFrame, kind: str, when: tuple[float, float, float], size: float | None
) -> dict[str, object]:
    start, end, known = (float(one) for one in when)
    row = min(int(velocities["t"].search_sorted(start)), velocities.height - 1)
    x, y = (float(velocities[name][row]) for name in ("x", "y"))
    return {"kind": kind, "t_start": start, "t_end": end, "t_known": known, "size": size, "x": x, "y": y}
