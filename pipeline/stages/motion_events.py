"""Events of the motion: wheels that dig in or spin, a body that slides, and the incidents of a run."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import polars as pl

from pipeline.core import Flags, Floats, arrays
from pipeline.recording import Finding
from pipeline.run import (
    ANSWERS_S,
    Limits,
    find_limits,
    trace_traction,
)
from pipeline.sources import Vehicle
from pipeline.stages.inputs import Ideal
from pipeline.stages.spans import LIVE, USUAL_S, Rims, Span, Spans, gather_rims, mark_incidents
from schemas import tabulate

_FALSE_MOTION = {"pushed", "localization_frozen"}
"""Incidents in which the body's motion says nothing about the ground under the wheels."""
_WIDTH = 5
"""Samples over which the size of an event is averaged: shorter peaks are noise of the poses."""
_SMOOTH_S = 0.5
"""Width of a running mean [s], below the 0.75 s over which poses are differentiated."""
_JOINED_S = 1.5
"""Largest gap [s] between events of one kind that are merged."""
_KINDS = {1: "digging_in", 2: "spinning", 3: "sliding"}


@dataclass(frozen=True)
class MotionEvents:
    """Table `events`, and a finding for every event that is not an incident."""

    table: pl.DataFrame = field(default_factory=lambda: tabulate("events", []))
    findings: tuple[Finding, ...] = ()


def find_events(
    velocities: pl.DataFrame,
    inputs: Mapping[str, Ideal],
    vehicle: Vehicle,
    spans: Spans,
) -> MotionEvents:
    """All events of a run in order.

    Args:
        velocities: table `velocities`, of poses alone.
        inputs: ideal velocities by input; without measured wheels only incidents are detected.
        vehicle: its track converts yaw rates to rim speeds.
        spans: contradictions of the run.
    """
    times = velocities["t"].to_numpy()
    rims = gather_rims(velocities, inputs, vehicle)
    loss, events = np.zeros(times.size), list[_Event]()
    if rims is not None and rims.driven is not None:
        fastest, driven = np.abs(rims.driven).sum(axis=1), np.nan_to_num(rims.driven)
        unknown = spans.wrong | np.isnan(fastest)
        unknown |= mark_incidents(times, [one for one in spans.incidents if one.kind in _FALSE_MOTION])
        moved = _smooth(times, rims.moved)
        gain = _measure_gain(rims, driven[:, 0], moved[:, 0])
        limits = find_limits(rims.top, gain)
        brought = gain * driven[:, 0]
        signals = _Signals(
            times,
            np.where(unknown, 0.0, brought),
            driven[:, 2],
            np.where(unknown, 0.0, _count_sideways(moved, brought)),
        )
        events = _leave_out_usual(_find_traction(signals, limits), times, fastest > LIVE * rims.top)
        events = _end_where_stuck(events, times, spans.incidents)
        wheels = np.where(signals.wheels == 0.0, np.inf, signals.wheels)
        loss = 1.0 - signals.body / wheels
    rows = [
        _make_row(velocities, kind, (times[a], times[b], times[known]), _measure_size(kind, loss[a : b + 1]))
        for kind, a, b, known in events
    ]
    for one in spans.incidents:
        ends = (one.start, one.end, min(one.start + ANSWERS_S, one.end))
        rows.append(_make_row(velocities, one.kind, ends, None))
    findings = [
        Finding(kind, "warning", t_start=float(times[a]), t_end=float(times[b])) for kind, a, b, _ in events
    ]
    rows.sort(key=lambda row: (row["t_start"], row["kind"]))
    return MotionEvents(tabulate("events", rows), tuple(findings))


_Event = tuple[str, int, int, int]
"""Kind of an event, its first and last sample, and the sample at which it is known."""


@dataclass(frozen=True)
class _Signals:
    """Inputs of `trace_traction` on the grid, shape (n,) each; zero if unknown."""

    times: Floats
    wheels: Floats
    turning: Floats
    body: Floats


