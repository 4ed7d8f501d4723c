"""Body turn limit: the controller clips the commanded yaw rate before it reaches the wheels.

    f_w_commanded = clip(f_w_commanded, -limit, limit)

limit [rad/s], 1 on a Husky, 4 to 5 on a Warthog. On a car the steering angle is held to what gives that yaw
rate at the commanded speed. A limit that no command reaches is only bounded from below.

Source: velocity limits of a ros2_control diff_drive_controller; measured on the DRIVE recordings.
"""

from dataclasses import replace

import numpy as np

from pipeline.models.effect import INF, CommandEffect, Effect, Excitation, Parameter
from pipeline.models.effects.turn_droop import TurnDroop
from pipeline.models.parameter import Conditions, Largest, Level, Quantity
from pipeline.run.signals import Commands, RunContext

_ON_A_CAR = """
        moving = max(abs(R * (left + right) / 2.0), 1e-9)
        widest = math.atan({limit} * WHEELBASE / moving)
        steering = max(-widest, min(widest, steering))"""


class BodyTurnLimit(CommandEffect):
    """Body turn limit: the controller clips the commanded yaw rate before it reaches the wheels."""

    id = "body_turn_limit"
    rank = 20
    parameters = (
        Parameter(
            "limit",
            "rad/s",
            (0.01, 50.0),
            INF,
            "largest commanded yaw rate",
            0.6,
            starts=(0.3, 0.5, 0.7, 0.85, 0.95),
            relative_to="turn",
            step=1e-3,
            quantities=(Quantity.TURN_LIMIT,),
            level=Level.VEHICLE,
        ),
    )
    motion = "Yaw rate limit: commands are clipped at {size:.3g} rad/s"
    clause = "clips the commanded yaw rate at {size:.3g} rad/s"
    needs = (Excitation.LARGE, Excitation.TURNING)
    confused_with = ("wheel_speed_limit", "turn_droop")
    python = """
        asked = (right - left) * R / (B * MULTIPLIER)
        excess = (asked - max(-{limit}, min({limit}, asked))) * B * MULTIPLIER / (2.0 * R)
        left, right = left + excess, right - excess"""

    def choose_python(self, kind: str) -> str | None:
        """Its step in the exported function; on a car it limits the steering angle."""
        return _ON_A_CAR if kind == "ackermann" else self.python

    def change_commands(self, commands: Commands, context: RunContext) -> Commands:
        """See the formula above."""
        limit, vehicle = self.values["limit"], context.vehicle
        if vehicle.kind == "ackermann":
            forward = 0.5 * vehicle.wheel_radius_m * (commands.left + commands.right)
            moving = np.maximum(np.abs(forward), 1e-9)
            widest = np.arctan(limit * (vehicle.wheelbase_m or 1.0) / moving)
            return replace(commands, steering=np.clip(commands.steering, -widest, widest))
        # The limit acts on the body command, converted to wheel speeds with the controller's own track.
        to_wheels = 0.5 * context.track_m * vehicle.controller_track_multiplier / vehicle.wheel_radius_m
        turning = 0.5 * (commands.right - commands.left) / to_wheels
        excess = (turning - np.clip(turning, -limit, limit)) * to_wheels
        return commands.change_wheels(commands.left + excess, commands.right - excess)

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether no command reaches the limit."""
        return not conditions.largest.reaches(self.values["limit"], "turn")

    def list_softer(self, largest: Largest) -> tuple[Effect, ...]:
        """A droop with a typical gain, for runs with only one turn command above the limit."""
        return (TurnDroop().make_usual(largest).fix("gain"),)
