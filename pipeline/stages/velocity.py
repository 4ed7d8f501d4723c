"""The velocity stage: body velocities on a uniform grid, from poses, and the gyro beside them.

Held poses are left out; the increments between the remaining ones are taken on SE(3), so that neither a turn
nor a tilted ground leaves a false velocity; their running sum is the vehicle's own odometer, and a local
quadratic fit of that odometer gives the velocity.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.core import arrays, rigid
from pipeline.core.arrays import Floats
from pipeline.core.program import format_share
from pipeline.run.heading import LEAST_TURNING_RADPS, SPAN_S
from pipeline.run.recording import GyroFit
from pipeline.sources.configuration import VelocitySection
from pipeline.stages.finding import Finding, StageError

if TYPE_CHECKING:
    from pipeline.run.recording import Alignment

_SCALE_FORGIVEN = 0.05
"""Share by which a gyro's scale may be off without a word: data sheets of MEMS say 1 to 3 %."""
_BIAS_FORGIVEN = 0.01
"""Bias of a gyro [rad/s] that is told: 0.6 degrees a second; MEMS at rest have less."""
_LATE = 0.04
"""Delay of poses [s] that is told: one of a scan at 25 Hz is within a pose's own period."""


def smooth_gyro(times: Floats, imu: pl.DataFrame, fit: GyroFit, window: float) -> Floats:
    """The gyro's yaw rate [rad/s] at grid times, sign, scale, bias and clock corrected.

    It goes through the same local fit as the poses. NaN where the gyro was silent: a hole is not bridged.

    Args:
        times: grid [s], shape (n,).
        imu: table `imu`.
        fit: how the gyro fits the poses.
        window: width of the fit [s].
    """
    stamps, rate = imu["t"].to_numpy() - fit.moved_s, imu["rate_z"].to_numpy()
    distinct = np.concatenate(([True], np.diff(stamps) > 0.0))
    stamps, rate = stamps[distinct], rate[distinct]
    first = max(float(times.min()) - 1.0, float(stamps[0]))
    last = min(float(times.max()) + 1.0, float(stamps[-1]))
    grid = arrays.make_grid(first, last, VelocitySection().rate_hz)
    if grid.size < 2 or stamps.size < 2:  # noqa: PLR2004 - no overlap with the poses
        return np.full(times.size, np.nan)
    angle = arrays.integrate_rate(stamps, rate)[:, None]
    smooth = arrays.differentiate_locally(grid, stamps, angle, window)[:, 0]
    corrected: Floats = fit.signed_scale * np.interp(times, grid, smooth) + fit.bias
    # A grid that meets stamps meets them up to rounding.
    following = np.searchsorted(stamps, times - arrays.ROUNDING_S)
    before = stamps[np.maximum(following - 1, 0)]
    after = stamps[np.minimum(following, stamps.size - 1)]
    away = np.maximum(np.abs(times - before), np.abs(after - times))
    corrected[away > arrays.SILENT_S + arrays.ROUNDING_S] = np.nan
    return corrected


def report_gyro(alignment: Alignment, turning: Floats) -> list[Finding]:
    """What is said of the gyro.

    Args:
        alignment: with how it fits the poses, if it does.
        turning: yaw rate of the poses [rad/s], shape (n,).
    """
    fit = alignment.gyro
    if fit is None:
        if float(np.std(turning)) < LEAST_TURNING_RADPS:
            text = "the vehicle turned too little to check the gyro against the poses: it was not used"
            return [Finding("imu_unchecked", "info", text)]
        text = "the gyro does not agree with the poses, or is silent in part of the run: it was not used"
        return [Finding("imu_disagrees", "warning", text, where="imu")]
    findings = []
    if fit.signed_scale < 0.0:
        text = (
            "the gyro's yaw rate has the wrong sign: it was inverted, "
            f"and then differs from that of the poses by {format_share(fit.residual)}"
        )
        findings.append(Finding("imu_sign", "warning", text, where="imu", value=fit.signed_scale))
    scale = abs(fit.signed_scale)
    if abs(scale - 1.0) > _SCALE_FORGIVEN:
        text = f"the poses turn {scale:.3f} times as much as the gyro says: it was scaled"
        findings.append(Finding("imu_scale", "warning", text, where="imu", value=scale))
    if abs(fit.bias) > _BIAS_FORGIVEN:
        text = f"the gyro has a bias of {-fit.bias:.4f} rad/s against the poses: it was removed"
        findings.append(Finding("imu_bias", "info", text, where="imu", value=-fit.bias))
    delay = alignment.heading_delay_s
    if abs(delay) > _LATE:
        late = "late" if delay > 0.0 else "early"
        text = f"the poses are {abs(delay) * 1e3:.0f} ms {late} against the gyro: corrected"
        findings.append(Finding("pose_delay", "info", text, where="pose", value=delay))
    return findings


@dataclass(frozen=True)
class VelocityResult:
    """Velocities, and what was noticed."""

    table: pl.DataFrame
    findings: tuple[Finding, ...] = field(default=())


