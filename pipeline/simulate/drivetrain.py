"""From commands to wheels, and from wheels to body velocity, effect by effect in the order they act."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.simulate.facts import Effects, Vehicle
from pipeline.simulate.motors import turn_by_motors
from pipeline.simulate.programs import (
    Commands,
    filter_pole,
    follow,
    hold_on_grid,
    integrate_cells,
    lag_signal,
    limit_rate,
    make_coloured_noise,
)
from pipeline.simulate.scenario import Disturbance

# From commands to wheels: limits, deadband, delay, reversal, rate limit, lags and droop, in that order.
#
# Static limits act on the commands at their own stamps, so that nothing depends on the integration step
# there.

_STEPS = 8
"""Steps of the integration of a spring and a damper in one cell."""
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
    commands: Commands, vehicle: Vehicle, effects: Effects, *, hold_s: float, step_s: float, cell_count: int
) -> Drive:
    """Run the commands through the drivetrain.

    Args:
        commands: body commands at their stamps.
        vehicle: geometry.
        effects: which of the drivetrain's effects act.
        hold_s: the controller stops this long after its last command [s].
        step_s: cell width [s].
        cell_count: number of cells.
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
        wheel = lag_signal(wheel, tau_s=effects.value("drive_lag", "tau"), step_s=step_s)
        if effects.is_active("brake_lag"):
            wheel = _brake(wheel, effects, step_s)
        return _swing(wheel, effects, step_s) if effects.is_active("drive_overshoot") else wheel

    def slow_alike(asked: Floats) -> Floats:
        fastest = np.maximum(np.abs(asked).max(axis=0), 1e-9)
        scaled: Floats = asked * np.minimum(1.0, effects.value("wheel_speed_scaling", "limit") / fastest)
        return scaled

    if vehicle.moves_sideways:
        corners = invert_corners(vehicle, speed, commands.sideways, turn)
        asked = dict(zip(corners, slow_alike(np.array([*corners.values()])), strict=True))
        turned = {corner: turn_wheel(wheel) for corner, wheel in asked.items()}
        return _join_corners(turned, effects, step_s)
    on_left, on_right = invert_ideal_model(vehicle, speed, turn)
    if vehicle.kind == "ackermann":
        axle = turn_wheel(on_left)
        return Drive(step_s, axle, axle, _steer(hold(turn), effects, step_s))
    left, right = map(turn_wheel, slow_alike(np.array([on_left, on_right])))
    if effects.is_active("speed_servo") or effects.is_active("turn_servo"):
        left, right = turn_by_motors(vehicle, left, right, effects, step_s)
    left, right = _couple_sides(left, right, effects, step_s)
    return Drive(step_s, left, right, np.zeros(cell_count))


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


# From wheels to body velocity: rolling, then inertia and ground effects in parallel, then rotation centres.
#
# What depends on the place or the slope is added while the pose is integrated (``path``).

_TURNING_MPS = 0.01


@dataclass(frozen=True)
class BodyMotion:
    """Velocities on the drive's cells.

    Attributes:
        v0, w0: body velocity before ground effects [m/s], [rad/s], shape (n,).
        velocity: (v_x, v_y, v_w) so far [m/s, m/s, rad/s], shape (n, 3).
        turning: one where the wheels turn, else zero, shape (n,).
    """

    v0: Floats
    w0: Floats
    velocity: Floats
    turning: Floats


def move_body(
    drive: Drive,
    vehicle: Vehicle,
    effects: Effects,
    *,
    disturbance: Disturbance,
    ground_input: Literal["drive", "inertia"],
    generator: np.random.Generator,
) -> BodyMotion:
    """Body velocity of the drive's wheels.

    Args:
        drive: true wheel speeds and steering.
        vehicle: geometry.
        effects: which effects act.
        disturbance: random true motion, on top.
        ground_input: what ground effects act on.
        generator: source of the disturbance.
    """
    v0, s0, w0 = _roll_wheels(drive, vehicle, effects)
    rim = vehicle.wheel_radius_m * np.maximum(np.abs(drive.left), np.abs(drive.right))
    if drive.corners is not None:
        rim = vehicle.wheel_radius_m * np.max(np.abs(list(drive.corners.values())), axis=0)
    turning = (rim > _TURNING_MPS).astype(np.float64)
    v_x, v_y, v_w = v0, s0, w0
    if effects.is_active("body_inertia"):
        v_x, v_y, v_w = _apply_inertia(v0, s0, w0, effects.value("body_inertia", "tau"), drive.step_s)
    along, aside, yaw_rate = (v0, s0, w0) if ground_input == "drive" else (v_x, v_y, v_w)
    v_x = (
        v_x
        - effects.value("speed_slip", "k") * along * np.abs(along)
        - effects.value("turning_resistance", "k") * along * np.abs(yaw_rate)
    )
    v_y = (
        v_y
        - effects.value("lateral_skid", "c") * along * yaw_rate
        + effects.value("lateral_drift", "c") * turning
    )
    if vehicle.moves_sideways:
        v_x = v_x + effects.value("lateral_skid", "c") * aside * yaw_rate
        v_y = v_y - effects.value("roller_slip", "k") * aside * np.abs(aside)
    v_w = (
        v_w
        + effects.value("speed_track", "k") * np.abs(along) * yaw_rate
        + effects.value("yaw_drift", "c") * turning
    )
    shaken = _shake(disturbance, turning, drive.step_s, generator)
    v_x, v_y, v_w = v_x + shaken[0], v_y + shaken[1], v_w + shaken[2]
    v_y = v_y - effects.value("icr_offset", "x_icr") * v_w
    v_x = v_x + effects.value("icr_lateral", "y_icr") * v_w
    return BodyMotion(v0, w0, np.stack((v_x, v_y, v_w), axis=1), turning)


