"""Understeer: the faster a car drives, the less it turns for the same steering.

    w0 = v0 * tan(delta) / (l + K * v0^2)

K [s^2/m], about 0.03. Take the same curve at several speeds.

Source: Gillespie, Fundamentals of Vehicle Dynamics, steady-state cornering.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from pipeline.models.effect import (
    ACKERMANN,
    Effect,
    Excitation,
    KinematicEffect,
    Parameter,
    Plausible,
    format_share_of_gain,
)
from pipeline.run.signals import Rolling, RunContext
from pipeline.sources import Vehicle


class Understeer(KinematicEffect):
    """Understeer: the faster a car drives, the less it turns for the same steering."""

    id = "understeer"
    rank = 40
    kinds = ACKERMANN
    parameters = (
        Parameter(
            "K",
            "s^2/m",
            (-0.05, 1.0),
            0.0,
            "understeer gradient",
            0.03,
            plausible=Plausible(-0.02, 0.5, "wider than the 0.03 of a road car"),
        ),
    )
    needs = (Excitation.SPEED_SPREAD, Excitation.STEERING)
    confused_with = ("steering_gain",)
    python = "w0 = w0 / max(1.0 + {K} / WHEELBASE * v0 * v0, 0.05)"

    def describe_motion(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """What the vehicle does, with numbers."""
        at = 3.0
        wheelbase = vehicle.wheelbase_m or 1.0
        share = 1.0 - wheelbase / (wheelbase + self.values["K"] * at**2)
        return f"Understeer: the robot turns {format_share_of_gain(1.0 - share)} than ideal at {at:g} m/s"

    def roll(self, rolling: Rolling, context: RunContext) -> Rolling:
        """See the formula above."""
        wheelbase = context.vehicle.wheelbase_m or 1.0
        divisor = np.maximum(1.0 + self.values["K"] / wheelbase * rolling.v0**2, 0.05)
        return replace(rolling, w0=rolling.w0 / divisor)
