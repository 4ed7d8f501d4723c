"""From commands to wheels, effect by effect in the order they act, and the motors that turn them."""

import math
from collections.abc import Mapping

import numpy as np

from pipeline.core import Floats
from pipeline.simulate.facts import Effects, Vehicle
from pipeline.simulate.programs import follow, hold_on_grid, lag_signal, limit_rate
from pipeline.simulate.scenario import Commands, Drive

# From commands to wheels: limits, deadband, delay, reversal, rate limit, lags and droop, in that order.
#
# Static limits act on the commands at their own stamps, so that nothing depends on the integration step
# there.

TURNING_MPS = 0.01
"""Speed of a wheel's rim [m/s] above which it turns: grade and drag act on wheels that turn."""
_STEPS = 8
"""Steps of the integration of a spring and a damper, or of motors, in one cell."""
_SMOOTHER_S = 0.005
_SMOOTHED_S = 5.0
"""A smoother speaks so often, and as long beyond the last command."""


CORNERS = ("front_left", "front_right", "rear_left", "rear_right")
_TURNS = {"front_left": -1.0, "front_right": 1.0, "rear_left": -1.0, "rear_right": 1.0}
_PUSHES = {"front_left": -1.0, "front_right": 1.0, "rear_left": 1.0, "rear_right": -1.0}


def invert_corners(vehicle: Vehicle, speed: Floats, sideways: Floats, turn: Floats) -> dict[str, Floats]:
    """Speeds [rad/s] of the four wheels that the controller asks for, by place, each of shape (n,)."""
    turning = vehicle.lever_m * vehicle.controller_track_multiplier * turn
    return {
        corner: (speed + _PUSHES[corner] * sideways + _TURNS[corner] * turning) / vehicle.wheel_radius_m
        for corner in CORNERS
    }


def move_by_corners(vehicle: Vehicle, corners: Mapping[str, Floats]) -> tuple[Floats, Floats, Floats]:
    """Speed ahead and to the left [m/s] and yaw rate [rad/s] of four wheels [rad/s], each of shape (n,)."""
    rims = {corner: 0.25 * vehicle.wheel_radius_m * corners[corner] for corner in CORNERS}
    ahead = sum((rims[corner] for corner in CORNERS), start=np.zeros_like(rims["front_left"]))
    aside = sum((_PUSHES[corner] * rims[corner] for corner in CORNERS), start=np.zeros_like(ahead))
    turning = sum((_TURNS[corner] * rims[corner] for corner in CORNERS), start=np.zeros_like(ahead))
    return ahead, aside, turning / vehicle.lever_m


def invert_ideal_model(vehicle: Vehicle, speed: Floats, turn: Floats) -> tuple[Floats, Floats]:
    """Wheel speeds (left, right) [rad/s] that the ideal vehicle needs for a body command, each of shape (n,).

    A differential vehicle's controller uses its own multiple of the track; on a car both wheels are the rear
    axle and the turn does not enter.
    """
    if vehicle.kind == "ackermann":
        return speed / vehicle.wheel_radius_m, speed / vehicle.wheel_radius_m
    half = vehicle.lever_m * vehicle.controller_track_multiplier
    return (speed - half * turn) / vehicle.wheel_radius_m, (speed + half * turn) / vehicle.wheel_radius_m


def apply_ideal_model(
    vehicle: Vehicle, left: Floats, right: Floats, steering: Floats
) -> tuple[Floats, Floats]:
    """Ideal speed [m/s] and yaw rate [rad/s] of wheel speeds [rad/s] and steering [rad], shape (n,) each."""
    speed = 0.5 * vehicle.wheel_radius_m * (left + right)
    if vehicle.kind == "ackermann":
        return speed, speed * np.tan(steering) / vehicle.wheelbase_m
    return speed, vehicle.wheel_radius_m * (right - left) / (2.0 * vehicle.lever_m)


