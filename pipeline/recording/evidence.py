"""Roles, frame, signs, units and lengths of a log by one likelihood.

The question is always which reading of the signals makes one rigid body move as it was asked to, and whether
another is as likely. The pose gives increments of the body; every other signal is a reading of them with free
gains and a free delay; names and types are priors in the same unit (nats).
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Literal

import numpy as np

from pipeline.core import Complex, Floats, join_parts
from pipeline.recording.motion import CLEAR, LEAST_NATS, Motion, compare, fit
from pipeline.recording.readings import Reading, fit_across
from pipeline.sources import COMMANDED, LENGTH_UNITS, MEASURED, RADII_M, convert_unit

# Frame of the pose.

_USUAL_DEG = 12.0
"""Angle between heading and course within which it is that of a mounting, and not of another axis."""
_NEARLY_BACK_DEG = 135.0
"""Angle from which on half a turn is nearer than a quarter."""
_CONCENTRATED = 0.6
"""Concentration of the course above which its angle means anything."""
ONE_LINE = 0.9
"""Share of a motion along one line of the body, from which on it tells no direction from another."""


def find_frame(motion: Motion, readings: Sequence[Reading]) -> tuple[Motion, float, float | None]:
    """The sense and the offset of the heading with which the body moves ahead as the best reading says.

    Half a turn is left to `find_reversed`: it reverses signs only.

    Args:
        motion: the motion as recorded.
        readings: readings that were fitted to it.

    Returns:
        The motion in its likeliest frame; Vuong's statistic against the recorded one, zero where that one
        stays; and the angle [degrees] of another frame along which the reading is followed, where it is not
        along this one.
    """
    known = [one for one in readings if one.form != "gyro" and one.explained.is_sure]
    if not known:
        return motion, 0.0, None
    best = max(known, key=lambda one: one.explained.moves)
    explained = best.explained
    part = explained.motion
    ahead, _ = best.columns(part.steps, explained.lag, explained.delay, crossed=explained.crossed)
    aside = best.columns_aside(part.steps, explained.lag, explained.delay, crossed=explained.crossed)
    if aside.size:
        return *_find_frame_across(motion, part, join_parts(ahead, aside[:, 0])), None
    course, concentration = motion.find_course_deg()
    angles = {0.0, 90.0}
    if concentration > _CONCENTRATED and abs(course - 90.0 * round(course / 90.0)) > _USUAL_DEG:
        angles.add(course)
    scores: dict[tuple[bool, float], Floats] = {}
    pulls: dict[tuple[bool, float], float] = {}
    for flip in (False, True):
        for angle in angles:
            turned = part.turn(flip=flip, offset_deg=angle)
            body, yaw = turned.body, turned.yaw
            along = fit(body.real, np.column_stack([ahead, yaw]), part.steps)
            across = fit(body.imag, np.column_stack([aside, yaw]), part.steps)
            scores[flip, angle], pulls[flip, angle] = along.blocks + across.blocks, float(along.t[0])
    usual = (False, 0.0)
    likeliest = max(scores, key=lambda key: float(scores[key].sum()))
    margin = compare(scores[likeliest], scores[usual])
    gain = float((scores[likeliest] - scores[usual]).sum()) / part.moved.size
    # A body that only turns about one point does so along any heading.
    if likeliest == usual or min(margin, abs(pulls[likeliest])) < CLEAR or gain < LEAST_NATS:
        # Where wheels spin, the body may go along any of them.
        pull = pulls[False, 90.0]
        is_open = abs(pulls[usual]) < CLEAR < abs(pull)
        return motion, 0.0, float(np.copysign(90.0, pull)) if is_open else None
    return motion.turn(flip=likeliest[0], offset_deg=likeliest[1]), margin, None


def _find_frame_across(motion: Motion, part: Motion, asked: Complex) -> tuple[Motion, float]:
    """The same of a base that moves sideways, which moves as it is asked to in both directions.

    Args:
        motion: the motion as recorded.
        part: where the reading is known.
        asked: increments ahead + 1j * left over its steps, shape (n,).
    """
    usual = fit_across(part, [asked], lever=True).blocks
    chosen: tuple[bool, float, Floats] | None = None
    for flip in (False, True):
        body = part.turn(flip=flip, offset_deg=0.0).body
        # Along one line, a mirrored frame is a turned one: the other hand is to be clearly better.
        for one in (asked, np.conj(asked)):
            angle = float(np.degrees(np.angle(np.vdot(one, body))))
            # Half a turn reverses signs only.
            angle -= 180.0 * np.sign(angle) if abs(angle) > _NEARLY_BACK_DEG else 0.0
            blocks = fit_across(part.turn(flip=flip, offset_deg=angle), [one], lever=True).blocks
            if chosen is None or compare(blocks, chosen[2]) > CLEAR:
                chosen = flip, angle, blocks
    assert chosen is not None  # noqa: S101 - the first one is
    flip, angle, blocks = chosen
    quarters = 90.0 * round(angle / 90.0)
    if abs(angle - quarters) <= _USUAL_DEG:
        angle = quarters
    elif abs(np.sum(asked**2)) > ONE_LINE * float(np.sum(np.abs(asked) ** 2)):
        # Along one line, a heading that is off is a ground on which the body slips aside, too.
        return motion, 0.0
    margin, gain = compare(blocks, usual), float((blocks - usual).sum()) / part.moved.size
    if not (flip or angle) or margin < CLEAR or gain < LEAST_NATS:
        return motion, 0.0
    return motion.turn(flip=flip, offset_deg=angle), margin


# Signs: the fewest faults that explain which signals go the other way.

Axis = Literal["ahead", "turned", "aside"]
_FAULTS: Mapping[str, tuple[frozenset[tuple[str, Axis]], float]] = {
    "pose_backward": (frozenset({("pose", "ahead"), ("pose", "aside")}), 2.0),
    "pose_mirrored": (frozenset({("pose", "turned"), ("pose", "aside")}), 2.0),
    "command_ahead": (frozenset({("command", "ahead")}), 2.0),
    "command_turned": (frozenset({("command", "turned")}), 2.0),
    "command_aside": (frozenset({("command", "aside")}), 2.0),
    "command_mirrored": (frozenset({("command", "turned"), ("command", "aside")}), 2.0),
    "command_both": (frozenset({("command", "ahead"), ("command", "turned"), ("command", "aside")}), 2.0),
    "wheels_both": (frozenset({("wheels", "ahead"), ("wheels", "turned"), ("wheels", "aside")}), 2.0),
    "wheels_exchanged": (frozenset({("wheels", "turned"), ("wheels", "aside")}), 2.0),
    "wheels_exchanged_both": (frozenset({("wheels", "ahead")}), 3.0),
    "gyro": (frozenset({("gyro", "turned")}), 1.0),
}
"""Faults with what each reverses, and its surprise in nats; a gyro is often mounted upside down."""


@dataclass(frozen=True)
class Reversal:
    """What goes the other way.

    Attributes:
        faults: names of the faults; the likeliest explanation.
        rivals: other explanations that are as likely.
    """

    faults: tuple[str, ...] = ()
    rivals: tuple[tuple[str, ...], ...] = ()


def find_reversed(signs: Mapping[tuple[str, Axis], int]) -> Reversal:
    """The least surprising faults that give these signs against the pose.

    Args:
        signs: by signal and axis: 1, -1, or 0 where it is not clear.
    """
    known = {key: sign for key, sign in signs.items() if sign}
    if all(sign > 0 for sign in known.values()):
        return Reversal()
    there = {signal for signal, _ in known}
    axes = {"ahead", "turned", *(axis for _, axis in known)}
    # Of a base that does not move to the side, faults that differ in that only are one.
    usable: dict[frozenset[tuple[str, Axis]], str] = {}
    for name, (reversed_by_it, _) in _FAULTS.items():
        part = frozenset(key for key in reversed_by_it if key[1] in axes)
        if part and name.split("_")[0] in {"pose", *there}:
            usable.setdefault(part, name)
    matches: list[tuple[float, tuple[str, ...]]] = []
    for count in (1, 2, 3):
        for parts in combinations(usable, count):
            if all(_sign_of(key, parts) == sign for key, sign in known.items()):
                names = tuple(usable[part] for part in parts)
                matches.append((sum(_FAULTS[name][1] for name in names), names))
    if not matches:
        return Reversal()
    least = min(cost for cost, _ in matches)
    best = [names for cost, names in matches if cost < least + 0.5]
    return Reversal(best[0], tuple(best[1:]))


def _sign_of(key: tuple[str, Axis], parts: Sequence[frozenset[tuple[str, Axis]]]) -> int:
    """Sign that a signal would have against the pose with these faults."""
    count = sum(key in part for part in parts) + sum(("pose", key[1]) in part for part in parts)
    return -1 if count % 2 else 1


# Units.


def _list_factors(*units: str) -> dict[str, float]:
    """Factors to SI units, the unit of the message type first."""
    return {unit: convert_unit(unit, {}, where="")[0] for unit in units}


SPEEDS = _list_factors("m/s", "km/h", "mm/s", "cm/s")
RATES = _list_factors("rad/s", "deg/s", "mrad/s")
WHEELS = _list_factors("rad/s", "rpm", "deg/s")
USUAL = ("m/s", "rad/s", "rad")
"""Units of message types."""
_STRANGE = {
    "rpm": 4.0, "deg/s": 4.0, "deg": 3.0, "km/h": 3.0, "mm/s": 5.0, "cm/s": 6.0, "mrad/s": 10.0,
    "mm": 3.0, "cm": 5.0,
}  # fmt: skip
"""Surprise of a unit that a message type does not have [nats]: some are hardly ever met."""
_NAMED = 4.0
"""Surprise of another unit than that which a topic's name says [nats]."""
_GOOD = 0.7
"""Least share of the motion that a signal explains whose unit is in question."""
_WIN = 5.0
"""Least gain of another unit [nats]."""
_CLEAR = 2.0
"""The same of one whose factor is that of the gain; with less both are told [nats]."""
_EXACT = 0.03
"""Spread of the logarithm of a gain of a robot that moves as it is commanded."""
_COMMON, _OWN = 0.5, (0.35, 0.5)
"""The same of one that does not: of both gains, by a wrong radius or slip, and of each alone; turning slips
more than driving."""


