"""The align stage: systematic errors of a recording are corrected once, and the corrections stored.

Clocks, the latency of poses, outliers of the localization, the gyro's sign, scale and bias, the scale of
commands, their hold time and those not followed at once: corrections are columns of the stored tables, with
findings, and every reader of the run gets corrected data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.core import arrays
from pipeline.core.arrays import Flags, Floats, Ints, fit_robustly, robust_spread
from pipeline.run import Alignment, GyroFit, read_drive, tabulate_alignment
from pipeline.run.signals import ANSWERS_S, STILL_MPS
from pipeline.run.windows import WINDOW_S
from pipeline.sources import Vehicle, list_presets
from pipeline.sources.configuration import SlipSection, VelocitySection
from pipeline.stages import Finding
from pipeline.stages.drive import Drive, interpolate_readings
from pipeline.stages.drive_numbers import find_timeout, mark_late_starts, report_timeout
from pipeline.stages.pose_choice import find_steady_gain
from pipeline.stages.pose_faults import align_poses
from pipeline.stages.slip_stage import Ideal, cut_steps, interpolate_wheels, keep_known, read_inputs
from pipeline.stages.spans import find_spans
from pipeline.stages.trust import (
    LEAST_CORRELATION,
    ONE_SCALE,
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
    is_drive_alone: bool = False,
) -> Aligned:
    """Align a run.

    Args:
        tables: `poses`, `commands`, `wheels`, `imu` as extracted; those that the log lacks may be missing.
        vehicle: as configured.
        hold_s: how long a command is valid; by default the command timeout if silences show one, else
            `arrays.usual_hold`.
        body_commanded: whether the command is a body command, which the controller converts to wheel speeds.
        where: the run, for error messages.
        is_drive_alone: whether the poses are the motion of the measured wheels, since none were recorded:
            they have no faults of a localization.

    Raises:
        StageError: ``no_segment``, no stretch of the poses can be differentiated.
    """
    commands, wheels = (tables.get(name, pl.DataFrame()) for name in ("commands", "wheels"))
    echo = check_echo(commands, wheels, vehicle, body_commanded=body_commanded)
    used = {name: table for name, table in tables.items() if not (echo and name == "wheels")}
    made = _align(
        used,
        wheels,
        vehicle,
        hold_s=hold_s,
        body_commanded=body_commanded,
        where=where,
        is_drive_alone=is_drive_alone,
    )
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
    is_drive_alone: bool,
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
        spans = find_spans(velocities, tables["poses"], known, vehicle, hold)
        usual = {name: ideal.leave_out(spans.excluded) for name, ideal in known.items()}
        bad = spans.wrong | spans.excluded
        if not is_drive_alone:
            events = find_events(velocities, known, vehicle, spans)
        findings += [*spans.findings, *events.findings]
        grid = _Grid(velocities, bad, _tabulate_steps(velocities, known, cut.step, bad))
        samples = gather_samples(velocities, usual, cut, body_commanded=body_commanded)
        scale = measure_command_scale(
            replace(samples, measured=samples.velocity) if is_drive_alone else samples, vehicle
        )
        independent = _check_poses(samples, witness, tables["poses"], vehicle)
        findings += [*scale.findings, *independent]
        grid = replace(
            grid, recorded=_measure_moduli(samples, bad), is_localization=not (independent or is_drive_alone)
        )
    aligned_vehicle = msgspec.structs.replace(vehicle, controller_track_multiplier=scale.track_multiplier)
    asked, late_starts = mark_late_starts(correct_commands(commands, vehicle, scale), wheels, aligned_vehicle)
    findings += late_starts
    corrected = {**tables, "commands": asked}
    alignment = Alignment(
        hold,
        scale.scale,
        scale.turn_scale,
        scale.track_multiplier,
        recorded_moduli=grid.recorded,
        body_multiplier=_find_body_multiplier(commands, vehicle, scale, body_commanded=body_commanded),
    )
    poses, alignment = align_poses(
        {**corrected, "slip": grid.steps},
        aligned_vehicle,
        alignment,
        outlier=_spread_to_poses(grid, tables["poses"]["t"].to_numpy()),
        is_localization=grid.is_localization,
        where=where,
    )
    imu = tables.get("imu", pl.DataFrame())
    if not wheels.is_empty():
        late = measure_wheel_delay(times, wheels, imu, alignment.gyro, aligned_vehicle)
        alignment = replace(alignment, wheel_delay_s=late)
        corrected = {**corrected, "wheels": wheels.with_columns(pl.lit(late).alias("latency"))}
        findings += _report_wheels(late)
    if not imu.is_empty():
        findings += report_gyro(alignment, velocities["v_w"].to_numpy())
    findings += [report_timeout(timeout, hold)] if timeout is not None and hold is not None else []
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
        recorded: median slip modulus with L = 1 m by input [m/s].
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
    """Median slip modulus with L = 1 m of every input [m/s], as recorded."""
    medians: dict[str, float | None] = {}
    for name, ideal in (("command", samples.command), ("measured", samples.measured)):
        if ideal is not None:
            modulus = np.linalg.norm(ideal - samples.velocity, axis=1)
            mask = np.isfinite(modulus) & ~bad
            medians[name] = float(np.median(modulus[mask])) if mask.any() else None
    return medians


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


# The scale of recorded commands: measured against the wheels, explained, and corrected.

_LEAST_RATIO = 0.02
"""Ratio of measured to commanded speed below which wheels did not respond: they show no scale."""
_FEWEST_STEPS = 6
"""Least number of slow steady steps for a median; half and double change no finding of two recordings."""
_SCALED = 0.18
"""Absolute logarithm of a ratio above which a scale is wrong: a ratio of 1.2, or of 0.84. The ratio is 1.81
on `husky_snow_boreal` and 0.95 to 1.04 on the other recordings."""
_SAME = 0.05
"""Absolute logarithm of a ratio below which it is that of two radii: on recordings with the right scale it is
0.05 at most."""
_FEWEST_BLOCKS = 60
"""Half seconds that tell a gain from a lag; half and double change no finding of two recordings."""


@dataclass(frozen=True)
class CommandScale:
    """Correction factors of commands.

    Attributes:
        scale: factor on the whole command; of sides that are commanded, on their mean.
        turn_scale: factor on the difference of sides that are commanded.
        track_multiplier: factor on the track width in the controller's conversion of yaw rates.
        findings: findings on it.
    """

    scale: float
    turn_scale: float
    track_multiplier: float
    findings: tuple[Finding, ...] = ()


def measure_command_scale(samples: Samples, vehicle: Vehicle) -> CommandScale:
    """Compare steady commanded wheel speeds with measured ones.

    Only the slower half of the steps is used: there the drive does not saturate. If a body command has too
    few steady steps, the gain of a lag from command to wheels gives the controller's multiplier.

    Args:
        samples: of the run, before any correction.
        vehicle: as configured.
    """
    unscaled = CommandScale(1.0, 1.0, vehicle.controller_track_multiplier)
    if samples.measured is None or samples.command is None:
        return unscaled
    both: Flags = np.all(np.isfinite(np.hstack((samples.measured, samples.command))), axis=1)
    steps = _average(samples, both & samples.steady, samples.step.astype(np.int64))
    forward, turning = _measure_ratios(samples, both, steps)
    if forward is None:
        return unscaled
    if abs(np.log(forward)) > _SCALED:
        return _explain_scale(samples, steps, forward, vehicle)
    if turning is None or not samples.body_commanded or not _is_multiplied(turning / forward, vehicle):
        return unscaled
    used = vehicle.controller_track_multiplier
    multiplier = turning / forward * used
    track = "the nominal track width" if used == 1.0 else f"{used:g} times the nominal track width"
    text = (
        f"in turns the difference of the wheels is {turning / forward:.2f} times the one commanded "
        f"with {track}: vehicle.controller_track_multiplier = {multiplier:.3g} was used"
    )
    finding = Finding("controller_multiplier", "warning", text, where="command", value=multiplier)
    return CommandScale(1.0, 1.0, multiplier, (finding,))


def _find_body_multiplier(
    commands: pl.DataFrame, vehicle: Vehicle, scale: CommandScale, *, body_commanded: bool
) -> float | None:
    """See `Alignment.body_multiplier`; a command in another scale has none."""
    if commands.is_empty() or not scale.scale == scale.turn_scale == 1.0:
        return None
    return scale.track_multiplier if body_commanded else measure_body_multiplier(commands, vehicle)


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
    if (
        turned is None
        or turned <= 0.0
        or (ahead is not None and abs(np.log(max(ahead, _LEAST_RATIO))) > _SCALED)
    ):
        return None
    return round(turned, 6)


def _explain_scale(samples: Samples, steps: Floats, forward: float, vehicle: Vehicle) -> CommandScale:
    """One factor on the whole command, or the geometry of another vehicle where that contradicts turns."""
    asked, got = steps[1]
    slow = _find_slow(asked)
    turning = float(np.median(got[slow] / asked[slow])) if slow.sum() >= _FEWEST_STEPS else forward
    scales, other = (forward, forward), None
    text = f"in slow steady steps the wheels turn {forward:.2f} times as fast as commanded"
    if turning <= 0.0 or abs(np.log(turning / forward)) >= _SCALED:
        text += f", and in turns their difference is {turning:.2f} times the commanded one (median)"
        if not samples.body_commanded and turning > 0.0:
            scales, other = _find_geometry(scales, turning, vehicle)
        if other is None:
            text += ": no single scale fits, and slip from commands in turns depends on the scale"
    if other is None:
        text += (
            ": the recorded command is in another scale (another vehicle's wheel radius, a unit, or a gain "
            f"of the drive); commands are multiplied by {forward:.2f}"
        )
    else:
        text += (
            f": the recorded command was made for a wheel radius of {other.wheel_radius_m:g} m and a track "
            f"of {other.track_width_m:g} m, as of {other.name}; the mean of the sides is multiplied by "
            f"{scales[0]:.2f} and their difference by {scales[1]:.2f}"
        )
    text += " before all other steps, also for models and exports"
    finding = Finding("command_scale", "warning", text, where="command", value=scales[0])
    return CommandScale(*scales, vehicle.controller_track_multiplier, (finding,))


def _find_geometry(
    scales: tuple[float, float], turning: float, vehicle: Vehicle
) -> tuple[tuple[float, float], Vehicle | None]:
    """Scales of mean and difference of the sides by a preset's geometry, if nearer to the ratio in turns."""
    forward, nearest = scales[0], None
    for other in list_presets():
        is_alike = other.kind == vehicle.kind == "differential"
        if not (is_alike and other.wheel_radius_m and other.track_width_m):
            continue
        radii = other.wheel_radius_m / (vehicle.wheel_radius_m or np.nan)
        tracks = radii * (vehicle.track_width_m or np.nan) / other.track_width_m
        is_nearer = abs(np.log(turning / tracks)) < abs(np.log(turning / scales[1]))
        # Wheels may differ less than they are asked to, not more.
        if abs(np.log(forward / radii)) < _SAME and np.log(turning / tracks) < _SCALED and is_nearer:
            scales, nearest = (radii, tracks), other
    return scales, nearest


