"""Manoeuvres of a vehicle within its limits and an area, and the choice of the fewest that decide."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.core import Complex, Floats, SlipError
from pipeline.sources import Vehicle


class PlanError(SlipError):
    """A plan that cannot be made, written or read; one line."""


# Defaults of a plan, if neither the user nor the vehicle's preset sets a limit.
_USUAL_YAW_RATE_RADPS = 1.0
_USUAL_STEERING_RAD = 0.4
_USUAL_ACCELERATION_MPS2 = 0.5

# Lateral acceleration: below the values at which wheeled vehicles tip or slide on firm ground.
_LATERAL_MPS2 = 2.0

# From rest to the largest turn.
_TURN_RISE_S = 1.0

# Added to half of the vehicle's length, towards every edge of the area.
_MARGIN_M = 0.5
_SHORTEST_S = 15.0
_RAISED = 2.0
"""Factor on the limits to see whether a harder drive would tell more."""
LONGEST_S = 3600.0


@dataclass(frozen=True)
class Limits:
    """Upper limits of a plan's commands.

    Attributes:
        speed_mps: forward or backward.
        turn: yaw rate [rad/s], or steering angle [rad] on a car.
        acceleration_mps2: of the commanded speed.
        turn_rate: change of the commanded turn per second.
        lateral_mps2: speed times yaw rate.
        yaw_rate_radps: on a car, whose turn is a steering angle; infinite if not limited.
    """

    speed_mps: float
    turn: float
    acceleration_mps2: float
    turn_rate: float
    lateral_mps2: float = _LATERAL_MPS2
    yaw_rate_radps: float = math.inf

    def format(self, *, steered: bool) -> str:
        """All limits with their units; ``steered`` on a car, whose turn is a steering angle."""
        turn = "rad of steering" if steered else "rad/s"
        texts = [
            f"{self.speed_mps:.3g} m/s",
            f"{self.turn:.3g} {turn}",
            f"{self.acceleration_mps2:.3g} m/s^2",
        ]
        texts.append(f"{self.turn_rate:.3g} {'rad/s of steering' if steered else 'rad/s^2'}")
        return ", ".join([*texts, f"{self.lateral_mps2:.3g} m/s^2 sideways"])

    def raise_within(self, vehicle: Vehicle) -> tuple["Limits", str]:
        """Twice the limits, within the vehicle's own, and the options for them."""
        raised = replace(
            self,
            speed_mps=min(_RAISED * self.speed_mps, vehicle.max_speed_mps or math.inf),
            acceleration_mps2=_RAISED * self.acceleration_mps2,
            lateral_mps2=_RAISED * self.lateral_mps2,
        )
        if not is_steered(vehicle):
            turn = min(_RAISED * self.turn, vehicle.max_yaw_rate_radps or math.inf)
            raised = replace(raised, turn=turn, turn_rate=turn / _TURN_RISE_S)
        pairs = {
            "--max-speed": (raised.speed_mps, self.speed_mps),
            "--max-yaw-rate": (raised.turn, self.turn),
            "--max-acceleration": (raised.acceleration_mps2, self.acceleration_mps2),
            "--max-lateral": (raised.lateral_mps2, self.lateral_mps2),
        }
        return raised, " ".join(f"{name} {new:.3g}" for name, (new, old) in pairs.items() if new > old)


def is_steered(vehicle: Vehicle) -> bool:
    """Whether a turn is a steering angle."""
    return vehicle.kinematics.has_inputs("speed", "steering")


@dataclass(frozen=True)
class DrivenRange:
    """What the driving of runs reached, each NaN where they hardly moved in this way.

    Attributes:
        speed_mps, yaw_rate_radps: commanded.
        acceleration_mps2: of the body, measured.
        lateral_mps2: measured speed times measured yaw rate.
    """

    speed_mps: float = math.nan
    yaw_rate_radps: float = math.nan
    acceleration_mps2: float = math.nan
    lateral_mps2: float = math.nan

    def list_used(self, limits: Limits) -> list[str]:
        """Limits that are what the runs reached, in words."""
        pairs = {
            "speed": (self.speed_mps, limits.speed_mps),
            "yaw rate": (self.yaw_rate_radps, limits.turn),
            "acceleration": (self.acceleration_mps2, limits.acceleration_mps2),
            "sideways": (self.lateral_mps2, limits.lateral_mps2),
        }
        return [name for name, (reached, limit) in pairs.items() if reached == limit]


