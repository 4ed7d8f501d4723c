"""Traction over time: whether wheels dig in or spin, or the body slides, from the last seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

# What tells an event at a moment is known at that moment: the rule runs forward in time, and the same source
# is exported for robots (`export/targets/data_formats.py`). Shares are of the motion that the wheels
# usually bring on this ground, so that deep snow that takes half all the time is no event. Turning is left
# out: what a skid-steered vehicle slips in turns is its drive.


@dataclass(frozen=True)
class Limits:
    """Thresholds of `trace_traction`; `make events` measures misses, false alarms and lead times with them.

    Attributes:
        live: wheels that bring less tell nothing of the ground [m/s].
        margin: a body that slides is faster than its wheels by so much [m/s], or by half of it for longer.
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
"""Of the usual largest speed, which wheels must bring: slower ones tell nothing of the ground. Also the least
gain that a limit is divided by."""
MARGIN_SHARE = 0.25
"""Share of it by which a body must be faster than its wheels: lags and drifting poses stay below."""


def find_limits(top: float, gain: float) -> Limits:
    """Thresholds for a vehicle.

    Args:
        top: usual largest speed [m/s].
        gain: forward speed that the wheels usually bring, over their own.
    """
    # A body that is faster than usual but not faster than its wheels has found better ground.
    excess = Limits.excess / min(max(gain, LEAST_SHARE), 1.0)
    return Limits(LEAST_SHARE * top, MARGIN_SHARE * top, excess=excess)


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
    """State of the wheels at every step: 0 drive, 1 dig in, 2 spin, 3 slide.

    Args:
        wheels: forward speed that the wheels usually bring when they turn as they do [m/s].
        turning: rim speed of their turning, half the track times the yaw rate that they ask for [m/s].
        body: forward speed of the body [m/s].
        step_s: time between two of them [s].
        live: wheels that bring less tell nothing [m/s].
        margin: a sliding body is faster than its wheels by so much [m/s], or by half of it for longer.
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
    compared = digs = spins = 0
    slid = 0.0
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
        # Page's cumulative sum with bounded steps: a body that slows down as it slides still counts, and a
        # jump of the poses counts no more than its time.
        faster = 2.0 * (abs(body[now]) - excess * most) - margin
        slid = max(slid + min(faster, margin) * step_s, 0.0)
        if spins * step_s > hold_s:
            codes.append(2)
        elif is_steady and digs * step_s > dig_hold_s and spins * step_s <= sudden_s:
            codes.append(1)
        elif faster > 0.0 and slid > margin * hold_s:
            codes.append(3)
        else:
            codes.append(0)
    return codes