@dataclass(frozen=True)
class Units:
    """Units of a signal's two inputs.

    Attributes:
        likeliest: of the first and the second input.
        rival: another pair that is as likely; None if there is none.
    """

    likeliest: tuple[str, str]
    rival: tuple[str, str] | None = None


def find_body_units(gains: Sequence[float | None], shares: Sequence[float], name: str = "") -> Units:
    """Units of a body command by its gains.

    Half of all robots move as they are commanded, to within a few percent: a gain that is a unit's factor is
    rarely anything else. A poor fit attenuates a gain, which then counts as near to one as that allows.

    Args:
        gains: motion over command, ahead and turning; None where it is not excited.
        shares: part of the motion that is explained, of both.
        name: of the signals; a unit that it names is no surprise.
    """
    return _find_units((SPEEDS, RATES), gains, shares, (name, name), _OWN)


def find_car_units(
    gains: Sequence[float | None],
    shares: Sequence[float],
    names: tuple[str, str],
    units: tuple[Sequence[str], Sequence[str]] = ((*SPEEDS,), (*SPEEDS,)),
) -> Units:
    """Units of a car's commanded and of its measured speed, which vote with the motion.

    Args:
        gains: motion over the command, and over the measurement; None where it is not excited.
        shares: part of the motion that is explained, of both.
        names: of the signals.
        units: that each may be in.
    """
    options = [{unit: SPEEDS[unit] for unit in some} for some in units]
    return _find_units((options[0], options[1]), gains, shares, names, (_OWN[0], _OWN[0]))


