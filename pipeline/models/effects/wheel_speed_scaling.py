"""Wheel speed scaling: all wheels are slowed by one factor where one would exceed its limit.

    Omega = u * min(1, limit / fastest), each wheel; fastest = max(abs(u)) of all wheels

limit [rad/s], 6 on a Husky. It keeps the radius of a curve; where each wheel is clipped alone, which is a
wheel speed limit, a fast curve becomes a wider one. Command curves that are too fast for the outer wheels.

Source: desaturation of wheel speeds in WPILib, `DifferentialDriveKinematics`; measured on a Husky on snow.
"""

from dataclasses import replace

import numpy as np

from pipeline.models.effect import DriveEffect, Excitation
from pipeline.models.effects.wheel_speed_limit import WheelSpeedLimit
from pipeline.models.parameter import Conditions
from pipeline.run.signals import RunContext, Wheels, find_fastest_wheel

_LEAST_SPEED = 1e-9
"""Smallest divisor [rad/s], for wheels at rest."""


class WheelSpeedScaling(DriveEffect):
    """Wheel speed scaling: all wheels are slowed by one factor where one would exceed its limit."""

    id = "wheel_speed_scaling"
    rank = 4
    kinds = ("differential", "mecanum")
    parameters = WheelSpeedLimit.parameters
    motion = "Wheel speed scaling: all wheels are slowed by one factor where one exceeds {limit:.3g} rad/s"
    clause = "slows all wheels by one factor where one exceeds {rim:.2g} m/s at the rim"
    needs = (Excitation.LARGE, Excitation.TURNING)
    confused_with = ("wheel_speed_limit", "body_speed_limit", "body_turn_limit")
    same_at_one_speed = ("drive_gain", "wheel_servo", "wheel_radius")
    same_in_one_motion = ("wheel_speed_limit",)
    python = """
        fastest = max(map(abs, split(left, right, sideways)))
        scale = min(1.0, {limit} / max(fastest, 1e-9))
        left, right, sideways = scale * left, scale * right, scale * sideways"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        if self.is_neutral:
            return wheels
        scale = np.minimum(1.0, self.values["limit"] / np.maximum(find_fastest_wheel(wheels), _LEAST_SPEED))
        sideways = None if wheels.sideways is None else scale * wheels.sideways
        return replace(wheels, left=scale * wheels.left, right=scale * wheels.right, sideways=sideways)

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether no wheel reaches the limit."""
        return not conditions.attain(self.values["limit"], "wheel")

    def can_show(self, conditions: Conditions) -> bool:
        """Only measured wheels distinguish it from a wheel speed limit."""
        return conditions.encoders
