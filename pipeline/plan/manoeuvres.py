"""What a plan may ask of a vehicle, the library of manoeuvres within these limits, and their choice."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Complex, Floats
from pipeline.core.program import SlipError
from pipeline.models.parameter import Largest
from pipeline.sources import Vehicle

if TYPE_CHECKING:
    from pipeline.plan.questions import Answerable


class PlanError(SlipError):
    """A plan that cannot be made, written or read, in one line."""


# Of a plan, where neither the user nor the vehicle's preset says more.
_USUAL_YAW_RATE_RADPS = 1.0
_USUAL_STEERING_RAD = 0.4
_USUAL_ACCELERATION_MPS2 = 0.5
# Across the vehicle's way: below what tips or slides wheeled vehicles on firm ground.
_LATERAL_MPS2 = 2.0
# From standing to the largest turn.
_TURN_RISE_S = 1.0
# Beside half of the vehicle's length, towards every edge of the area.
_MARGIN_M = 0.5
_SHORTEST_S = 15.0
_LONGEST_S = 3600.0


@dataclass(frozen=True)
class Limits:
    """The most that a plan asks for.

    Attributes:
        speed_mps: forward or backward.
        turn: yaw rate [rad/s], or steering angle [rad] on a car.
        acceleration_mps2: of the commanded speed.
        turn_rate: change of the commanded turn in a second.
        lateral_mps2: speed times yaw rate.
        yaw_rate_radps: of a car, whose turn is a steering angle; infinite where it is not limited.
    """

    speed_mps: float
    turn: float
    acceleration_mps2: float
    turn_rate: float
    lateral_mps2: float = _LATERAL_MPS2
    yaw_rate_radps: float = math.inf


def is_steered(vehicle: Vehicle) -> bool:
    """Whether a turn is a steering angle."""
    return vehicle.kinematics.has_inputs("speed", "steering")


def choose_limits(
    vehicle: Vehicle,
    largest: Largest | None = None,
    *,
    speed_mps: float | None = None,
    yaw_rate_radps: float | None = None,
    acceleration_mps2: float | None = None,
) -> Limits:
    """Limits as asked for, else the preset's, else what the run itself asked for at most.

    Args:
        vehicle: with its preset's limits.
        largest: that a run asked for; None without a run.
        speed_mps: as asked for; never above the preset's.
        yaw_rate_radps: as asked for; never above the preset's.
        acceleration_mps2: as asked for.

    Raises:
        PlanError: ``no_limits``, the largest speed of the vehicle is not known.
    """
    known = vehicle.max_speed_mps or (largest.speed if largest is not None and largest.speed > 0.0 else None)
    if speed_mps is None and known is None:
        what = "the largest speed of the vehicle is not known"
        raise PlanError("no_limits", what, where=vehicle.id, hint="Give --max-speed.")
    speed = min(speed_mps or math.inf, known or math.inf)
    acceleration = acceleration_mps2 or min(_USUAL_ACCELERATION_MPS2, speed)
    if is_steered(vehicle):
        turn = vehicle.max_steering_rad or _USUAL_STEERING_RAD
        return Limits(
            speed, turn, acceleration, turn / _TURN_RISE_S, yaw_rate_radps=yaw_rate_radps or math.inf
        )
    # Beyond what is usual only where somebody says so: the preset, or who asks.
    fastest = 2.0 * speed / (vehicle.track_width_m or 1.0)
    most = vehicle.max_yaw_rate_radps or min(yaw_rate_radps or _USUAL_YAW_RATE_RADPS, fastest)
    turn = min(yaw_rate_radps or math.inf, most)
    return Limits(speed, turn, acceleration, turn / _TURN_RISE_S)


@dataclass(frozen=True)
class Area:
    """A rectangle whose middle is the start; its first side lies along the heading at the start.

    Attributes:
        length_m, width_m: its sides.
        margin_m: how far base_link stays away from every edge.
    """

    length_m: float
    width_m: float
    margin_m: float = _MARGIN_M

    def holds(self, path: Complex) -> bool:
        """Whether all positions x + iy [m] from the start lie inside, with the margin."""
        x, y = 0.5 * self.length_m - self.margin_m, 0.5 * self.width_m - self.margin_m
        return bool((np.abs(path.real) <= x).all() and (np.abs(path.imag) <= y).all())


def parse_area(text: str, vehicle: Vehicle) -> Area:
    """``20x10m``: length and width in metres.

    Raises:
        PlanError: ``bad_area``, it is no such text, or smaller than the vehicle with its margin.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*x\s*(\d+(?:\.\d+)?)\s*m?\s*", text)
    body = max(vehicle.wheelbase_m or 0.0, vehicle.track_width_m or 0.0)
    margin = _MARGIN_M + 0.5 * body
    if match is None or min(float(match[1]), float(match[2])) <= 2.0 * margin:
        what = f"the area {text!r} is not a length and width in metres of more than {2.0 * margin:.1f} m"
        raise PlanError("bad_area", what, where="--area", hint="Write for example --area 20x10m.")
    return Area(float(match[1]), float(match[2]), margin)