def drive_wheels(
    commands: Commands,
    vehicle: Vehicle,
    effects: Effects,
    *,
    hold_s: float,
    step_s: float,
    cell_count: int,
    pitch: Floats | None = None,
) -> Drive:
    """Run the commands through the drivetrain.

    Args:
        commands: body commands at their stamps.
        vehicle: geometry.
        effects: which of the drivetrain's effects act.
        hold_s: the controller stops this long after its last command [s].
        step_s: cell width [s].
        cell_count: number of cells.
        pitch: of the body, nose down above zero [rad], shape (cell_count,); None on level ground.
    """
    commands = _smooth(_stop_when_silent(commands, hold_s), vehicle, effects)
    speed, turn = _limit_body(commands, vehicle, effects)
    deadband = effects.value("deadband", "d")
    charge = 1.0 - effects.value("gain_drift", "k") * (np.arange(cell_count) + 0.5) / cell_count

    def hold(values: Floats) -> Floats:
        return hold_on_grid(
            commands.time_s,
            values,
            delay_s=effects.value("transport_delay", "d"),
            step_s=step_s,
            cell_count=cell_count,
        )

    def turn_wheel(asked: Floats) -> Floats:
        heard = np.where(np.abs(asked) * vehicle.wheel_radius_m < deadband, 0.0, asked)
        top = effects.value("wheel_speed_limit", "limit")
        wheel: Floats = np.clip(hold(heard), -top, top)
        if effects.is_active("reversal_pause"):
            wheel = _rest_at_reversal(wheel, effects.value("reversal_pause", "d"), step_s)
        if effects.is_active("acceleration_limit"):
            wheel = limit_rate(wheel, per_second=effects.value("acceleration_limit", "limit"), step_s=step_s)
        wheel = effects.value("drive_gain", "g") * charge * wheel
        lost = effects.value("load_droop", "d") / vehicle.wheel_radius_m
        wheel = np.sign(wheel) * np.maximum(np.abs(wheel) - lost, 0.0)
        if pitch is not None:
            wheel = _load(wheel, pitch, vehicle.wheel_radius_m, effects.value("grade_load", "k"))
        wheel = lag_signal(wheel, tau_s=effects.value("drive_lag", "tau"), step_s=step_s)
        for name, loop in (("torque_limit", _pull), ("brake_lag", _brake), ("drive_overshoot", _swing)):
            wheel = loop(wheel, effects, step_s) if effects.is_active(name) else wheel
        return wheel

    if vehicle.moves_sideways:
        corners = invert_corners(vehicle, speed, commands.sideways, turn)
        asked = dict(zip(corners, _slow_alike(np.array([*corners.values()]), effects), strict=True))
        turned = {corner: turn_wheel(wheel) for corner, wheel in asked.items()}
        return _join_corners(turned, effects, step_s)
    on_left, on_right = invert_ideal_model(vehicle, speed, turn)
    if vehicle.kind == "ackermann":
        axle = turn_wheel(on_left)
        return Drive(step_s, axle, axle, _steer(hold(turn), effects, step_s))
    left, right = map(turn_wheel, _slow_alike(np.array([on_left, on_right]), effects))
    if effects.is_active("wheel_servo"):
        left, right = turn_by_motors(vehicle, left, right, effects, step_s)
    left, right = _couple_sides(left, right, effects, step_s)
    return Drive(step_s, left, right, np.zeros(cell_count))


def _slow_alike(asked: Floats, effects: Effects) -> Floats:
    """Speeds of wheels [rad/s], shape (wheels, n), scaled down together to a limit of the fastest."""
    fastest = np.maximum(np.abs(asked).max(axis=0), 1e-9)
    scaled: Floats = asked * np.minimum(1.0, effects.value("wheel_speed_scaling", "limit") / fastest)
    return scaled


def _load(wheel: Floats, pitch: Floats, radius_m: float, load_mps: float) -> Floats:
    """Speed of a wheel [rad/s] that turns on a slope; a vertical one would take `load_mps` of its rim."""
    pull = load_mps * np.sin(pitch) / radius_m
    return wheel + np.where(np.abs(wheel) * radius_m > TURNING_MPS, pull, 0.0)


def _rest_at_reversal(asked: Floats, rest_s: float, step_s: float) -> Floats:
    """A wheel that stands for so long whenever it is asked for another direction than it had last."""
    direction, until, speeds = 0.0, -1, []
    for cell, speed in enumerate(asked.tolist()):
        if speed * direction < 0.0:
            until = cell + round(rest_s / step_s)
        direction = speed or direction
        speeds.append(0.0 if cell < until else speed)
    return np.array(speeds)


def _pull(asked: Floats, effects: Effects, step_s: float) -> Floats:
    """A wheel that a motor of limited torque pulls towards what it is asked for, by Euler's method."""
    short = step_s / _STEPS
    rate, most = (
        short / max(effects.value("torque_limit", "tau"), short),
        short * effects.value("torque_limit", "limit"),
    )

    def step(now: float, goal: float) -> float:
        for _ in range(_STEPS):
            now += min(max(rate * (goal - now), -most), most)
        return now

    return follow(asked, step)


