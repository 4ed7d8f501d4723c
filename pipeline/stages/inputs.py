"""Ideal velocities f(u) of command and measured wheels on the grid of a run, and its command steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.core import Flags, Floats, arrays
from pipeline.recording import number_gaps
from pipeline.run import STILL_MPS, read_wheel_times
from pipeline.sources import Vehicle

_SHARE_OF_RANGE = 0.02
"""Fraction of a command's range that counts as a change: joysticks and path followers vary by less."""
_NOISES = 8.0
"""Change of measured wheel speeds that counts [standard deviations of their noise]: eight exceed any
noise."""
_GROWTH = 0.6745 * 6.0**0.5
"""Median magnitude of second differences of white noise over its standard deviation."""
_SHORTEST_STEP = 1.0
"""Shortest command step [s]: a shorter ramp is one change."""
_ACROSS_RAD = 1.4
"""Steering angle beyond which the speed of the rear axle does not tell how fast a vehicle turns [rad]: 80
degrees, where it is a sixth of the front wheel's, and 0.02 rad of steering change the turn by an eighth."""
WINDOW_S = 2.0
"""Length of a window [s]: that of the published medians, and the shortest hold of a command step."""


def find_changes(times: Floats, ideal: Floats, length: float) -> Flags:
    """Whether the command changes before each sample.

    It changes if its ideal velocity has moved from its level by more than 2 % of its range (and eight times
    the noise, if measured wheels replace a command), but no sooner than one second after the last change. The
    level is the value of the command one second after a change, so that a short ramp is one change.

    Args:
        times: grid times [s], shape (n,).
        ideal: ideal velocity of the command (f_x, f_y, f_w), NaN where there is none, shape (n, 3).
        length: length scale L [m] that makes yaw rates comparable to speeds.

    Returns:
        Flags of shape (n,); the first is True, since the earlier command is unknown.
    """
    scaled = np.nan_to_num(ideal * np.array([1.0, 1.0, length]))
    size = np.linalg.norm(scaled, axis=1)
    jitter = np.linalg.norm(np.diff(scaled, axis=0), axis=1)
    changes = np.zeros(times.size, dtype=bool)
    changes[:1] = True
    if times.size < 2:  # noqa: PLR2004 - one sample has nothing to change from
        return changes
    tolerance = max(
        _SHARE_OF_RANGE * float(np.quantile(size, 0.99)),
        _NOISES * _estimate_noise(scaled),
        STILL_MPS,
    )
    begin, level = 0, scaled[0]
    # Only samples at which the command changes can start a step, so this loop is short for held commands.
    for index in (np.flatnonzero(jitter > 0.0) + 1).tolist():
        late_enough = times[index] - times[begin] >= _SHORTEST_STEP
        if late_enough and np.linalg.norm(scaled[index] - level) > tolerance:
            changes[index] = True
            begin = index
        if times[index] - times[begin] < _SHORTEST_STEP:
            level = scaled[index]
    return changes


def _estimate_noise(scaled: Floats) -> float:
    """Level of the white noise in a series (n, 3) by its second differences, which cancel smooth motion."""
    if scaled.shape[0] < 3:  # noqa: PLR2004 - a second difference needs three
        return 0.0
    return float(np.median(np.linalg.norm(np.diff(scaled, n=2, axis=0), axis=1))) / _GROWTH


def number_steps(times: Floats, segment: NDArray[np.int32], changes: Flags) -> NDArray[np.int32]:
    """Number the command steps of a run.

    A step starts with a segment, and where the command changes to or from a value held for two seconds. A
    command that varies continuously (a joystick, a path follower) is one long step: cut at each change, it
    would have no window of two seconds at all.

    Args:
        times: grid times [s], shape (n,).
        segment: number of the segment, shape (n,).
        changes: whether the command changes before each sample, shape (n,).

    Returns:
        Step numbers, shape (n,), starting at zero.
    """
    places = np.flatnonzero(changes)
    period = times[1] - times[0] if times.size > 1 else 0.0
    lasts = np.diff(times[places], append=times[-1] + period)
    held = lasts >= WINDOW_S - arrays.ROUNDING_S
    starts = np.zeros(times.size, dtype=bool)
    starts[places[held | np.concatenate(([True], held[:-1]))]] = True
    starts[1:] |= np.diff(segment) != 0
    return (np.cumsum(starts) - 1).astype(np.int32)


def mark_transitory(times: Floats, changes: Flags, span: float) -> Flags:
    """Whether each sample lies within ``span`` [s] of the last change of the command."""
    last = np.maximum.accumulate(np.where(changes, np.arange(times.size), 0))
    return times - times[last] < span - arrays.ROUNDING_S


@dataclass(frozen=True)
class Ideal:
    """Ideal velocities of one input on the grid.

    Attributes:
        velocity: (f_x, f_y, f_w), NaN if the input is unknown, shape (n, 3).
        stale: samples whose last command is too old to be valid, shape (n,).
        active: samples in an interval with live commands.
    """

    velocity: Floats
    stale: Flags
    active: Flags

    def leave_out(self, samples: Flags) -> Ideal:
        """The same with some samples unknown."""
        return replace(self, velocity=np.where(samples[:, None], np.nan, self.velocity))

    @property
    def expired(self) -> Floats:
        """Velocities of the last valid input where it is stale; zero elsewhere, shape (n, 3)."""
        known = np.isfinite(self.velocity).all(axis=1)
        last = np.maximum.accumulate(np.where(known, np.arange(known.size), -1))
        taken = self.stale & (last >= 0)
        return np.where(taken[:, None], self.velocity[np.maximum(last, 0)], 0.0)


