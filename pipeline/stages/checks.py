"""Checks of a whole run: scale, and consistency of encoders, command and pose."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np
import polars as pl

from pipeline.core import Floats, fit_robustly
from pipeline.recording import SURE, Finding, find_one_ratio
from pipeline.run import STILL_MPS
from pipeline.sources import DriveForm, DriveSource, Vehicle, list_factors
from pipeline.stages.slip_stage import SlipResult
from pipeline.stages.trust import (
    FEWEST_SAMPLES,
    Samples,
    check_independence,
    check_live_commands,
    check_map_shape,
    estimate_delay,
    gather_samples,
)

_LIVE: Final = 0.05
"""Speed of a side [m/s] above encoder rounding and that of a creeping vehicle; above `STILL_MPS`, since here
the sign of the poses' noise matters."""
_LEAST_SCALE: Final = 0.04
"""Smallest difference of the sides' scales that is reported: unequal tyres and motors reach 0.035."""


def check_side_scale(samples: Samples, vehicle: Vehicle) -> list[Finding]:
    """Check for one encoder on another scale than the other, although the vehicle follows commands evenly.

    Unequal tyres show between wheels and body only, a weak motor between command and wheels only; an encoder
    that reads low shows in both, in opposite directions.
    """
    if vehicle.kind != "differential" or vehicle.track_width_m is None:
        return []
    if samples.command is None or samples.measured is None:
        return []
    signals = {"pose": samples.velocity, "command": samples.command, "wheels": samples.measured}
    known = samples.steady & np.all([np.isfinite(signal).all(axis=1) for signal in signals.values()], axis=0)
    sides = {name: _find_sides(signal[known], vehicle.track_width_m) for name, signal in signals.items()}
    # Without turning and without a command, noise has no sign.
    live = np.any([np.abs(side).max(axis=1) > _LIVE for side in sides.values()], axis=0)
    # Wheels that stand have no scale.
    turns = np.abs(sides["wheels"]) > _LIVE
    if min(live.sum(), *turns.sum(axis=0)) < FEWEST_SAMPLES:
        return []
    sides = {name: side[live] for name, side in sides.items()}
    turned = sides["pose"][:, 1] - sides["pose"][:, 0]
    left, right = fit_robustly(sides["wheels"], turned).gains
    left_ratio = fit_robustly(sides["command"], sides["wheels"][:, 0]).gains[0]
    own_right = fit_robustly(sides["command"], sides["wheels"][:, 1]).gains[1]
    if not (left < 0.0 < right and left_ratio > 0.0 and own_right > 0.0):
        return []
    of_command, of_body = float(np.log(left_ratio / own_right)), float(np.log(-left / right))
    scale = 0.5 * (of_command - of_body)
    if abs(scale) < _LEAST_SCALE or abs(of_command + of_body) > abs(scale):
        return []
    low = "left" if scale < 0.0 else "right"
    values = {"value": float(np.exp(-abs(scale))), "side": low}
    return [Finding("wheel_scale", "warning", f"wheels {low}", values)]


def _find_sides(velocity: Floats, track_m: float) -> Floats:
    """Speed of the left and the right side of an ideal differential drive [m/s], shape (n, 2)."""
    half = 0.5 * track_m * velocity[:, 2]
    return np.column_stack((velocity[:, 0] - half, velocity[:, 0] + half))


# Scale of the measured wheels against the motion: a wrong wheel radius, or a wrong unit.
#
# On slippery ground a vehicle covers less distance than its wheels, and hardly ever more. If the gain would
# be plausible slip with the wheels in another unit (rpm for rad/s, degrees, millimetres), that unit is
# reported. A smaller difference is a wrong radius only if the vehicle is as fast as its body command: a
# controller that knows the radius does not compensate for slip on the ground.

