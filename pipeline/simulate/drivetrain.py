"""From commands to wheels, effect by effect in the order they act, and the motors that turn them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.simulate.facts import Effects, Vehicle
from pipeline.simulate.programs import Commands, follow, hold_on_grid, integrate_cells, lag_signal, limit_rate

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


@dataclass(frozen=True)
class Drive:
    """What the drivetrain does, on cells of ``step_s``.

    Attributes:
        step_s: cell width [s].
        left, right: true wheel speeds [rad/s], shape (n,); equal on a car, whose rear axle they are; means of
            a side on mecanum wheels.
        steering: true steering angle [rad], shape (n,); zero on a differential vehicle.
        corners: true speeds of mecanum wheels by place; on omni wheels those of wheels at the corners of the
            same body motion; None on a vehicle that cannot move sideways.
    """

    step_s: float
    left: Floats
    right: Floats
    steering: Floats
    corners: Mapping[str, Floats] | None = None

    def wheel_angles(self) -> tuple[Floats, Floats]:
        """Turned angles [rad] of left and right wheels at the cell edges, each of shape (n + 1,)."""
        return integrate_cells(self.left, step_s=self.step_s), integrate_cells(self.right, step_s=self.step_s)


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
        wheel = effects.value("drive_gain", "g") * wheel
        if pitch is not None:
            wheel = _load(wheel, pitch, vehicle.wheel_radius_m, effects.value("grade_load", "k"))
        wheel = lag_signal(wheel, tau_s=effects.value("drive_lag", "tau"), step_s=step_s)
        if effects.is_active("brake_lag"):
            wheel = _brake(wheel, effects, step_s)
        return _swing(wheel, effects, step_s) if effects.is_active("drive_overshoot") else wheel

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
    if effects.is_active("speed_servo") or effects.is_active("turn_servo"):
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
    angle = lag_signal(angle, tau_s=effects.value("steering_lag", "tau"), step_s=step_s)
    if effects.is_active("steering_play"):
        half = effects.value("steering_play", "g")
        angle = follow(angle, lambda now, asked: min(max(now, asked - half), asked + half))
    return angle + effects.value("steering_offset", "o")


# Motors under a speed controller: proportional and integral gain, bounded effort, friction of the ground.
#
# Integrated by Euler's method in steps much shorter than what the controller answers in.

_RADIUS_FALL = 0.15
"""Turning resistance falls to 1 / (1 + 0.15 R / b) at a radius R, with a track width b."""

_STILL_RADPS = 1e-6
"""Commanded yaw rate [rad/s] that is nothing but rounding."""


def turn_by_motors(
    vehicle: Vehicle, left: Floats, right: Floats, effects: Effects, step_s: float
) -> tuple[Floats, Floats]:
    """Wheel speeds (left, right) [rad/s] that motors reach of those asked for, each of shape (n,)."""
    radius, width = vehicle.wheel_radius_m, 2.0 * vehicle.lever_m
    speed, turn = 0.5 * radius * (left + right), radius * (right - left) / width
    if effects.is_active("speed_servo"):
        speed = _push(speed, effects, step_s)
    if effects.is_active("turn_servo"):
        turn = _twist(turn, np.abs(speed) / width, effects, step_s)
    return (speed - 0.5 * width * turn) / radius, (speed + 0.5 * width * turn) / radius


def _push(asked: Floats, effects: Effects, step_s: float) -> Floats:
    """Speed [m/s] of a vehicle that a controller without integral part pushes against a drag."""
    short = step_s / _STEPS
    gain = 1.0 / max(effects.value("speed_servo", "tau"), short)
    drag = gain * effects.value("speed_servo", "drag")
    most, now, out = effects.value("speed_servo", "effort"), 0.0, []
    for goal in asked.tolist():
        total = 0.0
        for _ in range(_STEPS):
            push = min(max(gain * (goal - now), -most), most)
            now += short * (push - drag * now)
            total += now
        out.append(total / _STEPS)
    return np.array(out)


def _twist(asked: Floats, ahead: Floats, effects: Effects, step_s: float) -> Floats:
    """Yaw rate of the wheels [rad/s] that a controller twists against the friction of a turn.

    Without a command the controller forgets what it has integrated.

    Args:
        asked: yaw rate [rad/s], shape (n,).
        ahead: speed over the track width [1/s], shape (n,).
        effects: of which one is the controller.
        step_s: cell width [s].
    """
    short = step_s / _STEPS
    gain = 1.0 / max(effects.value("turn_servo", "tau"), short)
    gain_i = gain * effects.value("turn_servo", "reset")
    scrub, most = gain * effects.value("turn_servo", "scrub"), effects.value("turn_servo", "effort")
    full = gain * effects.value("turn_servo", "windup")
    now = memory = 0.0
    out = []
    for goal, speed in zip(asked.tolist(), ahead.tolist(), strict=True):
        total, is_asked = 0.0, abs(goal) > _STILL_RADPS
        memory = memory if is_asked else 0.0
        for _ in range(_STEPS):
            twist = gain * (goal - now) + memory
            if is_asked and abs(twist) <= most:
                memory = min(max(memory + short * gain_i * (goal - now), -full), full)
            twist = min(max(twist, -most), most)
            # On the spot all of the friction acts from the first motion on.
            spot = abs(now) if now else 1e-9
            friction = scrub / (1.0 + _RADIUS_FALL * speed / spot)
            if now == 0.0 and abs(twist) <= friction:
                continue
            then = now + short * (twist - math.copysign(friction, now or twist))
            now = 0.0 if then * now < 0.0 and abs(twist) <= friction else then
            total += now
        out.append(total / _STEPS)
    return np.array(out)
