"""How long a command is held where no other follows: many drives stop by themselves after a time-out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.core import NORMAL_95, Flags, Floats
from pipeline.recording.case import Candidate, Case
from pipeline.recording.geometry import roll_wheels
from pipeline.recording.motion import Motion
from pipeline.recording.readings import GRID_S, SIDES, Bent, Explained, Held, Reading
from pipeline.recording.score import CLEAR, FEWEST_STEPS, compare
from pipeline.stages import CommandTimeout

_PERIODS = 3.0
"""Gap in the commands [usual periods] above which they are silent: a shorter one is jitter."""
_FEWEST = 3
"""Least number of silences: one or two are chance."""
_BEFORE_S = 5.0
"""Time [s] before a silence, and in it, in which it shows what the drive does of commands."""
_AFTER_S = 2.0
"""The same after it [s]."""
_DELAYS_S = np.arange(-0.1, 0.41, 0.1)
"""Delays that are tried [s]."""
_STOPPED = 0.5
"""Motion over what is asked in the second half of silences, over that of driving, of a drive that stops."""
_TRIES = 6
"""Time-outs that are tried first, from the usual period to the longest silence."""
_FINE_S = 0.02
"""Step between those that are tried last [s]."""
_KNOWN = 0.3
"""Largest half-width of the interval, as a fraction of the time-out, that is reported."""


def settle_timeout(
    case: Case, command: Candidate | None, wheels: Candidate | None, motion: Motion | None
) -> None:
    """Hold the command as long as what follows it does; `measure_command` tells how long.

    Args:
        case: the log.
        command: the candidate for the command, whose reading is replaced.
        wheels: that for the wheels, which show it best.
        motion: of the poses; None where wheels stand in for them.
    """
    if command is None:
        return
    follows = motion
    if wheels is not None and len(wheels.reading.inputs) == len(SIDES) and wheels.reading.form != "steering":
        follows = roll_wheels(wheels.reading) or motion
    timeout = None if follows is None else find_by_silences(command.reading, follows)
    if timeout is None:
        return
    case.timeout = timeout
    command.reading = hold(command.reading, case.configuration.command.hold_s or timeout.seconds)
    if motion is not None:
        command.reading.explain(motion)


def find_by_silences(reading: Reading, motion: Motion) -> CommandTimeout | None:
    """The time-out with which a motion follows a command best; None if it follows it as well throughout.

    Args:
        reading: the command.
        motion: of the wheels, or of the body.
    """
    gaps, near = _find_silences(reading, motion)
    throughout = hold(reading, np.inf).explain(motion.take(near), _DELAYS_S) if gaps.size else None
    if throughout is None:
        return None
    part, crossed, usual = throughout.motion, throughout.crossed, _find_period(reading)

    tried: dict[float, Explained] = {}

    def rate(some: Floats) -> float:
        for one in np.round(some, 3).tolist():
            if one not in tried and one > usual:
                tried[one] = hold(reading, one).fit_to(part, _DELAYS_S, crossed=crossed)
        return max(tried, key=lambda one: float(tried[one].blocks.sum()))

    grid = np.geomspace(1.5 * usual, float(gaps.max()), _TRIES)
    best = rate(grid)
    if compare(tried[best].blocks, throughout.blocks) < CLEAR:
        return None
    best = rate(best * (grid[1] / grid[0]) ** np.array([-0.6, -0.3, 0.3, 0.6]))
    for _ in range(2):
        best = rate(best + _FINE_S * np.arange(-3.0, 4.0))
    likely = [one for one in tried if compare(tried[best].blocks, tried[one].blocks) < NORMAL_95]
    low, high = min(likely) - 0.5 * _FINE_S, max(likely) + 0.5 * _FINE_S
    is_known = 0.5 * (high - low) <= _KNOWN * best
    return CommandTimeout(best, low, high, int((gaps > best).sum())) if is_known else None


def _find_silences(reading: Reading, motion: Motion) -> tuple[Floats, Flags]:
    """Lengths of the silences in which something is asked [s], and the steps near them.

    There are none of too few, or where the motion goes on as it was asked to before.
    """
    steps = motion.steps
    nothing = np.zeros(0), np.zeros(steps.start.size, dtype=bool)
    if not reading.inputs:
        return nothing
    times = reading.inputs[0].times
    asked = np.any([one.values != 0.0 for one in reading.inputs if one.times.size == times.size], axis=0)
    gaps = np.diff(times)
    silent = np.flatnonzero((gaps > _PERIODS * _find_period(reading)) & asked[:-1])
    if silent.size < _FEWEST:
        return nothing
    begins = times[silent] - _BEFORE_S
    ends = np.minimum(times[silent + 1], times[silent] + _BEFORE_S) + _AFTER_S
    at = np.searchsorted(begins, steps.end, side="right") - 1
    near = (at >= 0) & (steps.end < ends[at])
    if near.sum() < FEWEST_STEPS:
        return nothing
    asked_there = np.abs(np.column_stack(reading.columns(steps, 0.0, 0.0, crossed=False)))
    moved = np.abs(np.column_stack([motion.body.real, motion.yaw]))
    of = np.maximum(np.searchsorted(times[silent], steps.start, side="right") - 1, 0)
    since = steps.start - times[silent][of]
    late = (since > 0.5 * gaps[silent][of]) & (since + steps.end - steps.start < gaps[silent][of])
    shares = [moved[rows].sum(axis=0) / (asked_there[rows].sum(axis=0) + 1e-9) for rows in (late, ~late)]
    return (gaps[silent], near) if (shares[0] < _STOPPED * shares[1]).all() else nothing


def _find_period(reading: Reading) -> float:
    return max(float(np.median(np.diff(reading.inputs[0].times))), 1e-3)


def hold(reading: Reading, seconds: float) -> Reading:
    """A command that is zero from a time [s] after its last message on, until the next one."""
    if not reading.inputs:
        return reading
    period = _find_period(reading)
    first, second, third = (
        None if one is None or isinstance(one, Bent) else _hold(one, seconds, period)
        for one in (reading.first, reading.second, reading.third)
    )
    if isinstance(reading.second, Bent) and first is not None:
        second = reading.second.drive(first)
    return replace(reading, first=first, second=second, third=third)


def _hold(one: Held, seconds: float, period: float) -> Held:
    """A signal whose silences are filled: with its last value, then with zero."""
    if one.times.size < 2:  # noqa: PLR2004 - one message has no gap
        return one
    gaps = np.diff(one.times)
    times, values, live = [one.times], [one.values], [one.live]
    for row in np.flatnonzero(gaps > min(seconds, _PERIODS * period)).tolist():
        # Signals are read on a grid: samples nearer to each other say nothing more.
        step = max(period, GRID_S)
        after = np.arange(step, gaps[row], step)
        if seconds < gaps[row]:
            after = np.sort(np.append(after, seconds))
        times.append(one.times[row] + after)
        values.append(np.where(after < seconds, one.values[row], 0.0))
        live.append(np.full(after.size, one.live[row]))
    order = np.argsort(np.concatenate(times), kind="stable")
    filled = (np.concatenate(each)[order] for each in (times, values, live))
    return Held(next(filled), next(filled), may_stand=one.may_stand, counts=next(filled).astype(bool))