def _measure_ratios(samples: Samples, both: Flags, steps: Floats) -> tuple[float | None, float | None]:
    """Ratio of measured to commanded speed and yaw rate in steady steps; None if it cannot be determined."""
    forward, turning = (_find_ratio(asked, got) for asked, got in steps)
    if forward is not None and turning is not None:
        return forward, turning
    if samples.body_commanded and both.any():
        blocks = _average(samples, both, arrays.number_stretches(samples.times - samples.times[0], WINDOW_S))
        along, across = (_find_gain(asked, got) for asked, got in blocks)
        # Limits and droops lower the gain of fast turns; only a multiplier raises it.
        if along is not None and across is not None and abs(np.log(along)) < _SCALED and across > along:
            return along, across
    return forward, turning


def _is_multiplied(ratio: float, vehicle: Vehicle) -> bool:
    """Whether turns show another multiplier than the configured one.

    A controller widens the track or leaves it unchanged: a smaller wheel difference is due to the drive.
    """
    multiplier = ratio * vehicle.controller_track_multiplier
    return bool(abs(np.log(ratio)) >= _SCALED and np.log(multiplier) > -_SCALED)


def _average(samples: Samples, counts: Flags, label: Ints) -> Floats:
    """Means over stretches of one label, in their order.

    Args:
        samples: of the run.
        counts: samples to use, shape (n,).
        label: label of each sample's stretch, shape (n,).

    Returns:
        Speed and yaw rate, each commanded and measured, shape (2, 2, stretches).
    """
    _, number, size = np.unique(label[counts], return_inverse=True, return_counts=True)
    means = [
        [
            np.zeros(0) if values is None else np.bincount(number, values[counts, channel]) / size
            for values in (samples.command, samples.measured)
        ]
        for channel in (0, 2)
    ]
    return np.array(means, dtype=np.float64)


