"""Motor imbalance: the motor of one side is weaker than that of the other, as with less voltage.

    largest force at rest of wheel_servo: bound (1 - e/2) on the left, bound (1 + e/2) on the right

e is the voltage of the right motor minus that of the left one, over their mean: the force of a DC motor at
rest and its speed without load grow with the voltage. The weaker side is slower where the force is the
largest one, above all as the outer side of a turn on ground of high friction: turns to one side are slower
than to the other. Drive at large speeds and turn quickly both ways.

Source: DC motors of Franklin, Powell and Emami-Naeini, Feedback Control of Dynamic Systems, chapter 2;
measured on five of nine recordings of a Warthog, whose left motor is weaker by 8 to 15 %.
"""

from collections.abc import Iterable
from dataclasses import replace

from pipeline.core import format_share
from pipeline.models.effect import DriveEffect, Effect, Excitation, Least, Parameter, Plausible, name_side
from pipeline.models.parameter import Conditions, Level
from pipeline.run.signals import RunContext, Wheels
from pipeline.sources import Vehicle


class MotorImbalance(DriveEffect):
    """Motor imbalance: the motor of one side is weaker than that of the other, as with less voltage."""

    id = "motor_imbalance"
    rank = 30
    kinds = ("differential",)
    parameters = (
        Parameter(
            "e",
            "1",
            (-1.0, 1.0),
            0.0,
            "right minus left voltage over their mean",
            0.1,
            least=Least(0.01, Least.DATA_SHEET),
            plausible=Plausible(-0.5, 0.5, "a larger difference is a fault of one motor"),
            level=Level.VEHICLE,
        ),
    )
    acts_with = ("wheel_servo",)
    needs = (Excitation.BOTH_SIGNS, Excitation.LARGE)
    confused_with = ("side_gain", "wheel_asymmetry", "wheel_servo")
    python = "imbalance = {e}"

    def describe_motion(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """What the vehicle does, with numbers."""
        size, side = abs(self.values["e"]), name_side(self.values["e"])
        share = format_share(2.0 * size / (2.0 + size), 2)
        return f"Motor imbalance: the motor on the {side} is weaker, as with {share} less voltage"

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        return replace(wheels, imbalance=self.values["e"])

    def can_show(self, conditions: Conditions) -> bool:
        """Without measured wheels it is the same as wheels of unequal size."""
        return conditions.encoders