def _smooth(times: Floats, values: Floats) -> Floats:
    """Running mean over `_SMOOTH_S`, shape (n, k)."""
    steps = arrays.count_steps(times, _SMOOTH_S)
    total = np.concatenate((np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)))
    low = np.maximum(np.arange(times.size) - steps // 2, 0)
    high = np.minimum(np.arange(times.size) + steps // 2 + 1, times.size)
    means: Floats = (total[high] - total[low]) / (high - low)[:, None]
    return means


def _measure_gain(rims: Rims, driven: Floats, moved: Floats) -> float:
    """Usual ratio of the body's forward motion to that of the wheels; 0 if the wheels never moved."""
    turning = np.abs(driven) > LIVE * rims.top
    return max(float(np.median(moved[turning] / driven[turning])), 0.0) if turning.any() else 0.0


def _count_sideways(moved: Floats, brought: Floats) -> Floats:
    """Forward speed of the body, to which sideways motion is added up to the speed of the wheels.

    A vehicle that slides sideways through a turn moves: neither does it dig in nor do its wheels spin in
    place. Only up to the speed of the wheels, because a sensor ahead of the axles moves sideways in every
    turn, which is no slide.

    Args:
        moved: (v_x, v_y, v_w times half the track) of the body [m/s], shape (n, 3).
        brought: forward speed of the body that is usual at the wheel speeds [m/s], shape (n,).
    """
    forward, total = moved[:, 0], np.hypot(moved[:, 0], moved[:, 1])
    missing = np.minimum(total, np.abs(brought)) - np.abs(forward)
    counted: Floats = forward + np.sign(brought) * np.maximum(missing, 0.0)
    return counted


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
        # Wheels that dig themselves in finally spin.
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
    """First sample of an event that is detected at a later sample."""
    least = 1.0 - limits.drop if kind == "digging_in" else limits.half
    for index in range(first, 0, -1):
        wheel, speed = signals.wheels[index - 1], signals.body[index - 1]
        slides = abs(speed) > limits.excess * abs(wheel) + 0.5 * limits.margin
        slips = abs(wheel) > limits.live and speed * np.sign(wheel) < least * abs(wheel)
        if not (slides if kind == "sliding" else slips):
            return index
    return 0


def _leave_out_usual(events: Sequence[_Event], times: Floats, driven: Flags) -> list[_Event]:
    """The infrequent events: what occurs repeatedly is a property of the ground."""
    driven_s = float(np.sum(np.diff(times)[driven[1:]]))
    counts = Counter(kind for kind, *_ in events)
    return [event for event in events if counts[event[0]] <= max(driven_s / USUAL_S, 1.0)]


def _end_where_stuck(events: Sequence[_Event], times: Floats, incidents: Sequence[Span]) -> list[_Event]:
    """The events up to the time at which the vehicle is stuck, which explains the later ones."""
    for kind, start, end, _ in incidents:
        if kind == "stuck":
            last = int(np.searchsorted(times, start))
            events = [
                (name, a, min(b, max(last, a)) if times[a] < end else b, known)
                for name, a, b, known in events
                if not start <= times[a] < end
            ]
    return list(events)


def _measure_size(kind: str, loss: Floats) -> float:
    """Largest fraction of motion lost, or for a sliding body the largest fraction not made by the wheels."""
    width = min(_WIDTH, loss.size)
    smooth = np.convolve(loss, np.full(width, 1.0 / width), mode="valid")
    if kind == "sliding":
        # Body over wheels is one minus the loss; the fraction beyond the wheels is one minus its inverse.
        return float(np.clip(1.0 - 1.0 / max(float(np.abs(1.0 - smooth).max()), 1.0), 0.0, 1.0))
    return float(np.clip(smooth.max(), 0.0, 1.0))


def _make_row(
    velocities: pl.DataFrame, kind: str, when: tuple[float, float, float], size: float | None
) -> dict[str, object]:
    start, end, known = (float(one) for one in when)
    row = min(int(velocities["t"].search_sorted(start)), velocities.height - 1)
    x, y = (float(velocities[name][row]) for name in ("x", "y"))
    return {"kind": kind, "t_start": start, "t_end": end, "t_known": known, "size": size, "x": x, "y": y}
