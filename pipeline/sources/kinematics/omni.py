"""Omni wheels on a circle, three or four: the vehicle moves any way; what it is told is body motion.

    v_x = r (left + right) / 2        v_y = r sideways        v_w = r (right - left) / b

b is the diameter of the circle that the wheels stand on. How many wheels there are and where does not matter
to body motion: left, right and sideways are the speeds of wheels that would stand at its sides.

Source: Siciliano and Khatib, Springer Handbook of Robotics, chapter 24, omnimobile robots.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.sources.kinematics import Quantity
from pipeline.sources.kinematics.mecanum import Mecanum

if TYPE_CHECKING:
    from pipeline.sources.configuration import Vehicle


class Omni(Mecanum):
    """Three or four omni wheels, told and measured as body motion."""

    geometry = (
        Quantity("wheel_radius_m", "m", "r"),
        Quantity("track_width_m", "m", "b, diameter of the circle through the wheels"),
        Quantity("controller_track_multiplier", "1", "the controller's diameter over b", required=False),
    )
    known_joints = False

    def turning_width_m(self, vehicle: Vehicle) -> float:
        """The diameter of the circle."""
        return vehicle.track_width_m or 1.0
