"""Corrections of a recording: clocks, latencies, the gyro, the scale of commands, and what is not to be used.

They are estimated once, from commands, wheels, poses and gyro as extracted, and stored as columns of their
tables and as numbers, so that every reader of the run gets corrected data.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import polars as pl

from pipeline.core import NORMAL_95, Flags, Floats, Ints, arrays, fit_robustly
from pipeline.recording import ONE_SCALE, SIGNALS, Finding, check_echo, find_one_ratio, interpolate_readings
from pipeline.run import (
    ANSWERS_S,
    Alignment,
    DriveSeries,
    GyroFit,
    MotionError,
    Track,
    align_heading,
    mark_excluded,
    name_inputs,
    read_gyro,
    read_track,
    read_wheels,
    tabulate_alignment,
)
from pipeline.sources import Vehicle, VelocitySection
from pipeline.stages.drive_numbers import mark_late_starts
from pipeline.stages.gyro import fit_gyro, pair_poses
from pipeline.stages.inputs import interpolate_wheels, usual_hold
from pipeline.stages.timing import estimate_latency
from pipeline.stages.trust import LEAST_CORRELATION, estimate_delay
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


# Faults of the localization: half seconds of motion that contradict the vehicle's wheels.
#
# A localization that was lost jumps back, stops and catches up, or reports a path that is rotated against the
# heading. Every displacement over half a second, its direction and its length, is compared with a robust
# model of the whole run: a regression on the wheels with delays and gains, general enough to contain every
# effect of the catalogue. A deviation of eight times the usual one at that speed, and of a quarter of a
# metre, is an outlier, up to a twentieth of the run.

_EARLY_S = 1e-3
"""See `pair_poses`: rounding."""
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
_LEAST_NOISE_M = 1e-3
"""Least noise of a displacement: a localization that errs less is a simulation."""
_RIDGE = 1e-4
"""See `fit_robustly`: at one speed its columns do not determine their coefficients."""
_BINS = 6
"""Classes of speed of equal size, at least 33 displacements in each."""
_BESIDE_S = 0.05
"""Time before and after a displacement that is at fault with it [s]: the step of the grid."""


def find_outliers(
    track: Track, heading: Floats, at: Floats, wheels: DriveSeries, vehicle: Vehicle, excluded: Floats
) -> list[tuple[float, float]]:
    """Starts and ends of spans in which the localization is at fault [s], in order.

    Args:
        track: the poses, shape (n,).
        heading: of the gyro if there is a good one, else of the poses [rad], shape (n,).
        at: times of the poses on the clock of the wheels [s], shape (n,).
        wheels: measured; without them the vehicle's motion is unknown.
        vehicle: geometry.
        excluded: times [s] that are not compared, increasing.
    """
    first, last = pair_poses(track, excluded, early_s=_EARLY_S, longest_s=_LONGEST_S)
    active = track.active[first] & track.active[last]
    first, last = first[active], last[active]
    if first.size < _FEWEST:
        return []
    off = _measure_misfit(track, heading, at, wheels, vehicle, first, last)
    begin, end = track.times[first] - _BESIDE_S, track.times[last] + _BESIDE_S
    live = np.diff(track.times)[track.active[1:]]
    most = _LARGEST_SHARE * float(live[live < _LONGEST_S].sum())
    faulty = off > 1.0
    spans = _join(begin[faulty], end[faulty])
    # More than a twentieth is not an exception: then only the worst part counts as a fault.
    while np.diff(spans).sum() > most:
        faulty &= off > np.quantile(off[faulty], 0.1)
        spans = _join(begin[faulty], end[faulty])
    return [(start, stop) for start, stop in spans.tolist()]


def _join(begin: Floats, end: Floats) -> Floats:
    """Union of some intervals in the order of their starts, shape (k, 2)."""
    until = np.maximum.accumulate(end)
    first = np.append(True, begin[1:] > until[:-1])[: begin.size]
    return np.column_stack((begin[first], until[np.append(first[1:], True)[: begin.size]]))


def _measure_misfit(
    track: Track, heading: Floats, at: Floats, wheels: DriveSeries, vehicle: Vehicle, first: Ints, last: Ints
) -> Floats:
    """Distance of each displacement from the robust model, one at the threshold of a fault, shape (n,)."""
    moved = (track.path[last] - track.path[first]) * np.exp(-0.5j * (heading[first] + heading[last]))
    span = track.times[last] - track.times[first]
    forward, sideways, turning = vehicle.kinematics.forward(name_inputs(wheels, vehicle), vehicle)

    def drive(rate: Floats, late: float) -> Floats:
        driven = arrays.integrate_rate(wheels.times, rate)
        until = np.interp(at - late, wheels.times, driven)
        return until[last] - until[first]

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
    parts = (moved.real, moved.imag)
    size = np.hypot(*(fit_robustly(columns, part, least=_LEAST_NOISE_M, ridge=_RIDGE).rest for part in parts))
    usual = _spread_by_speed(size, speed / span)
    return size / np.maximum(_FAR * usual, _LEAST_M)


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
    excluded, own, outliers = times[~is_live], np.zeros(times.size), list[tuple[float, float]]()
    try:
        stamped = read_track(poses, wheels, name=where)
    except MotionError:
        # A log without enough data for a model still has slip.
        return _correct_poses(poses, own, own > 0.0), alignment
    if not is_localization:
        # Integrated wheels have no clock of their own.
        fit = fit_gyro(stamped, gyro, excluded)
        return _correct_poses(poses, own, own > 0.0), replace(alignment, gyro=_put_on_clock(fit))
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
        at_fault = track.times[_mark(track.times, outliers)]
        fit = fit_gyro(track, gyro, np.union1d(excluded, at_fault))
    late, moved = _split_delay(fit, gyro)
    found = replace(
        alignment,
        gyro=_put_on_clock(fit, moved),
        heading_delay_s=late,
        latency_spread_s=spread,
        outlier_s=sum(end - begin for begin, end in outliers),
    )
    outlier = _mark(times - own, outliers)
    return _correct_poses(poses, own + late, outlier), found


def _mark(times: Floats, spans: Sequence[tuple[float, float]]) -> Flags:
    """Times in some spans, shape (n,)."""
    inside = np.zeros(times.size, dtype=bool)
    for begin, end in spans:
        inside |= (times >= begin) & (times <= end)
    return inside


def _correct_poses(poses: pl.DataFrame, latency: Floats, outlier: Flags) -> pl.DataFrame:
    return poses.with_columns(pl.Series("latency", latency), pl.Series("outlier", outlier))


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