def parse_time(text: str) -> float:
    """Seconds of ``60s``, ``2min`` or a plain number.

    Raises:
        PlanError: ``bad_time``, it is no such text, or not 15 s to an hour.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(s|min)?\s*", text)
    seconds = float(match[1]) * (60.0 if match[2] == "min" else 1.0) if match is not None else 0.0
    if not _SHORTEST_S <= seconds <= _LONGEST_S:
        what = f"{text!r} is not a time of {_SHORTEST_S:g} s to {_LONGEST_S / 60.0:g} min"
        raise PlanError("bad_time", what, where="--time", hint="Write for example --time 60s.")
    return seconds


# The library of manoeuvres: short sequences of body commands that end where they began.
#
# Every manoeuvre drives a way and then drives it back: commands of the way back are those of the way there,
# in reverse order and with the other sign of the speed. An ideal vehicle retraces its path, so that
# manoeuvres can follow each other in any order inside a small area, and each has both signs of everything.

RATE_HZ = 20.0
LEAD_S = 3.0
"""Zero commands before anything moves [s]."""
REST_S = 1.0
"""Zero commands after every manoeuvre [s]: what follows late has settled before the next begins."""
_SHARES = (0.25, 0.5, 1.0)
_SMALL = 0.06
_HOLDS_S = (1.5, 4.0)
_SWEEP_S = 8.0
_SWEEP_HZ = (0.15, 1.2)


@dataclass(frozen=True)
class Commands:
    """Body commands, each held until the next.

    Attributes:
        speed: [m/s], shape (n,), one every 1 / `RATE_HZ` seconds.
        turn: yaw rate [rad/s], or steering angle [rad] on a car, shape (n,).
    """

    speed: Floats
    turn: Floats

    @property
    def times(self) -> Floats:
        """Since the first command [s], shape (n,)."""
        return np.arange(self.speed.size) / RATE_HZ

    @property
    def duration_s(self) -> float:
        """Until the last command has ended."""
        return self.speed.size / RATE_HZ


@dataclass(frozen=True)
class Manoeuvre:
    """A name that says what is driven, and the commands, the rest at the end included."""

    name: str
    commands: Commands


def wait(seconds: float) -> Commands:
    """Zero commands."""
    zeros = np.zeros(round(seconds * RATE_HZ))
    return Commands(zeros, zeros)


def join(pieces: Sequence[Commands]) -> Commands:
    """One after the other."""
    return Commands(np.concatenate([p.speed for p in pieces]), np.concatenate([p.turn for p in pieces]))


def list_manoeuvres(vehicle: Vehicle, limits: Limits) -> tuple[Manoeuvre, ...]:
    """All manoeuvres of a vehicle within its limits; one on the spot is none for a car."""
    steered = is_steered(vehicle)
    manoeuvres: list[Manoeuvre] = []

    def add(name: str, *stages: tuple[float, float, float], end: str = "") -> None:
        there = hold_within(stages, vehicle, limits)
        # What is reached: short stages and narrow limits leave some targets far away.
        fast, turning = (
            float(v[np.abs(v).argmax()]) for v in (there.speed, np.copysign(there.turn, stages[0][1]))
        )
        reached = [f"{fast:.2g} m/s"] if fast else []
        reached += [f"{turning:.2g} {unit}"] if turning else []
        manoeuvres.append(
            Manoeuvre(f"{name} {', '.join(reached)}{end}", _go_and_return(there, steered=steered))
        )

    speed, turn = limits.speed_mps, limits.turn
    unit = "rad" if steered else "rad/s"
    for share in (_SMALL, *_SHARES):
        for hold in _HOLDS_S:
            add("straight at", (share * speed, 0.0, hold), end=f", {hold:g} s")
            if not steered:
                add("spin at", (0.0, share * turn, hold), end=f", {hold:g} s")
                add("spin at", (0.0, -share * turn, hold), end=f", {hold:g} s")
    for fast in _SHARES:
        for round_ in (_SMALL, *_SHARES):
            for side in (1.0, -1.0):
                at = (fast * speed, side * round_ * turn)
                for hold in _HOLDS_S:
                    add("arc at", (*at, hold), end=f", {hold:g} s")
                add("S at", (*at, 2.0), (at[0], -at[1], 2.0))
    for share in _SHARES:
        add(
            "steps of speed to",
            (0.3 * share * speed, 0.0, 1.5),
            (share * speed, 0.0, 1.5),
            (0.0, 0.0, 1.0),
        )
        sweep = _sweep(share * speed, turn)
        there = _limit(*sweep, vehicle, limits)
        manoeuvres.append(
            Manoeuvre(f"sine sweep at {share * speed:.2g} m/s", _go_and_return(there, steered=steered))
        )
    # Targets that are not reached make the same drive several times.
    different = {(one.commands.speed.tobytes(), one.commands.turn.tobytes()): one for one in manoeuvres}
    return tuple(different.values())


def hold_within(stages: Sequence[tuple[float, float, float]], vehicle: Vehicle, limits: Limits) -> Commands:
    """Targets of (speed, turn, seconds) held one after the other."""
    counts = [round(seconds * RATE_HZ) for _, _, seconds in stages]
    return _limit(
        np.repeat([speed for speed, _, _ in stages], counts),
        np.repeat([turn for _, turn, _ in stages], counts),
        vehicle,
        limits,
    )


def _sweep(speed: float, turn: float) -> tuple[Floats, Floats]:
    """Constant speed while the turn swings faster and faster."""
    time = np.arange(round(_SWEEP_S * RATE_HZ)) / RATE_HZ
    low, high = _SWEEP_HZ
    phase = 2.0 * np.pi * (low * time + 0.5 * (high - low) * time**2 / _SWEEP_S)
    return np.full(time.size, speed), turn * np.sin(phase)


def _limit(speed: Floats, turn: Floats, vehicle: Vehicle, limits: Limits) -> Commands:
    """Targets brought within the limits: ramps from and to standing, slower turns where it is fast."""
    rate = limit_yaw_rate(speed, vehicle, limits)
    held = np.clip(turn, -rate, rate)
    # The slowest ramp down has room after the last target.
    slowest = max(limits.speed_mps / limits.acceleration_mps2, limits.turn / limits.turn_rate)
    room = np.zeros(int(np.ceil(RATE_HZ * slowest)) + 1)
    speeds = _ramp(np.append(speed, room), limits.acceleration_mps2 / RATE_HZ)
    turns = _ramp(np.append(held, room), limits.turn_rate / RATE_HZ)
    rate = limit_yaw_rate(speeds, vehicle, limits)
    # A turn that its own ramp leaves behind is cut at most where a slower speed allows more anyway.
    turns = np.clip(turns, -rate, rate)
    last = np.flatnonzero((speeds != 0.0) | (turns != 0.0))
    end = int(last[-1]) + 2 if last.size else 1
    return Commands(speeds[:end], turns[:end])


def limit_yaw_rate(speed: Floats, vehicle: Vehicle, limits: Limits) -> Floats:
    """The largest turn at each speed: the vehicle's own, and what the lateral acceleration allows."""
    fast = np.maximum(np.abs(speed), 1e-6)
    rate = np.minimum(limits.lateral_mps2 / fast, limits.yaw_rate_radps)
    if not is_steered(vehicle):
        return np.minimum(rate, limits.turn)
    return np.minimum(np.arctan(rate * (vehicle.wheelbase_m or 1.0) / fast), limits.turn)