def choose_limits(
    vehicle: Vehicle,
    reached: DrivenRange | None = None,
    *,
    speed_mps: float | None = None,
    yaw_rate_radps: float | None = None,
    acceleration_mps2: float | None = None,
    lateral_mps2: float | None = None,
) -> Limits:
    """Limits of the request, else what the runs reached, else of the preset, else usual ones.

    Args:
        vehicle: with its preset's limits.
        reached: by the driving of the runs so far; None without a run.
        speed_mps: requested limit; never above the preset's.
        yaw_rate_radps: requested limit; never above the preset's.
        acceleration_mps2: requested limit.
        lateral_mps2: requested limit of speed times yaw rate.

    Raises:
        PlanError: ``no_limits``, the largest speed of the vehicle is not known.
    """
    driven = reached or DrivenRange()

    def choose(asked: float | None, done: float, most: float | None, usual: float) -> float:
        wanted = asked or (done if math.isfinite(done) else most or usual)
        return min(wanted, most or math.inf)

    speed = choose(speed_mps, driven.speed_mps, vehicle.max_speed_mps, math.inf)
    if math.isinf(speed):
        what = "the largest speed of the vehicle is not known"
        raise PlanError("no_limits", what, where=vehicle.id, hint="Give --max-speed.")
    usual = min(_USUAL_ACCELERATION_MPS2, speed)
    acceleration = choose(acceleration_mps2, driven.acceleration_mps2, None, usual)
    lateral = choose(lateral_mps2, driven.lateral_mps2, None, _LATERAL_MPS2)
    if is_steered(vehicle):
        turn = vehicle.max_steering_rad or _USUAL_STEERING_RAD
        rate = yaw_rate_radps or math.inf
        return Limits(speed, turn, acceleration, turn / _TURN_RISE_S, lateral, rate)
    fastest = 2.0 * speed / (vehicle.track_width_m or 1.0)
    usual = min(_USUAL_YAW_RATE_RADPS, fastest)
    turn = choose(yaw_rate_radps, driven.yaw_rate_radps, vehicle.max_yaw_rate_radps, usual)
    if vehicle.max_yaw_rate_radps is None and math.isnan(driven.yaw_rate_radps):
        turn = min(turn, fastest)
    return Limits(speed, turn, acceleration, turn / _TURN_RISE_S, lateral)


@dataclass(frozen=True)
class Area:
    """A rectangle centred at the start, its first side along the initial heading.

    Attributes:
        length_m, width_m: its sides.
        margin_m: distance that base_link keeps from every edge.
    """

    length_m: float
    width_m: float
    margin_m: float = _MARGIN_M

    def holds(self, path: Complex) -> bool:
        """Whether all positions x + iy [m] from the start lie inside, with the margin."""
        x, y = 0.5 * self.length_m - self.margin_m, 0.5 * self.width_m - self.margin_m
        return bool((np.abs(path.real) <= x).all() and (np.abs(path.imag) <= y).all())


def parse_area(text: str, vehicle: Vehicle) -> Area:
    """Parse ``20x10m``: length and width in metres.

    Raises:
        PlanError: ``bad_area``, malformed text, or an area smaller than the vehicle with its margin.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*x\s*(\d+(?:\.\d+)?)\s*m?\s*", text)
    body = max(vehicle.wheelbase_m or 0.0, vehicle.track_width_m or 0.0)
    margin = _MARGIN_M + 0.5 * body
    if match is None or min(float(match[1]), float(match[2])) <= 2.0 * margin:
        what = f"the area {text!r} is not a length and width in metres of more than {2.0 * margin:.1f} m"
        raise PlanError("bad_area", what, where="--area", hint="Write it like 20x10m.")
    return Area(float(match[1]), float(match[2]), margin)


def parse_time(text: str) -> float:
    """Parse ``60s``, ``2min`` or a plain number into seconds.

    Raises:
        PlanError: ``bad_time``, malformed text, or a time outside 15 s to an hour.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(s|min)?\s*", text)
    seconds = float(match[1]) * (60.0 if match[2] == "min" else 1.0) if match is not None else 0.0
    if not _SHORTEST_S <= seconds <= LONGEST_S:
        what = f"{text!r} is not a time of {_SHORTEST_S:g} s to {LONGEST_S / 60.0:g} min"
        raise PlanError("bad_time", what, where="--time", hint="Write it like 60s.")
    return seconds


# The library of manoeuvres: short sequences of body commands that end where they began.
#
# Every manoeuvre drives out and back: the commands of the return are those of the way out in reverse order,
# with the sign of the speed inverted. An ideal vehicle retraces its path, so that manoeuvres can follow each
# other in any order inside a small area, and each contains both signs of every command.

RATE_HZ = 20.0
LEAD_S = 3.0
"""Duration of zero commands before the first motion [s]."""
TAIL_S = 1.0
"""Duration of zero commands at the end [s], added to the rest of the last manoeuvre."""
REST_S = 1.0
"""Duration of zero commands after every manoeuvre [s]: delayed responses settle before the next begins."""
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
        """Times since the first command [s], shape (n,)."""
        return np.arange(self.speed.size) / RATE_HZ

    @property
    def duration_s(self) -> float:
        """Time until the last command ends."""
        return self.speed.size / RATE_HZ