def _find_units(
    options: tuple[Mapping[str, float], Mapping[str, float]],
    gains: Sequence[float | None],
    shares: Sequence[float],
    names: tuple[str, str],
    own: tuple[float, float],
) -> Units:
    """Units of two signals by the motion over each; ``own`` is the spread of what each has for itself."""
    usual = (next(iter(options[0])), next(iter(options[1])))
    costs, exact = dict[tuple[str, str], float](), set[tuple[str, str]]()
    for pair in product(*options):
        # A gain is the motion in SI units over the signal in its own unit.
        factors = [some[unit] for some, unit in zip(options, pair, strict=True)]
        logs = [
            _shrink(float(np.log(abs(gain) / of)), share) if gain else None
            for gain, of, share in zip(gains, factors, shares, strict=True)
        ]
        # Two signals in one strange unit are no stranger than one.
        surprises = {
            unit: 0.0 if _is_named(unit, name) else _STRANGE.get(unit, 0.0)
            for unit, name in zip(pair, names, strict=True)
        }
        costs[pair] = sum(surprises.values()) - _rate_gains(logs, own)
        strange = [
            abs(log or 0.0) < 4.0 * _EXACT and log is not None and share > _GOOD
            for log, share, unit, one in zip(logs, shares, pair, usual, strict=True)
            if unit != one
        ]
        if all(strange):
            exact.add(pair)
    best = min(costs, key=lambda key: costs[key])
    gain = costs[usual] - costs[best]
    if gain > _WIN or (best in exact and best != usual and gain > _CLEAR):
        return Units(best)
    rivals = [pair for pair in exact if pair != usual and costs[pair] < costs[usual] + _CLEAR]
    return Units(usual, min(rivals, key=lambda pair: costs[pair], default=None))


