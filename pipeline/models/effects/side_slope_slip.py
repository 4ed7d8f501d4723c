"""Side slope slip: across a slope the vehicle slides downhill, in proportion to its speed.

    v_y += -k * cos(pitch) * sin(roll) * abs(v0)

roll > 0 is left side up. k [1], 0.3 to 1 on loose ground: the angle of the slide over the slope. Drive across
a slope both ways at several speeds.

Source: Seegmiller and Kelly, RSS 2014: slip in proportion to the components of gravity and to the speed.
"""

import math
from collections.abc import Mapping

import numpy as np

from pipeline.models.effect import Column, Excitation, LinearEffect, Parameter, Plausible
from pipeline.run.signals import Rolling, RunContext, Velocity


class SideSlopeSlip(LinearEffect):
    """Side slope slip: across a slope the vehicle slides downhill, in proportion to its speed."""

    id = "side_slope_slip"
    parameters = (
        Parameter(
            "k",
            "1",
            (-3.0, 3.0),
            0.0,
            "sideways travel over forward travel, over the sine of the slope",
            0.6,
            plausible=Plausible(-0.1, 2.5, "a slope of 20 degrees then turns the course by 40 degrees"),
            one_sign=True,
        ),
    )
    motion = "Side slope slip: {size:.2g} m {way} a metre across a slope of 10 degrees"
    clause = "slides {size:.2g} m {way} with every metre across a slope of 10 degrees"
    ways = ("downhill", "uphill")
    size_in = math.sin(math.radians(10.0))
    needs = (Excitation.SLOPE, Excitation.SPEED_SPREAD)
    confused_with = ("side_slope_creep", "yaw_misalignment", "lateral_skid")
    same_at_one_speed = ("side_slope_creep",)
    python = "v_y = v_y - {k} * math.cos(pitch) * math.sin(roll) * abs(v0)"

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        _, aside = context.downhill
        return {"k": (0.0, aside * np.abs(rolling.v0), 0.0)}