def _find_ratio(asked: Floats, got: Floats) -> float | None:
    """Median ratio of measured to commanded over the slower half of the steps; None if they disagree."""
    slow = _find_slow(asked)
    if slow.sum() < _FEWEST_STEPS:
        return None
    ratio, inverse = got[slow] / asked[slow], 1.0 / np.abs(asked[slow])
    middle = float(np.median(ratio))
    spread = robust_spread(ratio - middle)
    # A dead band takes more of a slower step; a scale is that of the fastest ones, too.
    apart = inverse - inverse.mean()
    (level, slope), rest = fit_robustly(np.column_stack((np.ones(apart.size), apart)), ratio)
    is_sloped = float(rest.std()) < 0.5 * float(ratio.std())
    changed = abs(level - slope * inverse.mean() - middle) if is_sloped else 0.0
    return middle if middle > _LEAST_RATIO and max(spread, changed) < ONE_SCALE * middle else None


def _find_slow(asked: Floats) -> Flags:
    """The slower half of steps, without those near a standstill."""
    size, most = np.abs(asked), float(np.abs(asked).max(initial=0.0))
    slow: Flags = (size > max(0.1 * most, STILL_MPS)) & (size < 0.5 * most)
    return slow


def _find_gain(asked: Floats, got: Floats) -> float | None:
    """Gain of a first-order lag, got + tau dgot/dt = gain * asked; None if the fit is poor."""
    if asked.size < _FEWEST_BLOCKS or float(np.abs(asked).max()) < STILL_MPS:
        return None
    change = 0.5 * (got[2:] - got[:-2])
    inner = got[1:-1]
    design = np.column_stack((asked[1:-1], change))
    fitted = np.linalg.lstsq(design, inner, rcond=None)[0]
    gain, rest = float(fitted[0]), inner - design @ fitted
    agrees = float(np.sum(rest**2)) < ONE_SCALE**2 * float(np.sum(inner**2))
    return gain if gain > _LEAST_RATIO and agrees else None


def correct_commands(commands: pl.DataFrame, vehicle: Vehicle, scale: CommandScale) -> pl.DataFrame:
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
    turned, both = scale.turn_scale, np.nan_to_num(0.5 * (scale.scale - scale.turn_scale) * (left + right))
    aligned = {"left": turned * left + both, "right": turned * right + both}
    aligned |= {name: scale.scale * columns[name] for name in ("sideways", "speed")}
    return commands.with_columns(
        pl.Series(f"{name}_aligned", values, dtype=pl.Float64).fill_nan(None)
        for name, values in aligned.items()
    )
