"""Lever arm: the reported pose is that of a point beside base_link.

    v_x += -l_y * w,   v_y += l_x * w

w is the yaw rate of the model. l_x, l_y [m], 0 to 0.3. Check the transform between sensor and base_link.

Source: rigid body motion of a point; see any text on mechanics.
"""

from collections.abc import Iterable, Mapping

from pipeline.core import format_length
from pipeline.models.effect import Column, Effect, Excitation, LinearEffect, Parameter, Part, Place, name_side
from pipeline.run.signals import Rolling, RunContext, Velocity
from pipeline.sources import Vehicle


class LeverArm(LinearEffect):
    """Lever arm: the reported pose is that of a point beside base_link."""

    id = "lever_arm"
    place = Place.LOCALIZATION
    rank = 10
    parameters = (
        Parameter("l_x", "m", (-2.0, 2.0), 0.0, "point ahead of base_link", 0.2),
        Parameter("l_y", "m", (-2.0, 2.0), 0.0, "point left of base_link", 0.08),
    )
    needs = (Excitation.TURNING,)
    confused_with = ("lateral_skid", "wheel_asymmetry")
    equivalent_to = ("icr_offset", "icr_lateral")
    equivalent_when = "always: a centre of rotation at (-l_x, -l_y) moves in the same way"
    parts = (Part("l_x", "icr_offset", "x_icr", -1.0), Part("l_y", "icr_lateral", "y_icr", -1.0))

    def describe_motion(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """What the vehicle does, with numbers."""
        ahead, sideways = self.values["l_x"], self.values["l_y"]
        direction = "ahead of" if ahead >= 0.0 else "behind"
        return (
            f"Lever arm: the pose is measured {format_length(abs(ahead))} {direction} base_link and "
            f"{format_length(abs(sideways))} to the {name_side(sideways)}"
        )

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        return {"l_x": (0.0, velocity.w, 0.0), "l_y": (-velocity.w, 0.0, 0.0)}
