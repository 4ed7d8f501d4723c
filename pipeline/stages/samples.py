"""The samples of a run side by side, as the checks of a whole run need them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Samples:
    """Samples of one run on its grid; ideals are NaN where unknown.

    Attributes:
        times: [s], shape (n,).
        segment: number of the segment, shape (n,).
        steady: outside transitory spans, shape (n,).
        step: number of the command step, shape (n,).
        position: x, y of base_link [m], shape (n, 2).
        yaw: of base_link, unwrapped inside a segment [rad], shape (n,).
        velocity: (v_x, v_y, v_w), shape (n, 3).
        gyro: yaw rate of the gyro, NaN without one, shape (n,).
        command: ideal velocity of the command, shape (n, 3); None without commands.
        measured: ideal velocity of the measured wheels, shape (n, 3); None without encoders.
        body_commanded: whether the command was a body command.
    """

    times: Floats
    segment: NDArray[np.int32]
    steady: NDArray[np.bool_]
    step: NDArray[np.int32]
    position: Floats
    yaw: Floats
    velocity: Floats
    gyro: Floats
    command: Floats | None
    measured: Floats | None
    body_commanded: bool


def gather_samples(velocities: pl.DataFrame, slip: pl.DataFrame, *, body_commanded: bool) -> Samples:
    """Arrange the tables of a run for the checks."""
    ideals: dict[str, Floats | None] = {"command": None, "measured": None}
    steady = np.zeros(velocities.height, dtype=bool)
    step = np.full(velocities.height, -1, dtype=np.int32)
    stamps = velocities["stamp"].to_numpy()
    for name in ideals:
        part = slip.filter(pl.col("input") == name)
        if part.is_empty():
            continue
        values = np.full((velocities.height, 3), np.nan)
        place = np.searchsorted(stamps, part["stamp"].to_numpy())
        values[place] = part.select("f_x", "f_y", "f_w").to_numpy()
        steady[place] |= ~part["transitory"].to_numpy()
        step[place] = part["step"].to_numpy()
        ideals[name] = values
    gyro = velocities["v_w_imu"].cast(pl.Float64).fill_null(np.nan).to_numpy()
    return Samples(
        velocities["t"].to_numpy(),
        velocities["segment"].to_numpy(),
        steady,
        step,
        velocities.select("x", "y").to_numpy(),
        velocities["yaw"].to_numpy(),
        velocities.select("v_x", "v_y", "v_w").to_numpy(),
        gyro,
        ideals["command"],
        ideals["measured"],
        body_commanded,
    )