def is_unit_exact(gain: float, unit: str) -> bool:
    """Whether a body moves as far as a speed says in a unit, so that it is no number without one."""
    return abs(float(np.log(abs(gain) / SPEEDS[unit]))) < 4.0 * _EXACT


def _is_named(unit: str, name: str) -> bool:
    """Whether the name of a signal says its unit."""
    word = {"km/h": "km_?p?_?h|kph", "deg/s": "deg", "deg": "deg", "rpm": "rpm"}.get(unit)
    return word is not None and bool(re.search(rf"(?<![a-z])(?:{word})(?![a-z])", name.lower()))


def _rate_gains(logs: Sequence[float | None], spreads: tuple[float, float]) -> float:
    """Log-likelihood of the logarithms of gains in the right units."""
    known = [index for index, one in enumerate(logs) if one is not None]
    seen = np.array([logs[index] for index in known], dtype=np.float64)
    if not known:
        return 0.0
    total = 0.0
    for common in (_EXACT, _COMMON):
        for own in product(*((_EXACT, spreads[index]) for index in known)):
            spread = common**2 + np.diag(np.square(own))
            quadratic = float(seen @ np.linalg.solve(spread, seen))
            total += np.exp(-0.5 * quadratic) / np.sqrt(np.linalg.det(spread)) / 2.0 ** (1 + len(known))
    return float(np.log(total + 1e-300))


_RADIUS = (0.12, 0.7)
"""Usual wheel radius [m], and the spread of its logarithm."""


def find_pose_unit(commanded: float | None, rolled: float | None, radius: float | None) -> str:
    """Unit of positions by how far the body moves: as far as commanded, and as wheels of some size roll.

    Args:
        commanded: motion over the speeds that are commanded; None if nothing tells.
        rolled: motion over the angle of the wheels; None if nothing tells.
        radius: of the wheels [m]; None if it is not known.
    """
    scores = {}
    for unit, factor in LENGTH_UNITS.items():
        logs = [(np.log(commanded * factor), _COMMON)] if commanded else []
        if rolled:
            middle, spread = (radius, 0.35) if radius else _RADIUS
            logs.append((np.log(rolled * factor / middle), spread))
        scores[unit] = -_STRANGE.get(unit, 0.0) - sum(0.5 * (log / spread) ** 2 for log, spread in logs)
    best = max(scores, key=lambda unit: scores[unit])
    return best if scores[best] > scores["m"] + _WIN else "m"


