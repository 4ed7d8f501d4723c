"""Slope drift: while it drives on a slope, the vehicle slides downhill.

    v_x += k * sin(pitch) * turning,   v_y += -k * cos(pitch) * sin(roll) * turning

pitch > 0 is nose down; turning is one while the wheels turn. k [m/s], 0.4 to 0.8. Drive a slope in several
directions.

Source: Seegmiller and Kelly, RSS 2014, the gravity term of the slip model.
"""

import math
from collections.abc import Mapping

import numpy as np

from pipeline.models.effect import Column, Excitation, LinearEffect, Parameter, Plausible
from pipeline.run.signals import Rolling, RunContext, Velocity, find_turning


class SlopeDrift(LinearEffect):
    """Slope drift: while it drives on a slope, the vehicle slides downhill."""

    id = "slope_drift"
    parameters = (
        Parameter(
            "k",
            "m/s",
            (-3.0, 3.0),
            0.0,
            "downhill speed at a slope of 90 degrees (k sin(slope))",
            0.6,
            plausible=Plausible(-0.1, 2.5, "wider than the 0.4 to 0.8 m/s that were seen"),
            one_sign=True,
        ),
    )
    motion = "Slope drift: {size:.2g} m/s {way} on a slope of 10 degrees"
    clause = "drifts {size:.2g} m/s {way} on a slope of 10 degrees"
    ways = ("downhill", "uphill")
    size_in = math.sin(math.radians(10.0))
    needs = (Excitation.SLOPE,)
    confused_with = ("lateral_drift",)
    python = """
        v_x = v_x + {k} * math.sin(pitch) * turning
        v_y = v_y - {k} * math.cos(pitch) * math.sin(roll) * turning"""

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        turning = find_turning(rolling.wheels, context)
        roll, pitch = context.attitude[:, 0], context.attitude[:, 1]
        return {"k": (np.sin(pitch) * turning, -np.cos(pitch) * np.sin(roll) * turning, 0.0)}
