"""Delays and limits of a vehicle's body, out of those of its wheels and steering."""

from __future__ import annotations

import math
import operator
from typing import TYPE_CHECKING

from pipeline.models.quantity import Quantity
from pipeline.models.settings import Amount, combine

if TYPE_CHECKING:
    from pipeline.models.settings import Facts


def negate(amount: Amount) -> Amount:
    """The same limit in the other direction."""
    return amount.change(operator.neg)


def find_radius(facts: Facts) -> Amount:
    """Effective wheel radius [m]."""
    return combine(operator.mul, facts.measure("wheel_radius_m"), facts.take(Quantity.RADIUS))


def find_track(facts: Facts) -> Amount:
    """Effective track width [m]."""
    return combine(operator.mul, facts.measure("track_width_m"), facts.take(Quantity.TRACK))


def find_largest_steering(facts: Facts) -> Amount:
    """Steering angle that the largest command gives [rad]."""
    return combine(operator.mul, facts.measure("max_steering_rad"), facts.take(Quantity.STEERING_GAIN))


def find_turning_radius(facts: Facts) -> Amount:
    """Radius of the narrowest turn that a car drives to both sides [m]."""
    gain, offset = facts.take(Quantity.STEERING_GAIN), facts.take(Quantity.STEERING_OFFSET)
    angle = facts.measure("max_steering_rad").change(lambda a, g, o: g * a - abs(o), gain, offset)
    return facts.measure("wheelbase_m").change(_find_circle, angle)


def find_speed_delay(facts: Facts) -> Amount:
    """How late the speed follows a smooth command [s]: dead time and time constants add up."""
    return combine(operator.add, facts.take(Quantity.COMMAND_DELAY), facts.take(Quantity.SPEED_LAG))


def find_turn_delay(facts: Facts) -> Amount:
    """How late turning follows a smooth command [s]; on a car it is the steering that is late."""
    lag = Quantity.TURN_LAG if facts.vehicle.kind == "differential" else Quantity.STEERING_LAG
    return combine(operator.add, facts.take(Quantity.COMMAND_DELAY), facts.take(lag))


def find_speed_limit(facts: Facts) -> Amount:
    """Largest speed [m/s]: of the body command, or of the wheels driving straight."""
    wheels = facts.take(Quantity.WHEEL_SPEED_LIMIT).change(operator.mul, find_radius(facts))
    return _take_least(facts.take(Quantity.SPEED_LIMIT), wheels)


def find_turn_limit(facts: Facts) -> Amount:
    """Largest yaw rate [rad/s]: of the body command, or of the wheels turning on the spot."""
    return _take_least(facts.take(Quantity.TURN_LIMIT), _spin(facts, Quantity.WHEEL_SPEED_LIMIT))


def find_speed_acceleration(facts: Facts) -> Amount:
    """Largest acceleration [m/s^2] driving straight."""
    return facts.take(Quantity.WHEEL_ACCELERATION_LIMIT).change(operator.mul, find_radius(facts))


def find_turn_acceleration(facts: Facts) -> Amount:
    """Largest yaw acceleration [rad/s^2] turning on the spot; unknown for a car."""
    return _spin(facts, Quantity.WHEEL_ACCELERATION_LIMIT)


def find_deadband(facts: Facts) -> tuple[Amount, Amount]:
    """Speed [m/s] driving straight and yaw rate [rad/s] turning on the spot below which nothing moves."""
    rim = facts.take(Quantity.DEADBAND).change(operator.mul, facts.take(Quantity.RADIUS))
    return rim, _turn(facts, rim)


def _find_circle(wheelbase_m: float, angle_rad: float) -> float:
    """Radius that the rear axle drives; none where the car steers to one side only."""
    return wheelbase_m / math.tan(angle_rad) if angle_rad > 0.0 else math.inf


def _spin(facts: Facts, quantity: Quantity) -> Amount:
    return _turn(facts, facts.take(quantity).change(operator.mul, find_radius(facts)))


def _turn(facts: Facts, rim: Amount) -> Amount:
    """Yaw rate of a vehicle whose sides run at a speed against each other; unknown for a car."""
    if facts.vehicle.kind != "differential":
        return Amount(math.nan)
    return rim.change(lambda speed, track: 2.0 * speed / track, find_track(facts))


def _take_least(*amounts: Amount) -> Amount:
    known = [amount for amount in amounts if amount.is_known]
    return combine(min, *known) if len(known) > 1 else (known or [Amount(math.inf)])[0]
