"""Side gain: one side reaches a larger share of its commanded speed than the other.

    left u * (1 - e/2), right u * (1 + e/2)

e is a plain number. Drive straight forward and backward. Only encoders tell it from wheels of unequal size.

Source: unequal motors under a proportional speed controller; Borenstein and Feng, IEEE T-RA 1996 (UMBmark).
"""

from collections.abc import Iterable
from dataclasses import replace

from pipeline.models.effect import (
    DriveEffect,
    Effect,
    Excitation,
    Least,
    Parameter,
    Plausible,
    name_side,
)
from pipeline.models.parameter import Conditions
from pipeline.run.signals import RunContext, Wheels
from pipeline.sources import Vehicle


class SideGain(DriveEffect):
    """Side gain: one side reaches a larger share of its commanded speed than the other."""

    id = "side_gain"
    rank = 1
    kinds = ("differential", "mecanum")
    parameters = (
        Parameter(
            "e",
            "1",
            (-0.5, 0.5),
            0.0,
            "right minus left gain over their mean",
            0.05,
            least=Least(0.005, Least.DATA_SHEET),
            plausible=Plausible(-0.3, 0.3, "a larger difference is a fault of one motor"),
        ),
    )
    needs = (Excitation.BOTH_SIGNS, Excitation.SPEED_SPREAD)
    confused_with = ("wheel_asymmetry", "side_lag")
    python = "left, right = left * (1.0 - {e} / 2.0), right * (1.0 + {e} / 2.0)"

    def describe_motion(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """What the vehicle does, with numbers."""
        share, side = self.values["e"], name_side(-self.values["e"])
        return f"Side gain: the {side} wheels turn {100.0 * abs(share):.1f} % faster than the others"

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        uneven = 0.5 * self.values["e"]
        return replace(wheels, left=(1.0 - uneven) * wheels.left, right=(1.0 + uneven) * wheels.right)

    def can_show(self, conditions: Conditions) -> bool:
        """Without measured wheels it is the same as wheels of unequal size."""
        return conditions.encoders
