"""Side slope creep: while its wheels turn across a slope, the vehicle creeps downhill.

    v_y += -c * cos(pitch) * sin(roll) * turning

roll > 0 is left side up; turning is one while the wheels turn. c [m/s], 0.4 to 0.8, whatever the speed. Drive
across a slope both ways at several speeds.

Source: Seegmiller and Kelly, RSS 2014, the gravity term of the slip model.
"""

import math
from collections.abc import Mapping

from pipeline.models.effect import Column, Excitation, LinearEffect, Parameter, Plausible
from pipeline.run.signals import Rolling, RunContext, Velocity, find_turning


class SideSlopeCreep(LinearEffect):
    """Side slope creep: while its wheels turn across a slope, the vehicle creeps downhill."""

    id = "side_slope_creep"
    parameters = (
        Parameter(
            "c",
            "m/s",
            (-3.0, 3.0),
            0.0,
            "downhill speed at a slope of 90 degrees (c sin(slope))",
            0.6,
            plausible=Plausible(-0.1, 2.5, "wider than the 0.4 to 0.8 m/s that were seen"),
            one_sign=True,
        ),
    )
    motion = "Side slope creep: {size:.2g} m/s {way} across a slope of 10 degrees"
    clause = "creeps {size:.2g} m/s {way} across a slope of 10 degrees"
    ways = ("downhill", "uphill")
    size_in = math.sin(math.radians(10.0))
    needs = (Excitation.SLOPE, Excitation.SPEED_SPREAD)
    confused_with = ("side_slope_slip", "lateral_drift")
    same_at_one_speed = ("side_slope_slip",)
    python = "v_y = v_y - {c} * math.cos(pitch) * math.sin(roll) * turning"

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        _, aside = context.downhill
        return {"c": (0.0, aside * find_turning(rolling.wheels, context), 0.0)}