def _roll_wheels(drive: Drive, vehicle: Vehicle, effects: Effects) -> tuple[Floats, Floats, Floats]:
    radius = vehicle.wheel_radius_m * effects.value("wheel_radius", "k")
    uneven = 0.5 * effects.value("wheel_asymmetry", "e")
    left = radius * (1.0 - uneven) * drive.left
    right = radius * (1.0 + uneven) * drive.right
    v0 = 0.5 * (left + right)
    s0 = np.zeros_like(v0)
    if drive.corners is not None:
        radii = {
            corner: radius * (1.0 + uneven * (1 if "right" in corner else -1)) for corner in drive.corners
        }
        rims = {
            corner: radii[corner] / vehicle.wheel_radius_m * wheel for corner, wheel in drive.corners.items()
        }
        v0, s0, w0 = move_by_corners(vehicle, rims)
        s0, w0 = s0 * effects.value("lateral_scale", "k"), w0 / effects.value("effective_track", "k")
    elif vehicle.kind == "ackermann":
        span = vehicle.wheelbase_m + effects.value("understeer", "K") * v0**2
        tyres = drive.steering + effects.value("steering_sensor_offset", "o")
        w0 = v0 * np.tan(tyres) / span
    else:
        w0 = (right - left) / (vehicle.track_width_m * effects.value("effective_track", "k"))
    time = (np.arange(v0.size) + 0.5) * drive.step_s
    duration = v0.size * drive.step_s
    fade = 1.0 - effects.value("time_drift", "k") * time / duration
    gain_v, gain_w = fade, fade
    if effects.is_active("terrain_change") and np.isnan(effects.value("terrain_change", "at_x")):
        at = effects.value("terrain_change", "at_s")
        beyond = time >= (0.5 * duration if np.isnan(at) else at)
        gain_v = fade * np.where(beyond, effects.value("terrain_change", "k_v"), 1.0)
        gain_w = fade * np.where(beyond, effects.value("terrain_change", "k_w"), 1.0)
    return v0 * gain_v, s0 * gain_v, w0 * gain_w


def _apply_inertia(
    v0: Floats, s0: Floats, w0: Floats, tau_s: float, step_s: float
) -> tuple[Floats, Floats, Floats]:
    # In a frame that does not turn, the two equations of v_x and v_y are one linear lag of a complex number.
    turning = lag_signal(w0, tau_s=tau_s, step_s=step_s)
    heading = integrate_cells(turning, step_s=step_s)
    middle = np.exp(0.5j * (heading[:-1] + heading[1:]))
    decay = float(np.exp(-step_s / tau_s))
    drive = (v0 + 1j * s0) * middle * (1.0 - decay)
    at_end = filter_pole(drive.real, decay) + 1j * filter_pole(drive.imag, decay)
    fixed = 0.5 * (at_end + np.concatenate(([0.0], at_end[:-1])))
    turned = fixed * np.conj(middle)
    return turned.real, turned.imag, turning


def _shake(
    disturbance: Disturbance, turning: Floats, step_s: float, generator: np.random.Generator
) -> tuple[Floats, Floats, Floats]:
    def draw(deviation: float) -> Floats:
        if deviation == 0.0:
            return np.zeros_like(turning)
        return turning * make_coloured_noise(
            generator,
            size=turning.size,
            deviation=deviation,
            correlation_s=disturbance.correlation_s,
            step_s=step_s,
        )

    return draw(disturbance.speed_mps), draw(disturbance.speed_mps), draw(disturbance.turn_radps)
