"""Signals from commands to motion: commands, wheels, rolling and velocity, and their context.

Commands have their own stamps. All later signals are on cells: short intervals of equal length with the mean
of the signal, so that held commands are exact for any stamp. Cells are grouped in spans; between spans the
recording has a gap.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.sources import Vehicle

if TYPE_CHECKING:
    Drive: TypeAlias = "DriveSeries | Wheels"

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Integers = NDArray[np.int64]
Signal = TypeVar("Signal", NDArray[np.float64], NDArray[np.complex128])


@dataclass(frozen=True)
class DriveSeries:
    """Commanded or measured wheel speeds at stamps.

    Attributes:
        times: stamps [s], increasing, shape (n,).
        left, right: wheel speeds [rad/s]; on a car both are the rear axle's, shape (n,).
        steering: steering angle [rad], left positive; zero on a differential vehicle, shape (n,).
        sideways: speed of the wheels that moves the vehicle to the left [rad/s], shape (n,); None on one that
            cannot move sideways.
    """

    times: Floats
    left: Floats
    right: Floats
    steering: Floats
    sideways: Floats | None = None

    def change(self, times: Floats, change: Callable[[Floats], Floats]) -> DriveSeries:
        """The series at other stamps, with the same change of each signal."""
        sideways = None if self.sideways is None else change(self.sideways)
        return DriveSeries(times, change(self.left), change(self.right), change(self.steering), sideways)


class Commands(DriveSeries):
    """Held commands: each value applies from its stamp to the next."""

    def change_wheels(self, left: Floats, right: Floats) -> Commands:
        """The commands with other mean wheel speeds of the sides."""
        return replace(self, left=left, right=right)

    def change_each_wheel(self, change: Callable[[Floats], Floats]) -> Commands:
        """The commands with the speed of every wheel changed."""
        return replace(self, **_join_wheels([change(wheel) for wheel in split_wheels(self)]))


@dataclass(frozen=True)
class Wheels:
    """Output of the drivetrain on cells.

    Attributes:
        left, right: wheel speeds [rad/s], shape (n,).
        steering: steering angle [rad], shape (n,).
        sideways: speed of the wheels that moves the vehicle to the left [rad/s], shape (n,); None on one that
            cannot move sideways.
        straight: share of each cell in which the commands of the sides are equal, shape (n,); None if the
            commands are not known by their stamps.
    """

    left: Floats
    right: Floats
    steering: Floats
    sideways: Floats | None = None
    straight: Floats | None = None

    def stack(self) -> Floats:
        """Columns left, right and sideways [rad/s], shape (n, 3)."""
        sideways = np.zeros_like(self.left) if self.sideways is None else self.sideways
        return np.column_stack((self.left, self.right, sideways))

    def change_each_wheel(self, change: Callable[[Floats, Floats], Floats], start: Floats) -> Wheels:
        """The output with the speed of every wheel changed, each from its own state.

        Args:
            change: function of the speed of a wheel, shape (n,), and its state at every reset, shape (k,).
            start: left, right and sideways at every reset, shape (k, 3).
        """
        sideways = None if self.sideways is None else start[:, 2]
        states = split_wheels(Wheels(start[:, 0], start[:, 1], np.zeros(0), sideways))
        changed = [change(*wheel) for wheel in zip(split_wheels(self), states, strict=True)]
        return replace(self, **_join_wheels(changed))


def split_wheels(drive: Drive) -> list[Floats]:
    """Speeds of the wheels [rad/s]: left, right; or front left, front right, rear left, rear right."""
    left, right, sideways = drive.left, drive.right, drive.sideways
    if sideways is None:
        return [left, right]
    return [left - sideways, right + sideways, left + sideways, right - sideways]


def _join_wheels(wheels: Sequence[Floats]) -> dict[str, Floats]:
    """Inverse of `split_wheels`, by name; the combination of four wheels without motion is dropped."""
    if len(wheels) == 2:  # noqa: PLR2004 - one a side
        return {"left": wheels[0], "right": wheels[1]}
    front_left, front_right, rear_left, rear_right = wheels
    return {
        "left": 0.5 * (front_left + rear_left),
        "right": 0.5 * (front_right + rear_right),
        "sideways": 0.25 * (front_right - front_left + rear_left - rear_right),
    }


def find_fastest_wheel(drive: Drive) -> Floats:
    """Absolute speed of the fastest wheel [rad/s], shape (n,)."""
    fastest: Floats = np.maximum(np.abs(drive.left), np.abs(drive.right))
    return fastest if drive.sideways is None else fastest + np.abs(drive.sideways)


@dataclass(frozen=True)
class Rolling:
    """Body velocity before the ground acts, on cells.

    Attributes:
        v0: forward [m/s], shape (n,).
        w0: yaw rate [rad/s], shape (n,).
        wheels: output of the drivetrain from which it is computed.
        s0: to the left [m/s], shape (n,); scalar zero for a vehicle that cannot move sideways.
    """

    v0: Floats
    w0: Floats
    wheels: Wheels
    s0: Floats | float = 0.0

    @property
    def velocity(self) -> Velocity:
        """The rolling velocity as a velocity of the body."""
        return Velocity(self.v0, np.zeros_like(self.v0) + self.s0, self.w0)

    def scale(self, along: Floats | float, turning: Floats | float) -> Rolling:
        """Rolling with the speed in every direction and the yaw rate multiplied."""
        return Rolling(self.v0 * along, self.w0 * turning, self.wheels, self.s0 * along)


@dataclass(frozen=True)
class Velocity:
    """Body velocity on cells: x [m/s], y [m/s], w [rad/s], each of shape (n,)."""

    x: Floats
    y: Floats
    w: Floats

    def add(
        self,
        x: Floats | float | None = None,
        y: Floats | float | None = None,
        w: Floats | float | None = None,
    ) -> Velocity:
        """Velocity with an addition; None leaves a channel unchanged."""
        return Velocity(
            self.x if x is None else self.x + x,
            self.y if y is None else self.y + y,
            self.w if w is None else self.w + w,
        )


@dataclass(frozen=True)
class Resets:
    """Resets of internal states, and their start values.

    Attributes:
        number: number of the last reset before each cell, shape (n,).
        first: first cell after each reset, into which no state is carried over, shape (k,).
        at: cell before which the state is set, shape (k,).
        start: state, one column per signal; NaN for the value of the input, shape (k, m).
    """

    number: Integers
    first: Integers
    at: Integers
    start: Floats


@dataclass(frozen=True)
class RunContext:
    """Data of a run that an effect may use besides the signal it acts on.

    Attributes:
        vehicle: geometry.
        times: middles of the cells [s], shape (n,).
        start_s: start of the run [s].
        step_s: width of a cell [s].
        duration_s: length of the run [s].
        spans: resets at the starts of spans; states unknown.
        wheels: resets with known wheel speeds: (left, right, sideways) [rad/s].
        body: resets with known body velocity: (v_x, v_y, v_w).
        attitude: roll, pitch, yaw as reported [rad], shape (n, 3).
        position: x, y as reported [m], shape (n, 2).
    """

    vehicle: Vehicle
    times: Floats
    start_s: float
    step_s: float
    duration_s: float
    spans: Resets
    wheels: Resets
    body: Resets
    attitude: Floats
    position: Floats

    @cached_property
    def from_start(self) -> Floats:
        """x, y [m] and yaw [rad] in the frame of the first pose, independent of the map, shape (n, 3)."""
        yaw = self.attitude[:, 2] - self.attitude[0, 2]
        moved = (self.position - self.position[0]) @ np.array([1.0, 1.0j]) * np.exp(-1j * self.attitude[0, 2])
        return np.column_stack((moved.real, moved.imag, yaw))

    @property
    def slope_rad(self) -> float:
        """Half of the range of pitch in the central nine tenths of its values [rad]."""
        low, high = np.quantile(self.attitude[:, 1], (0.05, 0.95))
        return 0.5 * float(high - low)

    @property
    def track_m(self) -> float:
        """Nominal track width of a difference between the sides [m]; 1 if there is none."""
        return self.vehicle.kinematics.turning_width_m(self.vehicle)


STILL_MPS = 0.02
"""Speed [m/s] below which a wheel or vehicle is at rest: encoder rounding, wheels wound up by a motor,
drifting poses; half and double change no finding of two recordings."""
MOVING_MPS = 0.1
"""Speed [m/s] above which a vehicle moves, and its velocity has a direction and can be a divisor: 4 mm of
noise over 0.75 s are 5 % of it."""
LIVE_SHARE = 0.1
"""Share of the usual largest speed above which a side turns and its sign and ratios are significant: a lower
speed may be noise, friction or drift of the poses."""
ANSWERS_S = 2.0
"""Time [s] in which a drive follows a command: longer than dead times and pauses; with a lag of 1.2 s, 19 %
of a step remain after it."""
LEAST_RIM_SPEED = 0.01
"""Speed of the fastest rim [m/s] above which effects of driving act."""


def find_turning(wheels: Wheels, context: RunContext) -> Floats:
    """One where the wheels turn, zero where they are at rest, shape (n,)."""
    rim = context.vehicle.wheel_radius_m * find_fastest_wheel(wheels)
    return (rim > LEAST_RIM_SPEED).astype(np.float64)


def name_inputs(drive: Drive, vehicle: Vehicle) -> dict[str, Floats]:
    """Signals of a drive by their names in the kinematics."""
    named = {"left": drive.left, "right": drive.right, "steering": drive.steering}
    if vehicle.kinematics.has_inputs("speed"):
        named["speed"] = 0.5 * vehicle.wheel_radius_m * (drive.left + drive.right)
    return named if drive.sideways is None else named | {"sideways": drive.sideways}


def roll_ideally(wheels: Wheels, context: RunContext) -> Rolling:
    """Ideal velocity of the drivetrain's output, without the sideways motion of a lever arm."""
    vehicle = context.vehicle
    forward, sideways, turning = vehicle.kinematics.forward(name_inputs(wheels, vehicle), vehicle)
    return Rolling(forward, turning, wheels, 0.0 if wheels.sideways is None else sideways)


def earlier_in_span(context: RunContext, late: float) -> Flags:
    """Whether the time ``late`` seconds before each cell (after it, if negative) lies in the same span."""
    spans = context.spans
    last = np.append(spans.first[1:], context.times.size) - 1
    at = context.times - late
    inside: Flags = (at >= context.times[spans.first][spans.number]) & (
        at <= context.times[last][spans.number]
    )
    return inside
