"""Wheel speed limit: the speed of every wheel is limited.

    Omega = clip(Omega, -limit, limit), each wheel

limit [rad/s], 13 on a Warthog. A limit that no command reaches is only bounded from below; where wheels are
measured, it is neither below what they exceed for half a second nor above all that they reach.

Source: saturation of the drive; measured on the DRIVE recordings.
"""

import numpy as np

from pipeline.models.effect import INF, WHEELED, DriveEffect, Excitation, Parameter, Spread
from pipeline.models.parameter import Conditions, Level, Quantity
from pipeline.run.signals import RunContext, Wheels


class WheelSpeedLimit(DriveEffect):
    """Wheel speed limit: the speed of every wheel is limited."""

    id = "wheel_speed_limit"
    rank = 4
    kinds = WHEELED
    parameters = (
        Parameter(
            "limit",
            "rad/s",
            (0.05, 500.0),
            INF,
            "largest wheel speed",
            4.5,
            starts=(0.3, 0.5, 0.7, 0.85, 0.95),
            relative_to="wheel",
            step=1e-2,
            quantities=(Quantity.WHEEL_SPEED_LIMIT,),
            between_runs=Spread(0.2),
            level=Level.VEHICLE,
        ),
    )
    motion = "Wheel speed limit: {limit:.3g} rad/s"
    clause = "turns its wheels no faster than {rim:.2g} m/s at the rim"
    needs = (Excitation.LARGE,)
    confused_with = ("body_speed_limit", "body_turn_limit", "wheel_speed_scaling")
    same_at_one_speed = ("drive_gain", "wheel_servo", "wheel_radius")
    same_in_one_motion = ("wheel_speed_scaling",)
    python = """
        wheels = split(left, right, sideways)
        left, right, sideways = join([max(-{limit}, min({limit}, wheel)) for wheel in wheels])"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        limit = self.values["limit"]
        if self.is_neutral:
            return wheels
        return wheels.change_each_wheel(lambda speed, *_: np.clip(speed, -limit, limit), context)

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether no wheel reaches the limit."""
        return not conditions.attain(self.values["limit"], "wheel")
