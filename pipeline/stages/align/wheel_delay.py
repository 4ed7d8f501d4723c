"""How late the measured wheels are against the gyro: a filter in the drive, or a clock of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.stages.delays import estimate_delay
from pipeline.stages.gyro import smooth_gyro
from pipeline.stages.slip import interpolate_wheels

if TYPE_CHECKING:
    import polars as pl

    from pipeline.runs.recording import GyroFit
    from pipeline.vehicles import Vehicle


# Below it, reading the wheels now and then feigns as much.
_LEAST_S = 0.05
_LEAST_CORRELATION = 0.7
_WINDOW_S = 0.75


def measure_wheel_delay(
    times: Floats, wheels: pl.DataFrame, imu: pl.DataFrame, gyro: GyroFit | None, vehicle: Vehicle
) -> float:
    """Delay [s] of the wheels' turning against the gyro's; zero where it is small or cannot be told.

    The other way round, a body that follows its wheels late is physics, not an encoder.

    Args:
        times: grid that is looked at [s], shape (n,).
        wheels: table `wheels`.
        imu: table `imu`.
        gyro: how the gyro fits the poses; None without a good one.
        vehicle: geometry.
    """
    if gyro is None or wheels.is_empty():
        return 0.0
    turning = interpolate_wheels(times, wheels, vehicle).velocity[:, 2]
    seen = smooth_gyro(times, imu, gyro, _WINDOW_S)
    known = np.isfinite(turning) & np.isfinite(seen)
    found = estimate_delay(times[known], turning[known], times[known], seen[known])
    if found is None or abs(found.correlation) < _LEAST_CORRELATION or found.seconds < _LEAST_S:
        return 0.0
    return found.seconds
