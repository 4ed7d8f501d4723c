"""Corrections of a recording: clocks, latencies, the gyro, the scale of commands, and what is not to be used.

They are estimated once, from commands, wheels, poses and gyro as extracted, and stored as columns of their
tables and as numbers, so that every reader of the run gets corrected data.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import msgspec
import numpy as np
import polars as pl

from pipeline.core import NORMAL_95, Flags, Floats, arrays
from pipeline.recording import ONE_SCALE, SIGNALS, Finding, check_echo, find_one_ratio, interpolate_readings
from pipeline.run import (
    ANSWERS_S,
    Alignment,
    GyroFit,
    MotionError,
    align_heading,
    mark_excluded,
    read_gyro,
    read_track,
    read_wheels,
    tabulate_alignment,
)
from pipeline.sources import Vehicle, VelocitySection
from pipeline.stages.drive_numbers import mark_late_starts
from pipeline.stages.gyro import fit_gyro
from pipeline.stages.inputs import interpolate_wheels, usual_hold
from pipeline.stages.outliers import find_outliers
from pipeline.stages.spans import Span, mark_spans
from pipeline.stages.timing import estimate_latency
from pipeline.stages.trust import estimate_delay
from pipeline.stages.velocity import smooth_gyro

_FEWEST_ASKED = 20
"""Least number of stretches of a command for the controller's multiplier."""
_LEAST_S = 0.05
"""Least delay of encoders [s] that is corrected here; fits find shorter ones (six of twelve recordings)."""


@dataclass(frozen=True)
class Aligned:
    """An aligned run.

    Attributes:
        tables: the given tables with columns of their corrections, and `alignments`.
        alignment: the corrections as numbers.
        vehicle: with the controller's track multiplier found in the recording.
        findings: findings on the corrections.
    """

    tables: Mapping[str, pl.DataFrame]
    alignment: Alignment
    vehicle: Vehicle
    findings: tuple[Finding, ...]


def align_tables(
    tables: Mapping[str, pl.DataFrame],
    vehicle: Vehicle,
    known: Alignment,
    *,
    body_commanded: bool,
    where: str,
    is_drive_alone: bool = False,
    has_gyro_sign: bool = False,
) -> Aligned:
    """Align a run.

    Args:
        tables: `poses`, `commands`, `wheels`, `imu` as extracted; those that the log lacks may be missing.
        vehicle: as configured.
        known: what the examination of the log found: scale of the command, the controller's multiplier, and
            how long a command is valid (by default `usual_hold`).
        body_commanded: whether the command is a body command, which the controller converts to wheel speeds.
        where: the run, for error messages.
        is_drive_alone: whether the poses are the motion of the measured wheels, since none were recorded:
            they have no clock of their own.
        has_gyro_sign: whether the user gives the sign of the gyro: with another one it is not used.
    """
    recorded, commands = (tables.get(name, pl.DataFrame()) for name in ("wheels", "commands"))
    echo = check_echo(commands, recorded, vehicle, body_commanded=body_commanded)
    wheels, held = interpolate_readings(pl.DataFrame() if echo else recorded)
    aligned_vehicle = msgspec.structs.replace(vehicle, controller_track_multiplier=known.track_multiplier)
    asked = correct_commands(commands, vehicle, known)
    asked, late_starts = mark_late_starts(asked, wheels, aligned_vehicle)
    if not commands.is_empty() and known.hold_s is None:
        known = replace(known, hold_s=usual_hold(commands["t"].to_numpy()))
    multiplier = _find_body_multiplier(commands, vehicle, known, body_commanded=body_commanded)
    align = partial(
        align_poses,
        vehicle=aligned_vehicle,
        alignment=replace(known, body_multiplier=multiplier),
        is_live=_find_live(tables["poses"], asked, known.hold_s),
        is_localization=not is_drive_alone,
        where=where,
    )
    driven = {**tables, "commands": asked, "wheels": wheels}
    poses, alignment = align(driven)
    if has_gyro_sign and alignment.gyro is not None and alignment.gyro.signed_scale < 0.0:
        poses, alignment = align({**driven, "imu": pl.DataFrame()})
    late = measure_wheel_delay(wheels, tables.get("imu", pl.DataFrame()), alignment.gyro, aligned_vehicle)
    alignment = replace(alignment, wheel_delay_s=late)
    if echo:
        # The readings stay as recorded; as aligned they are unknown, so that nothing evaluates them.
        names = [name for name in recorded.columns if name.endswith("_aligned")]
        wheels = recorded.with_columns(pl.lit(None, pl.Float64).alias(name) for name in names)
    elif not wheels.is_empty():
        wheels = wheels.with_columns(pl.lit(late).alias("latency"))
    made = {"poses": poses, "commands": asked, "wheels": wheels, "alignments": tabulate_alignment(alignment)}
    findings = (*echo, *held, *late_starts, *_report(alignment))
    return Aligned({**tables, **made}, alignment, aligned_vehicle, findings)


