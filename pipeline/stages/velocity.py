"""The velocity stage: body velocities on a uniform grid, and the gyro's yaw rate.

Held poses are left out. The increments between the remaining ones are taken on SE(3), so that neither a turn
nor tilted ground causes a false velocity. Their running sum is an odometer, and a local quadratic fit of this
odometer gives the velocity.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.core import Floats, arrays, rigid
from pipeline.recording import Finding, StageError
from pipeline.run import (
    SPAN_S,
    Alignment,
    DriveSeries,
    GyroFit,
    select_fresh,
)
from pipeline.sources import VelocitySection

_LEAST_TURNING_RADPS = 0.03
"""Standard deviation of the yaw rate below which an unused gyro cannot be judged, so that no disagreement is
reported."""
_SCALE_FORGIVEN = 0.05
"""Relative scale error of a gyro that is not reported: data sheets of MEMS gyros state 1 to 3 %."""
_BIAS_FORGIVEN = 0.01
"""Bias of a gyro [rad/s] above which it is reported: 0.6 degrees per second."""
_LATE = 0.04
"""Delay of poses [s] above which it is reported: the period of poses at 25 Hz."""


def make_grid(start: float, end: float, rate: float) -> Floats:
    """Uniform times from ``start`` to ``end`` inclusive in steps of 1/``rate``, tolerant of rounding."""
    return start + np.arange(_count_grid(start, end, rate)) / rate


def _count_grid(start: float, end: float, rate: float) -> int:
    """Number of uniform times from ``start`` to ``end`` inclusive in steps of 1/``rate``; see `make_grid`."""
    return max(int(np.floor((end - start) * rate + 1e-6)) + 1, 0)


def smooth_gyro(times: Floats, imu: pl.DataFrame, fit: GyroFit, window: float) -> Floats:
    """The gyro's yaw rate [rad/s] at grid times, with sign, scale, bias and clock corrected.

    It is smoothed by the same local fit as the poses. Gaps of the gyro are NaN and are not bridged.

    Args:
        times: grid [s], shape (n,).
        imu: table `imu`.
        fit: fit of the gyro to the poses.
        window: width of the fit [s].
    """
    stamps, rate = imu["t"].to_numpy() - fit.moved_s, imu["rate_z"].to_numpy()
    distinct = np.concatenate(([True], np.diff(stamps) > 0.0))
    stamps, rate = stamps[distinct], rate[distinct]
    first = max(float(times.min()) - 1.0, float(stamps[0]))
    last = min(float(times.max()) + 1.0, float(stamps[-1]))
    rate_hz = VelocitySection().rate_hz
    count = _count_grid(first, last, rate_hz)
    if count < 2 or stamps.size < 2:  # noqa: PLR2004 - no overlap with the poses
        return np.full(times.size, np.nan)
    # Grid times may differ from stamps by rounding.
    following = np.searchsorted(stamps, times - arrays.ROUNDING_S)
    before = stamps[np.maximum(following - 1, 0)]
    after = stamps[np.minimum(following, stamps.size - 1)]
    away = np.maximum(np.abs(times - before), np.abs(after - times))
    known = away <= arrays.SILENT_S + arrays.ROUNDING_S
    # Of the uniform grid only the points beside the given times, however long the gyro was silent.
    cell = np.clip(np.floor((times[known] - first) * rate_hz).astype(np.int64), 0, count - 2)
    grid = first + np.unique(np.concatenate((cell, cell + 1))) / rate_hz
    angle = arrays.integrate_rate(stamps, rate)[:, None]
    smooth = arrays.differentiate_locally(grid, stamps, angle, window)[:, 0]
    corrected = np.full(times.size, np.nan)
    if known.any():
        corrected[known] = fit.signed_scale * np.interp(times[known], grid, smooth) + fit.bias
    return corrected


def report_gyro(alignment: Alignment, turning: Floats) -> list[Finding]:
    """Findings on the gyro.

    Args:
        alignment: alignment with its fit to the poses, if any.
        turning: yaw rate of the poses [rad/s], shape (n,).
    """
    fit = alignment.gyro
    if fit is None:
        if float(np.std(turning)) < _LEAST_TURNING_RADPS:
            return [Finding("imu_unchecked", "info")]
        return [Finding("imu_disagrees", "warning", "imu")]
    findings = []
    if fit.signed_scale < 0.0:
        values = {"value": fit.signed_scale, "residual": fit.residual}
        findings.append(Finding("imu_sign", "warning", "imu", values))
    scale = abs(fit.signed_scale)
    if abs(scale - 1.0) > _SCALE_FORGIVEN:
        findings.append(Finding("imu_scale", "warning", "imu", {"value": scale}))
    if abs(fit.bias) > _BIAS_FORGIVEN:
        findings.append(Finding("imu_bias", "info", "imu", {"value": -fit.bias}))
    delay = alignment.heading_delay_s
    if abs(delay) > _LATE:
        findings.append(Finding("pose_delay", "info", "pose", {"value": delay}))
    return findings


@dataclass(frozen=True)
class VelocityResult:
    """Velocities and findings."""

    table: pl.DataFrame
    findings: tuple[Finding, ...] = field(default=())


def compute_velocities(
    poses: pl.DataFrame,
    imu: pl.DataFrame,
    alignment: Alignment,
    settings: VelocitySection,
    *,
    where: str,
    wheels: DriveSeries | None = None,
) -> VelocityResult:
    """Differentiate aligned poses into body velocities.

    Args:
        poses: table `poses`, aligned.
        imu: table `imu`; may be empty.
        alignment: with the fit of the gyro to the poses, if it is good.
        settings: grid rate [Hz], width of the fit [s], source of the yaw rate.
        where: the run, for error messages.
        wheels: measured wheels, which tell a localization that waits from a vehicle at rest.

    Raises:
        StageError: no segment is long enough, or the gyro is requested and none is usable.
    """
    table, skipped = differentiate_poses(poses, settings, wheels, where=where)
    findings: list[Finding] = []
    if skipped:
        findings.append(Finding("short_segments", "info", "", {"count": skipped, "span_s": SPAN_S}))
    gyro = alignment.gyro
    if not imu.is_empty():
        findings += report_gyro(alignment, table["v_w"].to_numpy())
    rate = None if gyro is None else smooth_gyro(table["t"].to_numpy(), imu, gyro, settings.window_s)
    column = (
        pl.Series("v_w_imu", rate, dtype=pl.Float64).fill_nan(None)
        if rate is not None
        else pl.lit(None, pl.Float64).alias("v_w_imu")
    )
    table = table.with_columns(column)
    if settings.yaw == "imu":
        if rate is None:
            what = "--yaw imu was given, but the log has no gyro that agrees with the poses"
            raise StageError("no_gyro", what, where=where, hint="Use --yaw pose (the default).")
        silent = table["v_w_imu"].null_count()
        if silent:
            findings.append(Finding("imu_gap", "warning", "imu", {"count": silent}))
        table = table.with_columns(pl.coalesce(pl.col("v_w_imu"), pl.col("v_w")).alias("v_w"))
    return VelocityResult(table, tuple(findings))


def differentiate_poses(
    poses: pl.DataFrame, settings: VelocitySection, wheels: DriveSeries | None, *, where: str
) -> tuple[pl.DataFrame, int]:
    """Body velocities on the uniform grid of every segment, without those of a gyro.

    Args:
        poses: table `poses`, aligned.
        settings: grid rate [Hz] and width of the fit [s].
        wheels: see `compute_velocities`.
        where: the run, for error messages.

    Returns:
        Table `velocities` without `v_w_imu`, and the number of segments that were too short.

    Raises:
        StageError: ``no_segment``.
    """
    pieces = [_differentiate_segment(piece, settings, wheels) for piece in rigid.cut_segments(poses)]
    made = [piece for piece in pieces if piece is not None]
    if not made:
        what = "the poses hold no stretch of half a second without a gap or a jump"
        hint = "Check the pose topic with `slip inspect`; or widen velocity.gap_s, velocity.jump_m."
        raise StageError("no_segment", what, where=where, hint=hint)
    table = pl.DataFrame({name: np.concatenate([piece[name] for piece in made]) for name in made[0]})
    return table, len(pieces) - len(made)


def _differentiate_segment(
    piece: dict[str, NDArray[Any]], settings: VelocitySection, wheels: DriveSeries | None
) -> dict[str, NDArray[Any]] | None:
    """Velocities of one segment, by column; None if it is too short."""
    times = piece["t"]
    fresh = select_fresh(piece, wheels)
    aligned = np.maximum.accumulate(times - piece["latency"])
    # Latencies do not change the order, up to rounding.
    fresh = fresh[np.diff(aligned[fresh], prepend=-np.inf) > 0.0]
    if fresh.size < 2:  # noqa: PLR2004 - one pose has no velocity
        return None
    stamps = aligned[fresh]
    # The grid covers the whole segment including repeats: a vehicle may be at rest at its end.
    first, last = float(aligned[0]), float(aligned[-1])
    if last - first < SPAN_S:
        return None
    position, quaternion = piece["position"][fresh], piece["quaternion"][fresh]
    move, turn = rigid.measure_increments(position, quaternion)
    odometer = np.concatenate(
        (np.zeros((1, 3)), np.cumsum(np.column_stack((move[:, :2], turn[:, 2])), axis=0))
    )
    grid = make_grid(first, last, settings.rate_hz)
    inside = np.clip(grid, stamps[0], stamps[-1])
    velocity = arrays.differentiate_locally(inside, stamps, odometer, settings.window_s)
    late, stamped = piece["latency"], np.interp(inside, stamps, times[fresh])
    # A common delay moves a velocity in time, and does not change it.
    before = (
        arrays.differentiate_locally(stamped, times[fresh], odometer, settings.window_s)
        if np.ptp(late) > 0.0
        else velocity
    )
    at, attitude = rigid.interpolate_poses(inside, stamps, position, quaternion)
    roll, pitch, yaw = rigid.euler_from_quaternions(attitude)
    return {
        "t": grid,
        "stamp": piece["stamp"][0] + np.round((grid - times[0]) * 1e9).astype(np.int64),
        "segment": np.full(grid.size, piece["segment"][0], dtype=np.int32),
        **{name: at[:, i] for i, name in enumerate("xyz")},
        "roll": roll,
        "pitch": pitch,
        "yaw": np.unwrap(yaw),
        **{name: velocity[:, i] for i, name in enumerate(("v_x", "v_y", "v_w"))},
        "recorded_t": stamped,
        **{f"recorded_{axis}": before[:, i] for i, axis in enumerate("xyw")},
        "outlier": piece["outlier"][arrays.nearest_indices(grid, aligned)],
    }
