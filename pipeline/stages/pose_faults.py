"""Faults of the localization: its latency, and half seconds and stretches of implausible motion."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import polars as pl

from pipeline.core import NORMAL_95, Flags, Floats, Ints, arrays, robust_spread
from pipeline.run import (
    SPAN_S,
    Alignment,
    DriveSeries,
    MotionError,
    MotionRun,
    align_heading,
    fit_gyro,
    has_excluded,
    make_run,
    mark_excluded,
    name_inputs,
)
from pipeline.sources import Vehicle
from pipeline.stages.timing import estimate_latency

# Faults of the localization: half seconds of motion that contradict the vehicle's wheels.
#
# A localization that was lost jumps back, stops and catches up, or reports a path that is rotated against the
# heading. Every displacement over half a second, its direction and its length, is compared with a robust
# model of the whole run: a regression on the wheels with delays and gains, general enough to contain every
# effect of the catalogue. A deviation of eight times the usual one at that speed, and of a quarter of a
# metre, is an outlier, up to a twentieth of the run.

_LONGEST_S = 1.2
"""Longest span of a tested displacement [s]: over a longer one the wheels' motion is too uncertain."""
_FEWEST = 200
"""Least number of displacements for a fit of some thirty parameters: six per parameter."""
_FAR = 8.0
"""Usual misfits at a speed above which a displacement is a fault; half and double change no finding of two
recordings, where `_LEAST_M` decides."""
_LEAST_M = 0.25
"""Least misfit of a fault [m]. With half of it the recording on grass of 2024-07-29 has outliers, and 0.6 %
less median slip."""
_LARGEST_SHARE = 0.05
"""Largest fraction of a run that is an outlier; a larger one is a property of the localization. Bad poses are
0 to 10 % of the windows of the recordings."""
_LAGS_S = (-0.3, -0.1, 0.0, 0.1, 0.3, 0.6, 1.0, 1.6)
"""Delays [s] at which wheels enter the model: their mixture approximates any lag and inertia up to 1.6 s."""
_ROUNDS = 10
"""Reweighting iterations, as in `fit_robustly`."""
_BINS = 6
"""Classes of speed of equal size, at least 33 displacements in each."""
SAMPLE_S = 0.05
"""Step of the times at which a localization is at fault [s]: that of the grid."""
_ROUNDING = 1e-6
"""Tolerance relative to a step, so that times on the raster stay on it."""


def find_outliers(run: MotionRun, vehicle: Vehicle) -> Floats:
    """Times at which the localization is at fault [s], at 20 Hz.

    Without measured wheels the vehicle's motion is unknown, and there are none.
    """
    none = np.zeros(0)
    if run.wheels is None:
        return none
    first, last = _pair_up(run)
    if first.size < _FEWEST:
        return none
    off = _measure_misfit(run, run.wheels, vehicle, first, last)
    begin, end = run.track.times[first], run.track.times[last]
    live = np.diff(run.track.times)[run.track.active[1:]]
    most = _LARGEST_SHARE * float(live[live < _LONGEST_S].sum())
    faulty = off > 1.0
    grid = _fill(begin[faulty], end[faulty], run.start_s)
    # More than a twentieth is not an exception: then only the worst part counts as a fault.
    while grid.size * SAMPLE_S > most:
        faulty &= off > np.quantile(off[faulty], 0.1)
        grid = _fill(begin[faulty], end[faulty], run.start_s)
    return grid


def _fill(begin: Floats, end: Floats, origin: float) -> Floats:
    """Times throughout some intervals, at 20 Hz since ``origin``."""
    first = np.floor((begin - origin) / SAMPLE_S + _ROUNDING)
    last = np.ceil((end - origin) / SAMPLE_S - _ROUNDING)
    ticks = [np.arange(a, b + 1) for a, b in zip(first.tolist(), last.tolist(), strict=True)]
    return origin + np.unique(np.concatenate(ticks)) * SAMPLE_S if ticks else np.zeros(0)