def compute_velocities(
    poses: pl.DataFrame,
    imu: pl.DataFrame,
    gyro: GyroFit | None,
    settings: VelocitySection,
    *,
    where: str,
) -> VelocityResult:
    """Differentiate aligned poses into body velocities.

    Args:
        poses: table `poses`, aligned.
        imu: table `imu`; may be empty.
        gyro: how the gyro fits the poses; None without a good one.
        settings: grid rate [Hz], width of the fit [s], whose yaw rate to use.
        where: the run, for error messages.

    Raises:
        StageError: no segment is long enough, or the gyro is asked for and there is no usable one.
    """
    table, skipped = differentiate_poses(poses, settings, where=where)
    findings = []
    if skipped:
        text = f"{skipped} segments are shorter than {SPAN_S} s or hold one pose: left out"
        findings.append(Finding("short_segments", "info", text, count=skipped))
    rate = None if gyro is None else smooth_gyro(table["t"].to_numpy(), imu, gyro, settings.window_s)
    column = (
        pl.Series("v_w_imu", rate, dtype=pl.Float64).fill_nan(None)
        if rate is not None
        else pl.lit(None, pl.Float64).alias("v_w_imu")
    )
    table = table.with_columns(column)
    if settings.yaw == "imu":
        if rate is None:
            what = "--yaw imu was asked for, but the log has no gyro that agrees with the poses"
            raise StageError("no_gyro", what, where=where, hint="Use --yaw pose (the default).")
        silent = table["v_w_imu"].null_count()
        if silent:
            text = f"the gyro is silent in {silent} time steps: the poses' yaw rate stands in there"
            findings.append(Finding("imu_gap", "warning", text, where="imu", count=silent))
        table = table.with_columns(pl.coalesce(pl.col("v_w_imu"), pl.col("v_w")).alias("v_w"))
    return VelocityResult(table, tuple(findings))


def differentiate_poses(
    poses: pl.DataFrame, settings: VelocitySection, *, where: str
) -> tuple[pl.DataFrame, int]:
    """Body velocities on the uniform grid of every segment, without a gyro's.

    Args:
        poses: table `poses`; where it is not aligned yet its stamps stand as they are.
        settings: grid rate [Hz] and width of the fit [s].
        where: the run, for error messages.

    Returns:
        Table `velocities` but for `v_w_imu`, and how many segments were too short.

    Raises:
        StageError: ``no_segment``.
    """
    pieces = [_differentiate_segment(piece, settings) for piece in rigid.cut_segments(poses)]
    made = [piece for piece in pieces if piece is not None]
    if not made:
        what = "the poses hold no stretch of half a second without a gap or a jump"
        hint = "Check the pose topic with `slip inspect`; or widen velocity.gap_s, velocity.jump_m."
        raise StageError("no_segment", what, where=where, hint=hint)
    table = pl.DataFrame({name: np.concatenate([piece[name] for piece in made]) for name in made[0]})
    return table, len(pieces) - len(made)


def _differentiate_segment(
    piece: dict[str, NDArray[Any]], settings: VelocitySection
) -> dict[str, NDArray[Any]] | None:
    """Velocities of one segment, by column; None when it is too short."""
    times = piece["t"]
    fresh = rigid.select_fresh_poses(times, piece["held"])
    aligned = times
    if "latency" in piece:
        aligned = np.maximum.accumulate(times - piece["latency"])
    # Latencies leave the order as it is, up to rounding.
    fresh = fresh[np.diff(aligned[fresh], prepend=-np.inf) > 0.0]
    if fresh.size < 2:  # noqa: PLR2004 - one pose has no velocity
        return None
    stamps = aligned[fresh]
    # The grid spans the whole segment, repeats included: a vehicle may stand at its end.
    first, last = float(aligned[0]), float(aligned[-1])
    if last - first < SPAN_S:
        return None
    position, quaternion = piece["position"][fresh], piece["quaternion"][fresh]
    move, turn = rigid.measure_increments(position, quaternion)
    odometer = np.concatenate(
        (np.zeros((1, 3)), np.cumsum(np.column_stack((move[:, :2], turn[:, 2])), axis=0))
    )
    grid = arrays.make_grid(first, last, settings.rate_hz)
    inside = np.clip(grid, stamps[0], stamps[-1])
    velocity = arrays.differentiate_locally(inside, stamps, odometer, settings.window_s)
    at, attitude = rigid.interpolate_poses(inside, stamps, position, quaternion)
    roll, pitch, yaw = rigid.euler_from_quaternions(attitude)
    outlier = piece.get("outlier", np.zeros(times.size, dtype=bool))
    return {
        "t": grid,
        "stamp": piece["stamp"][0] + np.round((grid - times[0]) * 1e9).astype(np.int64),
        "segment": np.full(grid.size, piece["segment"][0], dtype=np.int32),
        **{name: at[:, i] for i, name in enumerate("xyz")},
        "roll": roll,
        "pitch": pitch,
        "yaw": rigid.unwrap_yaw(yaw),
        **{name: velocity[:, i] for i, name in enumerate(("v_x", "v_y", "v_w"))},
        "outlier": outlier[arrays.nearest_indices(grid, aligned)],
    }
