"""Lengths of a vehicle by its signals: wheel radius, track and wheelbase, with standard errors.

They come last: no decision on roles, signs and frames needs them, and what is not excited is missing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.core import format_share, join_parts
from pipeline.recording.case import Candidate, Case, is_crossed
from pipeline.recording.evidence import RIMS
from pipeline.recording.motion import CLEAR, FEWEST_STEPS, STEP_S, Motion, Steps
from pipeline.recording.readings import SIDES, Explained, Reading
from pipeline.sources import RANGES, DriveForm, find_alike

LENGTHS = ("wheel_radius_m", "track_width_m", "wheelbase_m")
_ROUGH = 2e-3
"""Relative standard error from which on it is stated."""
_SAME_TRACK = 0.1
"""Share by which a fitted track may differ from that of a platform without skidding."""

_METHOD = 1.5e-3
"""Relative error of a length beyond that of its fit: of delays on a grid and of what happens between samples.
Over 24 drawn drives the root mean square is 0.4e-3 to 1.8e-3, and fits alone state a fifth of it."""


@dataclass(frozen=True)
class Length:
    """A length with its standard error, both [m]."""

    value: float
    error: float


@dataclass(frozen=True)
class Geometry:
    """Lengths of a vehicle that its signals show; None where they do not.

    Attributes:
        radius, track: by which the controller turns commands into wheel speeds.
        rolled: wheel radius by the motion.
        effective: track by the motion.
        wheelbase: of a car, by the motion.
        is_taken: whether the radius is any, since the speeds of the wheels show none.
    """

    radius: Length | None = None
    track: Length | None = None
    rolled: Length | None = None
    effective: Length | None = None
    wheelbase: Length | None = None
    is_taken: bool = False

    def list_lengths(self, kind: str) -> dict[str, Length]:
        """Plausible lengths of that kind of vehicle by name, those of its controller first."""
        if kind == "ackermann":
            lengths = {"wheelbase_m": self.wheelbase, "wheel_radius_m": self.rolled}
        elif self.radius is not None:
            lengths = {"wheel_radius_m": self.radius, "track_width_m": self.track}
        else:
            lengths = {"wheel_radius_m": self.rolled, "track_width_m": self.effective}
        wide = lengths.get("track_width_m")
        if kind == "mecanum" and wide is not None:
            # Wheels with rollers turn a body by track and wheelbase together.
            half = Length(0.5 * wide.value, 0.5 * wide.error)
            lengths |= {"track_width_m": half, "wheelbase_m": half}
        return {
            key: length
            for key, length in lengths.items()
            if length is not None and RANGES[key][0] < length.value < RANGES[key][1]
        }


def roll_wheels(wheels: Reading) -> Motion | None:
    """Increments of wheels that roll without slip, in their own units; None if they hardly turn."""
    start = max(float(one.times[0]) for one in wheels.inputs)
    end = min(float(one.times[-1]) for one in wheels.inputs)
    if end - start < FEWEST_STEPS * STEP_S:
        return None
    edges = np.arange(start, end, STEP_S)
    steps = Steps(edges[:-1], edges[1:])
    steps = steps.take(np.logical_and.reduce([one.is_there(steps) for one in wheels.inputs]))
    if steps.start.size < FEWEST_STEPS:
        return None
    ahead, turned = wheels.columns(steps, 0.0, 0.0, crossed=False)
    return Motion(steps, join_parts(ahead, 0.0), np.zeros(turned.size), turned, "z")


def explain_wheels(command: Reading, wheels: Reading) -> Explained | None:
    """What wheels do of a command: their motion takes the place of a pose's.

    Args:
        command: of the body, of both sides, or of speed and steering.
        wheels: what is measured of them.

    Returns:
        The fit; None if the wheels do not follow the command, or one of its sides counts backward.
    """
    is_whole = len(wheels.inputs) == len(SIDES) or (wheels.inputs and wheels.form != "sides")
    motion = roll_wheels(wheels) if is_whole else None
    if motion is None:
        return None
    made = Reading(command.form, command.name, command.first, command.second).explain(motion)
    return None if made is None or not made.is_sure or made.crossed else made


def measure_controller(made: Explained) -> tuple[Length | None, Length | None]:
    """Wheel radius and track by which a controller turns body commands into wheel speeds.

    Args:
        made: speeds of both sides [rad/s] by commanded speed [m/s] and yaw rate [rad/s].

    Returns:
        Radius and track, each None where it is not excited.
    """
    ahead, bent = (float(one.gains[0]) for one in (made.ahead, made.turned))
    errors = _list_errors(made)
    radius = Length(1.0 / ahead, errors[0] / ahead) if ahead > 0.0 and 1.0 / errors[0] > CLEAR else None
    track = (
        Length(bent / ahead, bent / ahead * float(np.hypot(errors[0], errors[1])))
        if radius is not None and bent > 0.0 and 1.0 / errors[1] > CLEAR
        else None
    )
    return radius, track


def _list_errors(made: Explained) -> list[float]:
    """Relative standard errors of the gains ahead and turning."""
    return [float(np.hypot(1.0 / max(abs(one.t[0]), 1e-9), _METHOD)) for one in (made.ahead, made.turned)]


def measure_geometry(wheels: Explained) -> tuple[Length | None, Length | None]:
    """Wheel radius and effective track by the motion, each None where it is not excited."""
    ahead, bent = abs(float(wheels.ahead.gains[0])), abs(float(wheels.turned.gains[0]))
    errors = _list_errors(wheels)
    radius = Length(ahead, errors[0] * ahead) if wheels.sign("ahead") else None
    track = (
        Length(ahead / bent, ahead / bent * float(np.hypot(errors[0], errors[1])))
        if radius is not None and wheels.sign("turned")
        else None
    )
    return radius, track


def measure_car(car: Explained, *, is_measured: bool) -> Geometry:
    """Wheelbase of a car that turns by its steering, and the radius of wheels whose turning is measured."""
    ahead, bent = abs(float(car.ahead.gains[0])), abs(float(car.turned.gains[0]))
    of_speed, of_turn = _list_errors(car)
    if not car.sign("ahead"):
        return Geometry(wheelbase=Length(1.0 / bent, of_turn / bent))
    # A car that is slower than commanded turns by the speed that it has.
    wheelbase = Length(ahead / bent, ahead / bent * float(np.hypot(of_speed, of_turn)))
    return Geometry(rolled=Length(ahead, ahead * of_speed) if is_measured else None, wheelbase=wheelbase)


def describe_vehicle(
    seen: Geometry,
    kind: str,
    values: Mapping[str, object],
    given: Sequence[str],
    *,
    is_body: bool,
) -> tuple[str, str]:
    """An id that depends only on the geometry of an unidentified vehicle, and a sentence on it.

    Args:
        seen: lengths by the signals.
        kind: of the vehicle.
        values: lengths that are used [m].
        given: names of those that the user or the log gives.
        is_body: whether commands and measurements are body motion alone.
    """
    if is_body and kind != "ackermann":
        text = (
            "no vehicle is given and none is needed: commands and measurements of the drive are body motion, "
            "whose slip does not depend on wheel radius and track width"
        )
        track = values.get("track_width_m")
        if kind == "differential" and track is not None:
            text += f"; a difference of the wheels is that at a track of {track:g} m (--track-width: another)"
        if kind == "omni":
            text += " (sideways motion is commanded: --vehicle reads joints as mecanum wheels)"
        return "fitted_body", text
    lengths = {key: float(value) for key, value in values.items() if isinstance(value, float)}
    errors = {key: length.error for key, length in seen.list_lengths(kind).items()}
    track = {
        "differential": "a track of" if seen.radius is not None else "an effective track of",
        "mecanum": "a track and a wheelbase of together",
    }
    words = {
        "wheel_radius_m": "a wheel radius of",
        "track_width_m": track.get(kind, "a track of"),
        "wheelbase_m": "a wheelbase of",
    }
    if kind == "mecanum":
        errors["track_width_m"] = errors.get("track_width_m", 0.0) + errors.pop("wheelbase_m", 0.0)
        lengths["track_width_m"] += lengths.pop("wheelbase_m")
    parts = {
        key: f"{words[key]} {lengths[key]:.3g} m"
        + (
            f" (±{format_share(errors[key] / lengths[key])})"
            if key not in given and errors.get(key, 0.0) > _ROUGH * lengths[key]
            else ""
        )
        for key in LENGTHS
        if key in lengths
    }
    own = " and ".join(text for key, text in parts.items() if key in given)
    shown = " and ".join(text for key, text in parts.items() if key not in given)
    if not shown:
        text = f"the vehicle has {own}, as given or recorded"
    else:
        text = "the log does not identify the vehicle" + (f": {own} as given or recorded" if own else "")
    if shown and kind in {"differential", "mecanum"} and seen.radius is not None:
        text += f"; its controller turns commands into wheel speeds by {shown}, which are used"
    elif shown:
        verb = "fit" if " and " in shown else "fits"
        text += f"; {shown} {verb} the motion, so that no effect is reported of it"
    if kind == "differential" and "track_width_m" not in lengths:
        text += "; there is too little turning for a track: give --track-width"
    if kind == "ackermann":
        return (
            f"fitted_{1e3 * lengths['wheelbase_m']:.0f}",
            f"{text} (wheelbase_m under [vehicle] gives another)",
        )
    is_shown = kind != "mecanum" and not seen.is_taken
    name, guess = _guess_platform(lengths["wheel_radius_m"], lengths.get("track_width_m"), is_shown=is_shown)
    return f"fitted_{name}", f"{text} ({guess})"


def _guess_platform(radius: float, track: float | None, *, is_shown: bool) -> tuple[str, str]:
    """Id of the platform with these lengths [m], or digits of them; and what to confirm."""
    name = f"{1e3 * radius:.0f}_{0.0 if track is None else 1e3 * track:.0f}"
    if not is_shown:
        return name, "[vehicle] gives others"
    alike = {} if track is None else find_alike(radius, track)
    if not alike:
        return name, "--wheel-radius and --track-width give others"
    first, (called, share) = next(iter(alike.items()))
    if abs(share - 1.0) < _SAME_TRACK:
        return first, f"{called} has about these: confirm with --vehicle {first}"
    names = " or ".join(called for called, _ in alike.values())
    turns = f"turns at {format_share(share)} of the ideal rate"
    return name, f"{names} has such wheels, and then {turns}: confirm with --vehicle {' or '.join(alike)}"


def measure_lengths(case: Case, command: Candidate | None, wheels: Candidate | None) -> Geometry:
    """Lengths of the vehicle by its controller and by the motion."""
    made = Geometry()
    car = next((one for one in (wheels, command) if one is not None and one.reading.form == "steering"), None)
    if car is not None and car.reading.explained is not None and car.sign("turned"):
        is_turned = car is wheels and car.source.form is DriveForm.JOINTS
        return measure_car(car.reading.explained, is_measured=is_turned)
    if wheels is None or wheels.reading.form != "sides":
        sides = command if command is not None and command.reading.form == "sides" else None
    else:
        sides = wheels
    if sides is not None and sides.is_sure and not is_crossed(sides) and sides.reading.explained is not None:
        rolled, effective = measure_geometry(sides.reading.explained)
        factor = case.wheel_factor("wheels" if sides is wheels else "command")
        made = replace(made, rolled=_scale(rolled, factor), effective=effective)
    if (
        command is not None
        and wheels is not None
        and wheels.reading.form == "sides"
        and command.reading.form == "body"
        and case.driven is not None
        and case.is_scaled
    ):
        radius, track = measure_controller(case.driven)
        speed, rate = case.command_factors()
        radius = made.rolled if case.in_bursts else _scale(radius, speed * case.wheel_factor())
        made = replace(made, radius=radius, track=_scale(track, speed / rate))
    changes = case.changes.get("command" if sides is command else "wheels", {})
    return replace(made, is_taken="scale" in changes or changes.get("unit") in RIMS)


def _scale(length: Length | None, factor: float) -> Length | None:
    return None if length is None else Length(length.value * factor, length.error * factor)