def _pair_up(run: MotionRun) -> tuple[Ints, Ints]:
    """Poses of one segment half a second apart, and those before and after a longer wait."""
    times = run.track.times
    first = np.arange(times.size)
    last = np.searchsorted(times, times + SPAN_S - 1e-3)
    mask = last < times.size
    first, last = first[mask], last[mask].astype(np.int64)
    mask = (run.track.segment[first] == run.track.segment[last]) & (times[last] - times[first] < _LONGEST_S)
    mask &= run.track.active[first] & run.track.active[last]
    mask &= ~has_excluded(run.excluded, times[first], times[last])
    return first[mask], last[mask]


def _measure_misfit(run: MotionRun, wheels: DriveSeries, vehicle: Vehicle, first: Ints, last: Ints) -> Floats:
    """Distance of each displacement from the robust model, one at the threshold of a fault, shape (n,)."""
    track = run.track
    heading, delay = _choose_heading(run)
    moved = (track.path[last] - track.path[first]) * np.exp(-0.5j * (heading[first] + heading[last]))
    span = track.times[last] - track.times[first]
    forward, sideways, turning = vehicle.kinematics.forward(name_inputs(wheels, vehicle), vehicle)

    def drive(rate: Floats, late: float) -> Floats:
        driven = arrays.integrate_rate(wheels.times, rate)
        at = track.times - delay - late
        return np.interp(at[last], wheels.times, driven) - np.interp(at[first], wheels.times, driven)

    own = (heading[last] - heading[first]) / span
    along = [drive(forward, late) for late in _LAGS_S]
    across = [drive(forward * turning, late) for late in _LAGS_S]
    beside = [own * column for column in along]
    rest = [span, drive(forward * np.abs(turning), 0.1), drive(forward * np.abs(forward), 0.1)]
    rest += [drive(np.abs(forward), 0.1), drive(np.abs(turning), 0.1), drive(turning, 0.1), own * span]
    speed = np.abs(along[_LAGS_S.index(0.1)])
    if wheels.sideways is not None:
        aside = [drive(sideways, late) for late in _LAGS_S]
        rest += [*aside, *(own * column for column in aside), drive(sideways * np.abs(sideways), 0.1)]
        rest += [drive(sideways * turning, 0.1), drive(np.abs(sideways), 0.1)]
        speed = np.hypot(speed, aside[_LAGS_S.index(0.1)])
    columns = np.column_stack((*along, *across, *beside, *rest))
    gap = np.column_stack([_fit_robustly(columns, part) for part in (moved.real, moved.imag)])
    size = np.hypot(gap[:, 0], gap[:, 1])
    usual = _spread_by_speed(size, speed / span)
    return size / np.maximum(_FAR * usual, _LEAST_M)


def _choose_heading(run: MotionRun) -> tuple[Floats, float]:
    """Heading at the poses, of the gyro if there is a good one, and the delay of the poses [s]."""
    gyro = run.gyro_fit
    if gyro is None or run.gyro is None:
        return run.track.heading, 0.0
    times, rate = run.gyro
    angle = gyro.turn(times, rate)
    seen = np.interp(run.track.times - gyro.yaw_delay_s, times, angle)
    good = ~mark_excluded(run, run.track.times)
    return seen + align_heading(run.track, run.track.heading - seen, good), gyro.yaw_delay_s


def _fit_robustly(columns: Floats, values: Floats) -> Floats:
    """Residuals of a regression with Cauchy weights, shape (n,)."""
    scale = np.sqrt(np.mean(columns**2, axis=0)) + 1e-9
    design = columns / scale
    weight, residual = np.ones(values.size), values
    ridge = 1e-4 * values.size * np.eye(design.shape[1])
    for _ in range(_ROUNDS):
        rows = design * weight[:, None]
        estimates = np.linalg.solve(rows.T @ design + ridge, rows.T @ values)
        residual = values - design @ estimates
        spread = max(robust_spread(residual), 1e-3)
        weight = 1.0 / (1.0 + (residual / (2.0 * spread)) ** 2)
    return residual


def _spread_by_speed(size: Floats, speed: Floats) -> Floats:
    """Usual misfit at each speed: it increases with the speed, since stamps are the source of error."""
    edges = np.quantile(speed, np.linspace(0.0, 1.0, _BINS + 1))
    bins = np.clip(np.searchsorted(edges, speed, side="right") - 1, 0, _BINS - 1)
    middle = np.array([np.median(speed[bins == k]) if (bins == k).any() else np.nan for k in range(_BINS)])
    usual = np.array([np.median(size[bins == k]) if (bins == k).any() else np.nan for k in range(_BINS)])
    known = np.isfinite(middle)
    # The median of the length of two normal parts is 1.18 times the spread of either.
    return np.interp(speed, middle[known], np.maximum.accumulate(usual[known])) / 1.18