WRONG_RADIUS: Final = "wheel_radius_wrong"
"""Id of the finding on a wheel radius that the travel of a run contradicts."""
_LEAST: Final = 0.55
"""Distance over that of the wheels above which it may be slip: with a constant ratio (`ONE_SCALE`), the
recordings have 0.86 to 0.96. Below it a unit or a radius is wrong."""
_MOST: Final = 1.25
"""Distance over that of the wheels above which a unit or a radius is wrong: wheels that roll do not slide."""
_LEAST_DIFFERENCE: Final = 0.1
"""Least relative error of a radius that is reported; tyres and their pressure cause smaller ones."""
_SPEED_TOLERANCE: Final = 0.05
"""Relative deviation within which a controller reaches the commanded speed."""


def check_scale(samples: Samples, vehicle: Vehicle) -> list[Finding]:
    """Check the steady gain from the measured wheels to the forward motion."""
    moved, steady = samples.velocity[:, 0], samples.steady
    gain = None if samples.measured is None else _find_gain(samples.measured[steady, 0], moved[steady])
    if gain is None or samples.measured is None:
        return []
    if _LEAST < gain < _MOST:
        reached = None
        if samples.body_commanded and samples.command is not None:
            reached = _find_gain(samples.command[steady, 0], moved[steady])
        if reached is None or abs(reached - 1.0) > _SPEED_TOLERANCE or abs(gain - 1.0) < _LEAST_DIFFERENCE:
            return []
    driven = samples.measured[:, 0]
    known = np.isfinite(driven) & samples.steady
    for unit, factor in list_factors("rad/s", "m/s").items():
        if _LEAST < gain / factor < _MOST:
            fastest = float(np.max(np.abs(driven[known])))
            values = {"kind": "of the motion", "value": gain, "unit": unit, "fastest_mps": fastest}
            return [Finding("unit_wrong", "error", "wheels", values)]
    radius = vehicle.wheel_radius_m
    values = {"value": radius * gain, "gain": gain, "radius_m": radius, "dimensions": ["wheel_radius_m"]}
    return [Finding(WRONG_RADIUS, "error", "wheels", values)]


def is_grip(gain: float, others: Iterable[float]) -> bool:
    """Whether a gain that alone contradicts the wheel radius is the ground's, by gains of the same vehicle.

    With the radius that this gain implies, a run whose gain may be slip would cover more than its wheels.
    """
    return any(_LEAST < other < _MOST and other > _MOST * gain for other in others)


def find_gain_of(slip: pl.DataFrame) -> float | None:
    """The steady gain from the measured wheels to the forward motion, from the rows of table `slip`."""
    rows = slip.filter(
        pl.col("input").cast(pl.String) == "measured", ~pl.col("suspect"), ~pl.col("transitory")
    )
    return _find_gain(rows["f_x"].to_numpy(), rows["v_x"].to_numpy())


def _find_gain(driven: Floats, moved: Floats) -> float | None:
    """Median of the forward motion over an ideal one; None if it is not steady, or backward."""
    gain = find_one_ratio(moved, driven, FEWEST_SAMPLES)
    return gain if gain is not None and gain > 0.0 else None


# Checks of a whole run: whether the vehicle moves at all, and whether encoders, command and pose agree.
#
# Each check is a function from the samples of a run to findings. It uses displacements over half a second,
# which neither smoothing nor vibration affects.

_GAIN_OF_NO_MOTION = 0.05
"""Ratio of the motion to the ideal one below which a vehicle does not move; for wheels in the air
(`husky_wheels_avide2`) it is noise of the poses, whose path and correlation (0.6) are no criterion."""
_NET_OF_NO_MOTION = 0.5
"""Distance [m] within which a vehicle that does not move stays, with `_PATH_OF_MOTION`; a run with a smaller
command, and with less turning [rad], commands no motion."""
_PATH_OF_MOTION = 5.0
"""Wheel path [m] after which staying within `_NET_OF_NO_MOTION` is not a short drive."""
_FEWEST_ASKED = 20
"""Least number of samples in which an axis is commanded: a second at 20 Hz. With fewer its gain is zero, so
that a larger number would report a short drive in a long log as no motion."""
_SKEW = 0.05
"""Least skew that is reported [s]: it appears as a lateral skid of 0.05 s, and skids are 0.02 to 0.15 s."""


