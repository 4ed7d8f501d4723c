"""Corrections of the recorded commands by what the drive does of them: scale and multiplier.

Commands and wheels are ideal velocities of the body. The wheels follow the command with a lag and a delay
that are fitted; what remains is a factor, which is that of slow driving: there the drive does not saturate.
"""

from dataclasses import dataclass, replace

import msgspec
import numpy as np
import polars as pl

from pipeline.core import (
    Flags,
    Floats,
    Ints,
    SlipError,
    fit_robustly,
    list_likelihoods,
    pick,
    robust_spread,
)
from pipeline.recording.case import Case, are_apart
from pipeline.recording.evidence import Axis
from pipeline.recording.findings import Finding
from pipeline.recording.geometry import roll_wheels
from pipeline.recording.motion import CLEAR, FEWEST_STEPS, ONE_SCALE, compare
from pipeline.recording.readings import Held, Reading
from pipeline.run import STILL_MPS, Alignment
from pipeline.sources import DriveForm, Vehicle, list_presets

_LEAST_RATIO = 0.02
"""Ratio of measured to commanded speed below which wheels did not respond: they show no scale."""
_SCALED = 0.18
"""Absolute logarithm of a ratio above which a scale is wrong: a ratio of 1.2, or of 0.84. The ratio is 1.79
on `husky_snow_boreal` and 0.96 to 1.04 on the other recordings."""
_SAME = 0.05
"""Absolute logarithm of a ratio below which it is that of two radii: on recordings with the right scale it is
0.04 at most."""


@dataclass(frozen=True)
class _Rates:
    """Commanded and measured rates over steps of a tenth of a second.

    Attributes:
        asked, got: speeds [m/s] and yaw rates [rad/s], shape (n,) each.
        block: number of each step's block, shape (n,).
    """

    asked: tuple[Floats, Floats]
    got: tuple[Floats, Floats]
    block: Ints

    def is_better(self, scales: tuple[float, float]) -> bool:
        """Whether wheels follow a scaled command clearly better, and neither ahead nor in turns worse.

        Either command may ask for more than the drive does: wheels at their limit tell nothing.
        """
        gains = []
        for scale, asked, got in zip(scales, self.asked, self.got, strict=True):
            top = float(np.quantile(np.abs(got), 0.99))
            one, other = (
                list_likelihoods(got - np.clip(factor * asked, -top, top)) for factor in (scale, 1.0)
            )
            gains.append(np.bincount(self.block, one - other).astype(np.float64))
        nothing = np.zeros(gains[0].size)
        least = min(compare(one, nothing) for one in gains)
        return least > -CLEAR and compare(gains[0] + gains[1], nothing) > CLEAR


def measure_command_scale(
    commands: pl.DataFrame,
    wheels: pl.DataFrame,
    vehicle: Vehicle,
    *,
    body_commanded: bool,
    late: tuple[float, float],
    gain: float | None = None,
) -> tuple[Alignment, tuple[Finding, ...]]:
    """Compare commanded motion with that of the measured wheels.

    Args:
        commands: table `commands` as extracted for this vehicle; may be empty.
        wheels: table `wheels`; may be empty.
        vehicle: as configured.
        body_commanded: whether the command was a body command, which the controller converts to wheel speeds.
        late: lag and delay of the wheels [s].
        gain: motion of the poses over a body command; if it is nearer to one than to that of the wheels, the
            wheels have another radius, and the command is right.

    Returns:
        The corrections of the command, neutral where nothing shows them, and findings on them.
    """
    neutral = Alignment(track_multiplier=vehicle.controller_track_multiplier)
    driven = _compare_rates(commands, wheels, vehicle, late)
    forward, turning = (find_ratio(*pair) for pair in zip(driven.asked, driven.got, strict=True))
    if forward is None:
        return neutral, ()
    is_right = gain is not None and abs(np.log(gain)) < abs(np.log(gain / forward))
    if abs(np.log(forward)) > _SCALED and not is_right:
        turning = _find_median(driven.asked[1], driven.got[1]) or forward
        return _explain_scale(neutral, (forward, turning), driven, vehicle, body_commanded=body_commanded)
    if abs(np.log(forward)) > _SCALED:
        return neutral, (_report_wheels(forward, turning, vehicle),)
    if turning is None or not body_commanded or not _is_multiplied(turning / forward, vehicle):
        return neutral, ()
    used = vehicle.controller_track_multiplier
    multiplier = turning / forward * used
    values = {"value": multiplier, "turns": turning / forward, "used": used}
    finding = Finding("controller_multiplier", "warning", "command", values)
    return replace(neutral, track_multiplier=multiplier), (finding,)


