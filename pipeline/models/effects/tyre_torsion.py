"""Tyre torsion: the yaw of the body swings on its tyres, also after the wheels stand.

    tau^2 d2w/dt2 + 2 damping tau dw/dt = w0 - w + 2 damping tau dw0/dt

The tyres are a spring and a damper between the wheels and the body. tau [s] is one over the natural frequency
of the yaw, damping a plain number: with 0.2 it swings a few times. It makes nothing late. Turn in steps, with
stops from fast turns, on the spot and while driving.

Source: second-order systems driven at their base; Thomson and Dahleh, Theory of Vibration with Applications,
chapter 3; Pacejka, Tire and Vehicle Dynamics, chapter 9 (torsion of standing tyres).
"""

import math
from dataclasses import replace

from pipeline.models.effect import NAN, BodyEffect, Excitation, Least, Parameter, Plausible, Search
from pipeline.models.families import TIME_CONSTANT
from pipeline.models.filters import swing_signal
from pipeline.models.parameter import Conditions
from pipeline.run.signals import Rolling, RunContext, Velocity

_STRONG = 0.7
"""Damping from which a step overshoots by less than 5 %: nothing swings."""


class TyreTorsion(BodyEffect):
    """Tyre torsion: the yaw of the body swings on its tyres, also after the wheels stand."""

    id = "tyre_torsion"
    rank = 20
    kinds = ("differential", "mecanum")
    parameters = (
        replace(
            TIME_CONSTANT,
            about="inverse natural frequency, of the yaw",
            typical=0.12,
            starts=(),
            search=Search.STARTS,
            least=Least(0.03, Least.STAMPS),
            plausible=Plausible(0.0, 0.6, "tyres swing faster than 0.3 Hz"),
        ),
        Parameter(
            "damping",
            "1",
            (0.02, 1.5),
            NAN,
            "damping ratio of the tyres",
            0.2,
            search=Search.STARTS,
            step=5e-3,
        ),
    )
    starts = (
        {"tau": 0.07, "damping": 0.3},
        {"tau": 0.12, "damping": 0.3},
        {"tau": 0.25, "damping": 0.3},
    )
    needs = (Excitation.CHANGES, Excitation.TURNING)

    def move_body(self, rolling: Rolling, context: RunContext) -> Velocity:
        """See the formula above."""
        tau, damping = self.values["tau"], self.values["damping"]
        if tau <= 0.0:
            return rolling.velocity
        resets = context.body
        damping = self.parameter("damping").typical if math.isnan(damping) else damping
        w = swing_signal(rolling.w0, tau, damping, context.step_s, resets, resets.start[:, 2], from_base=True)
        return replace(rolling, w0=w).velocity

    def can_show(self, conditions: Conditions) -> bool:
        """Only measured wheels tell it from a drive that swings."""
        return conditions.encoders

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether nothing swings."""
        return not self.values["damping"] < _STRONG
