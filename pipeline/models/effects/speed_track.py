"""Track at speed: the effective track of a skid-steered vehicle changes with its speed.

    v_w += k * abs(v0) * w0

k [s/m], 0.035 to 0.053 on a Warthog on fast asphalt: the effective track is narrower at speed. w0 is the yaw
rate that the track leaves. Turn both ways, on the spot and at several speeds.

Source: Pentzer, Brennan and Reichard, Journal of Field Robotics 31 (2014): instantaneous centres of rotation
that move with speed.
"""

from collections.abc import Mapping

import numpy as np

from pipeline.models.effect import SIDES, Column, Excitation, Least, LinearEffect, Parameter, Plausible
from pipeline.run.signals import Rolling, RunContext, Velocity


class SpeedTrack(LinearEffect):
    """Track at speed: the effective track of a skid-steered vehicle changes with its speed."""

    id = "speed_track"
    kinds = SIDES
    parameters = (
        Parameter(
            "k",
            "s/m",
            (-1.0, 1.0),
            0.0,
            "share of turning gained per speed",
            0.05,
            least=Least(0.01, Least.DATA_SHEET),
            plausible=Plausible(-0.3, 0.3, "wider than the 0.035 to 0.053 of a Warthog on asphalt"),
        ),
    )
    motion = "Speed-dependent track: the robot turns {share} at 1 m/s than on the spot"
    share_of = (1.0, 1.0)
    needs = (Excitation.TURNING, Excitation.SPEED_SPREAD)
    confused_with = ("effective_track", "turn_lag")
    python = "v_w = v_w + {k} * abs(v0) * w0"

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        return {"k": (0.0, 0.0, np.abs(rolling.v0) * rolling.w0)}