def _report_wheels(forward: float, turning: float | None, vehicle: Vehicle) -> Finding:
    """Wheels that turn at another speed than commanded where the body does as it is told.

    Where their difference is in a smaller ratio, which no controller makes, the vehicle is another one.
    """
    values = {"value": forward, "radius_m": vehicle.wheel_radius_m, "dimensions": ["wheel_radius_m"]}
    if turning is not None and vehicle.track_width_m and 0.0 < turning < forward * np.exp(-_SCALED):
        values["track_m"] = vehicle.track_width_m
        values["other_track_m"] = vehicle.track_width_m * turning / forward
    return Finding("wheels_scaled", "warning", "wheels", values)


def _explain_scale(
    neutral: Alignment, ratios: tuple[float, float], driven: _Rates, vehicle: Vehicle, *, body_commanded: bool
) -> tuple[Alignment, tuple[Finding, ...]]:
    """One factor on the whole command, or the geometry of another vehicle where that contradicts turns.

    A factor with which the wheels do not clearly follow better, in all driving and turning, is told, and not
    applied: a gain of the drive would have to undo it.
    """
    forward, turning = ratios
    scales, other = (forward, forward), None
    values: dict[str, object] = {"kind": "of the wheels", "forward": forward}
    if turning <= 0.0 or abs(np.log(turning / forward)) >= _SCALED:
        values["turning"] = turning
        if not body_commanded and turning > 0.0:
            scales, other = _find_geometry(scales, turning, vehicle)
    if not driven.is_better(scales):
        values |= {"kind": "not followed", "value": forward}
        return neutral, (Finding("command_scale", "warning", "command", values),)
    if other is not None:
        values["vehicle"] = pick(other, "name", "wheel_radius_m", "track_width_m")
    values |= {"value": scales[0], "turn_scale": scales[1]}
    finding = Finding("command_scale", "warning", "command", values)
    return replace(neutral, command_scale=scales[0], command_turn_scale=scales[1]), (finding,)


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


def _is_multiplied(ratio: float, vehicle: Vehicle) -> bool:
    """Whether turns show another multiplier than the configured one.

    A controller widens the track or leaves it unchanged: a smaller wheel difference is due to the drive.
    """
    multiplier = ratio * vehicle.controller_track_multiplier
    return bool(abs(np.log(ratio)) >= _SCALED and np.log(multiplier) > -_SCALED)


def _compare_rates(
    commands: pl.DataFrame, wheels: pl.DataFrame, vehicle: Vehicle, late: tuple[float, float]
) -> _Rates:
    """Commanded and measured rates over steps of a tenth of a second; empty where nothing can be compared.

    Commands are lagged and delayed as the wheels follow them best.
    """
    asked, got = (_read(table, vehicle) for table in (commands, wheels))
    motion = roll_wheels(got)
    nothing: Floats = np.zeros(0)
    there: Flags = np.zeros(0, dtype=bool)
    if motion.is_known and asked.inputs:
        there = np.logical_and.reduce([one.is_there(motion.steps) for one in asked.inputs])
    if not there.any():
        return _Rates((nothing, nothing), (nothing, nothing), np.zeros(0, dtype=np.int64))
    motion = motion.take(there)
    elapsed = motion.steps.end - motion.steps.start
    ahead, turned = asked.columns(motion.steps, *late, crossed=False)
    rates = motion.body.real / elapsed, motion.yaw / elapsed
    return _Rates((ahead / elapsed, turned / elapsed), rates, motion.steps.block)


def roll(table: pl.DataFrame, vehicle: Vehicle) -> tuple[Floats, Floats]:
    """Times [s], shape (n,), and ideal velocities of a drive where it is active, else NaN, shape (n, 3)."""
    inputs = {
        one.name: table[one.name].cast(pl.Float64).fill_null(np.nan).to_numpy()
        for one in vehicle.kinematics.inputs
    }
    velocity = np.stack(vehicle.kinematics.forward(inputs, vehicle), axis=-1)
    velocity[~table["active"].to_numpy()] = np.nan
    return table["t"].to_numpy(), velocity


