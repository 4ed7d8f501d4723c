"""Steering rate limit: the steering angle changes no faster than its actuator can.

    abs(ddelta/dt) <= limit

limit [rad/s], 0.2 to 0.6 at the tyres of a car. Command large and quick changes of steering: slow ones
are reached at once and do not show it.

Source: the steering rate limit of vehicle models; Rajamani, Vehicle Dynamics and Control, steering actuators.
"""

from dataclasses import replace

from pipeline.models.effect import ACKERMANN, INF, DriveEffect, Excitation, Parameter
from pipeline.models.effects.body_acceleration_limit import LEAST_RAMP_S
from pipeline.models.filters import limit_rate
from pipeline.models.parameter import Conditions
from pipeline.run.signals import RunContext, Wheels

_LARGEST_RAD = 0.6
"""Largest steering angle of usual cars [rad]."""


class SteeringRateLimit(DriveEffect):
    """Steering rate limit: the steering angle changes no faster than its actuator can."""

    id = "steering_rate_limit"
    rank = 55
    kinds = ACKERMANN
    parameters = (
        Parameter(
            "limit",
            "rad/s",
            (0.02, 50.0),
            INF,
            "largest rate of the steering angle",
            0.35,
            starts=(0.15, 0.3, 0.6, 1.2),
            step=1e-3,
        ),
    )
    motion = "Steering rate limit: {limit:.2g} rad/s at the tyres"
    clause = "steers at most {limit:.2g} rad/s fast"
    needs = (Excitation.STEERING, Excitation.CHANGES)
    confused_with = ("steering_lag", "transport_delay")
    python_state = ("turned",)
    python = "steering = turned = approach(turned, steering, {limit} * step_s)"

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether every angle is reached within a ramp that the sampling of the wheels makes of a step."""
        least = max(LEAST_RAMP_S, 2.0 * conditions.least_delay_s)
        return self.values["limit"] * least >= _LARGEST_RAD

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        if self.is_neutral:
            return wheels
        spans = context.spans
        turned = limit_rate(wheels.steering, self.values["limit"], context.step_s, spans, spans.start[:, 3])
        return replace(wheels, steering=turned)
