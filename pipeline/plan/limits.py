"""What a plan may ask of a vehicle, and where it may drive."""

import math
import re
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Complex
from pipeline.models.conditions import Largest
from pipeline.plan.errors import PlanError
from pipeline.vehicles import Vehicle

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
        PlanError: ``no_limits``, nobody says how fast the vehicle may drive.
    """
    known = vehicle.max_speed_mps or (largest.speed if largest is not None and largest.speed > 0.0 else None)
    if speed_mps is None and known is None:
        what = "nobody says how fast the vehicle may drive"
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
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*x\s*(\d+(?:\.\d+)?)\s*m?\s*", text)
    body = max(vehicle.wheelbase_m or 0.0, vehicle.track_width_m or 0.0)
    margin = _MARGIN_M + 0.5 * body
    if found is None or min(float(found[1]), float(found[2])) <= 2.0 * margin:
        what = f"the area {text!r} is no length and width in metres of more than {2.0 * margin:.1f} m"
        raise PlanError("bad_area", what, where="--area", hint="Write for example --area 20x10m.")
    return Area(float(found[1]), float(found[2]), margin)


def parse_time(text: str) -> float:
    """Seconds of ``60s``, ``2min`` or a plain number.

    Raises:
        PlanError: ``bad_time``, it is no such text, or not 15 s to an hour.
    """
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(s|min)?\s*", text)
    seconds = float(found[1]) * (60.0 if found[2] == "min" else 1.0) if found is not None else 0.0
    if not _SHORTEST_S <= seconds <= _LONGEST_S:
        what = f"{text!r} is no time of {_SHORTEST_S:g} s to {_LONGEST_S / 60.0:g} min"
        raise PlanError("bad_time", what, where="--time", hint="Write for example --time 60s.")
    return seconds
