"""Differential drive: wheels on either side at a speed a side; turning is the difference.

    v_x = r (left + right) / 2        v_y = 0        v_w = r (right - left) / b

Source: Samson, Baril, Lépine and Pomerleau 2024, eq. 2.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pipeline.sources.kinematics import Kinematics, Quantity

if TYPE_CHECKING:
    from pipeline.sources.configuration import Vehicle
    from pipeline.sources.kinematics import Body, Floats, Inputs


class Differential(Kinematics):
    """Differential drive, also skid-steer and tracks."""

    inputs: ClassVar[tuple[Quantity, ...]] = (
        Quantity("left", "rad/s", "speed of the left wheels"),
        Quantity("right", "rad/s", "speed of the right wheels"),
    )
    geometry: ClassVar[tuple[Quantity, ...]] = (
        Quantity("wheel_radius_m", "m", "r"),
        Quantity("track_width_m", "m", "b, between the middles of the left and right wheels"),
        Quantity("controller_track_multiplier", "1", "the controller's track over b", required=False),
    )

    def forward(self, inputs: Inputs, vehicle: Vehicle) -> Body:
        """See the formula above."""
        return self._roll(inputs, vehicle, self.turning_width_m(vehicle))

    def asked(self, inputs: Inputs, vehicle: Vehicle) -> Body:
        """As `forward`, with the geometry that the controller believes in."""
        return self._roll(inputs, vehicle, self._controller_width_m(vehicle))

    def inverse(self, body: Body, vehicle: Vehicle) -> dict[str, Floats]:
        """Wheel speeds of a body command with the controller's geometry; it cannot move sideways."""
        forward, _, turning = body
        half = turning * self._controller_width_m(vehicle) / 2.0
        radius = vehicle.wheel_radius_m
        return {"left": (forward - half) / radius, "right": (forward + half) / radius}

    def _controller_width_m(self, vehicle: Vehicle) -> float:
        return self.turning_width_m(vehicle) * vehicle.controller_track_multiplier

    def _roll(self, inputs: Inputs, vehicle: Vehicle, width_m: float) -> Body:
        left, right, radius = inputs["left"], inputs["right"], vehicle.wheel_radius_m
        forward = radius * (left + right) / 2.0
        return forward, np.zeros_like(forward), radius * (right - left) / width_m
