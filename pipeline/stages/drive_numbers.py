"""How late the drive follows its first command after a stop or a gap."""

import math
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.core import (
    PERIODS,
    ROUNDING_S,
    SILENT_S,
    Flags,
    Floats,
    Ints,
    fit_robustly,
    rigid,
    robust_spread,
)
from pipeline.recording import Finding
from pipeline.sources import Vehicle
from pipeline.stages.inputs import hold_commands, interpolate_wheels

# A drive that was stopped or released may follow its next command late, by a different delay each time: a
# safety switch, a brake or a radio link comes first. That delay is no property of the motion.

_STEP_MPS = 0.3
"""Least change of a command [m/s at the wheels], and of the measured speed, that shows a response."""
_STEADY = 0.1
"""Largest change of a command that is held, relative to that."""
_HELD_S = 1.2
"""Least time [s] for which the command is held: drives reach most of a new speed in less."""
_WATCHED_S = 2.0
"""Time [s] for which a response is observed."""
_MEAN_S = 0.3
"""Time [s] for the speeds before a step and at its end; a command as early in a stretch is its first."""
_FINE_S = 0.02
"""Step of the integral [s]: the area of a response does not depend on a smaller one."""
_STANDING_MPS = 0.05
"""Speed [m/s] below which wheels stand."""
_LATE_S = 0.15
"""Least lateness [s] that is corrected: twice the spread of other responses, 0.04 to 0.08 s on recordings."""
_REGULAR = 0.2
"""Relative standard deviation of late starts below which they are a property of the drive, to be modelled."""
_FEWEST = 3
"""Least number of late starts, to be told."""
_FEWEST_RESPONSES = 12
"""Least number of responses for the regression of five coefficients."""


@dataclass(frozen=True)
class Responses:
    """When the drive followed steps of the command.

    Attributes:
        start: stamp of the step [s], shape (k,).
        late: mean response time beyond the usual one of a step of its kind [s], shape (k,).
        is_first: whether it is the first one after a stop or a gap in the commands, shape (k,).
        size: change of the measured speed [m/s], shape (k,).
    """

    start: Floats
    late: Floats
    is_first: Flags
    size: Floats

    def find_late(self) -> Ints:
        """Indices of late starts; none if they are alike, or depend on the step's size as by friction."""
        at = np.flatnonzero(self.is_first & (self.late > _LATE_S))
        if at.size < _FEWEST:
            return at[:0]
        late, inverse = self.late[self.is_first], 1.0 / self.size[self.is_first]
        rows = np.column_stack((np.ones_like(late), inverse))
        by_size = late - rows @ np.linalg.lstsq(rows, late, rcond=None)[0]
        spread = min(float(np.std(self.late[at])), float(np.std(by_size)))
        return at if spread >= _REGULAR * float(np.mean(self.late[at])) else at[:0]


def mark_late_starts(
    commands: pl.DataFrame, wheels: pl.DataFrame, vehicle: Vehicle
) -> tuple[pl.DataFrame, list[Finding]]:
    """Table `commands` with those that the drive did not follow yet, the first ones after a stop or a gap.

    Args:
        commands: table `commands`, aligned; of commands that are repeated less often than every 0.15 s, and
            of vehicles that steer, none is marked.
        wheels: table `wheels`.
        vehicle: for the ideal model.
    """
    if commands.is_empty():
        return commands, []
    steps = measure_responses(commands, wheels, vehicle)
    at, stamps = steps.find_late(), commands["t"].to_numpy()
    until = np.append(-np.inf, np.maximum.accumulate(steps.start[at] + steps.late[at]))
    followed = stamps >= until[np.searchsorted(steps.start[at], stamps, side="right")]
    marked = commands.with_columns(pl.Series("followed", followed))
    if not at.size:
        return marked, []
    longest = float(steps.late[at].max())
    starts = int(np.count_nonzero(steps.is_first))
    values = {"value": longest, "count": at.size, "starts": starts}
    return marked, [Finding("late_start", "warning", "command", values)]


def measure_responses(commands: pl.DataFrame, wheels: pl.DataFrame, vehicle: Vehicle) -> Responses:
    """Steps whose response is known; see `mark_late_starts`."""
    none = Responses(np.zeros(0), np.zeros(0), np.zeros(0, dtype=bool), np.zeros(0))
    if min(commands.height, wheels.height) < _FEWEST or vehicle.kinematics.has_inputs("steering"):
        return none
    stamps, active = commands["t"].to_numpy(), commands["active"].to_numpy()
    asked = hold_commands(stamps, commands, vehicle, math.inf).velocity * _rims(vehicle)
    steps = _list_steps(stamps, asked, active)
    if steps.start.size < _FEWEST_RESPONSES:
        return none
    before, reached, area = _watch(steps, wheels, vehicle)
    stands = (np.abs(before) < _STANDING_MPS).all(axis=1)
    is_first = np.asarray(steps.follows_gap | (steps.follows_stop & stands))
    late = _measure_lateness(before, reached, area, is_first)
    known = np.isfinite(late)
    size = np.abs(reached - before).max(axis=1)
    return Responses(steps.start[known], late[known], is_first[known], size[known])


def _rims(vehicle: Vehicle) -> Floats:
    """Factors from the ideal velocity to the speeds at the wheels [1, 1, m]."""
    return np.array([1.0, 1.0, 0.5 * vehicle.kinematics.turning_width_m(vehicle)])