def check_run(
    velocities: pl.DataFrame,
    tables: Mapping[str, pl.DataFrame],
    slip: SlipResult,
    vehicle: Vehicle,
    *,
    command: DriveSource | None,
    is_drive_alone: bool = False,
) -> list[Finding]:
    """All checks of a run.

    Args:
        velocities: table `velocities`.
        tables: `poses`, `commands`, `wheels`, aligned.
        slip: of all inputs.
        vehicle: its vehicle.
        command: topics of the command.
        is_drive_alone: whether the poses are the motion of the measured wheels.
    """
    body_commanded = command is not None and command.form is DriveForm.BODY
    inputs = {name: ideal.leave_out(slip.suspect) for name, ideal in slip.inputs.items()}
    samples = gather_samples(velocities, inputs, slip.cut, body_commanded=body_commanded)
    samples = replace(samples, is_drive_alone=is_drive_alone)
    findings = run_checks(samples, vehicle)
    if is_drive_alone or "measured" not in slip.recorded:
        return findings
    recorded = {"measured": slip.recorded["measured"].leave_out(slip.suspect)}
    names = {"recorded_t": "t", "recorded_x": "v_x", "recorded_y": "v_y", "recorded_w": "v_w"}
    stamped = velocities.drop(*names.values()).rename(names)
    samples = gather_samples(stamped, recorded, slip.cut, body_commanded=body_commanded)
    periods = [_find_period(tables[name]) for name in ("wheels", "poses")]
    return check_independence(samples, vehicle, periods) + findings


def _find_period(table: pl.DataFrame) -> float:
    """Median time between two rows [s]; zero if there are none."""
    return float(np.median(np.diff(table["t"].to_numpy()))) if table.height > 1 else 0.0


def run_checks(samples: Samples, vehicle: Vehicle) -> list[Finding]:
    """All checks; if the vehicle does not move, only those that report this.

    Wheels on a wrong scale may look like no motion: the scale is checked first.
    """
    scaled = check_scale(samples, vehicle)
    stuck = check_dead_wheels(samples, vehicle)
    stuck += [] if scaled else check_motion(samples, vehicle)
    if stuck:
        return stuck
    checks: tuple[Callable[[Samples, Vehicle], list[Finding]], ...] = (
        check_side_scale,
        check_live_commands,
        check_limits,
        check_delays,
        check_map_shape,
    )
    return scaled + [finding for check in checks for finding in check(samples, vehicle)]


def check_dead_wheels(samples: Samples, _vehicle: Vehicle) -> list[Finding]:
    """Encoders that read zero throughout under live commands: an emergency stop, or dead encoders."""
    if samples.measured is None or samples.command is None:
        return []
    both = np.isfinite(samples.measured).all(axis=1) & np.isfinite(samples.command).all(axis=1)
    live = both & (np.abs(samples.command) > STILL_MPS).any(axis=1)
    if live.sum() < FEWEST_SAMPLES or float(np.abs(samples.measured[both]).max()) > 0.0:
        return []
    return [Finding("wheels_dead", "error", "wheels", {"count": int(live.sum())})]


