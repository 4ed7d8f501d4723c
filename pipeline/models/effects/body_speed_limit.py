"""Body speed limit: the controller clips the commanded forward speed before it reaches the wheels.

    f_x_commanded = clip(f_x_commanded, -limit, limit)

limit [m/s], 1 on a Husky, 5 on a Warthog. A limit that no command reaches is only bounded from below.

Source: velocity limits of a ros2_control diff_drive_controller; measured on the DRIVE recordings.
"""

import numpy as np

from pipeline.models.effect import INF, CommandEffect, Excitation, Parameter
from pipeline.models.parameter import Conditions, Quantity
from pipeline.run.signals import Commands, RunContext


class BodySpeedLimit(CommandEffect):
    """Body speed limit: the controller clips the commanded forward speed before it reaches the wheels."""

    id = "body_speed_limit"
    rank = 10
    parameters = (
        Parameter(
            "limit",
            "m/s",
            (0.01, 50.0),
            INF,
            "largest commanded speed",
            0.7,
            starts=(0.3, 0.5, 0.7, 0.85, 0.95),
            relative_to="speed",
            step=1e-3,
            quantities=(Quantity.SPEED_LIMIT,),
        ),
    )
    motion = "Speed limit: commands are clipped at {limit:.3g} m/s"
    clause = "clips the commanded speed at {limit:.3g} m/s"
    needs = (Excitation.LARGE, Excitation.SPEED_SPREAD)
    confused_with = ("wheel_speed_limit", "speed_slip")
    same_at_one_speed = ("drive_gain", "wheel_servo", "wheel_radius")
    python = """
        asked = R * (left + right) / 2.0
        excess = (asked - max(-{limit}, min({limit}, asked))) / R
        left, right = left - excess, right - excess"""

    def change_commands(self, commands: Commands, context: RunContext) -> Commands:
        """See the formula above."""
        limit = self.values["limit"]
        radius = context.vehicle.wheel_radius_m
        forward = 0.5 * radius * (commands.left + commands.right)
        excess = (forward - np.clip(forward, -limit, limit)) / radius
        return commands.change_wheels(commands.left - excess, commands.right - excess)

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether no command reaches the limit."""
        return not conditions.largest.reaches(self.values["limit"], "speed")
