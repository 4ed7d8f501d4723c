"""Lengths of a vehicle by its signals: wheel radius, track and wheelbase, with 95 % intervals.

They come last: no decision on roles, signs and frames needs them, and what is not excited is missing. Each is
a guess: its interval is by how it differs between blocks of the drive, not by the noise of all of it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from pipeline.core import NORMAL_95, fit_robustly, join_parts
from pipeline.recording.motion import CLEAR, FEWEST_STEPS, NO_MOTION, Motion, MotionFit, Steps, find_step, fit
from pipeline.recording.readings import DELAYS_S, SIDES, UNEXPLAINED, Explained, Reading
from pipeline.sources import RANGES, find_alike_vehicles

LENGTHS = ("wheel_radius_m", "track_width_m", "wheelbase_m")
_SAME_TRACK = 0.1
"""Share by which a fitted track may differ from that of a platform without skidding."""

_METHOD = 1.5e-3
"""Relative error of a length beyond that of its fit: of delays on a grid and of what happens between samples.
Over 24 drawn drives the root mean square is 0.4e-3 to 1.8e-3, and fits alone state a fifth of it."""


@dataclass(frozen=True)
class Length:
    """A length [m].

    Attributes:
        value: by all of the drive.
        error: standard error, of which the 95 % interval has 1.96 to each side. It is that of the length over
            ten seconds of driving, see `motion.measure_spread`: the slip of a drive does not average out.
    """

    value: float
    error: float

    @property
    def is_clear(self) -> bool:
        """Whether it is far from zero for its error; without two blocks of driving it is not."""
        return self.error * CLEAR < self.value

    @property
    def interval(self) -> tuple[float, float]:
        """Ends of the 95 % interval [m]."""
        return self.value - NORMAL_95 * self.error, self.value + NORMAL_95 * self.error


def take_clear(value: float, share: float) -> Length | None:
    """A length of this value [m] and relative standard error; None if it is not clear."""
    length = Length(value, value * share)
    return length if length.is_clear else None


_GUESSED = 0.5
"""Relative standard error of a length that is shown, but by one stretch of the drive alone."""


def take_shown(value: float, share: float, made: Explained) -> Length | None:
    """A length by the turning of a drive, a wide guess if it is not clear; None if nothing turns so."""
    clear = take_clear(value, share)
    return clear or (Length(value, _GUESSED * value) if made.sign("turned") else None)


def measure_share_error(one: MotionFit) -> float:
    """Relative standard error of a gain."""
    size = abs(float(one.gains[0]))
    spread = one.spread / (NORMAL_95 * size) if size > 0.0 else np.inf
    return float(np.hypot(np.hypot(1.0 / max(abs(float(one.t[0])), 1e-9), _METHOD), spread))


@dataclass(frozen=True)
class Geometry:
    """Lengths of a vehicle that its signals show; None where they do not.

    Attributes:
        radius, track: by which the controller turns commands into wheel speeds.
        rolled: wheel radius by the motion: where wheels slip ahead, less than that of the wheel.
        effective: track by the motion, for wheels of the radius that is used. Where wheels skid it is more
            than the distance between them.
        wheelbase: of a car, by the motion.
        is_taken: whether the radius is any, since the speeds of the wheels show none.
    """

    radius: Length | None = None
    track: Length | None = None
    rolled: Length | None = None
    effective: Length | None = None
    wheelbase: Length | None = None
    is_taken: bool = False

    @property
    def is_contradicted(self) -> bool:
        """Whether the commands show another wheel radius than the motion, beyond both intervals."""
        one, other = self.radius, self.rolled
        if one is None or other is None or self.is_taken:
            return False
        return abs(one.value - other.value) > NORMAL_95 * (one.error + other.error)

    def list_lengths(self, kind: str) -> dict[str, Length]:
        """Plausible lengths of that kind of vehicle by name, those of its controller first."""
        if kind == "ackermann":
            lengths = {"wheelbase_m": self.wheelbase, "wheel_radius_m": self.rolled}
        else:
            lengths = {
                "wheel_radius_m": self.radius or self.rolled,
                "track_width_m": self.track or self.effective,
            }
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


def roll_wheels(wheels: Reading) -> Motion:
    """Increments of wheels that roll without slip, in their own units; `NO_MOTION` if they hardly turn."""
    if not wheels.inputs:
        return NO_MOTION
    start = max(float(one.times[0]) for one in wheels.inputs)
    end = min(float(one.times[-1]) for one in wheels.inputs)
    if end <= start:
        return NO_MOTION
    edges = np.arange(start, end, find_step(end - start))
    steps = Steps(edges[:-1], edges[1:])
    steps = steps.take(np.logical_and.reduce([one.is_there(steps) for one in wheels.inputs]))
    if steps.start.size < FEWEST_STEPS:
        return NO_MOTION
    ahead, turned = wheels.columns(steps, 0.0, 0.0, crossed=False)
    return Motion(steps, join_parts(ahead, 0.0), np.zeros(turned.size), turned, "z")


def explain_wheels(command: Reading, wheels: Reading) -> Explained:
    """What wheels do of a command: their motion takes the place of a pose's.

    Args:
        command: of the body, of both sides, or of speed and steering.
        wheels: what is measured of them.

    Returns:
        The fit; `UNEXPLAINED` if the wheels do not follow the command, or one of its sides counts backward.
    """
    is_whole = len(wheels.inputs) == len(SIDES) or (wheels.inputs and wheels.form != "sides")
    if not is_whole:
        return UNEXPLAINED
    made = Reading(command.form, command.name, command.first, command.second).explain(roll_wheels(wheels))
    return UNEXPLAINED if not made.is_sure or made.crossed else made


_SLOW = 0.5
"""Demand over the largest one up to which wheels are taken to follow at first."""
_OVER = 1.05
"""Demand over the fastest that wheels turn from which on they do not follow."""
_LIMITED = 0.02
"""Share of a drive beyond which wheels that do not follow are at a limit, and no noise."""
_SAME_SIDES = 1.02
"""Ratio of the gains of both sides up to which they are the same."""
_AFTER_S = 1.0
"""Time [s] after such a demand in which the wheels still come from their limit."""


def explain_followed(reading: Reading, made: Explained) -> Explained:
    """What wheels do of a command where they follow it: neither at a limit nor just after.

    Args:
        reading: a body command.
        made: what both sides of the wheels do of it.

    Returns:
        The fit to a part of the motion; that to all of it if there is no limit.
    """
    steps = made.motion.steps
    elapsed = (steps.end - steps.start)[:, None]
    columns = np.column_stack(reading.columns(steps, made.lag, made.delay, crossed=False)) / elapsed
    ahead, half = made.motion.body.real, 0.5 * made.motion.yaw
    sides = np.column_stack([ahead - half, ahead + half]) / elapsed
    top = np.quantile(np.abs(sides), 0.99, axis=0)
    gains = np.linalg.lstsq(columns, sides, rcond=None)[0]
    asked = np.abs(columns @ gains).max(axis=1)
    followed, limited = asked < _SLOW * float(np.quantile(asked, 0.95)), asked > np.inf
    for _ in range(3):
        if followed.sum() < FEWEST_STEPS:
            return made
        gains = np.column_stack([fit_robustly(columns[followed], side[followed]).gains for side in sides.T])
        limited = (np.abs(columns @ gains) > _OVER * top).any(axis=1)
        last = np.maximum.accumulate(np.where(limited, steps.end, -np.inf))
        followed = steps.start > last + _AFTER_S
    if limited.mean() < _LIMITED or followed.sum() < FEWEST_STEPS:
        return made
    return reading.fit_to(made.motion.take(followed), DELAYS_S, crossed=False)


def find_track_of_sides(reading: Reading, made: Explained) -> float | None:
    """Track by which each side follows the turning of a command, in its unit; None if both follow alike.

    Sides that follow a command ahead by different gains show no radius, and the mean of them no track.
    """
    steps = made.motion.steps
    columns = np.column_stack(reading.columns(steps, made.lag, made.delay, crossed=False))
    ahead, half = made.motion.body.real, 0.5 * made.motion.yaw
    left, right = (fit(side, columns, steps) for side in (ahead - half, ahead + half))
    error = float(np.hypot(1.0 / left.t[0], 1.0 / right.t[0]))
    apart = abs(float(np.log(left.gains[0] / right.gains[0])))
    tracks = [2.0 * abs(float(one.gains[1] / one.gains[0])) for one in (left, right)]
    return 0.5 * sum(tracks) if apart > np.log(_SAME_SIDES) + CLEAR * error else None


def measure_controller(made: Explained) -> tuple[Length | None, Length | None]:
    """Wheel radius and track by which a controller turns body commands into wheel speeds.

    Args:
        made: speeds of both sides [rad/s] by commanded speed [m/s] and yaw rate [rad/s].

    Returns:
        Radius and track, each None where it is not excited.
    """
    ahead, bent = (float(one.gains[0]) for one in (made.ahead, made.turned))
    errors = list_errors(made)
    radius = take_clear(1.0 / ahead, errors[0]) if ahead > 0.0 else None
    track = (
        take_shown(bent / ahead, float(np.hypot(errors[0], errors[1])), made)
        if radius is not None and bent > 0.0
        else None
    )
    return radius, track


def list_errors(made: Explained) -> list[float]:
    """Relative standard errors of the gains ahead and turning."""
    return [measure_share_error(one) for one in (made.ahead, made.turned)]


def measure_geometry(
    wheels: Explained, factor: float = 1.0, radius: Length | None = None
) -> tuple[Length | None, Length | None]:
    """Wheel radius and effective track by the motion, each None where it is not excited.

    Args:
        wheels: motion by speeds of both sides.
        factor: from the radius of these speeds to that of rad/s.
        radius: of the wheels, if it is known from elsewhere; the track is one for it.
    """
    ahead, bent = (factor * abs(float(one.gains[0])) for one in (wheels.ahead, wheels.turned))
    errors = list_errors(wheels)
    rolled = take_clear(ahead, errors[0]) if wheels.sign("ahead") else None
    used = radius or rolled
    if used is None or not wheels.sign("turned"):
        return rolled, None
    return rolled, take_clear(used.value / bent, float(np.hypot(used.error / used.value, errors[1])))


def measure_car(car: Explained, *, is_measured: bool) -> Geometry:
    """Wheelbase of a car that turns by its steering, and the radius of wheels whose turning is measured."""
    ahead, bent = abs(float(car.ahead.gains[0])), abs(float(car.turned.gains[0]))
    of_speed, of_turn = list_errors(car)
    if not car.sign("ahead"):
        return Geometry(wheelbase=take_shown(1.0 / bent, of_turn, car))
    # A car that is slower than commanded turns by the speed that it has.
    wheelbase = take_shown(ahead / bent, float(np.hypot(of_speed, of_turn)), car)
    return Geometry(rolled=take_clear(ahead, of_speed) if is_measured else None, wheelbase=wheelbase)


def describe_vehicle(
    seen: Geometry,
    kind: str,
    values: Mapping[str, object],
    given: Sequence[str],
    *,
    is_body: bool,
) -> tuple[str, dict[str, object]]:
    """An id that depends only on the geometry of an unidentified vehicle, and the values of a finding on it.

    Args:
        seen: lengths by the signals.
        kind: of the vehicle.
        values: lengths that are used [m].
        given: names of those that the user or the log gives.
        is_body: whether commands and measurements are body motion alone.
    """
    if is_body and kind != "ackermann":
        described: dict[str, object] = {"kind": "body alone", "is_omni": kind == "omni"}
        track = values.get("track_width_m")
        if kind == "differential" and track is not None:
            described["track_m"] = track
        return "fitted_body", described
    lengths = {key: float(value) for key, value in values.items() if isinstance(value, float)}
    words, shown = _list_shown(seen, kind, lengths)
    by_controller = {"wheel_radius_m": seen.radius, "track_width_m": seen.track}
    described = {
        "kind": "lengths",
        "vehicle_kind": kind,
        "has_track": "track_width_m" in lengths,
        "lengths": [
            {
                "name": words[key],
                "value": one.value,
                "low": one.interval[0],
                "high": one.interval[1],
                "by": "given"
                if key in given
                else "controller"
                if by_controller.get(key) is not None
                else "motion",
            }
            for key, one in shown.items()
        ],
        "alike": {},
    }
    if kind == "ackermann":
        return f"fitted_{1e3 * lengths['wheelbase_m']:.0f}", described
    is_shown = kind != "mecanum" and not seen.is_taken
    track_m = lengths.get("track_width_m")
    radius_m = lengths["wheel_radius_m"]
    name = f"{1e3 * radius_m:.0f}_{0.0 if track_m is None else 1e3 * track_m:.0f}"
    alike = find_alike_vehicles(radius_m, track_m) if is_shown and track_m is not None else {}
    for first, (_, share) in islice(alike.items(), 1):
        is_same = abs(share - 1.0) < _SAME_TRACK
        name = first if is_same else name
        described |= {"has_track_of_alike": is_same, "turns": share}
        described["alike"] = {one: called for one, (called, _) in alike.items()}
    return f"fitted_{name}", described


def _list_shown(
    seen: Geometry, kind: str, lengths: Mapping[str, float]
) -> tuple[dict[str, str], dict[str, Length]]:
    """Words for the lengths of a vehicle, and the lengths [m], in order; by name.

    Args:
        seen: lengths by the signals, with their errors.
        kind: of the vehicle.
        lengths: those that are used [m].
    """
    words = {"wheel_radius_m": "wheel radius", "track_width_m": "track", "wheelbase_m": "wheelbase"}
    fitted = seen.list_lengths(kind)
    track = seen.effective if seen.track is None and kind == "differential" else None
    if track is not None and lengths.get("track_width_m") == track.value:
        words["track_width_m"] = "effective track (with skidding)"
    shown = {
        key: fitted[key] if key in fitted and fitted[key].value == lengths[key] else Length(lengths[key], 0.0)
        for key in LENGTHS
        if key in lengths
    }
    if kind == "mecanum":
        words["track_width_m"] = "track and a wheelbase together"
        one, other = shown["track_width_m"], shown.pop("wheelbase_m")
        shown["track_width_m"] = Length(one.value + other.value, one.error + other.error)
    return words, shown