@dataclass(frozen=True)
class _Steps:
    """Steps of a command that is held.

    Attributes:
        start, end: stamp of the step, and end of the observation [s], shape (k,).
        begin: start of the stretch without a gap [s], shape (k,).
        follows_gap, follows_stop: whether it comes early in that, or after a command of zero, shape (k,).
    """

    start: Floats
    end: Floats
    begin: Floats
    follows_gap: Flags
    follows_stop: Flags


def _list_steps(stamps: Floats, asked: Floats, active: Flags) -> _Steps:
    """Steps of active commands [m/s], shape (n, 3), at stamps [s]; none if commands are not repeated."""
    period = float(np.median(np.diff(stamps)))
    breaks = rigid.find_gaps(stamps, max(SILENT_S, PERIODS * period)) | np.diff(active, prepend=active[:1])
    first, stretch = np.append(0, np.flatnonzero(breaks)), rigid.number_segments(breaks)
    size = np.abs(np.diff(asked, axis=0)).max(axis=1)
    at = 1 + np.flatnonzero(size > _STEADY * _STEP_MPS)
    last, begin = (np.append(first[1:], stamps.size) - 1)[stretch[at]], stamps[first[stretch[at]]]
    start = stamps[at]
    end = np.minimum(np.minimum(np.append(start[1:], np.inf), stamps[last]), start + _WATCHED_S)
    before = np.append(-np.inf, start[:-1])
    # Slow ramps are no change from one command to the next.
    early = np.searchsorted(stamps, np.maximum(begin, start - _HELD_S) - ROUNDING_S)
    late = np.searchsorted(stamps, end - ROUNDING_S) - 1
    drift = np.maximum(
        np.abs(asked[late] - asked[at]), np.abs(asked[at - 1] - asked[np.minimum(early, at - 1)])
    )
    held = (end - start >= _HELD_S) & ((start - before >= _HELD_S) | (before <= begin)) & (period <= _LATE_S)
    held &= (size[at - 1] > _STEP_MPS) & (drift.max(axis=1) <= _STEADY * _STEP_MPS) & active[at]
    stopped = np.abs(asked[at - 1]).max(axis=1) < _STANDING_MPS
    near = start - begin < _MEAN_S
    return _Steps(start[held], end[held], begin[held], near[held], stopped[held])


def _watch(steps: _Steps, wheels: pl.DataFrame, vehicle: Vehicle) -> tuple[Floats, Floats, Floats]:
    """Measured responses, NaN where unknown, shape (k, 3) each.

    Returns:
        Speed before the step, speed at its end [m/s], and the area [m] between that and the measured one.
    """
    at = np.arange(-_MEAN_S, _WATCHED_S, _FINE_S)
    times = steps.start[:, None] + at
    seen = interpolate_wheels(times.ravel(), wheels, vehicle).velocity.reshape(*times.shape, 3)
    seen *= _rims(vehicle)
    inside = (times >= steps.begin[:, None] - ROUNDING_S) & (times < steps.end[:, None])
    early, late = inside & (at < 0.5 * _FINE_S), inside & (times > steps.end[:, None] - _MEAN_S)
    before, reached = (
        np.where(rows[:, :, None], seen, 0.0).sum(axis=1) / rows.sum(axis=1)[:, None]
        for rows in (early, late)
    )
    missing = np.where((inside & (at >= 0.0))[:, :, None], reached[:, None] - seen, 0.0)
    return before, reached, _FINE_S * missing.sum(axis=1)


def _measure_lateness(before: Floats, reached: Floats, area: Floats, is_first: Flags) -> Floats:
    """Mean response time beyond that of a step of the same kind [s], NaN where unknown, shape (k,).

    The mean response time is the area over the change. It depends on the size of the step, on whether it
    brakes or reverses, and on what changes beside it: robust regression over the steps in between, over all
    where few of them speed up. Speeds with a larger change count more.
    """
    change = reached - before
    size, known = np.abs(change), np.isfinite(change).all(axis=1)
    brakes = np.maximum(np.abs(before) - np.abs(reached), 0.0)
    reverses = np.where(before * reached < 0.0, np.abs(before), 0.0)
    total, weights = np.zeros(known.size), np.zeros(known.size)
    for axis in range(3):
        used = known & (size[:, axis] > _STEP_MPS)
        if used.sum() < _FEWEST_RESPONSES:
            continue
        beside = size.sum(axis=1) - size[:, axis]
        columns = (np.ones(known.size), size[:, axis], brakes[:, axis], reverses[:, axis], beside)
        design, seconds = np.column_stack(columns)[used], area[used, axis] / change[used, axis]
        usual = ~is_first[used]
        # Brakings alone do not tell how long a start takes.
        if (usual & (brakes[used, axis] == 0.0)).sum() < _FEWEST_RESPONSES:
            usual = np.ones_like(usual)
        made = fit_robustly(design[usual], seconds[usual])
        late = seconds - design @ made.gains
        weight = 1.0 / ((1.0 + size[used, axis] ** -2.0) * max(robust_spread(made.rest), _FINE_S) ** 2)
        total[used] += weight * late
        weights[used] += weight
    late = np.full(known.size, np.nan)
    np.divide(total, weights, out=late, where=weights > 0.0)
    return late
