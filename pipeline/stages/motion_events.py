"""Events in motion: wheels that spin or dig in, a body that slides, and the incidents, as a table."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import arrays
from pipeline.core.tables import tabulate
from pipeline.stages.finding import Finding
from pipeline.stages.incidents import ANSWERS_S, LIVE, USUAL_S, gather_rims, mark_left_out, measure_gain

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import polars as pl

    from pipeline.core.arrays import Flags, Floats
    from pipeline.sources import Vehicle
    from pipeline.stages.incidents import Span
    from pipeline.stages.slip_stage import Ideal

# What tells an event at a moment is known at that moment: the rule runs forward in time, and the same source
# is exported for robots (`pipeline/export/targets/traction.py`). Shares are of the motion that the wheels
# usually bring on this ground, so that deep snow that takes half all the time is no event. Turning is left
# out: what a skid-steered vehicle slips in turns is its drive.


@dataclass(frozen=True)
class Limits:
    """Thresholds of `trace_traction`; `make events` measures misses, false alarms and lead times with them.

    Attributes:
        live: wheels that bring less tell nothing of the ground [m/s].
        margin: a body that slides is faster than its wheels by so much [m/s].
        window_s: wheels turn alike for so long before the body is compared with them [s]: lags are over then.
        steady: share by which their speed changes in it at most [1].
        falls_s: the body's share of the wheels' motion is set against that of so long ago, and up to three
            times as long [s].
        drop: by which it falls in that time [1].
        half: share below which wheels that dig in are told [1].
        lost: share below which wheels spin, however they came to it [1].
        excess: times the wheels' speed that a sliding body has [1]; poses that have it on steady wheels jump.
        dig_hold_s: how long the motion is lost before it is told [s].
    sudden_s: wheels that brought almost nothing for so long of it broke loose: they did not dig in [s].
        hold_s: how long wheels spin or a body slides before it is told [s].
    """

    live: float
    margin: float
    window_s: float = 1.0
    steady: float = 0.3
    falls_s: float = 3.0
    drop: float = 0.3
    half: float = 0.5
    lost: float = 0.3
    excess: float = 1.5
    dig_hold_s: float = 1.0
    sudden_s: float = 0.6
    hold_s: float = 1.5


LEAST_SHARE = 0.125
"""Of the usual largest speed, which wheels must bring: slower ones tell nothing of the ground."""
MARGIN_SHARE = 0.25
"""Of it, by which a body must be faster than its wheels: lags and poses that wander stay below."""
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


def trace_traction(
    wheels: Sequence[float],
    turning: Sequence[float],
    body: Sequence[float],
    step_s: float,
    *,
    live: float,
    margin: float,
    window_s: float,
    steady: float,
    falls_s: float,
    drop: float,
    half: float,
    lost: float,
    excess: float,
    dig_hold_s: float,
    sudden_s: float,
    hold_s: float,
) -> list[int]:
    """What the wheels do at every step: 0 drive, 1 dig in, 2 spin, 3 slide.

    Args:
        wheels: forward speed that the wheels usually bring when they turn as they do [m/s].
        turning: rim speed of their turning, half the track times the yaw rate that they ask for [m/s].
        body: forward speed of the body [m/s].
        step_s: time between two of them [s].
        live: wheels that bring less tell nothing [m/s].
        margin: a sliding body is faster than its wheels by so much [m/s].
        window_s: wheels turn alike for so long before the body is compared with them [s].
        steady: share by which their speed changes in it at most.
        falls_s: the body's share of the wheels' motion is set against that of so long ago, and up to three
            times as long [s].
        drop: by which it falls.
        half: share below which wheels dig in.
        lost: share below which they spin.
        excess: times the wheels' speed that a sliding body has.
        dig_hold_s: how long the motion is lost before it is told [s].
        sudden_s: wheels that brought almost nothing for so long of it broke loose: they did not dig in [s].
        hold_s: how long they spin, or the body slides, before it is told [s].
    """
    window, falls = round(window_s / step_s), round(falls_s / step_s)
    codes, shares = [], []
    compared = digs = spins = slides = 0
    share = 1.0
    surge = -falls - 1
    for now in range(len(wheels)):
        recent = wheels[max(now - window, 0) : now + 1]
        slowest, fastest = min(recent), max(recent)
        forward = 1.0 if slowest > 0.0 else -1.0
        if forward < 0.0:
            slowest, fastest = -fastest, -slowest
        is_straight = abs(turning[now]) < abs(wheels[now])
        compared = compared + 1 if slowest > live and is_straight else 0
        # While the wheels change their speed, nothing is learned of the ground and nothing is forgotten.
        is_steady = not compared or fastest - slowest < steady * fastest
        if is_steady:
            share = forward * body[now] / slowest if compared else 1.0
        if share > excess:
            surge = now
        # Poses that ran ahead of the wheels stand still until these have caught up.
        share = share if now - surge > falls else 1.0
        shares.append(share)
        earlier = shares[max(now - compared + 1, now - 3 * falls) : now - falls]
        before = max(earlier) if earlier else share
        digs = digs + 1 if share < half and before - share > drop else 0
        spins = spins + is_steady if share < lost else 0
        most = max(abs(slowest), abs(fastest))
        slides = slides + 1 if abs(body[now]) > excess * most + margin else 0
        if spins * step_s > hold_s:
            codes.append(2)
        elif is_steady and digs * step_s > dig_hold_s and spins * step_s <= sudden_s:
            codes.append(1)
        elif slides * step_s > hold_s:
            codes.append(3)
        else:
            codes.append(0)
    return codes


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
    loss, found = np.zeros(times.size), list[_Event]()
    if rims is not None and rims.wheels is not None:
        unknown = bad | mark_left_out(times, [span for span in incidents if span[0] != "stuck"])
        gain = measure_gain(rims, 0)
        limits = Limits(LEAST_SHARE * rims.top, MARGIN_SHARE * rims.top)
        # A body that is faster than usual but not faster than its wheels has found better ground.
        limits = replace(limits, excess=limits.excess / min(max(gain, LEAST_SHARE), 1.0))
        signals = _Signals(
            times,
            np.where(unknown, 0.0, gain * rims.driven[:, 0]),
            rims.driven[:, 2],
            np.where(unknown, 0.0, rims.moved[:, 0]),
        )
        found = _leave_out_usual(_find_traction(signals, limits), times, rims.wheels > LIVE * rims.top)
        found = _end_where_stuck(found, times, incidents)
        wheels = np.where(signals.wheels == 0.0, np.inf, signals.wheels)
        loss = 1.0 - signals.body / wheels
    rows = [
        _make_row(velocities, kind, (times[a], times[b], times[known]), _measure_size(kind, loss[a : b + 1]))
        for kind, a, b, known in found
    ]
    for kind, start, end in incidents:
        rows.append(_make_row(velocities, kind, (start, end, min(start + ANSWERS_S, end)), None))
    findings = [
        Finding(kind, "warning", _MEANS[kind], t_start=float(times[a]), t_end=float(times[b]))
        for kind, a, b, _ in found
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
    found: list[_Event] = []
    joined, place = arrays.count_steps(times, _JOINED_S), 0
    while place < len(codes):
        if codes[place] == 0:
            place += 1
            continue
        first, kind = place, _KINDS[codes[place]]
        # Wheels that dig themselves in spin in the end.
        while (
            place < len(codes) and codes[place] and (_KINDS[codes[place]] == "sliding") == (kind == "sliding")
        ):
            place += 1
        begin = _go_back(first, kind, signals, limits)
        if found and found[-1][0] == kind and begin - found[-1][2] <= joined:
            found[-1] = (kind, found[-1][1], place - 1, found[-1][3])
        else:
            found.append((kind, begin, place - 1, first))
    return found


def _go_back(first: int, kind: str, signals: _Signals, limits: Limits) -> int:
    """The sample at which an event began that is known at another."""
    least = 1.0 - limits.drop if kind == "digging_in" else limits.half
    for place in range(first, 0, -1):
        wheel, speed = signals.wheels[place - 1], signals.body[place - 1]
        slides = abs(speed) > limits.excess * abs(wheel) + limits.margin
        slips = abs(wheel) > limits.live and speed * np.sign(wheel) < least * abs(wheel)
        if not (slides if kind == "sliding" else slips):
            return place
    return 0


def _leave_out_usual(found: Sequence[_Event], times: Floats, driven: Flags) -> list[_Event]:
    """The events of which there are few: what happens again and again is how this ground is."""
    driven_s = float(np.sum(np.diff(times)[driven[1:]]))
    counts = Counter(kind for kind, *_ in found)
    return [event for event in found if counts[event[0]] <= max(driven_s / USUAL_S, 1.0)]


def _end_where_stuck(found: Sequence[_Event], times: Floats, incidents: Sequence[Span]) -> list[_Event]:
    """The events up to where the vehicle is stuck: from there on that is what happens."""
    for kind, start, end in incidents:
        if kind == "stuck":
            last = int(np.searchsorted(times, start))
            found = [
                (name, a, min(b, max(last, a)) if times[a] < end else b, known)
                for name, a, b, known in found
                if not start <= times[a] < end
            ]
    return list(found)


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
    place = min(int(velocities["t"].search_sorted(start)), velocities.height - 1)
    x, y = (float(velocities[name][place]) for name in ("x", "y"))
    return {"kind": kind, "t_start": start, "t_end": end, "t_known": known, "size": size, "x": x, "y": y}
