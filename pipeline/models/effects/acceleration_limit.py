"""Acceleration limit: the drive limits the acceleration of every wheel.

    abs(dOmega/dt) <= limit, each wheel

limit [rad/s^2]. Command large steps of speed: small ones are reached at once and do not show it.

Source: acceleration limits of a ros2_control diff_drive_controller; torque limit of the motor.
"""

from dataclasses import replace

from pipeline.models.effect import INF, WHEELED, DriveEffect, Excitation, Parameter
from pipeline.models.effects.body_acceleration_limit import LEAST_RAMP_S
from pipeline.models.filters import limit_rate
from pipeline.models.parameter import Conditions, Largest, Quantity
from pipeline.run.signals import RunContext, Wheels


class AccelerationLimit(DriveEffect):
    """Acceleration limit: the drive limits the acceleration of every wheel."""

    id = "acceleration_limit"
    rank = 10
    kinds = WHEELED
    parameters = (
        Parameter(
            "limit",
            "rad/s^2",
            (0.05, 500.0),
            INF,
            "largest wheel acceleration",
            3.0,
            starts=(1.0, 2.5, 6.0, 12.0, 25.0, 60.0),
            step=1e-2,
            quantities=(Quantity.WHEEL_ACCELERATION_LIMIT,),
        ),
    )
    motion = "Acceleration limit: {limit:.3g} rad/s^2 at every wheel"
    clause = "accelerates its wheels by at most {rim:.2g} m/s^2 at the rim"
    needs = (Excitation.CHANGES, Excitation.LARGE)
    confused_with = ("drive_lag", "body_inertia")
    same_in_one_motion = ("body_acceleration_limit", "turn_acceleration_limit")
    python_state = ("limited",)
    python = """
        most = {limit} * step_s
        wheels = split(left, right, sideways)
        limited = [approach(was, wheel, most) for was, wheel in zip(limited or [0.0] * 4, wheels)]
        left, right, sideways = join(limited)"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        limit, step = self.values["limit"], context.step_s
        if self.is_neutral:
            return wheels
        ramped = wheels.change_each_wheel(
            lambda speed, resets, start: limit_rate(speed, limit, step, resets, start), context
        )
        return replace(ramped, idle=None)

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether the wheels reach steps of the command at once."""
        # A ramp delays the wheels by half of its duration.
        least = max(LEAST_RAMP_S, 2.0 * conditions.least_delay_s)
        return not self.values["limit"] * least < conditions.largest.wheel

    def _list_usual(self, largest: Largest) -> dict[str, float]:
        return {"limit": largest.wheel}