# Correction of the poses: their latency against the gyro, and the outliers among them.

_BESIDE = 0.6
"""Distance of a pose to a fault, in `SAMPLE_S`, at which it is affected: over a half, to cover all poses."""


def align_poses(
    tables: Mapping[str, pl.DataFrame],
    vehicle: Vehicle,
    alignment: Alignment,
    *,
    is_live: Flags,
    is_localization: bool,
    where: str,
) -> tuple[pl.DataFrame, Alignment]:
    """Table `poses` with latencies and outliers, and the alignment with the gyro's part.

    Args:
        tables: of the run.
        vehicle: its vehicle.
        alignment: so far.
        is_live: poses at which recorded commands drive the vehicle, shape (m,): others are not compared.
        is_localization: whether the poses are more than integrated wheels, so that their delay is observable.
        where: the run, for error messages.
    """
    poses = tables["poses"]
    times = poses["t"].to_numpy()
    latency, outlier = np.zeros(times.size), np.zeros(times.size, dtype=bool)
    try:
        run = make_run(tables, vehicle, alignment, name=where)
    except MotionError:
        # A log without enough data for a model still has slip.
        return _correct_poses(poses, latency, outlier), alignment
    run = replace(run, excluded=times[~is_live])
    if not is_localization:
        # Integrated wheels have no clock of their own.
        return _correct_poses(poses, latency, outlier), _take_off_delay(_with_gyro(run).alignment, 0.0)
    raw = run.track.times
    own, spread = estimate_latency(run)
    run = replace(run, track=replace(run.track, times=raw - own))
    run = _with_gyro(run)
    at_fault = find_outliers(run, vehicle)
    if at_fault.size:
        near = np.abs(at_fault[arrays.nearest_indices(times, at_fault)] - times) <= _BESIDE * SAMPLE_S
        outlier |= near
        run = _with_gyro(replace(run, excluded=np.union1d(run.excluded, at_fault)))
    late, moved = _split_delay(run)
    for segment in np.unique(run.track.segment).tolist():
        rows, known = poses["segment"].to_numpy() == segment, run.track.segment == segment
        latency[rows] = late + np.interp(times[rows], raw[known], own[known])
    alignment = _take_off_delay(run.alignment, late, moved)
    alignment = replace(alignment, latency_spread_s=spread, outlier_s=float(at_fault.size * SAMPLE_S))
    return _correct_poses(poses, latency, outlier), alignment


def _correct_poses(poses: pl.DataFrame, latency: Floats, outlier: Flags) -> pl.DataFrame:
    return poses.with_columns(pl.Series("latency", latency), pl.Series("outlier", outlier))


def _split_delay(run: MotionRun) -> tuple[float, float]:
    """Delay of the poses against the gyro, and of the gyro against the poses [s]; one of them is zero.

    Between two samples the time at which the gyro's rate changed is unknown: if commands and samples are
    synchronous, the gyro appears late by a constant part of half a sampling period. A delay up to this does
    not concern the poses' clock.
    """
    if run.gyro_fit is None or run.gyro is None:
        return 0.0, 0.0
    late = run.gyro_fit.yaw_delay_s
    unknown = 0.5 * float(np.median(np.diff(run.gyro[0]))) + NORMAL_95 * run.gyro_fit.delay_error_s
    return (late, 0.0) if abs(late) > unknown else (0.0, -late)


def _take_off_delay(alignment: Alignment, late: float, moved: float = 0.0) -> Alignment:
    """The alignment of poses and a gyro on one clock."""
    gyro = alignment.gyro
    if gyro is not None:
        gyro = replace(gyro, yaw_delay_s=0.0, moved_s=moved)
    return replace(alignment, gyro=gyro, heading_delay_s=late)


def _with_gyro(run: MotionRun) -> MotionRun:
    return replace(run, alignment=replace(run.alignment, gyro=fit_gyro(run)))
