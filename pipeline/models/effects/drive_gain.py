"""Drive gain: all wheels reach a constant share of their commanded speed.

    Omega = g * u, each wheel

g is a plain number: 1 with an integral part in the speed controller, below it without. Drive at several
steady speeds. Only encoders tell it from the wheel radius; a speed that no command exceeds is a limit.
Gains come first in the drive: ramps and limits behind them are those of the measured wheels.

Source: steady state of a proportional speed controller; Astrom and Murray, Feedback Systems, chapter 10.
"""

from dataclasses import replace

from pipeline.models.effect import DriveEffect, Excitation, Least, Parameter, Plausible
from pipeline.models.parameter import Conditions
from pipeline.run.signals import RunContext, Wheels

SHARE = Parameter(
    "g",
    "1",
    (0.05, 3.0),
    1.0,
    "actual over commanded wheel speed",
    0.9,
    least=Least(0.01, Least.DATA_SHEET),
    plausible=Plausible(
        0.2, 1.3, "a controller without integral part reaches less, a wrong scale is a finding"
    ),
)


class DriveGain(DriveEffect):
    """Drive gain: all wheels reach a constant share of their commanded speed."""

    id = "drive_gain"
    scale_role = "gain"
    rank = 0
    parameters = (SHARE,)
    motion = "Drive gain: the wheels reach {percent} of the commanded speed"
    clause = "turns its wheels at {percent} of the commanded speed"
    needs = (Excitation.SPEED_SPREAD,)
    confused_with = ("wheel_radius", "wheel_speed_limit", "wheel_servo", "gain_drift")
    same_at_one_speed = ("body_speed_limit", "wheel_speed_limit", "wheel_servo")
    python = "left, right, sideways = {g} * left, {g} * right, {g} * sideways"

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        share = self.values["g"]
        sideways = None if wheels.sideways is None else share * wheels.sideways
        return replace(wheels, left=share * wheels.left, right=share * wheels.right, sideways=sideways)

    def can_show(self, conditions: Conditions) -> bool:
        """Without measured wheels it is the same as another wheel radius."""
        return conditions.encoders
