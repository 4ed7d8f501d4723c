"""Signals of a simulated drive: body commands at their stamps, wheels on cells, and their integrals."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.core import Floats
from pipeline.simulate.facts import Vehicle


def integrate_cells(signal: Floats, *, step_s: float) -> Floats:
    """Integral at the cell edges, shape (n + 1,), starting from zero."""
    return np.concatenate(([0.0], np.cumsum(signal) * step_s))


@dataclass(frozen=True)
class Commands:
    """Body commands at their own stamps.

    Attributes:
        time_s: increasing, shape (n,).
        speed_mps: shape (n,).
        turn: yaw rate [rad/s] or steering angle [rad], shape (n,).
        sideways_mps: speed to the left, shape (n,); None on a vehicle that cannot.
    """

    time_s: Floats
    speed_mps: Floats
    turn: Floats
    sideways_mps: Floats | None = None

    @property
    def sideways(self) -> Floats:
        """Speed to the left [m/s], zero on a vehicle that cannot, shape (n,)."""
        return np.zeros_like(self.speed_mps) if self.sideways_mps is None else self.sideways_mps

    def yaw_rate(self, vehicle: Vehicle) -> Floats:
        """The yaw rate that is asked for [rad/s], which a car's steering stands for."""
        if vehicle.kind != "ackermann":
            return self.turn
        return self.speed_mps * np.tan(self.turn) / vehicle.wheelbase_m


@dataclass(frozen=True)
class Drive:
    """What the drivetrain does, on cells of ``step_s``.

    Attributes:
        step_s: cell width [s].
        left, right: true wheel speeds [rad/s], shape (n,); equal on a car, whose rear axle they are; means of
            a side on mecanum wheels.
        steering: true steering angle [rad], shape (n,); zero on a differential vehicle.
        corners: true speeds of mecanum wheels by place; on omni wheels those of wheels at the corners of the
            same body motion; None on a vehicle that cannot move sideways.
    """

    step_s: float
    left: Floats
    right: Floats
    steering: Floats
    corners: Mapping[str, Floats] | None = None

    def wheel_angles(self) -> tuple[Floats, Floats]:
        """Turned angles [rad] of left and right wheels at the cell edges, each of shape (n + 1,)."""
        return integrate_cells(self.left, step_s=self.step_s), integrate_cells(self.right, step_s=self.step_s)
