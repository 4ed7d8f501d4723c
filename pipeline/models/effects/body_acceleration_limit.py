"""Body acceleration limit: a velocity smoother limits the rate of change of the commanded speed.

    abs(dM/dt) <= limit,  M = r (Omega_r + Omega_l) / 2

limit [m/s^2], 0.5 to 2.5 of the usual smoothers. Command large steps of speed while turning: straight ahead
it is an acceleration limit of the wheels.

Source: velocity smoothers of Nav2 and limits of a ros2_control diff_drive_controller, linear.x.
"""

from dataclasses import replace

from pipeline.models.effect import INF, SIDES, DriveEffect, Excitation, Parameter
from pipeline.models.filters import limit_rate
from pipeline.models.parameter import Conditions, Largest, Level, Quantity
from pipeline.run.signals import RunContext, Wheels

LEAST_RAMP_S = 0.08
"""Shortest ramp of the largest step [s] that a limit must cause to be visible in the poses."""


class BodyAccelerationLimit(DriveEffect):
    """Body acceleration limit: a velocity smoother limits the rate of change of the commanded speed."""

    id = "body_acceleration_limit"
    rank = 2
    kinds = SIDES
    parameters = (
        Parameter(
            "limit",
            "m/s^2",
            (0.02, 50.0),
            INF,
            "largest forward acceleration",
            1.0,
            starts=(0.4, 1.0, 2.5),
            step=1e-2,
            quantities=(Quantity.ACCELERATION_LIMIT,),
            level=Level.VEHICLE,
        ),
    )
    motion = "Body acceleration limit: {limit:.3g} m/s^2"
    clause = "accelerates by at most {limit:.2g} m/s^2"
    needs = (Excitation.CHANGES, Excitation.LARGE)
    confused_with = ("acceleration_limit", "wheel_servo", "drive_lag")
    same_in_one_motion = ("acceleration_limit",)
    python_state = ("ramped",)
    python = """
        asked = (left + right) / 2.0
        ramped = approach(ramped, asked, {limit} / R * step_s)
        left, right = left + ramped - asked, right + ramped - asked"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        if self.is_neutral:
            return wheels
        limit, resets = self.values["limit"] / context.vehicle.wheel_radius_m, context.wheels
        asked = 0.5 * (wheels.left + wheels.right)
        start = 0.5 * (resets.start[:, 0] + resets.start[:, 1])
        added = limit_rate(asked, limit, context.step_s, resets, start)
        added -= asked
        return replace(wheels, left=wheels.left + added, right=wheels.right + added, idle=None)

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether the wheels reach steps of the command at once."""
        least = max(LEAST_RAMP_S, 2.0 * conditions.least_delay_s)
        return not self.values["limit"] * least < conditions.largest.speed

    def _list_usual(self, largest: Largest) -> dict[str, float]:
        return {"limit": largest.speed}
