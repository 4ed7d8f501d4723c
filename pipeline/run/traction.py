"""Traction over time: whether wheels dig in or spin, or the body slides, from the last seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

# The rule is causal: it uses past and present samples only. The same source is exported for robots
# (`export/data_formats.py`). Ratios refer to the usual speed of the body at given wheel speeds on
# this terrain: deep snow that always takes half of it is no event. Turns are excluded, because skid-steered
# vehicles always slip in turns.


@dataclass(frozen=True)
class Limits:
    """Thresholds of `trace_traction`; `make events` measures misses, false alarms and lead times with them.

    Attributes:
        live: usual body speed above which traction is judged [m/s].
        margin: speed of a sliding body above `excess` times its wheels [m/s]; half of it is detected later.
        window_s: duration of steady wheel speed before body and wheels are compared [s]: lags have decayed.
        steady: maximum relative change of wheel speed in this window [1].
        falls_s: minimum age of the ratios of body to wheel speed with which the present one is compared [s];
            the maximum age is three times as long.
        drop: decrease of this ratio in that time when wheels dig in [1].
        half: ratio below which wheels dig in [1].
        lost: ratio below which wheels spin, with or without a decrease [1].
        excess: minimum ratio of a sliding body [1]; with steady wheels, a larger one is a jump of the poses.
        dig_hold_s: duration of the loss after which digging in is reported [s].
        sudden_s: longest time with a ratio below `lost` when wheels dig in [s]; above it, they broke loose.
        hold_s: duration of spinning or sliding after which it is reported [s].
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
"""Share of the usual largest speed above which traction is judged. Also the minimum gain by which a limit is
divided."""
MARGIN_SHARE = 0.25
"""`Limits.margin` as a share of the usual largest speed: lags and drifting poses stay below it."""


def find_limits(top: float, gain: float) -> Limits:
    """Thresholds for a vehicle.

    Args:
        top: usual largest speed [m/s].
        gain: usual ratio of body to wheel speed, forward.
    """
    # A body that is faster than usual, but not faster than its wheels, has better traction.
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
        wheels: forward speed of the body that is usual at the wheel speeds [m/s].
        turning: rim speed due to turning, half the track times the yaw rate from the wheels [m/s].
        body: forward speed of the body [m/s].
        step_s: time step [s].
        live: usual body speed above which traction is judged [m/s].
        margin: speed of a sliding body above `excess` times its wheels [m/s]; half of it is detected later.
        window_s: duration of steady wheel speed before body and wheels are compared [s].
        steady: maximum relative change of wheel speed in this window.
        falls_s: minimum age of the ratios of body to wheel speed with which the present one is compared [s];
            the maximum age is three times as long.
        drop: decrease of this ratio when wheels dig in.
        half: ratio below which wheels dig in.
        lost: ratio below which they spin.
        excess: minimum ratio of a sliding body.
        dig_hold_s: duration of the loss after which digging in is reported [s].
        sudden_s: longest time with a ratio below `lost` when wheels dig in [s]; above it, they broke loose.
        hold_s: duration of spinning or sliding after which it is reported [s].
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
        # While the wheel speed changes, the last ratio remains valid.
        is_steady = not compared or fastest - slowest < steady * fastest
        if is_steady:
            share = forward * body[now] / slowest if compared else 1.0
        if share > excess:
            surge = now
        # Poses that jumped ahead of the wheels then stand still until the wheels have caught up.
        share = share if now - surge > falls else 1.0
        shares.append(share)
        earlier = shares[max(now - compared + 1, now - 3 * falls) : now - falls]
        before = max(earlier) if earlier else share
        digs = digs + 1 if share < half and before - share > drop else 0
        spins = spins + is_steady if share < lost else 0
        most = max(abs(slowest), abs(fastest))
        # Page's CUSUM with bounded steps: a sliding body that slows down is still detected, and a jump of the
        # poses has no more weight than its duration.
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
