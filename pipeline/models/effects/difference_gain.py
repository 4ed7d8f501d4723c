"""Difference gain: the difference of the wheel speeds is a constant share of its command.

    D = Omega_r - Omega_l:  D = g * D

g is a plain number: below 1 where scrub holds back a controller without integral part. Turn slowly and
quickly. Only encoders tell it from the effective track; a share that falls with the turn is a turn droop.

Source: steady state of a proportional speed controller; Astrom and Murray, Feedback Systems, chapter 10.
"""

from collections.abc import Iterable
from dataclasses import replace

from pipeline.core import format_share
from pipeline.models.effect import SIDES, DriveEffect, Effect, Excitation
from pipeline.models.effects.drive_gain import SHARE, DriveGain
from pipeline.models.parameter import Conditions
from pipeline.run.signals import RunContext, Wheels
from pipeline.sources import Vehicle


class DifferenceGain(DriveEffect):
    """Difference gain: the difference of the wheel speeds is a constant share of its command."""

    id = "difference_gain"
    rank = 1
    kinds = SIDES
    parameters = (replace(SHARE, about="actual over commanded difference of the wheel speeds", typical=0.7),)
    motion = "Difference gain: the robot reaches {percent} of the commanded speed difference of its sides"
    needs = (Excitation.TURNING,)
    confused_with = ("effective_track", "turn_droop", "wheel_servo", "body_turn_limit")
    python = """
        lost = (1.0 - {g}) * (right - left) / 2.0
        left, right = left + lost, right - lost"""

    def describe_motion(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """What the sides reach, with the gain of all wheels."""
        gain = next((one.values["g"] for one in beside if isinstance(one, DriveGain)), 1.0)
        if gain == 1.0 or self.open_numbers:
            return super().describe_motion(vehicle)
        both = self.motion.format(percent=format_share(gain * self.values["g"], 3))
        return both.replace(":", ", with the drive gain:", 1)

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        lost = 0.5 * (1.0 - self.values["g"]) * (wheels.right - wheels.left)
        return replace(wheels, left=wheels.left + lost, right=wheels.right - lost)

    def can_show(self, conditions: Conditions) -> bool:
        """Without measured wheels it is the same as a wider track."""
        return conditions.encoders