_LENGTH = (0.8, 1.0)
"""Usual wheelbase [m], and the spread of its logarithm: models of a hand's length to lorries."""
_WHEELBASES_M = (0.05, 30.0)
"""Wheelbases [m] that vehicles have."""
_IMPOSSIBLE = 1e3
"""Surprise of another one [nats]: more than a limit of the steering, say, may take from a good fit."""


def _rate_wheelbase(length: float | None, known: float | None) -> float:
    """Log-likelihood of a wheelbase [m] by the motion, against a known one or the usual ones."""
    middle, spread = (known, 0.35) if known else _LENGTH
    if length and not _WHEELBASES_M[0] < length < _WHEELBASES_M[1]:
        return -_IMPOSSIBLE
    apart = 2.0 if not length else np.log(length / middle) / spread
    return float(-0.5 * min(apart**2, 40.0) - np.log(spread))


def find_steering_unit(
    nats: Mapping[str, float], lengths: Mapping[str, float | None], known: float | None, name: str
) -> Units:
    """Unit of a steering angle by how well it explains the turning, and by the wheelbase that it means.

    Args:
        nats: gain in log-likelihood by unit, ``rad`` and ``deg``.
        lengths: wheelbase by unit [m]; None where the body does not turn by it.
        known: the vehicle's wheelbase [m]; None if it is not known.
        name: of the signals.
    """
    scores = {
        unit: nats[unit]
        + _rate_wheelbase(lengths[unit], known)
        - (0.0 if _is_named(unit, name) else _STRANGE.get(unit, 0.0))
        for unit in nats
    }
    gain = scores["deg"] - scores["rad"]
    if gain > _CLEAR:
        return Units(("", "deg"))
    return Units(("", "rad"), ("", "deg") if gain > -_CLEAR else None)


def _shrink(log: float, share: float) -> float:
    """Logarithm of a gain, as near to one as the share that is explained allows."""
    return min(0.0, log - np.log(max(share, 1e-6))) if log < 0.0 else log


RIMS = ("m/s", "mm/s", "cm/s")
"""Units of wheels whose speeds are those of their rims."""
_METRES = 3.0
"""Surprise of wheels whose speeds are those of their rims [nats]."""
_OF_METRES = 0.1
"""Spread of the logarithm of the motion over them."""
_UNUSUAL = 4.0
"""Surprise of counts that no unit explains, as ticks of an encoder are [nats]."""
_ANY = 10.0
"""Range of the logarithm of what such a count may be."""
_WIDEST = 0.5
"""Radius of a wheel over the track, below which it is: wheels of both sides do not meet."""
_OF_KNOWN = 0.25
"""Largest absolute logarithm of a known radius over that of a unit which is not named: more is a gear."""


def can_roll(gain: float, share: float, turn: float | None = None) -> bool:
    """Whether wheels in rad/s roll so: their radius is one that vehicles have, and below half the track.

    Args:
        gain: path over the wheels' angle.
        share: part of the motion that is explained; a poor fit attenuates the gain.
        turn: change of heading over the difference of both sides' angles, which is the radius over the track;
            None if nothing tells.
    """
    size = abs(gain)
    is_round = _shrink(float(np.log(size / RADII_M[0])), share) >= 0.0 and size <= RADII_M[1]
    return is_round and (turn is None or abs(turn) < _WIDEST)


def name_wheel_units(name: str) -> set[str]:
    """Units of wheel speeds that the name of a signal says."""
    words = {"rpm": "rpm", "deg/s": "deg", "mm/s": "mm_?p?_?s", "cm/s": "cm_?p?_?s"}
    return {unit for unit, word in words.items() if re.search(rf"(?<![a-z]){word}(?![a-z])", name.lower())}


