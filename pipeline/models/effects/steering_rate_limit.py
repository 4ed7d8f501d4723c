"""Steering rate limit: the steering angle changes no faster than its actuator can.

limit [rad/s], 0.2 to 0.6 at the wheels of a car. Command large and quick changes of steering: slow ones
are reached at once and do not show it.

Source: the steering rate limit of vehicle models; Rajamani, Vehicle Dynamics and Control, steering actuators.
"""

from pipeline.models.families import (
    ACKERMANN,
    INF,
    Conditions,
    Effect,
    Excitation,
    Parameter,
    declare,
    find_least_ramp,
)

_LARGEST_RAD = 0.6

"""Largest steering angle of usual cars [rad]."""


def _is_quick(effect: Effect, conditions: Conditions) -> bool:
    """Whether every angle is reached within a ramp that the sampling of the wheels makes of a step."""
    return effect.values["limit"] * find_least_ramp(conditions) >= _LARGEST_RAD


SteeringRateLimit = declare(
    "steering_rate_limit",
    __doc__,
    "abs(ddelta/dt) <= limit",
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
    rank=55,
    kinds=ACKERMANN,
    needs=(Excitation.STEERING, Excitation.CHANGES),
    is_degenerate=_is_quick,
)
