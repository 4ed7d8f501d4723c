"""Steering offset: the steering angle is not zero at zero command.

    delta = delta + o

o [rad], about 0.04. Drive straight at several speeds.

Source: kinematic bicycle with an uncalibrated steering; Becker et al. 2023.
"""

from dataclasses import replace

from pipeline.models.effect import ACKERMANN, DriveEffect, Excitation, Least, Parameter
from pipeline.models.parameter import Conditions, Quantity
from pipeline.run.signals import RunContext, Wheels


class SteeringOffset(DriveEffect):
    """Steering offset: the steering angle is not zero at zero command."""

    id = "steering_offset"
    rank = 70
    kinds = ACKERMANN
    parameters = (
        Parameter(
            "o",
            "rad",
            (-0.5, 0.5),
            0.0,
            "steering angle at zero command",
            0.04,
            least=Least(0.002, Least.DATA_SHEET),
            quantities=(Quantity.STEERING_OFFSET,),
        ),
    )
    motion = "Steering offset: {angle} to the {way} at zero command"
    clause = "steers {angle} to the {way} at zero command"
    needs = (Excitation.SPEED_SPREAD,)
    confused_with = ("yaw_drift",)
    equivalent_to = ("steering_sensor_offset",)
    equivalent_when = "if only commands and body motion are used"
    python = "steering = steering + {o}"

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        return replace(wheels, steering=wheels.steering + self.values["o"])

    def is_equivalent(self, conditions: Conditions) -> bool:
        """A steering sensor shows whether the offset is before or after the sensor."""
        return not conditions.encoders
