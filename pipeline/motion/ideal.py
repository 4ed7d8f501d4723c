"""Ideal models: what the body velocity would be if nothing slipped, and their inverses.

Frames follow REP-103. Differential drive: Samson et al. 2024, eq. 2. Ackermann: kinematic bicycle with its
reference point at the rear axle (Becker et al. 2023); base_link elsewhere is a lever arm ahead of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pipeline.vehicles import Vehicle

Floats = NDArray[np.float64]

_SLOW = 1e-3


def predict_differential(left: Floats, right: Floats, vehicle: Vehicle) -> Floats:
    """Ideal body velocity of wheel speeds.

    Args:
        left: speed of the left wheels [rad/s], shape (n,).
        right: speed of the right wheels [rad/s], shape (n,).
        vehicle: with wheel radius r and track width b.

    Returns:
        (f_x [m/s], f_y [m/s], f_w [rad/s]), shape (n, 3):
        r (left + right) / 2, zero, r (right - left) / b.
    """
    radius, track = vehicle.wheel_radius_m, vehicle.track_width_m or 1.0
    forward = radius * (left + right) / 2.0
    turning = radius * (right - left) / track
    return np.stack((forward, np.zeros_like(forward), turning), axis=-1)


def predict_ackermann(speed: Floats, steering: Floats, vehicle: Vehicle) -> Floats:
    """Ideal body velocity of speed [m/s] at the rear axle and steering angle [rad], shape (n, 3)."""
    yaw_rate = speed * np.tan(steering) / (vehicle.wheelbase_m or 1.0)
    return np.stack((speed, vehicle.base_to_rear_axle_m * yaw_rate, yaw_rate), axis=-1)


def invert_differential(forward: Floats, yaw_rate: Floats, vehicle: Vehicle) -> tuple[Floats, Floats]:
    """Wheel speeds (left, right) [rad/s] that a controller asks for to reach a body command.

    The controller's track width is the vehicle's times `controller_track_multiplier`.
    """
    track = (vehicle.track_width_m or 1.0) * vehicle.controller_track_multiplier
    half = yaw_rate * track / 2.0
    return (forward - half) / vehicle.wheel_radius_m, (forward + half) / vehicle.wheel_radius_m


def invert_ackermann(forward: Floats, yaw_rate: Floats, vehicle: Vehicle) -> tuple[Floats, Floats]:
    """Speed [m/s] and steering angle [rad] that reach a body command; straight ahead when it stands still."""
    moving = np.abs(forward) > _SLOW
    ratio = np.where(moving, yaw_rate / np.where(moving, forward, 1.0), 0.0)
    steering = np.arctan((vehicle.wheelbase_m or 1.0) * ratio)
    if vehicle.max_steering_rad is not None:
        steering = np.clip(steering, -vehicle.max_steering_rad, vehicle.max_steering_rad)
    return forward, steering
