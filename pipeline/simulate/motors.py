"""Motors under a speed controller: proportional and integral gain, bounded effort, friction of the ground.

Integrated by Euler's method in steps much shorter than what the controller answers in.
"""

import math

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.simulate.facts import Effects, Vehicle

_STEPS = 8
"""Steps of the integration in one cell."""
_RADIUS_FALL = 0.15
"""Turning resistance falls to 1 / (1 + 0.15 R / b) at a radius R, with a track width b."""


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
        total = 0.0
        for _ in range(_STEPS):
            twist = gain * (goal - now) + memory
            if abs(twist) <= most:
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
