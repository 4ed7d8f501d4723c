"""What runs can show: the largest commands, and speeds that measured wheels exceed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import Floats
from pipeline.models import EXCEEDED_SHARE, STANDING, Asked, Largest
from pipeline.run import HORIZON_S, SPAN_S, MotionRun, find_fastest_wheel, name_inputs, split_wheels

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.sources import Vehicle

_MOSTLY = 0.99
"""Minimum share of live commands in a stretch for it to count: all but rounding."""
_STILL = 1e-9
"""Offset of wheel speed and yaw rate [rad/s], so that their sum over a run is not zero."""
_STANDS = 0.1
"""Share of the largest commanded wheel speed up to which a wheel counts as standing."""
_MOMENTS = 0.1
"""Share of the commands at either end that may be ramps."""
_ONE_SPEED = 0.8
"""Ratio of commanded speeds above which they are one: a limit and a gain that agree at one of them differ by
less than a fifth at the other, which lags of the drive hide."""


def measure_largest(runs: Sequence[MotionRun], vehicle: Vehicle) -> Largest:
    """The largest inputs of runs: of commands if there are any, else of wheels."""
    speed = aside = turn = wheel = difference = 0.0
    fastest = list[Floats]()
    for run in runs:
        series = run.commands or run.wheels
        if series is None:
            continue
        forward, sideways, yaw_rate = vehicle.kinematics.asked(name_inputs(series, vehicle), vehicle)
        speed, turn = max(speed, float(np.abs(forward).max())), max(turn, float(np.abs(yaw_rate).max()))
        if series.sideways is not None:
            aside = max(aside, float(np.abs(sideways).max()))
        wheels = find_fastest_wheel(series)
        wheel = max(wheel, float(wheels.max()))
        difference = max(difference, float(np.abs(series.right - series.left).max()))
        if series.sideways is None:
            fastest.append(wheels)
        else:
            # Rollers turn faster on a diagonal, at the same speed.
            half = 0.5 * np.abs(series.right - series.left)
            fastest.append(np.hypot(forward, sideways) / vehicle.wheel_radius_m + half)
    moments, turns = _find_tenths(runs, vehicle)
    rim = vehicle.wheel_radius_m * wheel
    return Largest(
        speed, turn, wheel, max(difference, 1e-6), moments, sideways=aside, turns=turns, rim=rim,
        is_one_speed=_is_one_speed(np.concatenate(fastest or [np.zeros(0)])),
    )  # fmt: skip


def measure_asked(runs: Sequence[MotionRun], vehicle: Vehicle) -> Asked:
    """The largest speed, and the largest yaw rate on the spot, that runs ask for during 2 s in all."""
    held, speeds, turns = list[Floats](), list[Floats](), list[Floats]()
    for run in runs:
        series = run.commands or run.wheels
        if series is not None:
            forward, _, yaw_rate = vehicle.kinematics.asked(name_inputs(series, vehicle), vehicle)
            held.append(np.minimum(np.diff(series.times, append=series.times[-1:]), SPAN_S))
            speeds.append(np.abs(forward))
            turns.append(np.abs(yaw_rate))
    if not held:
        return Asked()
    seconds, speed, turn = map(np.concatenate, (held, speeds, turns))
    on_the_spot = speed < _STANDS * speed.max(initial=0.0)
    # Of a run that only turns, no speed is above rounding.
    turned = turn * (on_the_spot | (speed < _STILL))
    return Asked(_find_exceeded(seconds, speed), _find_exceeded(seconds, turned))


def _find_exceeded(seconds: Floats, sizes: Floats) -> float:
    """The largest size that is reached during 2 s in all; zero where it would be standing."""
    order = np.argsort(-sizes)
    index = int(np.searchsorted(np.cumsum(seconds[order]), HORIZON_S))
    exceeded = float(sizes[order[index]]) if index < sizes.size else 0.0
    return exceeded if exceeded > STANDING else 0.0


def _is_one_speed(fastest: Floats) -> bool:
    """Whether speeds that are commanded while not standing are one, but for some moments."""
    moving = fastest[fastest > _STANDS * fastest.max(initial=0.0)]
    if not moving.size:
        return False
    low, high = np.quantile(moving, (_MOMENTS, 1.0 - _MOMENTS))
    return bool(low > _ONE_SPEED * high)


def measure_exceeded(runs: Sequence[MotionRun], vehicle: Vehicle) -> dict[str, float]:
    """Half-second means that measured wheels exceed in `EXCEEDED_SHARE` of a run: `speed`, `turn`, `wheel`.

    For several runs the largest value, as a limit applies to all of them. Means over half a second, the
    length of the fitted windows, average out the encoder noise of single readings (6 % on a Husky).
    """
    most: dict[str, float] = {}
    for run in runs:
        if run.wheels is None:
            continue
        wheels = run.wheels
        forward, _, yaw_rate = vehicle.kinematics.asked(name_inputs(wheels, vehicle), vehicle)
        driven = np.interp(wheels.times, run.track.times, run.track.active.astype(np.float64))
        active = average_sustained(wheels.times, driven) > _MOSTLY
        series = {"speed": [forward], "turn": [yaw_rate], "wheel": split_wheels(wheels)}
        for name, signals in series.items():
            means = np.array([average_sustained(wheels.times, signal) for signal in signals])[:, active]
            fastest = _find_fastest_mean(means)
            if fastest.size:
                most[name] = max(most.get(name, 0.0), float(np.quantile(fastest, 1.0 - EXCEEDED_SHARE)))
    return most


def _find_fastest_mean(means: Floats) -> Floats:
    """Least speed of the fastest wheel, or of a signal, for means of shape (1, 2 or 4 signals, n)."""
    if means.shape[0] < 4:  # noqa: PLR2004 - wheels
        return np.asarray(np.abs(means).max(axis=0))
    # Sides do not show how fast four wheels turn against each other: one of them is at least so fast.
    opposed = means * np.array([[1.0], [1.0], [-1.0], [-1.0]])
    return np.asarray(0.5 * np.ptp(opposed, axis=0))


def average_sustained(times: Floats, signal: Floats) -> Floats:
    """Means of a signal over the complete stretches of `SPAN_S` that begin at each sample."""
    count = max(round(SPAN_S / float(np.median(np.diff(times)))), 1) if times.size > 1 else 1
    whole = times[count - 1 :] - times[: times.size - count + 1] <= SPAN_S
    return np.convolve(signal, np.full(count, 1.0 / count), "valid")[whole]


def _find_tenths(runs: Sequence[MotionRun], vehicle: Vehicle) -> Floats:
    """Times of the tenths of the fastest wheel's travel, and of the total turning [s], shape (2, 11)."""
    times, moved = list[Floats](), list[Floats]()
    for run in runs:
        series, at = run.wheels or run.commands, run.track.times[run.track.active]
        if series is not None and at.size:
            yaw_rate = vehicle.kinematics.asked(name_inputs(series, vehicle), vehicle)[2]
            both = np.array([find_fastest_wheel(series), np.abs(yaw_rate)])
            times.append(at)
            # Without any motion, the share grows evenly with time.
            moved.append(np.array([np.interp(at, series.times, one) + _STILL for one in both]))
    if not times:
        return np.zeros((2, 11))
    order = np.argsort(np.concatenate(times), kind="stable")
    done = np.cumsum(np.concatenate(moved, axis=1)[:, order], axis=1)
    when, share = np.concatenate(times)[order], np.linspace(0.0, 1.0, 11)
    return np.array([np.interp(share * one[-1], one, when) for one in done])
