"""Turn acceleration limit: a velocity smoother limits the rate of change of the commanded yaw rate.

    abs(dD/dt) <= limit,  D = r (Omega_r - Omega_l) / b

limit [rad/s^2], 1 to 4 of the usual smoothers, of the yaw rate that the wheels would give without skidding.
Command large steps of the turn while driving: on the spot it is an acceleration limit of the wheels.

Source: velocity smoothers of Nav2 and limits of a ros2_control diff_drive_controller, angular.z.
"""

from dataclasses import replace

from pipeline.models.effect import INF, SIDES, DriveEffect, Excitation, Parameter
from pipeline.models.effects.body_acceleration_limit import LEAST_RAMP_S
from pipeline.models.filters import limit_rate
from pipeline.models.parameter import Conditions, Largest, Level, Quantity
from pipeline.run.signals import RunContext, Wheels


class TurnAccelerationLimit(DriveEffect):
    """Turn acceleration limit: a velocity smoother limits the rate of change of the commanded yaw rate."""

    id = "turn_acceleration_limit"
    rank = 3
    kinds = SIDES
    parameters = (
        Parameter(
            "limit",
            "rad/s^2",
            (0.02, 100.0),
            INF,
            "largest yaw acceleration",
            2.0,
            starts=(0.8, 2.0, 5.0),
            step=1e-2,
            quantities=(Quantity.TURN_ACCELERATION_LIMIT,),
            level=Level.VEHICLE,
        ),
    )
    motion = "Turn acceleration limit: {size:.3g} rad/s^2"
    clause = "accelerates its yaw rate by at most {size:.3g} rad/s^2"
    needs = (Excitation.CHANGES, Excitation.LARGE, Excitation.TURNING)
    confused_with = ("acceleration_limit", "wheel_servo", "turn_lag")
    same_in_one_motion = ("acceleration_limit",)
    python_state = ("twisted",)
    python = """
        asked = right - left
        twisted = approach(twisted, asked, {limit} * B / R * step_s)
        left, right = left - (twisted - asked) / 2.0, right + (twisted - asked) / 2.0"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        if self.is_neutral:
            return wheels
        limit, resets = (
            self.values["limit"] * context.track_m / context.vehicle.wheel_radius_m,
            context.wheels,
        )
        asked = wheels.right - wheels.left
        start = resets.start[:, 1] - resets.start[:, 0]
        added = 0.5 * (limit_rate(asked, limit, context.step_s, resets, start) - asked)
        return replace(wheels, left=wheels.left - added, right=wheels.right + added, idle=None)

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether the wheels reach steps of the command at once."""
        least = max(LEAST_RAMP_S, 2.0 * conditions.least_delay_s)
        return not self.values["limit"] * least < conditions.largest.turn

    def _list_usual(self, largest: Largest) -> dict[str, float]:
        return {"limit": largest.turn}
