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

from pipeline.sources.kinematics import Quantity
from pipeline.sources.kinematics.differential import Differential

if TYPE_CHECKING:
    from pipeline.sources.configuration import Vehicle
    from pipeline.sources.kinematics import Body, Floats, Inputs


class Mecanum(Differential):
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

    def inverse(self, body: Body, vehicle: Vehicle) -> dict[str, Floats]:
        """Wheel speeds of a body command with the controller's geometry."""
        sideways = np.asarray(body[1] / vehicle.wheel_radius_m)
        return {**super().inverse(body, vehicle), "sideways": sideways}

    def turning_width_m(self, vehicle: Vehicle) -> float:
        """The sum b + l: a wheel with rollers turns the vehicle about a lever of half of it."""
        return (vehicle.track_width_m or 1.0) + (vehicle.wheelbase_m or 1.0)

    def _roll(self, inputs: Inputs, vehicle: Vehicle, width_m: float) -> Body:
        forward, _, turning = super()._roll(inputs, vehicle, width_m)
        return forward, vehicle.wheel_radius_m * inputs["sideways"], turning
