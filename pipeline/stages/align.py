"""The align stage: systematic errors of a recording are corrected once, and the corrections stored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.core import NORMAL_95, arrays
from pipeline.core.arrays import Flags, Floats
from pipeline.run import Alignment, GyroFit, MotionError, MotionRun, make_run, read_drive, tabulate_alignment
from pipeline.run.heading import fit_gyro
from pipeline.sources import Vehicle
from pipeline.sources.configuration import SlipSection, VelocitySection
from pipeline.stages import Finding
from pipeline.stages.command_scale import CommandScale, correct_commands, measure_command_scale
from pipeline.stages.drive import interpolate_readings
from pipeline.stages.drive_numbers import find_timeout, mark_late_starts, report_timeout
from pipeline.stages.incidents import find_incidents
from pipeline.stages.pose_faults import SAMPLE_S, find_bad_stretches, find_outliers
from pipeline.stages.slip_stage import Ideal, cut_steps, interpolate_wheels, keep_known, read_inputs
from pipeline.stages.timing import estimate_latency
from pipeline.stages.trust import (
    LEAST_CORRELATION,
    Samples,
    check_echo,
    check_independence,
    estimate_delay,
    gather_samples,
)
from pipeline.stages.velocity import MotionEvents, differentiate_poses, find_events, report_gyro, smooth_gyro

_LEAST_S = 0.05
"""Least delay of encoders [s] that is corrected here; fits find shorter ones (six of twelve recordings)."""


def measure_wheel_delay(
    times: Floats, wheels: pl.DataFrame, imu: pl.DataFrame, gyro: GyroFit | None, vehicle: Vehicle
) -> float:
    """Delay [s] of the wheels' yaw rate against the gyro's; zero if small or not determinable.

    The opposite sign, a body that follows its wheels late, is physics and not an encoder delay.

    Args:
        times: evaluation grid [s], shape (n,).
        wheels: table `wheels`.
        imu: table `imu`.
        gyro: fit of the gyro to the poses; None without a good one.
        vehicle: geometry.
    """
    if gyro is None or wheels.is_empty():
        return 0.0
    turning = interpolate_wheels(times, wheels, vehicle).velocity[:, 2]
    seen = smooth_gyro(times, imu, gyro, _GRID.window_s)
    known = np.isfinite(turning) & np.isfinite(seen)
    delay = estimate_delay(times[known], turning[known], times[known], seen[known])
    if delay is None or abs(delay.correlation) < LEAST_CORRELATION or delay.seconds < _LEAST_S:
        return 0.0
    return delay.seconds


_BESIDE = 0.6
"""Distance of a pose to a fault, in `SAMPLE_S`, at which it is affected: over a half, to cover all poses."""
# Alignment uses a grid of its own, so that settings of later stages do not change it.
_GRID, _STEPS = VelocitySection(), SlipSection()


@dataclass(frozen=True)
class Aligned:
    """An aligned run.

    Attributes:
        tables: the given tables with columns of their corrections, and `alignments`.
        alignment: the corrections as numbers.
        vehicle: with the controller's track multiplier found in the recording.
        findings: findings of the stage.
    """

    tables: Mapping[str, pl.DataFrame]
    alignment: Alignment
    vehicle: Vehicle
    findings: tuple[Finding, ...]


def align_tables(
    tables: Mapping[str, pl.DataFrame],
    vehicle: Vehicle,
    *,
    hold_s: float | None,
    body_commanded: bool,
    where: str,
) -> Aligned:
    """Align a run.

    Args:
        tables: `poses`, `commands`, `wheels`, `imu` as extracted; those that the log lacks may be missing.
        vehicle: as configured.
        hold_s: how long a command is valid; by default the command timeout if silences show one, else
            `arrays.usual_hold`.
        body_commanded: whether the command is a body command, which the controller converts to wheel speeds.
        where: the run, for error messages.

    Raises:
        StageError: ``no_segment``, no stretch of the poses can be differentiated.
    """
    commands, wheels = (tables.get(name, pl.DataFrame()) for name in ("commands", "wheels"))
    echo = check_echo(commands, wheels, vehicle, body_commanded=body_commanded)
    used = {name: table for name, table in tables.items() if not (echo and name == "wheels")}
    made = _align(used, wheels, vehicle, hold_s=hold_s, body_commanded=body_commanded, where=where)
    if not echo:
        return made
    # The readings stay as recorded; as aligned they are unknown, so that nothing evaluates them.
    names = [name for name in wheels.columns if name.endswith("_aligned")]
    unknown = wheels.with_columns(pl.lit(None, pl.Float64).alias(name) for name in names)
    return replace(made, tables={**made.tables, "wheels": unknown}, findings=(*echo, *made.findings))


def _align(
    tables: Mapping[str, pl.DataFrame],
    witness: pl.DataFrame,
    vehicle: Vehicle,
    *,
    hold_s: float | None,
    body_commanded: bool,
    where: str,
) -> Aligned:
    """As `align_tables`; poses that are made of the wheels ``witness`` are reported even without wheels."""
    commands = tables.get("commands", pl.DataFrame())
    wheels, findings = interpolate_readings(tables.get("wheels", pl.DataFrame()))
    hold = None
    if not commands.is_empty():
        hold = arrays.usual_hold(commands["t"].to_numpy()) if hold_s is None else hold_s
    velocities, _ = differentiate_poses(tables["poses"], _GRID, read_drive(wheels, vehicle), where=where)
    times = velocities["t"].to_numpy()
    inputs = read_inputs(times, commands, wheels, vehicle, hold)
    moved = velocities.select("v_x", "v_y", "v_w").to_numpy()
    timeout = find_timeout(times, inputs, moved, commands, vehicle)
    if timeout is not None and hold_s is None:
        hold = timeout.seconds
        inputs = read_inputs(times, commands, wheels, vehicle, hold)
    known = keep_known(inputs)
    grid = _Grid(velocities, np.zeros(velocities.height, dtype=bool), pl.DataFrame())
    scale = CommandScale(1.0, 1.0, vehicle.controller_track_multiplier)
    events = MotionEvents()
    if known:
        cut = cut_steps(velocities, known, _STEPS.length_scale_m, _STEPS.transitory_s)
        incidents = find_incidents(velocities, tables, known, vehicle, hold)
        usual = {name: ideal.leave_out(incidents.excluded) for name, ideal in known.items()}
        bad, contradictions = find_bad_stretches(
            velocities, {name: ideal.velocity for name, ideal in usual.items()}, cut.step
        )
        events = find_events(velocities, known, vehicle, bad, incidents.spans)
        bad |= incidents.excluded
        findings += [*contradictions, *incidents.findings, *events.findings]
        grid = _Grid(velocities, bad, _tabulate_steps(velocities, known, cut.step, bad))
        samples = gather_samples(velocities, usual, cut, body_commanded=body_commanded)
        scale = measure_command_scale(samples, vehicle)
        independent = _check_poses(samples, witness, tables["poses"], vehicle)
        findings += [*scale.findings, *independent]
        grid = replace(grid, recorded=_measure_moduli(samples, bad), is_localization=not independent)
    aligned_vehicle = msgspec.structs.replace(vehicle, controller_track_multiplier=scale.track_multiplier)
    asked, late_starts = mark_late_starts(correct_commands(commands, vehicle, scale), wheels, aligned_vehicle)
    findings += late_starts
    corrected = {**tables, "commands": asked}
    alignment = Alignment(
        hold, scale.scale, scale.turn_scale, scale.track_multiplier, recorded_moduli=grid.recorded
    )
    poses, alignment = _align_poses(corrected, aligned_vehicle, alignment, grid, where)
    imu = tables.get("imu")
    if not wheels.is_empty():
        late = measure_wheel_delay(
            times,
            wheels,
            pl.DataFrame() if imu is None else imu,
            alignment.gyro,
            aligned_vehicle,
        )
        alignment = replace(alignment, wheel_delay_s=late)
        corrected = {**corrected, "wheels": wheels.with_columns(pl.lit(late).alias("latency"))}
        findings += _report_wheels(late)
    if imu is not None and not imu.is_empty():
        findings += report_gyro(alignment, velocities["v_w"].to_numpy())
    if timeout is not None and hold is not None:
        findings.append(report_timeout(timeout, hold))
    findings += _report_poses(alignment)
    made = {**corrected, "poses": poses, "alignments": tabulate_alignment(alignment), "events": events.table}
    return Aligned(made, alignment, aligned_vehicle, tuple(findings))


@dataclass(frozen=True)
class _Grid:
    """A run on its grid as recorded.

    Attributes:
        velocities: table `velocities`.
        bad: samples in an incident, or in a stretch with implausible poses, shape (n,).
        steps: columns of table `slip` with the starts of steps and the samples not to be scored.
        recorded: median slip speed with L = 1 m by input [m/s].
        is_localization: whether the poses are more than integrated wheels, so that their delay is observable.
    """

    velocities: pl.DataFrame
    bad: Flags
    steps: pl.DataFrame
    recorded: Mapping[str, float | None] = field(default_factory=dict)
    is_localization: bool = True


def _check_poses(
    samples: Samples, witness: pl.DataFrame, poses: pl.DataFrame, vehicle: Vehicle
) -> list[Finding]:
    """Report poses that are made of wheels, even of wheels that are not used."""
    if samples.measured is None and not witness.is_empty():
        ideal = interpolate_wheels(samples.times, witness, vehicle)
        samples = replace(samples, measured=np.where(ideal.active[:, None], ideal.velocity, np.nan))
    return check_independence(samples, vehicle, [_find_period(table) for table in (witness, poses)])


def _find_period(table: pl.DataFrame) -> float:
    """Median time between two rows [s]; zero if there are none."""
    return float(np.median(np.diff(table["t"].to_numpy()))) if table.height > 1 else 0.0


def _tabulate_steps(
    velocities: pl.DataFrame, known: Mapping[str, Ideal], step: NDArray[np.int32], bad: Flags
) -> pl.DataFrame:
    parts = []
    for name, ideal in known.items():
        mask = np.isfinite(ideal.velocity).all(axis=1) & ideal.active
        part = velocities.select("t").with_columns(
            pl.lit(name).alias("input"), pl.Series("step", step), pl.Series("suspect", bad)
        )
        parts.append(part.filter(pl.Series(mask)))
    return pl.concat(parts)


def _measure_moduli(samples: Samples, bad: Flags) -> dict[str, float | None]:
    """Median slip speed with L = 1 m of every input [m/s], as recorded."""
    medians: dict[str, float | None] = {}
    for name, ideal in (("command", samples.command), ("measured", samples.measured)):
        if ideal is not None:
            modulus = np.linalg.norm(ideal - samples.velocity, axis=1)
            mask = np.isfinite(modulus) & ~bad
            medians[name] = float(np.median(modulus[mask])) if mask.any() else None
    return medians


def _align_poses(
    tables: Mapping[str, pl.DataFrame], vehicle: Vehicle, alignment: Alignment, grid: _Grid, where: str
) -> tuple[pl.DataFrame, Alignment]:
    """Table `poses` with latencies and outliers, and the alignment with the gyro's part."""
    poses = tables["poses"]
    times = poses["t"].to_numpy()
    latency, outlier = np.zeros(times.size), _spread_to_poses(grid, times)
    try:
        run = make_run({**tables, "slip": grid.steps}, vehicle, alignment, name=where)
    except MotionError:
        # A log without enough data for a model still has slip.
        return _correct_poses(poses, latency, outlier), alignment
    if not grid.is_localization:
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