def _find_live(poses: pl.DataFrame, commands: pl.DataFrame, hold_s: float | None) -> Flags:
    """Poses at which recorded commands drive the vehicle, shape (n,)."""
    live = poses["active"].to_numpy()
    if commands.is_empty() or hold_s is None:
        return live
    times, stamps = poses["t"].to_numpy(), commands["t"].to_numpy()
    last = arrays.hold_indices(times, stamps)
    live = live & (last >= 0) & (times - stamps[np.maximum(last, 0)] <= hold_s)
    return np.asarray(live, dtype=bool)


def measure_wheel_delay(
    wheels: pl.DataFrame, imu: pl.DataFrame, gyro: GyroFit | None, vehicle: Vehicle
) -> float:
    """Delay [s] of the wheels' yaw rate against the gyro's; zero if small or not determinable.

    The opposite sign, a body that follows its wheels late, is physics and not an encoder delay.

    Args:
        wheels: table `wheels`.
        imu: table `imu`.
        gyro: fit of the gyro to the poses; None without a good one.
        vehicle: geometry.
    """
    if gyro is None or wheels.is_empty():
        return 0.0
    times = wheels["t"].to_numpy()
    turning = interpolate_wheels(times, wheels, vehicle).velocity[:, 2]
    seen = smooth_gyro(times, imu, gyro, VelocitySection().window_s)
    known = np.isfinite(turning) & np.isfinite(seen)
    delay = estimate_delay(times[known], turning[known], times[known], seen[known])
    return 0.0 if delay is None or delay.seconds < _LEAST_S else delay.seconds


def _report(alignment: Alignment) -> list[Finding]:
    findings = []
    late, spread, outlier_s = alignment.wheel_delay_s, alignment.latency_spread_s, alignment.outlier_s
    if late > 0.0:
        findings.append(Finding("wheels_delay", "info", "wheels", {"value": late}))
    if spread > 0.0:
        findings.append(Finding("pose_latency", "info", "pose", {"value": spread}))
    if outlier_s > 0.0:
        findings.append(Finding("pose_outliers", "info", "pose", {"value": outlier_s}))
    return findings


def _find_body_multiplier(
    commands: pl.DataFrame, vehicle: Vehicle, known: Alignment, *, body_commanded: bool
) -> float | None:
    """See `Alignment.body_multiplier`; a command in another scale has none."""
    if commands.is_empty() or not known.command_scale == known.command_turn_scale == 1.0:
        return None
    return known.track_multiplier if body_commanded else measure_body_multiplier(commands, vehicle)


def measure_body_multiplier(commands: pl.DataFrame, vehicle: Vehicle) -> float | None:
    """Yaw rate of commanded wheels at the nominal track over that of the body command beside them.

    Args:
        commands: table `commands` as extracted.
        vehicle: geometry.

    Returns:
        None without a body command, or where the wheels were not commanded by it: their ratio is not
        constant, or their speeds are not the same.
    """
    asked_for = ("left", "right", "body_x", "body_w")
    if not {*asked_for} <= {*commands.columns}:
        return None
    live = commands.filter(pl.all_horizontal(pl.col(name).is_finite() for name in asked_for))
    if live.is_empty():
        return None
    driven = [name for name in SIGNALS if name in live.columns and not name.startswith("body")]
    inputs = {name: np.nan_to_num(live[name].cast(pl.Float64).to_numpy()) for name in driven}
    rolled = vehicle.kinematics.forward(inputs, vehicle)
    label = arrays.number_stretches(live["t"].to_numpy() - float(live["t"][0]), ANSWERS_S)
    number = np.unique(label, return_inverse=True)[1]
    count = np.bincount(number)

    def compare(name: str, wheels: Floats) -> float | None:
        asked = live[name].to_numpy()
        sums = np.bincount(number, wheels), np.bincount(number, asked)
        return find_one_ratio(sums[0] / count, sums[1] / count, _FEWEST_ASKED)

    ahead, turned = compare("body_x", rolled[0]), compare("body_w", rolled[2])
    is_other = ahead is not None and abs(ahead - 1.0) > ONE_SCALE
    return None if turned is None or turned <= 0.0 or is_other else round(turned, 6)


