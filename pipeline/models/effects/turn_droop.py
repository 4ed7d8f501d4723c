"""Turn droop: beyond a threshold the difference of the wheels falls short of its command.

    D = Omega_r - Omega_l:  D = kept + gain * (D - kept),  kept = clip(D, -threshold, threshold)

threshold [rad/s]; gain is a plain number. The Warthog reaches 84 to 100 % of a wheel difference of the same
sign, 4 to 80 % after a change of sign. Turn slowly and quickly, on the spot and while driving.

Source: measured on the DRIVE recordings.
"""

import math
from dataclasses import replace

import numpy as np

from pipeline.models.effect import NAN, SIDES, DriveEffect, Excitation, Least, Parameter, Plausible
from pipeline.models.parameter import Conditions, Largest
from pipeline.run.signals import RunContext, Wheels

# Shares of the largest commanded difference: below it is a gain, above it has no effect.
_THRESHOLDS = (0.1, 0.99)
# Gain beyond the threshold below which it is a limit.
_LEAST_RISE = 0.08
_USUAL_THRESHOLD = 0.4
"""Start value of the threshold as a share of the largest wheel difference: it is within the driven range."""


class TurnDroop(DriveEffect):
    """Turn droop: beyond a threshold the difference of the wheels falls short of its command."""

    id = "turn_droop"
    rank = 40
    kinds = SIDES
    parameters = (
        Parameter(
            "threshold",
            "rad/s",
            (0.0, 200.0),
            NAN,
            "wheel speed difference above which it falls short",
            1.5,
            starts=(0.5, 1.5, 4.0, 10.0),
            step=1e-2,
        ),
        Parameter(
            "gain",
            "1",
            (0.0, 1.5),
            1.0,
            "share of the excess difference that is reached",
            0.4,
            least=Least(0.03, Least.DATA_SHEET),
            plausible=Plausible(0.0, 0.97, "with all of it reached nothing droops"),
        ),
    )
    motion = "Turn droop: gain {gain:.2f} beyond a wheel speed difference of {threshold:.2g} rad/s"
    clause = "turns with a gain of {gain:.2f} beyond a difference of {rim:.2g} m/s between its sides"
    needs = (Excitation.LARGE, Excitation.TURNING)
    confused_with = ("effective_track", "difference_gain", "wheel_speed_limit", "body_turn_limit")
    contains = ("effective_track", "difference_gain")
    python = """
        lost = (1.0 - {gain}) * (right - left - max(-{threshold}, min({threshold}, right - left)))
        left, right = left + lost / 2.0, right - lost / 2.0"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        gain = self.values["gain"]
        threshold = 0.0 if math.isnan(self.values["threshold"]) else self.values["threshold"]
        difference = wheels.right - wheels.left
        lost = (1.0 - gain) * (difference - np.clip(difference, -threshold, threshold))
        return replace(wheels, left=wheels.left + 0.5 * lost, right=wheels.right - 0.5 * lost)

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether it is a gain (the same as a wider track without measured wheels) or a limit."""
        low, high = _THRESHOLDS
        bends = low < self.values["threshold"] / conditions.largest.difference < high
        return not (bends and self.values["gain"] > _LEAST_RISE)

    def _list_usual(self, largest: Largest) -> dict[str, float]:
        return {**super()._list_usual(largest), "threshold": _USUAL_THRESHOLD * largest.difference}
