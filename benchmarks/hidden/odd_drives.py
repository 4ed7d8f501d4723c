"""Drivetrains that no catalogue has: what wheels and steering make of what they would do without."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pipeline.simulate import Drive, Vehicle
from pipeline.simulate.programs import follow

Floats = NDArray[np.float64]


def lock_sides(vehicle: Vehicle, drive: Drive) -> Drive:
    """Within 0.2 s of a change of speed by a quarter of the largest the axle locks for 2 s."""
    mean, difference = 0.5 * (drive.left + drive.right), drive.right - drive.left
    hard = 0.25 * vehicle.max_speed_mps / vehicle.wheel_radius_m
    before = round(0.2 / drive.step_s)
    jump = np.abs(mean - np.concatenate((np.zeros(before), mean[:-before]))) > hard
    last = np.maximum.accumulate(np.where(jump, np.arange(mean.size), -mean.size))
    locked = np.arange(mean.size) - last < 2.0 / drive.step_s
    difference = np.where(locked, 0.3, 1.0) * difference
    return replace(drive, left=mean - 0.5 * difference, right=mean + 0.5 * difference)


def wind_up(vehicle: Vehicle, drive: Drive) -> Drive:
    """Proportional and integral speed control of a motor of 0.5 s whose voltage is limited."""
    fastest = vehicle.max_speed_mps + 0.5 * vehicle.track_width_m * vehicle.max_turn_radps
    top, step_s = fastest / vehicle.wheel_radius_m, drive.step_s

    def regulate(asked: Floats) -> Floats:
        gathered = 0.0

        def step(now: float, goal: float) -> float:
            nonlocal gathered
            gathered += 3.0 * (goal - now) * step_s
            voltage = min(max(goal + (goal - now) + gathered, -top), top)
            return now + (voltage - now) * step_s / 0.5

        return follow(asked, step)

    return replace(drive, left=regulate(drive.left), right=regulate(drive.right))