def correct_commands(commands: pl.DataFrame, vehicle: Vehicle, scale: Alignment) -> pl.DataFrame:
    """Table `commands` with the drive's inputs after correction of scales and track multiplier."""
    if commands.is_empty():
        return commands
    columns = {
        name: commands[name].cast(pl.Float64).to_numpy()
        if name in commands.columns
        else np.full(commands.height, np.nan)
        for name in ("left", "right", "speed", "sideways", "body_x", "body_y", "body_w")
    }
    left, right = columns["left"], columns["right"]
    if scale.track_multiplier != vehicle.controller_track_multiplier:
        there = msgspec.structs.replace(vehicle, controller_track_multiplier=scale.track_multiplier)
        body = (columns["body_x"], np.nan_to_num(columns["body_y"]), columns["body_w"])
        asked = there.kinematics.inverse(body, there)
        left, right = asked["left"], asked["right"]
    turned = scale.command_turn_scale
    both = np.nan_to_num(0.5 * (scale.command_scale - turned) * (left + right))
    aligned = {"left": turned * left + both, "right": turned * right + both}
    aligned |= {name: scale.command_scale * columns[name] for name in ("sideways", "speed")}
    return commands.with_columns(
        pl.Series(f"{name}_aligned", values, dtype=pl.Float64).fill_nan(None)
        for name, values in aligned.items()
    )


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
    gyro, wheels = read_gyro(tables.get("imu")), read_wheels(tables.get("wheels"), vehicle)
    excluded, own, outliers = times[~is_live], np.zeros(times.size), list[Span]()
    try:
        stamped = read_track(poses, wheels, name=where)
    except MotionError:
        # A log without enough data for a model still has slip.
        return _correct_poses(poses, own, 0.0, outliers), alignment
    if not is_localization:
        # Integrated wheels have no clock of their own.
        fit = fit_gyro(stamped, gyro, excluded)
        return _correct_poses(poses, own, 0.0, outliers), replace(alignment, gyro=_put_on_clock(fit))
    ages, spread = estimate_latency(stamped, gyro, excluded)
    for segment in np.unique(stamped.segment).tolist():
        rows, known = poses["segment"].to_numpy() == segment, stamped.segment == segment
        own[rows] = np.interp(times[rows], stamped.times[known], ages[known])
    track = replace(stamped, times=stamped.times - ages)
    fit = fit_gyro(track, gyro, excluded)
    if wheels is not None:
        heading, late = track.heading, 0.0
        if fit is not None and gyro is not None:
            seen, late = fit.turn_until(track.times, gyro), fit.yaw_delay_s
            heading = seen + align_heading(track, heading - seen, ~mark_excluded(excluded, track.times))
        outliers = find_outliers(track, heading, track.times - late, wheels, vehicle, excluded)
    if outliers:
        at_fault = track.times[mark_spans(track.times, outliers)]
        fit = fit_gyro(track, gyro, np.union1d(excluded, at_fault))
    late, moved = _split_delay(fit, gyro)
    corrected = replace(
        alignment,
        gyro=_put_on_clock(fit, moved),
        heading_delay_s=late,
        latency_spread_s=spread,
        outlier_s=sum(one.end - one.start for one in outliers),
    )
    return _correct_poses(poses, own, late, outliers), corrected


def _correct_poses(poses: pl.DataFrame, own: Floats, late: float, outliers: Sequence[Span]) -> pl.DataFrame:
    """Table `poses` with latencies, of each pose its own one besides that of all [s], and outliers."""
    wrong = mark_spans(poses["t"].to_numpy() - own, outliers)
    return poses.with_columns(pl.Series("latency", own + late), pl.Series("outlier", wrong))


def _split_delay(fit: GyroFit | None, gyro: tuple[Floats, Floats] | None) -> tuple[float, float]:
    """Delay of the poses against the gyro, and of the gyro against the poses [s]; one of them is zero.

    Between two samples the time at which the gyro's rate changed is unknown: if commands and samples are
    synchronous, the gyro appears late by a constant part of half a sampling period. A delay up to this does
    not concern the poses' clock.
    """
    if fit is None or gyro is None:
        return 0.0, 0.0
    late = fit.yaw_delay_s
    unknown = 0.5 * float(np.median(np.diff(gyro[0]))) + NORMAL_95 * fit.delay_error_s
    return (late, 0.0) if abs(late) > unknown else (0.0, -late)


def _put_on_clock(fit: GyroFit | None, moved: float = 0.0) -> GyroFit | None:
    """The fit of a gyro to poses on its own clock."""
    return None if fit is None else replace(fit, yaw_delay_s=0.0, moved_s=moved)