@dataclass(frozen=True)
class Manoeuvre:
    """A descriptive name and the commands, including the rest at the end."""

    name: str
    commands: Commands


def wait(seconds: float) -> Commands:
    """Zero commands for a duration."""
    zeros = np.zeros(round(seconds * RATE_HZ))
    return Commands(zeros, zeros)


def join(pieces: Sequence[Commands]) -> Commands:
    """Concatenate commands."""
    return Commands(np.concatenate([p.speed for p in pieces]), np.concatenate([p.turn for p in pieces]))


def list_manoeuvres(vehicle: Vehicle, limits: Limits) -> tuple[Manoeuvre, ...]:
    """All manoeuvres of a vehicle within its limits; a car has none that turn on the spot."""
    steered = is_steered(vehicle)
    manoeuvres: list[Manoeuvre] = []

    def add(name: str, *stages: tuple[float, float, float], end: str = "") -> None:
        there = hold_within(stages, vehicle, limits)
        # Values that are reached: with short stages and narrow limits some targets are not.
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
    # Targets that are not reached can make several manoeuvres identical.
    different = {(one.commands.speed.tobytes(), one.commands.turn.tobytes()): one for one in manoeuvres}
    return tuple(different.values())


def hold_within(stages: Sequence[tuple[float, float, float]], vehicle: Vehicle, limits: Limits) -> Commands:
    """Targets of (speed, turn, seconds), each held for its duration, one after the other."""
    counts = [round(seconds * RATE_HZ) for _, _, seconds in stages]
    return _limit(
        np.repeat([speed for speed, _, _ in stages], counts),
        np.repeat([turn for _, turn, _ in stages], counts),
        vehicle,
        limits,
    )


def _sweep(speed: float, turn: float) -> tuple[Floats, Floats]:
    """Constant speed with a turn that oscillates at increasing frequency."""
    time = np.arange(round(_SWEEP_S * RATE_HZ)) / RATE_HZ
    low, high = _SWEEP_HZ
    phase = 2.0 * np.pi * (low * time + 0.5 * (high - low) * time**2 / _SWEEP_S)
    return np.full(time.size, speed), turn * np.sin(phase)


def _limit(speed: Floats, turn: Floats, vehicle: Vehicle, limits: Limits) -> Commands:
    """Apply the limits to targets: ramps from and to rest, smaller turns at higher speed."""
    rate = limit_yaw_rate(speed, vehicle, limits)
    held = np.clip(turn, -rate, rate)
    # Leaves room for the slowest ramp to zero after the last target.
    slowest = max(limits.speed_mps / limits.acceleration_mps2, limits.turn / limits.turn_rate)
    room = np.zeros(int(np.ceil(RATE_HZ * slowest)) + 1)
    speeds = _ramp(np.append(speed, room), limits.acceleration_mps2 / RATE_HZ)
    turns = _ramp(np.append(held, room), limits.turn_rate / RATE_HZ)
    rate = limit_yaw_rate(speeds, vehicle, limits)
    # The turn lags behind because of its ramp: it is cut only where a lower speed allows more anyway.
    turns = np.clip(turns, -rate, rate)
    last = np.flatnonzero((speeds != 0.0) | (turns != 0.0))
    end = int(last[-1]) + 2 if last.size else 1
    return Commands(speeds[:end], turns[:end])


def limit_yaw_rate(speed: Floats, vehicle: Vehicle, limits: Limits) -> Floats:
    """Largest turn at each speed, by the vehicle's own limit and the lateral acceleration."""
    fast = np.maximum(np.abs(speed), 1e-6)
    rate = np.minimum(limits.lateral_mps2 / fast, limits.yaw_rate_radps)
    if not is_steered(vehicle):
        return np.minimum(rate, limits.turn)
    return np.minimum(np.arctan(rate * (vehicle.wheelbase_m or 1.0) / fast), limits.turn)


def _ramp(target: Floats, step: float) -> Floats:
    """Follow a target from zero, by at most one step per command."""
    values = np.empty_like(target)
    value = 0.0
    for index, wanted in enumerate(target.tolist()):
        value += min(max(wanted - value, -step), step)
        values[index] = value
    return values


def _go_and_return(there: Commands, *, steered: bool) -> Commands:
    """Drive out and back: a yaw rate changes its sign with the speed, a steering angle does not."""
    sign = 1.0 if steered else -1.0
    back = Commands(-there.speed[::-1], sign * there.turn[::-1])
    return join((there, back, wait(REST_S)))
