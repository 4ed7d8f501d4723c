"""From wheels to body velocity, effect by effect in the order they act."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.simulate.drivetrain import Drive, move_by_corners
from pipeline.simulate.facts import Effects, Vehicle
from pipeline.simulate.programs import filter_pole, integrate_cells, lag_signal, make_coloured_noise
from pipeline.simulate.scenario import Disturbance

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
    along, aside, around = (v0, s0, w0) if ground_input == "drive" else (v_x, v_y, v_w)
    v_x = (
        v_x
        - effects.value("speed_slip", "k") * along * np.abs(along)
        - effects.value("turning_resistance", "k") * along * np.abs(around)
    )
    v_y = (
        v_y
        - effects.value("lateral_skid", "c") * along * around
        + effects.value("lateral_drift", "c") * turning
    )
    if vehicle.moves_sideways:
        v_x = v_x + effects.value("lateral_skid", "c") * aside * around
        v_y = v_y - effects.value("roller_slip", "k") * aside * np.abs(aside)
    v_w = (
        v_w
        + effects.value("speed_track", "k") * np.abs(along) * around
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
        radii = {place: radius * (1.0 + uneven * (1 if "right" in place else -1)) for place in drive.corners}
        rims = {
            place: radii[place] / vehicle.wheel_radius_m * wheel for place, wheel in drive.corners.items()
        }
        v0, s0, w0 = move_by_corners(vehicle, rims)
        s0, w0 = s0 * effects.value("lateral_scale", "k"), w0 / effects.value("effective_track", "k")
    elif vehicle.kind == "ackermann":
        reach = vehicle.wheelbase_m + effects.value("understeer", "K") * v0**2
        tyres = drive.steering + effects.value("steering_sensor_offset", "o")
        w0 = v0 * np.tan(tyres) / reach
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
    around = lag_signal(w0, tau_s=tau_s, step_s=step_s)
    heading = integrate_cells(around, step_s=step_s)
    middle = np.exp(0.5j * (heading[:-1] + heading[1:]))
    decay = float(np.exp(-step_s / tau_s))
    drive = (v0 + 1j * s0) * middle * (1.0 - decay)
    at_end = filter_pole(drive.real, decay) + 1j * filter_pole(drive.imag, decay)
    fixed = 0.5 * (at_end + np.concatenate(([0.0], at_end[:-1])))
    turned = fixed * np.conj(middle)
    return turned.real, turned.imag, around


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
