"""Steering gain: the steering angle is a constant multiple of its command.

    delta = g * delta

g is a plain number, 0.85 for worn linkage. Steer to both sides at several angles.

Source: kinematic bicycle with an uncalibrated steering; Becker et al. 2023.
"""

from dataclasses import replace

from pipeline.models.effect import ACKERMANN, DriveEffect, Excitation, Least, Parameter, Plausible
from pipeline.models.parameter import Quantity
from pipeline.run.signals import RunContext, Wheels


class SteeringGain(DriveEffect):
    """Steering gain: the steering angle is a constant multiple of its command."""

    id = "steering_gain"
    rank = 50
    kinds = ACKERMANN
    parameters = (
        Parameter(
            "g",
            "1",
            (0.05, 5.0),
            1.0,
            "actual over commanded steering angle",
            0.85,
            least=Least(0.01, Least.DATA_SHEET),
            plausible=Plausible(0.5, 1.5, "wider than the 0.85 of a worn linkage"),
            quantities=(Quantity.STEERING_GAIN,),
        ),
    )
    motion = "Steering gain: {g:.2f} times the commanded angle"
    clause = "steers {g:.2f} times the commanded angle"
    needs = (Excitation.STEERING,)
    confused_with = ("understeer",)
    python = "steering = {g} * steering"

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        return replace(wheels, steering=self.values["g"] * wheels.steering)
