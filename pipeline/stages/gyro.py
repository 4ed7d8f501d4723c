"""The gyro beside the poses: what is said of it, and its yaw rate on the grid."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import timegrid
from pipeline.core.arrays import Floats
from pipeline.stages.finding import Finding

if TYPE_CHECKING:
    import polars as pl

    from pipeline.runs.recording import Alignment, GyroFit


_LEAST_TURNING = 0.03
_SCALE_FORGIVEN = 0.05
_BIAS_FORGIVEN = 0.01
_LATE = 0.04
_GYRO_RATE = 20.0
_LONGEST_SILENCE = 0.25
_ROUNDING_S = 1e-6


def smooth_gyro(times: Floats, imu: pl.DataFrame, fit: GyroFit, window: float) -> Floats:
    """The gyro's yaw rate [rad/s] at grid times, sign, scale and bias corrected, at its own clock.

    It goes through the same local fit as the poses. NaN where the gyro was silent: a hole is not bridged.

    Args:
        times: grid [s], shape (n,).
        imu: table `imu`.
        fit: how the gyro fits the poses.
        window: width of the fit [s].
    """
    stamps, rate = imu["t"].to_numpy(), imu["rate_z"].to_numpy()
    distinct = np.concatenate(([True], np.diff(stamps) > 0.0))
    stamps, rate = stamps[distinct], rate[distinct]
    first = max(float(times.min()) - 1.0, float(stamps[0]))
    last = min(float(times.max()) + 1.0, float(stamps[-1]))
    grid = timegrid.make_grid(first, last, _GYRO_RATE)
    if grid.size < 2 or stamps.size < 2:  # noqa: PLR2004 - no overlap with the poses
        return np.full(times.size, np.nan)
    angle = timegrid.integrate_rate(stamps, rate)[:, None]
    smooth = timegrid.differentiate_locally(grid, stamps, angle, window)[:, 0]
    corrected: Floats = fit.signed_scale * np.interp(times, grid, smooth) + fit.bias
    # A grid that meets stamps meets them up to rounding.
    following = np.searchsorted(stamps, times - _ROUNDING_S)
    before = stamps[np.maximum(following - 1, 0)]
    after = stamps[np.minimum(following, stamps.size - 1)]
    away = np.maximum(np.abs(times - before), np.abs(after - times))
    corrected[away > _LONGEST_SILENCE + _ROUNDING_S] = np.nan
    return corrected


def describe_gyro(alignment: Alignment, turning: Floats) -> list[Finding]:
    """What is said of the gyro.

    Args:
        alignment: with how it fits the poses, if it does.
        turning: yaw rate of the poses [rad/s], shape (n,).
    """
    fit = alignment.gyro
    if fit is None:
        if float(np.std(turning)) < _LEAST_TURNING:
            text = "the vehicle turned too little to check the gyro against the poses: it was not used"
            return [Finding("imu_unchecked", "info", text)]
        text = "the gyro does not agree with the poses, or is silent in part of the run: it was not used"
        return [Finding("imu_disagrees", "warning", text, where="imu")]
    findings = []
    if fit.signed_scale < 0.0:
        text = (
            "the gyro's yaw rate has the wrong sign: it was turned round "
            f"(so it leaves {fit.residual:.1%} of the poses' turning)"
        )
        findings.append(Finding("imu_sign", "warning", text, where="imu", value=fit.signed_scale))
    scale = abs(fit.signed_scale)
    if abs(scale - 1.0) > _SCALE_FORGIVEN:
        text = f"the poses turn {scale:.3f} times as much as the gyro says: it was scaled"
        findings.append(Finding("imu_scale", "warning", text, where="imu", value=scale))
    if abs(fit.bias) > _BIAS_FORGIVEN:
        text = f"the gyro has a bias of {-fit.bias:.4f} rad/s against the poses: it was taken off"
        findings.append(Finding("imu_bias", "info", text, where="imu", value=-fit.bias))
    delay = alignment.heading_delay_s
    if abs(delay) > _LATE:
        late = "late" if delay > 0.0 else "early"
        text = f"the poses are {abs(delay) * 1e3:.0f} ms {late} against the gyro: put right"
        findings.append(Finding("pose_delay", "info", text, where="pose", value=delay))
    return findings
