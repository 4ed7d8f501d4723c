"""Ackermann steering: the kinematic bicycle, its reference point at the rear axle.

    v_x = speed        v_y = arm v_w        v_w = speed tan(steering) / l

arm [m] is how far base_link lies ahead of the rear axle.

Source: Becker et al. 2023.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.sources.kinematics import Kinematics, Quantity

if TYPE_CHECKING:
    from pipeline.sources.configuration import Vehicle
    from pipeline.sources.kinematics import Body, Floats, Inputs

_SLOW_MPS = 1e-3


class Ackermann(Kinematics):
    """A car: driven wheels, and front wheels that steer."""

    inputs = (
        Quantity("speed", "m/s", "speed at the rear axle"),
        Quantity("steering", "rad", "steering angle, left positive"),
    )
    geometry = (
        Quantity("wheel_radius_m", "m", "of the driven wheels"),
        Quantity("wheelbase_m", "m", "l, between the axles"),
        Quantity("base_to_rear_axle_m", "m", "arm", required=False),
        Quantity("max_steering_rad", "rad", "largest steering angle", required=False),
    )

    def forward(self, inputs: Inputs, vehicle: Vehicle) -> Body:
        """See the formula above."""
        speed = inputs["speed"]
        turning = speed * np.tan(inputs["steering"]) / (vehicle.wheelbase_m or 1.0)
        return speed, vehicle.base_to_rear_axle_m * turning, turning

    def inverse(self, body: Body, vehicle: Vehicle) -> dict[str, Floats]:
        """Speed and steering angle of a body command; straight ahead when it stands still."""
        forward, _, turning = body
        moving = np.abs(forward) > _SLOW_MPS
        ratio = np.where(moving, turning / np.where(moving, forward, 1.0), 0.0)
        steering = np.arctan((vehicle.wheelbase_m or 1.0) * ratio)
        if vehicle.max_steering_rad is not None:
            steering = np.clip(steering, -vehicle.max_steering_rad, vehicle.max_steering_rad)
        return {"speed": forward, "steering": steering}

    def lever_m(self, vehicle: Vehicle) -> float:
        """The arm of the formula above."""
        return vehicle.base_to_rear_axle_m