def check_motion(samples: Samples, _vehicle: Vehicle) -> list[Finding]:
    """Report a vehicle that does not move: wheels in the air, or standstill under commands.

    The gain of displacement on the ideal one is below 5 % ahead, sideways and in turning, or the run's net
    displacement is below half a metre over more than five metres of wheel path. The path of the poses is not
    used: its noise alone sums to tens of metres.
    """
    ideal = samples.measured if samples.measured is not None else samples.command
    if samples.measured is not None and not np.nanmax(np.abs(samples.measured), initial=0.0) > 0.0:
        ideal = samples.command
    if ideal is None:
        return []
    known = np.isfinite(ideal).all(axis=1)
    if known.sum() < FEWEST_SAMPLES:
        return []
    period = float(np.median(np.diff(samples.times)))
    path = float(np.hypot(ideal[known, 0], ideal[known, 1]).sum() * period)
    positions = samples.position[known]
    net = float(np.linalg.norm(positions.max(axis=0) - positions.min(axis=0)))
    turned = float(np.abs(ideal[known, 2]).sum() * period)
    if path < _NET_OF_NO_MOTION and turned < _NET_OF_NO_MOTION:
        values: dict[str, object] = {"kind": "hardly commanded", "value": path}
        if net > _NET_OF_NO_MOTION:
            values["moved_m"] = net
        return [Finding("not_moving", "error", "", values)]
    gains = [_gain_on(samples.velocity[known, axis], ideal[known, axis]) for axis in range(3)]
    still = all(abs(gain) < _GAIN_OF_NO_MOTION for gain in gains)
    # Wheels on a stand, or in a test of steps, may turn as much back as ahead.
    nowhere = not samples.is_drive_alone and net < _NET_OF_NO_MOTION and path > _PATH_OF_MOTION
    if not still and not (nowhere and abs(gains[2]) < 10.0 * _GAIN_OF_NO_MOTION):
        return []
    # Sideways motion counts only without a forward command.
    covered = gains[0] or gains[1]
    values = {
        "kind": "wheels stand" if samples.is_drive_alone else "body stands",
        "value": covered,
        "path_m": path,
        "of": "wheels" if ideal is samples.measured else "command",
        "moved_m": net,
    }
    if turned >= _NET_OF_NO_MOTION:
        values |= {"turned_rad": turned, "turning": gains[2]}
    return [Finding("not_moving", "error", "", values)]


def _gain_on(velocity: Floats, ideal: Floats) -> float:
    """Gain of a velocity on its ideal where motion is commanded, otherwise zero: noise is not motion."""
    live = np.abs(ideal) > STILL_MPS
    if live.sum() < _FEWEST_ASKED:
        return 0.0
    return float(np.sum(velocity[live] * ideal[live]) / np.sum(ideal[live] ** 2))


def check_limits(samples: Samples, vehicle: Vehicle) -> list[Finding]:
    """Commands beyond the limits of the vehicle's controller."""
    if samples.command is None:
        return []
    findings = []
    for axis, limit, unit in ((0, vehicle.max_speed_mps, "m/s"), (2, vehicle.max_yaw_rate_radps, "rad/s")):
        known = np.isfinite(samples.command[:, axis])
        asked, moved = (np.abs(values[known, axis]) for values in (samples.command, samples.velocity))
        if limit is None or asked.size == 0:
            continue
        beyond = asked > limit * 1.02
        share = float(np.mean(beyond))
        if share > 0.01:  # noqa: PLR2004 - a hundredth of the samples is no accident
            name, reached = "speed" if axis == 0 else "yaw rate", float(np.median(moved[beyond]))
            values = {"value": share, "name": name, "limit": limit, "unit": unit}
            if reached > limit * 1.02:
                values["reached"] = reached
            findings.append(Finding("command_beyond_limit", "info", f"command {name}", values))
    return findings


def check_delays(samples: Samples, _vehicle: Vehicle) -> list[Finding]:
    """Report a heading that is later than the position."""
    ideal = samples.measured
    if ideal is None:
        return []
    known = np.isfinite(ideal).all(axis=1)
    times = samples.times[known]
    along, turning = (
        estimate_delay(times, samples.velocity[known, axis], times, ideal[known, axis]) for axis in (0, 2)
    )
    if along is None or turning is None:
        return []
    skew = turning.seconds - along.seconds
    if abs(skew) <= max(_SKEW, SURE * float(np.hypot(along.deviation, turning.deviation))):
        return []
    from pipeline.models import Late, find_late_effect  # noqa: PLC0415 - heavy

    return [Finding(find_late_effect(Late.HEADING).id, "warning", "pose", {"value": skew})]
