"""Roller slip: the faster the vehicle drives sideways, the larger the share of that motion its rollers lose.

    v_y += -k * s0 * abs(s0)

s0 is the speed to the left. k [s/m]: 0.3 loses 15 % at 0.5 m/s. Drive sideways at several speeds, both ways,
to tell it from a scale that is the same at every speed.

Source: slip growing with traction; see Wong, Theory of Ground Vehicles, chapter 2.
"""

from collections.abc import Mapping

import numpy as np

from pipeline.models.effect import SIDEWAYS, Column, Excitation, LinearEffect, Parameter, Plausible
from pipeline.run.signals import Rolling, RunContext, Velocity


class RollerSlip(LinearEffect):
    """Roller slip: the faster it drives sideways, the larger the share of that motion its rollers lose."""

    id = "roller_slip"
    kinds = SIDEWAYS
    parameters = (
        Parameter(
            "k",
            "s/m",
            (-2.0, 2.0),
            0.0,
            "share of sideways speed lost per sideways speed",
            0.3,
            plausible=Plausible(-0.05, 1.5, "wider than losing half of one metre a second"),
            one_sign=True,
        ),
    )
    motion = "Roller slip: {share} sideways travel than ideal at 0.5 m/s, growing with speed"
    clause = "travels {share} sideways than ideal at 0.5 m/s"
    share_of = (1.0, -0.5)
    needs = (Excitation.SIDEWAYS, Excitation.SPEED_SPREAD)
    confused_with = ("lateral_scale",)
    python = "v_y = v_y - {k} * s0 * abs(s0)"

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        return {"k": (0.0, -rolling.s0 * np.abs(rolling.s0), 0.0)}