def _ramp(target: Floats, step: float) -> Floats:
    """Follow a target from zero by at most a step a command."""
    values = np.empty_like(target)
    value = 0.0
    for index, wanted in enumerate(target.tolist()):
        value += min(max(wanted - value, -step), step)
        values[index] = value
    return values


def _go_and_return(there: Commands, *, steered: bool) -> Commands:
    """There and back: a yaw rate changes its sign with the speed, a steering angle stays."""
    sign = 1.0 if steered else -1.0
    back = Commands(-there.speed[::-1], sign * there.turn[::-1])
    return join((there, back, wait(REST_S)))


_ROUNDS = 2
_NOTHING = 1e-4
# Every model ends within this share of the area's shorter side of its start.
_HOME_SHARE = 0.25


@dataclass(frozen=True)
class Shape:
    """The way of a manoeuvre from the origin, by model.

    Attributes:
        path: positions x + iy [m], shape (models, n).
        heading: at the end [rad], shape (models,).
    """

    path: Complex
    heading: Floats


class Chooser:
    """Sequences of manoeuvres.

    Args:
        questions: with one group of windows a manoeuvre.
        durations: of the manoeuvres [s], shape (k,).
        shapes: their ways, all of the same models.
        area: where all of these must stay.
        time_s: longest sequence.
    """

    def __init__(
        self,
        questions: Sequence[Answerable],
        durations: Floats,
        shapes: Sequence[Shape],
        area: Area,
        time_s: float,
    ) -> None:
        self.questions = questions
        self.durations = durations
        self.shapes = shapes
        self.area = area
        self.time_s = time_s
        self.reserve = 1.0
        self._answers: dict[tuple[int, ...], float] = {}

    def choose(self, reserve: float = 1.0) -> list[int]:
        """Manoeuvres in the order in which they answer most; empty where none says anything.

        Args:
            reserve: factor by which more is asked: manoeuvres do not quite add up, and stretches of driving
                do not begin where manoeuvres do.
        """
        chosen = self.extend([], reserve)
        for _ in range(_ROUNDS):
            if not self._exchange(chosen):
                break
        return chosen

    def extend(self, chosen: Sequence[int], reserve: float) -> list[int]:
        """Manoeuvres with more behind them, as long as these answer anything and there is time.

        Args:
            chosen: what stays at the beginning.
            reserve: as of `choose`.
        """
        self.reserve = reserve
        self._answers.clear()
        longer = list(chosen)
        while (best := self._find_next(longer)) is not None:
            longer.append(best)
        return longer

    def add_up(self, trials: Sequence[Sequence[int]]) -> list[float]:
        """Of each trial, the sum of the shares of all questions that its manoeuvres answer."""
        keys = [tuple(sorted(chosen)) for chosen in trials]
        new = [key for key in dict.fromkeys(keys) if key not in self._answers]
        if new:
            weight = np.array(
                [np.bincount(np.array(key, np.int64), minlength=self.durations.size) for key in new]
            )
            shares = sum(
                question.answer(weight.astype(np.float64), self.reserve) for question in self.questions
            )
            self._answers |= zip(new, np.broadcast_to(shares, len(new)).tolist(), strict=True)
        return [self._answers[key] for key in keys]

    def _find_next(self, chosen: list[int]) -> int | None:
        (now,) = self.add_up([chosen])
        remaining = self.time_s - float(self.durations[chosen].sum())
        extended = self.add_up([[*chosen, one] for one in range(self.durations.size)])
        rates = (np.array(extended) - now) / self.durations
        for one in np.argsort(rates)[::-1].tolist():
            if rates[one] < _NOTHING:
                return None
            if self.durations[one] <= remaining and self.fits([*chosen, one]):
                return int(one)
        return None

    def _exchange(self, chosen: list[int]) -> bool:
        """Replace or leave out one manoeuvre after the other where that answers more, or as much sooner."""
        changed = False
        for index in reversed(range(len(chosen))):
            rest = chosen[:index] + chosen[index + 1 :]
            spent = float(self.durations[rest].sum())
            short = np.flatnonzero(spent + self.durations <= self.time_s).tolist()
            trials = [chosen, rest, *([*chosen[:index], one, *chosen[index + 1 :]] for one in short)]
            (best, *ranks), trial = self._rank(trials), chosen
            for rank, other in zip(ranks, trials[1:], strict=True):
                if rank > best and self.fits(other):
                    best, trial = rank, other
            if trial is not chosen:
                chosen[:] = trial
                changed = True
        return changed

    def _rank(self, trials: Sequence[Sequence[int]]) -> list[tuple[float, float]]:
        return [
            (round(answered, 3), -float(self.durations[list(chosen)].sum()))
            for chosen, answered in zip(trials, self.add_up(trials), strict=True)
        ]

    def fits(self, chosen: Sequence[int]) -> bool:
        """Whether all models stay inside the area and end near their start."""
        at = np.zeros(self.shapes[0].heading.size, dtype=np.complex128)
        heading = np.zeros(at.size)
        for one in chosen:
            shape = self.shapes[one]
            path = at[:, None] + np.exp(1j * heading)[:, None] * shape.path
            if not self.area.holds(path):
                return False
            at, heading = path[:, -1], heading + shape.heading
        home = _HOME_SHARE * min(self.area.length_m, self.area.width_m)
        return bool((np.abs(at) <= home).all())
