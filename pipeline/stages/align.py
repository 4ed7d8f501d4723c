"""Corrections of a recording: clocks, latencies, the gyro, the scale of commands, and what is not to be used.

They are estimated once, from commands, wheels, poses and gyro as extracted, and stored as columns of their
tables and as numbers, so that every reader of the run gets corrected data.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import polars as pl

from pipeline.core import Flags, Floats, arrays
from pipeline.run import ANSWERS_S, Alignment, GyroFit, tabulate_alignment
from pipeline.sources import Vehicle, VelocitySection
from pipeline.stages.drive import Drive, interpolate_readings
from pipeline.stages.drive_numbers import mark_late_starts
from pipeline.stages.findings import Finding
from pipeline.stages.inputs import interpolate_wheels, usual_hold
from pipeline.stages.pose_choice import find_steady_gain
from pipeline.stages.pose_faults import align_poses
from pipeline.stages.trust import LEAST_CORRELATION, ONE_SCALE, check_echo, estimate_delay
from pipeline.stages.velocity import smooth_gyro

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
    poses, alignment = align_poses(
        {**tables, "commands": asked, "wheels": wheels},
        aligned_vehicle,
        replace(known, body_multiplier=multiplier),
        is_live=_find_live(tables["poses"], asked, known.hold_s),
        is_localization=not is_drive_alone,
        where=where,
    )
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
    if delay is None or abs(delay.correlation) < LEAST_CORRELATION or delay.seconds < _LEAST_S:
        return 0.0
    return delay.seconds


def _report(alignment: Alignment) -> list[Finding]:
    findings = []
    late, spread, outlier_s = alignment.wheel_delay_s, alignment.latency_spread_s, alignment.outlier_s
    if late > 0.0:
        text = f"the encoders are {late * 1e3:.0f} ms late against the gyro (a filter or a clock): corrected"
        findings.append(Finding("wheels_delay", "info", text, where="wheels", value=late))
    if spread > 0.0:
        text = f"the latency of poses varies by {spread:.2g} s: corrected with gyro and path"
        findings.append(Finding("pose_latency", "info", text, where="pose", value=spread))
    if outlier_s > 0.0:
        text = f"{outlier_s:.3g} s excluded: the localization contradicts the wheels there"
        findings.append(Finding("pose_outliers", "info", text, where="pose", value=outlier_s))
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
    driven = [name for name in Drive.list_signals() if name in live.columns and not name.startswith("body")]
    inputs = {name: np.nan_to_num(live[name].cast(pl.Float64).to_numpy()) for name in driven}
    rolled = vehicle.kinematics.forward(inputs, vehicle)
    label = arrays.number_stretches(live["t"].to_numpy() - float(live["t"][0]), ANSWERS_S)
    number = np.unique(label, return_inverse=True)[1]
    count = np.bincount(number)

    def compare(name: str, wheels: Floats) -> float | None:
        asked = live[name].to_numpy()
        return find_steady_gain(np.bincount(number, wheels) / count, np.bincount(number, asked) / count)

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
