"""Side slope turn: across a slope the front swings downhill, in proportion to the speed.

    v_w += -k * cos(pitch) * sin(roll) * v0

roll > 0 is left side up; below zero the front swings uphill. k [rad/m]: 0.4 turns a vehicle by 4 degrees a
metre across a slope of 10 degrees. Drive across a slope both ways.

Source: Seegmiller and Kelly, RSS 2014: slip of the yaw rate in proportion to gravity's lateral component.
"""

import math
from collections.abc import Mapping

from pipeline.models.effect import Column, Excitation, LinearEffect, Parameter, Plausible
from pipeline.run.signals import Rolling, RunContext, Velocity


class SideSlopeTurn(LinearEffect):
    """Side slope turn: across a slope the front swings downhill, in proportion to the speed."""

    id = "side_slope_turn"
    parameters = (
        Parameter(
            "k",
            "rad/m",
            (-3.0, 3.0),
            0.0,
            "curvature of the path at a slope of 90 degrees (k sin(slope))",
            0.4,
            plausible=Plausible(-1.5, 1.5, "a curve of 4 m radius on a slope of 10 degrees"),
        ),
    )
    motion = "Side slope turn: {angle} {way} a metre across a slope of 10 degrees"
    clause = "turns {angle} {way} with every metre across a slope of 10 degrees"
    ways = ("downhill", "uphill")
    size_in = math.sin(math.radians(10.0))
    needs = (Excitation.SLOPE,)
    confused_with = ("wheel_asymmetry", "yaw_drift")
    python = "v_w = v_w - {k} * math.cos(pitch) * math.sin(roll) * v0"

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        _, aside = context.downhill
        return {"k": (0.0, 0.0, aside * rolling.v0)}
