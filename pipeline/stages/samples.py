"""The samples of a run side by side, as the checks of a whole run need them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.core.arrays import Flags, Floats
from pipeline.stages.slip import Ideal, Steps


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
    steady: Flags
    step: NDArray[np.int32]
    position: Floats
    yaw: Floats
    velocity: Floats
    gyro: Floats
    command: Floats | None
    measured: Floats | None
    body_commanded: bool


def gather_samples(
    velocities: pl.DataFrame, inputs: Mapping[str, Ideal], cut: Steps, *, body_commanded: bool
) -> Samples:
    """Arrange what is known of a run on its grid for the checks.

    Args:
        velocities: table `velocities`.
        inputs: ideal velocities by input.
        cut: command steps.
        body_commanded: whether the command was a body command.
    """
    counts = np.zeros(velocities.height, dtype=bool)
    ideals: dict[str, Floats | None] = {"command": None, "measured": None}
    for name, ideal in inputs.items():
        kept = np.isfinite(ideal.velocity).all(axis=1) & ideal.active
        if kept.any():
            ideals[name] = np.where(kept[:, None], ideal.velocity, np.nan)
            counts |= kept
    gyro = velocities["v_w_imu"] if "v_w_imu" in velocities.columns else pl.Series([None] * counts.size)
    return Samples(
        velocities["t"].to_numpy(),
        velocities["segment"].to_numpy(),
        counts & ~cut.transitory,
        np.where(counts, cut.step, -1),
        velocities.select("x", "y").to_numpy(),
        velocities["yaw"].to_numpy(),
        velocities.select("v_x", "v_y", "v_w").to_numpy(),
        gyro.cast(pl.Float64).fill_null(np.nan).to_numpy(),
        ideals["command"],
        ideals["measured"],
        body_commanded,
    )
