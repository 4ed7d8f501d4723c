"""Lateral ICR offset: turning drags the vehicle forward or backward, as with a load on one side.

    v_x += y_icr * w

w is the yaw rate of the model. y_icr [m], positive to the left. Spin on the spot both ways.

Source: Mandow et al., IROS 2007, the lateral coordinates of the instantaneous centres of rotation.
"""

from collections.abc import Mapping

from pipeline.models.effect import Column, Excitation, Least, LinearEffect, Parameter, Place, Plausible
from pipeline.run.signals import Rolling, RunContext, Velocity


class IcrLateral(LinearEffect):
    """Lateral ICR offset: turning drags the vehicle forward or backward, as with a load on one side."""

    id = "icr_lateral"
    place = Place.CENTRE
    parameters = (
        Parameter(
            "y_icr",
            "m",
            (-1.0, 1.0),
            0.0,
            "centre of rotation left of base_link",
            0.08,
            least=Least(0.004, Least.MOUNTING),
            plausible=Plausible(-0.5, 0.5, "further out it lies beside the wheels of a Warthog"),
        ),
    )
    motion = "Lateral centre of rotation: {length} to the {way} of base_link"
    clause = "rotates about a point {length} to the {way} of its reference point"
    needs = (Excitation.TURNING,)
    confused_with = ("wheel_asymmetry",)
    equivalent_to = ("lever_arm",)
    equivalent_when = "always: a pose measured at l_y = -y_icr moves in the same way"
    python = "v_x = v_x + {y_icr} * v_w"

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        return {"y_icr": (velocity.w, 0.0, 0.0)}