@dataclass(frozen=True)
class Steps:
    """Command steps of a run on its grid.

    Attributes:
        step: number of the step of each sample, shape (n,).
        transitory: within the transitory span after a change of the command, shape (n,).
    """

    step: NDArray[np.int32]
    transitory: Flags


def read_inputs(
    times: Floats, commands: pl.DataFrame, wheels: pl.DataFrame, vehicle: Vehicle, hold_s: float | None
) -> dict[str, Ideal]:
    """Ideal velocities of every available input, by name."""
    known: dict[str, Ideal] = {}
    if not commands.is_empty() and hold_s is not None:
        known["command"] = hold_commands(times, commands, vehicle, hold_s)
    if not wheels.is_empty():
        known["measured"] = interpolate_wheels(times, wheels, vehicle)
    return known


def keep_known(inputs: Mapping[str, Ideal]) -> dict[str, Ideal]:
    """The inputs that are known in some live interval."""
    return {n: one for n, one in inputs.items() if np.isfinite(one.velocity[one.active]).all(axis=1).any()}


def cut_steps(
    velocities: pl.DataFrame, known: Mapping[str, Ideal], length: float, transitory_s: float
) -> Steps:
    """Command steps; those of the measured wheels only without a command, regardless of the requested inputs.

    Args:
        velocities: table `velocities`.
        known: at least one input.
        length: length scale L [m].
        transitory_s: span after a change [s].
    """
    times = velocities["t"].to_numpy()
    leading = known.get("command") or known["measured"]
    changes = find_changes(times, leading.velocity, length)
    return Steps(
        number_steps(times, velocities["segment"].to_numpy(), changes),
        mark_transitory(times, changes, transitory_s),
    )


_JITTER = 1.5
"""Longest gap between commands that are sent steadily [usual periods]: a longer one lacks a command."""


def hold_commands(times: Floats, commands: pl.DataFrame, vehicle: Vehicle, hold: float) -> Ideal:
    """Ideal velocities of the last command at each time, while it is valid.

    A controller that holds its command for less than the period of a steady sender stops in between: that is
    no silence.

    Args:
        times: grid [s].
        commands: table `commands`, sorted by time.
        vehicle: for the ideal model.
        hold: how long a command is valid [s].
    """
    stamps = commands["t"].to_numpy()
    index = arrays.hold_indices(times, stamps)
    known = index >= 0
    last = np.maximum(index, 0)
    age = times - stamps[last]
    _, period = number_gaps(stamps)
    stale = known & (age > max(hold, _JITTER * period))
    velocity = _predict(commands, vehicle)[last]
    velocity[age > hold] = 0.0
    velocity[~known | stale] = np.nan
    active = commands["active"].to_numpy()[last] & known
    return Ideal(velocity, stale & active, active)


def interpolate_wheels(times: Floats, wheels: pl.DataFrame, vehicle: Vehicle) -> Ideal:
    """Ideal velocities of the measured wheels, interpolated; unknown in gaps of the encoders."""
    stamps = read_wheel_times(wheels)
    values = arrays.interpolate_linearly(times, stamps, _predict(wheels, vehicle))
    before = arrays.hold_indices(times, stamps)
    after = np.minimum(before + 1, stamps.size - 1)
    longest = max(arrays.SILENT_S, arrays.PERIODS * _usual_period(stamps))
    on_sample = np.abs(times - stamps[np.maximum(before, 0)]) < arrays.ROUNDING_S
    known = (before >= 0) & (on_sample | ((after > before) & (stamps[after] - stamps[before] <= longest)))
    values[~known] = np.nan
    active = wheels["active"].to_numpy()[np.maximum(before, 0)] & (before >= 0)
    return Ideal(values, np.zeros(times.size, dtype=bool), active)


def _predict(drive: pl.DataFrame, vehicle: Vehicle) -> Floats:
    kinematics = vehicle.kinematics
    inputs = {quantity.name: _read_aligned(drive, quantity.name) for quantity in kinematics.inputs}
    velocity = np.stack(kinematics.forward(inputs, vehicle), axis=-1)
    velocity[mark_across(drive)] = np.nan
    return velocity


def mark_across(drive: pl.DataFrame) -> Flags:
    """Rows of a table of the drive whose steered wheel stands across: no turn is known there, shape (n,)."""
    if "steering" not in drive.columns:
        return np.zeros(drive.height, dtype=bool)
    return np.asarray(np.abs(_read_aligned(drive, "steering")) > _ACROSS_RAD, dtype=bool)


def _read_aligned(drive: pl.DataFrame, name: str) -> Floats:
    """A signal of the drive, corrected if a correction exists."""
    aligned = f"{name}_aligned"
    return drive[aligned if aligned in drive.columns else name].to_numpy()


_SHORTEST_HOLD_S = 0.5
"""Default cmd_vel_timeout of diff_drive_controller [s]; `command.hold_s` of the configuration replaces it."""


def usual_hold(stamps: Floats) -> float:
    """Default time for which a controller holds its last command [s]: five periods, at least half a second.

    Args:
        stamps: stamps of the commands [s], shape (n,).
    """
    return max(_SHORTEST_HOLD_S, arrays.PERIODS * _usual_period(stamps))


def _usual_period(stamps: Floats) -> float:
    # Two topics, one per side, come in pairs of nearly equal stamps: their median period is almost zero.
    return float(np.quantile(np.diff(stamps), 0.75)) if stamps.size > 1 else 0.0
