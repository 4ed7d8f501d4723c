"""Wheel asymmetry: the wheels of one side are larger than those of the other.

    left r * (1 - e/2), right r * (1 + e/2):  v0 += e*b*w0/4,  w0 += e*v0/b

e is a plain number, 1 to 5 %; 8 % with one soft side. Drive straight forward and backward.

Source: unequal wheel diameters; Borenstein and Feng, IEEE T-RA 1996 (UMBmark).
"""

from collections.abc import Iterable
from dataclasses import replace

from pipeline.models.effect import (
    Effect,
    Excitation,
    KinematicEffect,
    Least,
    Parameter,
    Plausible,
    Spread,
    name_side,
)
from pipeline.models.parameter import Quantity
from pipeline.run.signals import Rolling, RunContext
from pipeline.sources import Vehicle


class WheelAsymmetry(KinematicEffect):
    """Wheel asymmetry: the wheels of one side are larger than those of the other."""

    id = "wheel_asymmetry"
    rank = 10
    kinds = ("differential", "mecanum")
    parameters = (
        Parameter(
            "e",
            "1",
            (-0.5, 0.5),
            0.0,
            "right minus left radius over their mean",
            0.04,
            least=Least(0.003, Least.DATA_SHEET),
            plausible=Plausible(-0.2, 0.2, "wider than the 8 % of one soft side"),
            quantities=(Quantity.RADIUS_DIFFERENCE,),
            between_runs=Spread(0.016),
        ),
    )
    needs = (Excitation.BOTH_SIGNS, Excitation.SPEED_SPREAD)
    confused_with = ("yaw_drift", "lever_arm", "icr_lateral")
    python = "v0, w0 = v0 + {e} * B * w0 / 4.0, w0 + {e} * v0 / B"

    def describe_motion(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """What the vehicle does, with numbers."""
        share = self.values["e"]
        return f"Wheel asymmetry: the {name_side(-share)} wheels are {100.0 * abs(share):.1f} % larger"

    def roll(self, rolling: Rolling, context: RunContext) -> Rolling:
        """See the formula above."""
        uneven, track = self.values["e"], context.track_m
        return replace(
            rolling,
            v0=rolling.v0 + 0.25 * uneven * track * rolling.w0,
            w0=rolling.w0 + uneven / track * rolling.v0,
        )
