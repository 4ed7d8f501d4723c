"""Mecanum drive: four wheels with rollers at 45 degrees; the vehicle moves sideways as well.

    v_x = r (left + right) / 2        v_y = r sideways        v_w = r (right - left) / (b + l)

left and right are the means of a side. With front_left = left - sideways, rear_left = left + sideways,
front_right = right + sideways and rear_right = right - sideways these are the least-squares motion of any
four wheel speeds; their fourth combination moves nothing and only rubs.

Source: Muir and Neuman, ICRA 1987; Taheri, Qiao and Ghaeminezhad, IJCA 113(3), 2015.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pipeline.vehicles.kinematics import Kinematics, Quantity

if TYPE_CHECKING:
    from pipeline.vehicles import Vehicle
    from pipeline.vehicles.kinematics import Body, Floats, Inputs


class Mecanum(Kinematics):
    """Four driven mecanum wheels, their rollers seen from above as an X."""

    inputs = (
        Quantity("left", "rad/s", "mean speed of the left wheels"),
        Quantity("right", "rad/s", "mean speed of the right wheels"),
        Quantity(
            "sideways", "rad/s", "a quarter of front right and rear left less front left and rear right"
        ),
    )
    geometry: ClassVar[tuple[Quantity, ...]] = (
        Quantity("wheel_radius_m", "m", "r"),
        Quantity("track_width_m", "m", "b, between the middles of the left and right wheels"),
        Quantity("wheelbase_m", "m", "l, between the axles"),
        Quantity(
            "controller_track_multiplier", "1", "the controller's b + l over the vehicle's", required=False
        ),
    )

    def forward(self, inputs: Inputs, vehicle: Vehicle) -> Body:
        """See the formula above."""
        return self._roll(inputs, vehicle, self.turning_width_m(vehicle))

    def asked(self, inputs: Inputs, vehicle: Vehicle) -> Body:
        """As `forward`, with the geometry that the controller believes in."""
        return self._roll(inputs, vehicle, self._controller_width_m(vehicle))

    def inverse(self, body: Body, vehicle: Vehicle) -> dict[str, Floats]:
        """Wheel speeds of a body command with the controller's geometry."""
        forward, sideways, turning = body
        half = turning * self._controller_width_m(vehicle) / 2.0
        radius = vehicle.wheel_radius_m
        speeds = ((forward - half) / radius, (forward + half) / radius, np.asarray(sideways / radius))
        return {quantity.name: speed for quantity, speed in zip(self.inputs, speeds, strict=True)}

    def turning_width_m(self, vehicle: Vehicle) -> float:
        """The sum b + l: a wheel with rollers turns the vehicle about a lever of half of it."""
        return (vehicle.track_width_m or 1.0) + (vehicle.wheelbase_m or 1.0)

    def _controller_width_m(self, vehicle: Vehicle) -> float:
        return self.turning_width_m(vehicle) * vehicle.controller_track_multiplier

    @staticmethod
    def _roll(inputs: Inputs, vehicle: Vehicle, width_m: float) -> Body:
        left, right, radius = inputs["left"], inputs["right"], vehicle.wheel_radius_m
        return radius * (left + right) / 2.0, radius * inputs["sideways"], radius * (right - left) / width_m
