"""Turning resistance: a skid-steered vehicle loses forward speed while it turns.

    v_x += -k * v0 * abs(w0)

k [s], about 0.24 on a Husky in snow. Drive the same speed straight and in turns of both signs.

Source: DRIVE, Baril et al. 2024, learned slip terms; its other form is k sign(v0) abs(w0).
"""

from collections.abc import Mapping

import numpy as np

from pipeline.models.effect import Column, Excitation, LinearEffect, Parameter, Plausible
from pipeline.run.signals import Rolling, RunContext, Velocity


class TurningResistance(LinearEffect):
    """Turning resistance: a skid-steered vehicle loses forward speed while it turns."""

    id = "turning_resistance"
    parameters = (
        Parameter(
            "k",
            "s",
            (-1.0, 1.0),
            0.0,
            "share of speed lost per yaw rate",
            0.24,
            plausible=Plausible(-0.05, 0.6, "wider than the 0.24 of a Husky in snow"),
            one_sign=True,
        ),
    )
    motion = "Turning resistance: the robot travels {share} at 1 rad/s than straight ahead"
    clause = "travels {share} while turning at 1 rad/s than straight ahead"
    share_of = (1.0, -1.0)
    needs = (Excitation.TURNING, Excitation.SPEED_SPREAD)
    confused_with = ("speed_slip", "wheel_radius")
    python = "v_x = v_x - {k} * v0 * abs(w0)"

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        return {"k": (-rolling.v0 * np.abs(rolling.w0), 0.0, 0.0)}