def _spread_to_poses(grid: _Grid, times: Floats) -> Flags:
    """Whether the grid sample nearest to each pose is in a bad stretch, shape (m,)."""
    if not grid.bad.any():
        return np.zeros(times.size, dtype=bool)
    return grid.bad[arrays.nearest_indices(times, grid.velocities["t"].to_numpy())]


def _report_wheels(late: float) -> list[Finding]:
    if late == 0.0:
        return []
    text = f"the encoders are {late * 1e3:.0f} ms late against the gyro (a filter or a clock): corrected"
    return [Finding("wheels_delay", "info", text, where="wheels", value=late)]


def _report_poses(alignment: Alignment) -> list[Finding]:
    findings = []
    if alignment.latency_spread_s > 0.0:
        text = (
            f"the latency of poses varies by {alignment.latency_spread_s:.2g} s: corrected with gyro and path"
        )
        findings.append(Finding("pose_latency", "info", text, where="pose", value=alignment.latency_spread_s))
    if alignment.outlier_s > 0.0:
        text = f"{alignment.outlier_s:.3g} s excluded: the localization contradicts the wheels there"
        findings.append(Finding("pose_outliers", "info", text, where="pose", value=alignment.outlier_s))
    return findings


# The align stage: systematic errors of a recording are corrected once, and the corrections stored.
#
# Clocks, the latency of poses, outliers of the localization, the gyro's sign, scale and bias, the scale of
# commands, their hold time and those not followed at once: corrections are columns of the stored tables, with
# findings, and every reader of the run gets corrected data.
