"""Body inertia: with little grip the body follows its wheels with a lag and slides on in turns.

    dv_x/dt = (v0 - v_x)/tau + v_y*w,  dv_y/dt = -v_y/tau - v_x*w,  dw/dt = (w0 - w)/tau

tau [s], 0.2 to 1 on ice. A vehicle that drives sideways at s0 has (s0 - v_y)/tau in the second equation.
Change speed while turning.

Source: Newton's law of a body in viscous contact, written in its own turning frame; the ice runs of Samson et
al. 2024.
"""

from dataclasses import replace

import numpy as np

from pipeline.core import join_parts, turn_units
from pipeline.models.effect import BodyEffect, Excitation, Late, Least, Plausible, Spread
from pipeline.models.families import TIME_CONSTANT, is_one_motion
from pipeline.models.filters import lag_signal
from pipeline.models.parameter import Quantity
from pipeline.run import Rolling, RunContext, Velocity

LEAST_LAG_S = 0.02
"""Smallest lag of the body to report [s]: stamps have errors of this size."""


class BodyInertia(BodyEffect):
    """Body inertia: with little grip the body follows its wheels with a lag and slides on in turns."""

    id = "body_inertia"
    parameters = (
        replace(
            TIME_CONSTANT,
            about="time constant of the body on the ground",
            starts=(0.15, 0.4, 0.9, 1.6),
            least=Least(LEAST_LAG_S, Least.STAMPS),
            plausible=Plausible(0.0, 3.0, "wider than the 0.2 to 1 s of ice"),
            quantities=(Quantity.SPEED_LAG, Quantity.TURN_LAG),
            between_runs=Spread(0.034),
        ),
    )
    needs = (Excitation.CHANGES, Excitation.TURNING)
    late = Late.BODY
    is_equivalent = is_one_motion

    def move_body(self, rolling: Rolling, context: RunContext) -> Velocity:
        """See the formula above."""
        tau, resets, step = self.values["tau"], context.body, context.step_s
        if tau <= 0.0:
            return rolling.velocity
        w = lag_signal(rolling.w0, tau, step, resets, resets.start[:, 2])
        heading = (np.cumsum(w) - 0.5 * w) * step
        # In a frame that does not rotate, v_x and v_y follow one first-order lag of a complex number.
        frame = turn_units(heading)
        start = (resets.start[:, 0] + 1j * resets.start[:, 1]) * frame[resets.at]
        along = join_parts(rolling.v0, rolling.s0) * frame
        slide = lag_signal(along, tau, step, resets, start) * np.conj(frame)
        return Velocity(slide.real, slide.imag, w)