def _brake(asked: Floats, effects: Effects, step_s: float) -> Floats:
    """A wheel that speeds up with one time constant and slows down with another."""
    up, down = (
        -np.expm1(-step_s / tau) if tau > 0.0 else 1.0
        for tau in (effects.value("brake_lag", "tau_drive"), effects.value("brake_lag", "tau_brake"))
    )

    def step(now: float, goal: float) -> float:
        slows = now * goal < 0.0 or abs(goal) < abs(now)
        then = now + (down if slows else up) * (goal - now)
        # Braked, it comes to rest before it speeds up the other way.
        return then if then * now >= 0.0 else 0.0

    return follow(asked, step)


def _swing(asked: Floats, effects: Effects, step_s: float) -> Floats:
    """A wheel on a spring and a damper towards what it is asked for, by Euler's method, speeds last."""
    short = step_s / _STEPS
    tau = max(effects.value("drive_overshoot", "tau"), short)
    damping, pace = effects.value("drive_overshoot", "damping"), 0.0
    damping = 1.0 if math.isnan(damping) else damping

    def step(now: float, goal: float) -> float:
        nonlocal pace
        for _ in range(_STEPS):
            pace += short * (goal - now - 2.0 * damping * tau * pace) / tau**2
            now += short * pace
        return now

    return follow(asked, step)


def _join_corners(corners: dict[str, Floats], effects: Effects, step_s: float) -> Drive:
    """Four wheels whose sides are coupled as those of any vehicle: what is sideways lags like the mean."""
    sides = [0.5 * (corners[f"front_{side}"] + corners[f"rear_{side}"]) for side in ("left", "right")]
    left, right = _couple_sides(sides[0], sides[1], effects, step_s)
    rest = {corner: corners[corner] - sides[corner.endswith("right")] for corner in CORNERS}
    slow = effects.value("turn_lag", "tau_mean")
    rest = {corner: lag_signal(part, tau_s=slow, step_s=step_s) for corner, part in rest.items()}
    coupled = {corner: (right if corner.endswith("right") else left) + rest[corner] for corner in CORNERS}
    return Drive(step_s, left, right, np.zeros_like(left), coupled)


def _stop_when_silent(commands: Commands, hold_s: float) -> Commands:
    time = commands.time_s
    silent = np.flatnonzero(np.diff(time, append=np.inf) > hold_s)
    at = silent + 1
    return Commands(
        np.insert(time, at, time[silent] + hold_s),
        np.insert(commands.speed_mps, at, 0.0),
        np.insert(commands.turn, at, 0.0),
        None if commands.sideways_mps is None else np.insert(commands.sideways_mps, at, 0.0),
    )


def _smooth(commands: Commands, vehicle: Vehicle, effects: Effects) -> Commands:
    """Commands as a smoother passes them on, often enough to look like a ramp."""
    most_v = effects.value("body_acceleration_limit", "limit")
    # The limit is on the yaw rate that the wheels give, not on that which their controller widens.
    most_w = effects.value("turn_acceleration_limit", "limit") / vehicle.controller_track_multiplier
    if math.isinf(most_v) and math.isinf(most_w):
        return commands
    time = commands.time_s
    often = np.union1d(time, np.arange(time[0], time[-1] + _SMOOTHED_S, _SMOOTHER_S))
    held = np.searchsorted(time, often, side="right") - 1
    passed = np.diff(often, prepend=often[0])

    def ramp(values: Floats, most: float) -> Floats:
        now, out = 0.0, []
        for goal, since in zip(values[held].tolist(), passed.tolist(), strict=True):
            now += min(max(goal - now, -most * since), most * since) if math.isfinite(most) else goal - now
            out.append(now)
        return np.array(out)

    sideways = commands.sideways_mps
    return Commands(
        often,
        ramp(commands.speed_mps, most_v),
        ramp(commands.turn, most_w),
        None if sideways is None else sideways[held],
    )


def _limit_body(commands: Commands, vehicle: Vehicle, effects: Effects) -> tuple[Floats, Floats]:
    fastest = effects.value("body_speed_limit", "limit")
    sharpest = effects.value("body_turn_limit", "limit")
    speed = np.clip(commands.speed_mps, -fastest, fastest)
    turn = commands.turn
    if vehicle.kind != "ackermann":
        return speed, np.clip(turn, -sharpest, sharpest)
    if effects.is_active("body_turn_limit"):
        moving = np.maximum(np.abs(speed), 1e-9)
        widest = np.arctan(sharpest * vehicle.wheelbase_m / moving)
        turn = np.clip(turn, -widest, widest)
    return speed, turn


