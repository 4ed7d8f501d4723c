"""Slope slip: uphill the wheels lose a share of their travel, downhill they gain it.

    v_x += k * sin(pitch) * abs(v0)

pitch > 0 is nose down. k [1], 0.5 to 1.5 on loose ground: the slip ratio over the slope. Drive up and down a
slope at several speeds.

Source: Seegmiller and Kelly, RSS 2014: slip in proportion to the components of gravity and to the speed.
"""

import math
from collections.abc import Mapping

import numpy as np

from pipeline.models.effect import Column, Excitation, LinearEffect, Parameter, Plausible
from pipeline.run.signals import Rolling, RunContext, Velocity


class SlopeSlip(LinearEffect):
    """Slope slip: uphill the wheels lose a share of their travel, downhill they gain it."""

    id = "slope_slip"
    parameters = (
        Parameter(
            "k",
            "1",
            (-3.0, 3.0),
            0.0,
            "share of the travel that is lost, over the sine of the slope",
            1.0,
            plausible=Plausible(-0.1, 2.5, "a slope of 20 degrees then takes at most 86 % of the travel"),
            one_sign=True,
        ),
    )
    motion = "Slope slip: {share} travel than ideal uphill on a slope of 10 degrees"
    clause = "travels {share} than ideal uphill on a slope of 10 degrees"
    share_of = (1.0, -math.sin(math.radians(10.0)))
    needs = (Excitation.SLOPE, Excitation.SPEED_SPREAD)
    confused_with = ("slope_creep", "grade_load", "wheel_radius")
    same_at_one_speed = ("slope_creep",)
    python = "v_x = v_x + {k} * math.sin(pitch) * abs(v0)"

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        ahead, _ = context.downhill
        return {"k": (ahead * np.abs(rolling.v0), 0.0, 0.0)}
