"""Checking the gyro against the poses: sign, scale, bias, delay; and its yaw rate on the grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.core import timegrid
from pipeline.stages.delays import estimate_delay
from pipeline.stages.finding import Finding

if TYPE_CHECKING:
    import polars as pl

Floats = NDArray[np.float64]

_LEAST_TURNING = 0.03
_AGREES = 0.7
_DOUBTFUL = 0.5
_SCALE_FORGIVEN = 0.05
_BIAS_FORGIVEN = 0.01
_LATE = 0.04
_GYRO_RATE = 20.0
_LONGEST_SILENCE = 0.25


@dataclass(frozen=True)
class GyroCheck:
    """Yaw rate of the poses = sign * size * gyro + bias, the poses being late by `pose_delay_s`.

    Attributes:
        usable: whether the gyro agrees with the poses well enough to replace their yaw rate.
        sign: -1 where the gyro turns the other way.
        size: of the slope, without its sign.
        bias: what must be added after sign and size [rad/s].
        pose_delay_s: how late the poses are against the gyro.
        correlation: signed correlation at that delay.
    """

    usable: bool
    sign: int
    size: float
    bias: float
    pose_delay_s: float
    correlation: float


def fit_gyro(
    velocities: pl.DataFrame, imu: pl.DataFrame, window: float
) -> tuple[GyroCheck | None, list[Finding]]:
    """Compare the gyro with the yaw rate of the poses.

    Args:
        velocities: table `velocities`, with the poses' yaw rate in `v_w`.
        imu: table `imu`.
        window: width of the fit that smoothed the poses [s]; the gyro gets the same.

    Returns:
        The fit, None when the vehicle turned too little to tell; and findings.
    """
    times, turning = velocities["t"].to_numpy(), velocities["v_w"].to_numpy()
    if float(np.std(turning)) < _LEAST_TURNING:
        text = "the vehicle turned too little to check the gyro against the poses: it was not used"
        return None, [Finding("imu_unchecked", "info", text)]
    grid, rate = _smooth_gyro(times, imu, window)
    delay = estimate_delay(times, turning, grid, rate)
    if delay is None:
        return None, []
    shifted = np.interp(times - delay.seconds, grid, rate)
    slope, offset = _fit_line(shifted, turning)
    usable = abs(delay.correlation) > _AGREES and abs(slope) > 0.5  # noqa: PLR2004 - a gyro is no worse than that
    fit = GyroCheck(usable, -1 if slope < 0.0 else 1, abs(slope), offset, delay.seconds, delay.correlation)
    return fit, _describe(fit)


def rate_of_gyro(times: Floats, imu: pl.DataFrame, fit: GyroCheck, window: float) -> Floats:
    """The gyro's yaw rate [rad/s] at grid times, sign, scale and bias corrected, at its own clock.

    NaN where the gyro was silent: a hole is not bridged.
    """
    grid, rate = _smooth_gyro(times, imu, window)
    corrected: Floats = fit.sign * fit.size * np.interp(times, grid, rate) + fit.bias
    stamps = imu["t"].to_numpy()
    following = np.searchsorted(stamps, times)
    before = stamps[np.maximum(following - 1, 0)]
    after = stamps[np.minimum(following, stamps.size - 1)]
    away = np.maximum(np.abs(times - before), np.abs(after - times))
    corrected[away > _LONGEST_SILENCE] = np.nan
    return corrected


def _smooth_gyro(times: Floats, imu: pl.DataFrame, window: float) -> tuple[Floats, Floats]:
    """The gyro's rate through the same local fit as the poses, on a uniform grid over the whole run."""
    stamps, rate = imu["t"].to_numpy(), imu["rate_z"].to_numpy()
    distinct = np.concatenate(([True], np.diff(stamps) > 0.0))
    stamps, rate = stamps[distinct], rate[distinct]
    angle = timegrid.integrate_rate(stamps, rate)[:, None]
    first, last = (
        max(float(times.min()) - 1.0, float(stamps[0])),
        min(float(times.max()) + 1.0, float(stamps[-1])),
    )
    grid = timegrid.make_grid(first, last, _GYRO_RATE)
    if grid.size < 2 or stamps.size < 2:  # noqa: PLR2004 - no overlap with the poses
        return np.array([first, first + 1.0]), np.zeros(2)
    return grid, timegrid.differentiate_locally(grid, stamps, angle, window)[:, 0]


def _fit_line(x: Floats, y: Floats) -> tuple[float, float]:
    """Slope and offset by least squares, once more without what lies beyond four robust deviations."""
    keep = np.ones(x.size, dtype=bool)
    slope = offset = 0.0
    for _ in range(3):
        design = np.column_stack((x[keep], np.ones(int(keep.sum()))))
        (slope, offset), *_ = np.linalg.lstsq(design, y[keep], rcond=None)
        residual = np.abs(y - slope * x - offset)
        keep = residual <= 4.0 * 1.4826 * max(float(np.median(residual)), 1e-9)
    return float(slope), float(offset)


def _describe(fit: GyroCheck) -> list[Finding]:
    findings = []
    if abs(fit.correlation) < _DOUBTFUL or not fit.usable:
        text = f"the gyro does not agree with the poses (correlation {fit.correlation:.2f}): it was not used"
        return [Finding("imu_disagrees", "warning", text, where="imu", value=fit.correlation)]
    if fit.sign < 0:
        text = (
            f"the gyro's yaw rate has the wrong sign (correlation {fit.correlation:.2f}): it was turned round"
        )
        findings.append(Finding("imu_sign", "warning", text, where="imu", value=fit.correlation))
    if abs(fit.size - 1.0) > _SCALE_FORGIVEN:
        text = f"the poses turn {fit.size:.3f} times as much as the gyro says: it was scaled"
        findings.append(Finding("imu_scale", "warning", text, where="imu", value=fit.size))
    if abs(fit.bias) > _BIAS_FORGIVEN:
        text = f"the gyro has a bias of {-fit.bias:.4f} rad/s against the poses: it was taken off"
        findings.append(Finding("imu_bias", "info", text, where="imu", value=-fit.bias))
    if abs(fit.pose_delay_s) > _LATE:
        late = "late" if fit.pose_delay_s > 0.0 else "early"
        text = f"the poses are {abs(fit.pose_delay_s) * 1e3:.0f} ms {late} against the gyro"
        findings.append(Finding("pose_delay", "info", text, where="pose", value=fit.pose_delay_s))
    return findings
