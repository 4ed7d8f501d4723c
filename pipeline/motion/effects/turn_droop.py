"""Turn droop: beyond a threshold the difference of the wheels falls short of its command.

    D = Omega_r - Omega_l:  D = kept + gain * (D - kept),  kept = clip(D, -threshold, threshold)

threshold [rad/s]; gain is a plain number. The Warthog reaches 84 to 100 % of a wheel difference of the same
sign, 4 to 80 % after a change of sign. Turn slowly and quickly, on the spot and while driving.

Source: measured on the DRIVE recordings.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.motion.effect import DIFFERENTIAL, NAN, DriveEffect, Excitation, Parameter, Search

if TYPE_CHECKING:
    from pipeline.motion.signals import Surroundings, Wheels


class TurnDroop(DriveEffect):
    """Turn droop: beyond a threshold the difference of the wheels falls short of its command."""

    id = "turn_droop"
    rank = 40
    kinds = DIFFERENTIAL
    parameters = (
        Parameter(
            "threshold",
            "rad/s",
            (0.0, 200.0),
            NAN,
            "wheel difference from which it falls short",
            1.5,
            search=Search.STARTS,
            starts=(0.5, 1.5, 4.0, 10.0),
            step=1e-2,
        ),
        Parameter("gain", "1", (0.0, 1.5), 1.0, "share of the excess that is reached", 0.4),
    )
    needs = (Excitation.LARGE, Excitation.TURNING)
    confused_with = ("effective_track", "wheel_speed_limit", "body_turn_limit")

    def drive_wheels(self, wheels: Wheels, around: Surroundings) -> Wheels:
        """See the formula above."""
        del around
        gain = self.values["gain"]
        threshold = float(np.nan_to_num(self.values["threshold"]))
        difference = wheels.right - wheels.left
        lost = (1.0 - gain) * (difference - np.clip(difference, -threshold, threshold))
        return replace(wheels, left=wheels.left + 0.5 * lost, right=wheels.right - 0.5 * lost)
