"""Heading skew: the reported heading is older than the reported position.

    reported yaw(t) = yaw(t - d):  v_y += d * v0 * w0 at first order

d [s], up to 0.1. It looks like lateral skid of c = -d. Where a gyro is the heading, it is the position that
is reported d earlier than the heading.

Source: two clocks in one localization; measured on the DRIVE recordings.
"""

from dataclasses import replace

import numpy as np

from pipeline.models.effect import Excitation, Late, Least, Parameter, Plausible, ReportEffect
from pipeline.models.parameter import LEAST_DELAY_S, Conditions, Level, Meaning
from pipeline.run import RunContext, Velocity, earlier_in_span


class HeadingSkew(ReportEffect):
    """Heading skew: the reported heading is older than the reported position."""

    id = "heading_skew"
    rank = 30
    parameters = (
        # A heading newer than its position equals lateral skid to first order; skid is the likelier cause.
        Parameter(
            "d",
            "s",
            (-0.6, 0.6),
            0.0,
            "delay of the heading relative to the position",
            0.1,
            step=1e-3,
            least=Least(LEAST_DELAY_S, Least.STAMPS),
            plausible=Plausible(-0.3, 0.4, "wider than the 0.1 s of the DRIVE recordings"),
            one_sign=True,
        ),
    )
    needs = (Excitation.TURNING, Excitation.SPEED_SPREAD)
    late = Late.HEADING
    readings = (
        Meaning(Level.VEHICLE, "heading_skew", "a recorder that stamps headings late"),
        Meaning(Level.TERRAIN, "lateral_skid", "lateral skid on this terrain"),
        Meaning(Level.RUN, "heading_skew", "a clock that was reset"),
    )

    def report(self, velocity: Velocity, context: RunContext) -> Velocity:
        """See the formula above."""
        late = self.values["d"]
        if late == 0.0:
            return velocity
        ends = np.cumsum(velocity.w) * context.step_s
        middle = ends - 0.5 * velocity.w * context.step_s
        # The grid has gaps between spans; a delayed value must not come from the preceding span.
        earlier = np.interp(context.times - late, context.times, middle)
        reaches = earlier_in_span(context, late)
        turned = np.where(reaches, middle - earlier, late * velocity.w)
        rate = np.where(reaches, np.interp(context.times - late, context.times, velocity.w), velocity.w)
        sine, cosine = np.sin(turned), np.cos(turned)
        return replace(
            velocity,
            x=cosine * velocity.x - sine * velocity.y,
            y=sine * velocity.x + cosine * velocity.y,
            w=rate,
        )

    def report_gyro(self, velocity: Velocity, context: RunContext) -> Velocity:
        """The heading of a gyro has no skew; only the delay of the position remains."""
        return velocity

    def can_show(self, conditions: Conditions) -> bool:
        """Only with the reported heading, not with that of a gyro or with one made of positions."""
        return not conditions.gyro and not conditions.course
