"""Slope creep: while its wheels turn, the vehicle creeps backward uphill and forward downhill.

    v_x += c * sin(pitch) * turning

pitch > 0 is nose down; turning is one while the wheels turn. c [m/s], 0.4 to 0.8, whatever the speed. Drive
up and down a slope at several speeds.

Source: Seegmiller and Kelly, RSS 2014, the gravity term of the slip model.
"""

import math
from collections.abc import Mapping

from pipeline.models.effect import Column, Excitation, LinearEffect, Parameter, Plausible
from pipeline.models.parameter import Conditions
from pipeline.run.signals import Rolling, RunContext, Velocity, find_turning


class SlopeCreep(LinearEffect):
    """Slope creep: while its wheels turn, the vehicle creeps backward uphill and forward downhill."""

    id = "slope_creep"
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
    motion = "Slope creep: {size:.2g} m/s {way} along the body on a slope of 10 degrees"
    clause = "creeps {size:.2g} m/s {way} when it climbs or descends a slope of 10 degrees"
    ways = ("downhill", "uphill")
    size_in = math.sin(math.radians(10.0))
    needs = (Excitation.SLOPE, Excitation.SPEED_SPREAD)
    confused_with = ("slope_slip",)
    equivalent_to = ("grade_load",)
    equivalent_when = "if there are no encoders"
    same_at_one_speed = ("slope_slip",)
    python = "v_x = v_x + {c} * math.sin(pitch) * turning"

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        ahead, _ = context.downhill
        return {"c": (ahead * find_turning(rolling.wheels, context), 0.0, 0.0)}

    def is_equivalent(self, conditions: Conditions) -> bool:
        """Without encoders wheels that turn slower uphill are wheels that slip."""
        return not conditions.encoders