def find_wheel_unit(
    gain: float, share: float, name: str, radius: float | None = None, turn: float | None = None
) -> str:
    """Unit of wheel speeds by the radius that each would mean; empty if it is none, as ticks are.

    Args:
        gain: path over the wheels' angle.
        share: part of the motion that is explained; a poor fit attenuates the gain.
        name: of the signals; a unit that it names is no surprise, and "rad/s" is one then.
        radius: of the wheels, if it is known; else about .12 m within a factor of two.
        turn: as that of `can_roll`.
    """
    named = name_wheel_units(name)
    spread = 0.7 if radius is None else 0.35

    def rate(factor: float, middle: float, spread: float) -> float:
        apart = _shrink(float(np.log(abs(gain) / factor / middle)), share) / spread
        return 0.5 * apart**2 + float(np.log(spread))

    costs = {
        unit: rate(factor, radius or _RADIUS[0], spread) + _STRANGE.get(unit, 0.0) * (not named)
        for unit, factor in WHEELS.items()
    }
    costs |= {
        unit: rate(SPEEDS[unit], 1.0, _OF_METRES) + _METRES + _STRANGE.get(unit, 0.0) * (unit not in named)
        for unit in RIMS
    }
    if radius is None:
        costs[""] = float(np.log(_ANY / np.sqrt(2.0 * np.pi))) + _UNUSUAL
    # Of turns before a gear the name is right, and the unit none of the wheels.
    costs = {unit: cost + _NAMED * bool(unit and named - {unit}) for unit, cost in costs.items()}
    best = min(costs, key=lambda unit: costs[unit])
    least = _CLEAR if best in RIMS else _WIN
    if best not in named and costs["rad/s"] - costs[best] <= least:
        best = "rad/s"
    if radius is None:
        return "" if best == "rad/s" and not can_roll(gain, share, turn) else best
    is_near = best in RIMS or abs(np.log(abs(gain) / WHEELS[best] / radius)) < _OF_KNOWN
    return best if best in named or is_near else "rad/s"


# Roles.

_LEAD_S = 0.05
_USUAL = 3.0
"""Nats of a name that says what a topic is."""


def is_named_measured(name: str) -> bool:
    """Whether a name says that a signal is measured, and not that it is commanded."""
    return bool(MEASURED.search(name.lower())) and not COMMANDED.search(name.lower())


_EQUAL = 0.02
"""Deviation of a gain from one within which a signal measures the motion."""


def equal_motion(one: Reading) -> tuple[bool, bool]:
    """Whether the numbers of a body's motion equal what it does, at once: ahead, and turning."""
    made = one.explained
    if one.form != "body" or not made.is_sure or made.lag + made.delay >= _LEAD_S:
        return False, False
    ahead, turned = (abs(float(each.gains[0]) - 1.0) < _EQUAL for each in (made.ahead, made.turned))
    return ahead, turned


def rate_command(one: Reading, rank: int, earliest: float) -> float:
    """How likely a reading is the command, in nats.

    A command is followed late, and it is held: numbers that equal the motion at once measure it.

    Args:
        one: a reading that the motion follows.
        rank: its place by type and name.
        earliest: least delay of all readings [s].
    """
    explained = one.explained
    named = _USUAL * bool(COMMANDED.search(one.name.lower())) - _USUAL * is_named_measured(one.name)
    late = explained.lag + explained.delay
    lead = float(np.clip((late - earliest) / _LEAD_S, 0.0, 4.0))
    held = float(np.mean([one.held_share for one in one.inputs]))
    # No drive follows what it is told at once, and least of all what changes all the time.
    at_once = 2.0 * _USUAL * (late < _LEAD_S) * (1.0 - held)
    return named + lead + 3.0 * held - at_once - 1.0 * rank
