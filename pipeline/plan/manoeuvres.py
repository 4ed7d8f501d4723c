"""Five standard manoeuvres within the limits of a vehicle: speed steps, spins, circles, slalom, slow steps.

Every manoeuvre drives out and back: the commands of the return are those of the way out in reverse order,
with the sign of the speed inverted. An ideal vehicle retraces its path, so that manoeuvres can follow each
other in any order inside a small area, and each contains both signs of every command.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core import Complex, Floats, SlipError
from pipeline.models import Largest
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
# Least speed [m/s] and yaw rate [rad/s] of runs that count as driving in this way.
_MOVED = 0.05
# Added to half of the vehicle's length, towards every edge of the area.
_MARGIN_M = 0.5
_SHORTEST_S = 15.0
LONGEST_S = 3600.0
"""Longest plan, and most driving that is looked ahead."""
RATE_HZ = 20.0
REST_S = 1.0
"""Zero commands after every manoeuvre [s]: delayed responses settle before the next begins."""
_SLALOM_S = 8.0
_SLALOM_HZ = (0.15, 1.2)
"""Frequencies at the start and the end of a slalom."""


@dataclass(frozen=True)
class Limits:
    """Upper limits of a plan's commands.

    Attributes:
        speed_mps: forward or backward.
        turn: yaw rate [rad/s], or steering angle [rad] on a car.
        acceleration_mps2: of the commanded speed.
        turn_rate: change of the commanded turn per second.
        yaw_rate_radps: also on a car.
        lateral_mps2: speed times yaw rate.
    """

    speed_mps: float
    turn: float
    acceleration_mps2: float
    turn_rate: float
    yaw_rate_radps: float
    lateral_mps2: float = _LATERAL_MPS2

    def format(self, *, steered: bool) -> str:
        """All limits with their units; ``steered`` on a car, whose turn is a steering angle."""
        turn = "rad of steering" if steered else "rad/s"
        texts = (
            f"{self.speed_mps:.3g} m/s",
            f"{self.turn:.3g} {turn}",
            f"{self.acceleration_mps2:.3g} m/s^2",
        )
        return ", ".join((*texts, f"{self.lateral_mps2:.3g} m/s^2 sideways"))

    def limit_turn(self, speed: Floats, vehicle: Vehicle) -> Floats:
        """Largest turn at each speed."""
        fast = np.maximum(np.abs(speed), 1e-6)
        rate = np.minimum(self.lateral_mps2 / fast, self.yaw_rate_radps)
        if is_steered(vehicle):
            rate = np.arctan(rate * (vehicle.wheelbase_m or 1.0) / fast)
        return np.minimum(rate, self.turn)


def is_steered(vehicle: Vehicle) -> bool:
    """Whether a turn is a steering angle."""
    return vehicle.kinematics.has_inputs("speed", "steering")


def choose_limits(
    vehicle: Vehicle,
    driven: Largest | None = None,
    *,
    speed_mps: float | None = None,
    yaw_rate_radps: float | None = None,
    acceleration_mps2: float | None = None,
) -> Limits:
    """Limits of the request, else what the runs commanded, else of the preset, else usual ones.

    Args:
        vehicle: with its preset's limits, which are never exceeded.
        driven: largest commands of the runs so far; None without a run.
        speed_mps: requested limit.
        yaw_rate_radps: requested limit.
        acceleration_mps2: requested limit.

    Raises:
        PlanError: ``no_limits``, the largest speed of the vehicle is not known.
    """
    reached = (0.0, 0.0) if driven is None else (driven.speed, driven.turn)
    fast, turning = (value if value > _MOVED else None for value in reached)
    most = vehicle.max_speed_mps or math.inf
    speed = min(speed_mps or fast or most, most)
    if math.isinf(speed):
        what = "the largest speed of the vehicle is not known"
        raise PlanError("no_limits", what, where=vehicle.id, hint="Give --max-speed.")
    acceleration = acceleration_mps2 or min(_USUAL_ACCELERATION_MPS2, speed)
    most = vehicle.max_yaw_rate_radps or 2.0 * speed / (vehicle.track_width_m or 1.0)
    if is_steered(vehicle):
        turn, rate = vehicle.max_steering_rad or _USUAL_STEERING_RAD, yaw_rate_radps or math.inf
    else:
        rate = min(yaw_rate_radps or turning or vehicle.max_yaw_rate_radps or _USUAL_YAW_RATE_RADPS, most)
        turn = rate
    return Limits(speed, turn, acceleration, turn / _TURN_RISE_S, rate)


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
    margin = _MARGIN_M + 0.5 * max(vehicle.wheelbase_m or 0.0, vehicle.track_width_m or 0.0)
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


def wait(seconds: float) -> Commands:
    """Zero commands for a duration."""
    zeros = np.zeros(round(seconds * RATE_HZ))
    return Commands(zeros, zeros)


def join(pieces: Sequence[Commands]) -> Commands:
    """Concatenate commands."""
    return Commands(np.concatenate([p.speed for p in pieces]), np.concatenate([p.turn for p in pieces]))


def list_manoeuvres(vehicle: Vehicle, limits: Limits, scale: float = 1.0) -> dict[str, Commands]:
    """The manoeuvres by name, each with a rest at its end; a car has none that turns on the spot.

    Args:
        vehicle: to drive.
        limits: that no command exceeds.
        scale: share of the largest speed, to which lengths are proportional.
    """
    steered = is_steered(vehicle)
    speed, turn = scale * limits.speed_mps, limits.turn

    def return_after(*stages: tuple[float, float, float]) -> Commands:
        """Targets of (speed, turn, seconds), one after the other, and back."""
        counts = [round(seconds * RATE_HZ) for _, _, seconds in stages]
        fast, turned = (np.repeat([stage[index] for stage in stages], counts) for index in (0, 1))
        return _return(_limit(fast, turned, vehicle, limits), steered=steered)

    time = np.arange(round(_SLALOM_S * RATE_HZ)) / RATE_HZ
    low, high = _SLALOM_HZ
    swing = turn * np.sin(2.0 * np.pi * (low * time + 0.5 * (high - low) * time**2 / _SLALOM_S))
    slalom = _limit(np.full(time.size, 0.7 * speed), swing, vehicle, limits)
    radii = [[(0.7 * speed, side * share * turn, 2.0) for share in (0.25, 0.5, 1.0)] for side in (1.0, -1.0)]
    slow = [(share * speed, 0.0, 1.0) for share in (0.05, 0.1, 0.2)]
    slow += [(0.2 * speed if steered else 0.0, share * turn, 1.0) for share in (0.1, 0.2)]
    made = {
        "straight with steps of speed": return_after((0.4 * speed, 0.0, 2.0), (speed, 0.0, 3.0)),
        "spin both ways": return_after((0.0, 0.4 * turn, 2.0), (0.0, turn, 3.0)),
        "circles of three radii": join([return_after(*stages) for stages in radii]),
        "slalom": _return(slalom, steered=steered),
        "slow steps": return_after(*slow),
    }
    return {name: commands for name, commands in made.items() if not steered or "spin" not in name}


def _limit(speed: Floats, turn: Floats, vehicle: Vehicle, limits: Limits) -> Commands:
    """Apply the limits to targets: ramps from and to rest, smaller turns at higher speed."""
    # Leaves room for the slowest ramp to zero after the last target.
    slowest = max(limits.speed_mps / limits.acceleration_mps2, limits.turn / limits.turn_rate)
    room = np.zeros(int(np.ceil(RATE_HZ * slowest)) + 1)
    most = limits.limit_turn(speed, vehicle)
    speeds = _ramp(np.append(speed, room), limits.acceleration_mps2 / RATE_HZ)
    turns = _ramp(np.append(np.clip(turn, -most, most), room), limits.turn_rate / RATE_HZ)
    # The turn lags behind because of its ramp: it is cut only where a lower speed allows more anyway.
    most = limits.limit_turn(speeds, vehicle)
    turns = np.clip(turns, -most, most)
    end = int(np.flatnonzero((speeds != 0.0) | (turns != 0.0))[-1]) + 2
    return Commands(speeds[:end], turns[:end])


def _ramp(target: Floats, step: float) -> Floats:
    """Follow a target from zero, by at most one step per command."""
    values, value = np.empty_like(target), 0.0
    for index, wanted in enumerate(target.tolist()):
        value += min(max(wanted - value, -step), step)
        values[index] = value
    return values


def _return(there: Commands, *, steered: bool) -> Commands:
    """Drive out and back: a yaw rate changes its sign with the speed, a steering angle does not."""
    sign = 1.0 if steered else -1.0
    return join((there, Commands(-there.speed[::-1], sign * there.turn[::-1]), wait(REST_S)))