def _couple_sides(left: Floats, right: Floats, effects: Effects, step_s: float) -> tuple[Floats, Floats]:
    if not any(
        map(effects.is_active, ("turn_lag", "side_lag", "turn_droop", "difference_gain", "side_gain"))
    ):
        return left, right
    mean, difference = 0.5 * (left + right), right - left
    mean = lag_signal(mean, tau_s=effects.value("turn_lag", "tau_mean"), step_s=step_s)
    difference = lag_signal(difference, tau_s=effects.value("turn_lag", "tau_diff"), step_s=step_s)
    weak = [effects.value("side_lag", name) for name in ("tau_left", "tau_right")]
    if max(weak) > 0.0:
        sides = [
            lag_signal(side, tau_s=tau, step_s=step_s)
            for side, tau in zip((mean - 0.5 * difference, mean + 0.5 * difference), weak, strict=True)
        ]
        mean, difference = 0.5 * (sides[0] + sides[1]), sides[1] - sides[0]
    if effects.is_active("turn_droop"):
        threshold = float(np.nan_to_num(effects.value("turn_droop", "threshold")))
        held = np.clip(difference, -threshold, threshold)
        difference = held + effects.value("turn_droop", "gain") * (difference - held)
    difference = effects.value("difference_gain", "g") * difference
    uneven = 0.5 * effects.value("side_gain", "e")
    return (1.0 - uneven) * (mean - 0.5 * difference), (1.0 + uneven) * (mean + 0.5 * difference)


def _steer(asked: Floats, effects: Effects, step_s: float) -> Floats:
    angle = effects.value("steering_gain", "g") * asked
    if effects.is_active("steering_rate_limit"):
        angle = limit_rate(angle, per_second=effects.value("steering_rate_limit", "limit"), step_s=step_s)
    angle = lag_signal(angle, tau_s=effects.value("steering_lag", "tau"), step_s=step_s)
    return _play(angle, effects.value("steering_play", "g")) + effects.value("steering_offset", "o")


def steer_tyres(sensed: Floats, effects: Effects) -> Floats:
    """Angle of the tyres [rad] for that which a sensor reads, shape (n,)."""
    tyres = _play(sensed, effects.value("steering_sensor_play", "g"))
    return tyres + effects.value("steering_sensor_offset", "o")


def _play(angle: Floats, half: float) -> Floats:
    return follow(angle, lambda now, asked: min(max(now, asked - half), asked + half)) if half else angle


# Motors under speed controllers, one a side: proportional and integral gain, bounded force, and the ground.
#
# The equations are stiff. A step takes the force of a contact over its slip as at its beginning, and all else
# as at its end: four linear equations, of which those of the rims are eliminated.

_STEP_S = 5e-4
"""Longest step of the integration [s]."""
_SHORTEST_TAU_S = 0.01
_ROTATING = 0.7
"""Inertia of the rotating parts over that of the vehicle."""
_ALL = 1.0 + _ROTATING
_ASIDE = math.sqrt(0.75)
"""How far ahead and behind contacts are, over half the track width."""
_SIGN_MPS = 0.05
"""Rolling resistance reaches its full size well above this speed."""
_LEAST_SLIP = 0.01
"""Slip over scrub well below which the force of a wheel at rest is in proportion to its slip."""
_STILL_MPS = 1e-6
"""Commanded speed of a rim that is nothing but rounding."""


def turn_by_motors(
    vehicle: Vehicle, left: Floats, right: Floats, effects: Effects, step_s: float
) -> tuple[Floats, Floats]:
    """Wheel speeds (left, right) [rad/s] that motors reach of those asked for, each of shape (n,)."""
    count = max(1, math.ceil(step_s / _STEP_S - 1e-9))
    motors = _Motors(effects, step_s / count)
    radius, rows = vehicle.wheel_radius_m, []
    for on_left, on_right in zip((radius * left).tolist(), (radius * right).tolist(), strict=True):
        left_sum = right_sum = 0.0
        for _ in range(count):
            left_sum, right_sum = left_sum + 0.5 * motors.left, right_sum + 0.5 * motors.right
            motors.step(on_left, on_right)
            left_sum, right_sum = left_sum + 0.5 * motors.left, right_sum + 0.5 * motors.right
        rows.append((left_sum, right_sum))
    reached = np.array(rows).reshape(-1, 2) / (count * radius)
    return reached[:, 0], reached[:, 1]


