"""The signals on a command's way: commands, wheels, rolling, velocity; and what surrounds them.

Commands stand at their own stamps. Everything after them stands on cells: short stretches of equal length
whose values are means over the cell, so that a held command enters exactly wherever its stamp falls. Cells
are grouped in spans; between spans the recording had a hole.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pipeline.vehicles import Vehicle

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Integers = NDArray[np.int64]
Signal = TypeVar("Signal", NDArray[np.float64], NDArray[np.complex128])


@dataclass(frozen=True)
class Commands:
    """Held commands: each value counts from its stamp to the next.

    Attributes:
        times: stamps [s], increasing, shape (n,).
        left, right: wheel speeds [rad/s]; on a car both are the rear axle's, shape (n,).
        steering: steering angle [rad], left positive; zero on a differential vehicle, shape (n,).
    """

    times: Floats
    left: Floats
    right: Floats
    steering: Floats

    def change_wheels(self, left: Floats, right: Floats) -> Commands:
        """The same commands with other wheel speeds."""
        return replace(self, left=left, right=right)


@dataclass(frozen=True)
class Wheels:
    """What the drivetrain's output does, on cells.

    Attributes:
        left, right: wheel speeds [rad/s], shape (n,).
        steering: steering angle [rad], shape (n,).
    """

    left: Floats
    right: Floats
    steering: Floats


class Drive(Protocol):
    """Commands, measured wheels, or the drivetrain's output."""

    @property
    def left(self) -> Floats:
        """Speed of the left wheels [rad/s]; on a car the rear axle's."""

    @property
    def right(self) -> Floats:
        """Speed of the right wheels [rad/s]; on a car the rear axle's."""

    @property
    def steering(self) -> Floats:
        """Steering angle [rad]."""


@dataclass(frozen=True)
class Rolling:
    """Body velocity before the ground acts, on cells.

    Attributes:
        v0: forward [m/s], shape (n,).
        w0: yaw rate [rad/s], shape (n,).
        wheels: the drivetrain's output it came from.
    """

    v0: Floats
    w0: Floats
    wheels: Wheels

    def scale(self, along: Floats | float, around: Floats | float) -> Rolling:
        """Rolling with both parts multiplied."""
        return Rolling(self.v0 * along, self.w0 * around, self.wheels)


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
        """Velocity with something added; None leaves a channel alone."""
        return Velocity(
            self.x if x is None else self.x + x,
            self.y if y is None else self.y + y,
            self.w if w is None else self.w + w,
        )


@dataclass(frozen=True)
class Resets:
    """Where internal states begin anew, and with what.

    Attributes:
        number: which reset each cell follows, shape (n,).
        first: first cell that follows each reset: nothing is carried over into it, shape (k,).
        at: cell before which the state is set, shape (k,).
        start: the state, one column a signal; NaN for the input's own value, shape (k, m).
    """

    number: Integers
    first: Integers
    at: Integers
    start: Floats

    @cached_property
    def since_first(self) -> Integers:
        """How many cells after its reset each cell comes, shape (n,)."""
        since: Integers = np.arange(self.number.size) - self.first[self.number]
        return since

    @cached_property
    def since_set(self) -> Integers:
        """How many cells after the state was set each cell comes, -1 before, shape (n,)."""
        since: Integers = np.maximum(np.arange(self.number.size) - self.at[self.number], -1)
        return since


@dataclass(frozen=True)
class RunContext:
    """What an effect may know of a run beside the signal it acts on.

    Attributes:
        vehicle: geometry.
        times: middles of the cells [s] since the run's start, shape (n,).
        step_s: width of a cell [s].
        duration_s: length of the run [s].
        spans: begin where the recording begins anew; states unknown.
        wheels: begin where wheel speeds are known: (left, right) [rad/s].
        body: begin where the body velocity is known: (v_x, v_y, v_w).
        attitude: roll, pitch, yaw as reported [rad], shape (n, 3).
        place: x, y as reported [m], shape (n, 2).
    """

    vehicle: Vehicle
    times: Floats
    step_s: float
    duration_s: float
    spans: Resets
    wheels: Resets
    body: Resets
    attitude: Floats
    place: Floats

    @property
    def track_m(self) -> float:
        """Nominal track width [m]; one on a vehicle without."""
        return self.vehicle.track_width_m or 1.0


_LEAST_RIM_SPEED = 0.01


def find_turning(wheels: Wheels, around: RunContext) -> Floats:
    """One where the wheels turn, zero where they stand, shape (n,)."""
    rim = around.vehicle.wheel_radius_m * np.maximum(np.abs(wheels.left), np.abs(wheels.right))
    return (rim > _LEAST_RIM_SPEED).astype(np.float64)


def name_inputs(drive: Drive, vehicle: Vehicle) -> dict[str, Floats]:
    """The signals of a drive by the names under which kinematics ask for them."""
    speed = 0.5 * vehicle.wheel_radius_m * (drive.left + drive.right)
    return {"left": drive.left, "right": drive.right, "speed": speed, "steering": drive.steering}


def roll_ideally(wheels: Wheels, around: RunContext) -> Rolling:
    """Ideal velocity of the drivetrain's output, without sideways motion."""
    vehicle = around.vehicle
    forward, _, turning = vehicle.kinematics.forward(name_inputs(wheels, vehicle), vehicle)
    return Rolling(forward, turning, wheels)


def earlier_in_span(around: RunContext, late: float) -> Flags:
    """Whether the time ``late`` seconds before each cell lies in the same span (after it, when negative)."""
    spans = around.spans
    last = np.append(spans.first[1:], around.times.size) - 1
    at = around.times - late
    inside: Flags = (at >= around.times[spans.first][spans.number]) & (at <= around.times[last][spans.number])
    return inside
