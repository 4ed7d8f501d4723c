"""Lateral skid: in a turn the vehicle slides outward.

    v_y += -c * v0 * w0

c [s] grows with speed and falls with grip: 0.02 on tile, 0.15 on ice. A vehicle that drives sideways at s0
slides outward along x as well, by c s0 w0. Drive turns of both signs at several speeds, forward and
backward, to tell it from a shifted centre of rotation.

Source: Seegmiller and Kelly, RSS 2014, the centripetal term of the slip model.
"""

from collections.abc import Mapping

from pipeline.models.effect import Column, Excitation, Least, LinearEffect, Parameter, Plausible, Spread
from pipeline.models.parameter import LEAST_DELAY_S
from pipeline.run.signals import Rolling, RunContext, Velocity


class LateralSkid(LinearEffect):
    """Lateral skid: in a turn the vehicle slides outward."""

    id = "lateral_skid"
    parameters = (
        Parameter(
            "c",
            "s",
            (-0.5, 0.5),
            0.0,
            "outward slip per centripetal acceleration",
            0.1,
            least=Least(LEAST_DELAY_S, Least.STAMPS),
            plausible=Plausible(-0.02, 0.4, "wider than 0.02 on tile and 0.15 on ice"),
            one_sign=True,
            between_runs=Spread(0.064),
        ),
    )
    motion = "Lateral skid: {size:.2g} m/s {way} at 1 m/s and 1 rad/s"
    clause = "slides {size:.2g} m/s {way} at 1 m/s in a curve of 1 m radius"
    ways = ("outward", "inward")
    needs = (Excitation.TURNING, Excitation.SPEED_SPREAD)
    confused_with = ("icr_offset", "body_inertia", "heading_skew", "drive_lag")
    python = """
        v_x = v_x + {c} * s0 * w0
        v_y = v_y - {c} * v0 * w0"""

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        return {"c": (rolling.s0 * rolling.w0, -rolling.v0 * rolling.w0, 0.0)}