def _read(table: pl.DataFrame, vehicle: Vehicle) -> Reading:
    """The ideal motion of a drive."""
    if table.is_empty():
        return Reading()
    times, velocity = roll(table, vehicle)
    return Reading("body", "", *(Held(times, velocity[:, axis]) for axis in (0, 2)))


def find_ratio(asked: Floats, got: Floats) -> float | None:
    """Median ratio of measured to commanded speed in the slower half of the driving; None if it varies."""
    slow = _find_slow(asked)
    if slow.sum() < FEWEST_STEPS:
        return None
    ratio, inverse = got[slow] / asked[slow], 1.0 / np.abs(asked[slow])
    middle = float(np.median(ratio))
    spread = robust_spread(ratio - middle)
    # A dead band takes more of a slower step; a scale is that of the fastest ones, too.
    apart = inverse - inverse.mean()
    line = fit_robustly(np.column_stack((np.ones(apart.size), apart)), ratio)
    level, slope = line.gains
    is_sloped = float(line.rest.std()) < 0.5 * float(ratio.std())
    changed = abs(level - slope * inverse.mean() - middle) if is_sloped else 0.0
    return middle if middle > _LEAST_RATIO and max(spread, changed) < ONE_SCALE * middle else None


def _find_slow(asked: Floats) -> Flags:
    """The slower half of the driving, without what is near a standstill."""
    size = np.abs(asked)
    most = float(np.quantile(size, 0.99)) if size.size else 0.0
    slow: Flags = (size > max(0.1 * most, STILL_MPS)) & (size < 0.5 * most)
    return slow


def _find_median(asked: Floats, got: Floats) -> float | None:
    """Median ratio of measured to commanded speed in the slower half of the driving, however it varies."""
    slow = _find_slow(asked)
    return float(np.median(got[slow] / asked[slow])) if slow.sum() >= FEWEST_STEPS else None


def _take_as_followed(case: Case, alignment: Alignment) -> Alignment:
    """Scales of a body command without a unit, with which the body moves as far as it says."""
    command = case.command
    explained = command.reading.explained
    fits = (explained.ahead, explained.turned)
    scales = [abs(float(one.gains[0])) / of for one, of in zip(fits, case.command_factors(), strict=True)]
    axes: tuple[Axis, ...] = ("ahead", "turned")
    seen = [command.sign(axis) != 0 and not are_apart(command.reading.fit_halves(axis)) for axis in axes]
    ahead, turn = (scale if known else 1.0 for scale, known in zip(scales, seen, strict=True))
    values = {"kind": "without a unit", "value": ahead, "turn": turn, "source": str(command.source)}
    case.findings.append(Finding("command_scale", "warning", "command", values))
    return replace(alignment, command_scale=ahead, command_turn_scale=turn)


def ask_scale(case: Case) -> Case:
    """Corrections of the command as it is read with all others."""
    command, wheels = case.command, case.wheels
    if not command.is_there:
        return case
    vehicle, made = case.vehicle, case.complete()
    if case.kind and not case.is_known:
        vehicle = msgspec.structs.replace(vehicle, kind=case.kind)
    try:
        asked = case.extraction.read_drive(command.source, made.command, vehicle, held=True)
        got = pl.DataFrame()
        if wheels.is_there:
            got = case.extraction.read_drive(wheels.source, made.wheels, vehicle, held=False)
    except SlipError:
        return case
    is_body = command.reading.form == "body"
    alignment = Alignment(track_multiplier=vehicle.controller_track_multiplier)
    # Turns of wheels over metres a second are those of their radius.
    is_rolled = wheels.source.form is DriveForm.JOINTS
    is_alike = not is_body and not (is_rolled and command.reading.form == "steering")
    if case.driven.is_known and (case.is_known or is_alike):
        gain, made_of = None, command.reading.explained
        if is_body and command.sign("ahead") > 0:
            gain = float(made_of.ahead.gains[0]) / case.command_factors()[0]
        late = (case.driven.lag, case.driven.delay)
        alignment, findings = measure_command_scale(
            asked, got, vehicle, body_commanded=is_body, gain=gain, late=late
        )
        case.findings.extend(findings)
    if is_body and not case.is_scaled and command.reading.explained.is_known:
        alignment = _take_as_followed(case, alignment)
    return replace(case, alignment=alignment)
