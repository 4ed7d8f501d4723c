"""Speed slip: the faster the wheels turn, the larger the share of their motion that is lost.

    v_x += -k * v0 * abs(v0)

k [s/m], about 0.08 on loose ground. Drive at several speeds, forward and backward.

Source: longitudinal slip growing with traction; see Wong, Theory of Ground Vehicles, chapter 2.
"""

from collections.abc import Mapping

import numpy as np

from pipeline.models.effect import Column, Excitation, LinearEffect, Parameter, Plausible
from pipeline.run.signals import Rolling, RunContext, Velocity


class SpeedSlip(LinearEffect):
    """Speed slip: the faster the wheels turn, the larger the share of their motion that is lost."""

    id = "speed_slip"
    parameters = (
        Parameter(
            "k",
            "s/m",
            (-0.5, 0.5),
            0.0,
            "share of speed lost per speed",
            0.08,
            plausible=Plausible(-0.02, 0.4, "wider than the 0.08 of loose ground"),
            one_sign=True,
        ),
    )
    motion = "Speed slip: {share} travel than ideal at 1 m/s, growing with speed"
    clause = "travels {share} than ideal at 1 m/s"
    share_of = (1.0, -1.0)
    needs = (Excitation.SPEED_SPREAD,)
    confused_with = ("wheel_radius", "turning_resistance")
    python = "v_x = v_x - {k} * v0 * abs(v0)"

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        return {"k": (-rolling.v0 * np.abs(rolling.v0), 0.0, 0.0)}