class _Motors:
    """Motors of both sides, which start from rest, and the vehicle as their load.

    Attributes:
        left, right: speeds of the rims [m/s].
    """

    def __init__(self, effects: Effects, step_s: float) -> None:
        self.left = self.right = 0.0
        # The vehicle's speed ahead, and that of a side of it around its middle [m/s]; integral parts [m/s].
        self._ahead = self._turning = 0.0
        self._left_memory = self._right_memory = 0.0
        self._step_s = step_s
        self._load = max(effects.value("wheel_servo", "tau"), _SHORTEST_TAU_S) / step_s
        names = ("reset", "drag", "bound", "no_load", "scrub", "creep")
        self._reset, self._drag, self._bound, self._no_load, self._scrub, self._creep = (
            effects.value("wheel_servo", name) for name in names
        )
        uneven = effects.value("motor_imbalance", "e")
        self._left_supply, self._right_supply = 1.0 - uneven / 2.0, 1.0 + uneven / 2.0

    def step(self, on_left: float, on_right: float) -> None:
        """One step under the commanded speeds of the rims [m/s]."""
        if max(abs(on_left), abs(on_right)) < _STILL_MPS:
            self._left_memory = self._right_memory = 0.0
            reset = 0.0
        else:
            reset = self._step_s * self._reset
        ahead, turned, load = self._ahead, self._turning, self._load
        left_resistance, left_pull, left_error = self._drive(
            self.left, on_left, self._left_memory, self._left_supply
        )
        right_resistance, right_pull, right_error = self._drive(
            self.right, on_right, self._right_memory, self._right_supply
        )
        left_grip = self._grip(self.left, self.left - ahead + turned)
        right_grip = self._grip(self.right, self.right - ahead - turned)
        left_all, right_all = left_resistance + 2.0 * left_grip, right_resistance + 2.0 * right_grip
        # The force of the ground is a share of what the pull exceeds the resistance by at the ground's speed.
        left_share, right_share = left_grip / left_all, right_grip / right_all
        uneven = right_share * right_resistance - left_share * left_resistance
        straight = load + left_share * left_resistance + right_share * right_resistance
        turning = straight + _ASIDE**2 * (left_grip + right_grip)
        thrust = load * ahead + right_share * right_pull + left_share * left_pull
        moment = load * turned + right_share * right_pull - left_share * left_pull
        whole = straight * turning - uneven * uneven
        self._ahead = ahead = (turning * thrust - uneven * moment) / whole
        self._turning = turned = (straight * moment - uneven * thrust) / whole
        self.left = (left_pull + 2.0 * left_grip * (ahead - turned)) / left_all
        self.right = (right_pull + 2.0 * right_grip * (ahead + turned)) / right_all
        self._left_memory += reset * left_error
        self._right_memory += reset * right_error

    def _drive(self, rim: float, asked: float, memory: float, supply: float) -> tuple[float, float, float]:
        """Resistance and pull of a side, and the error that its controller integrates [m/s].

        At the end of the step, speed times resistance is the pull less twice the force of the ground.
        """
        inertia, error = _ROTATING * self._load, asked - rim
        push = error + memory
        # Half of what changes with the rim's speed is taken at the beginning of the step.
        braking = 0.5 * _ALL * self._drag / math.hypot(rim, _SIGN_MPS)
        resistance, pull = inertia + braking, (inertia - braking) * rim
        # A motor turns against its supply with what its own speed leaves of the voltage.
        left_over = supply - math.copysign(1.0, push) * rim / self._no_load
        most = math.inf if math.isinf(self._bound) else self._bound * max(left_over, 0.0)
        if abs(push) < most:
            return resistance + 0.5 * _ALL, pull + _ALL * (push + 0.5 * rim), error
        pull += _ALL * math.copysign(most, push)
        return resistance, pull, error if error * push < 0.0 else 0.0

    def _grip(self, rim: float, slip: float) -> float:
        """Force of the ground on a side over its slip."""
        if self._scrub == 0.0:
            return 0.0
        sliding = math.hypot(slip, _ASIDE * self._turning) / self._scrub
        return 0.5 / math.hypot(self._creep * rim, sliding, _LEAST_SLIP)
