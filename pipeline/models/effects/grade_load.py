"""Grade load: on a slope the wheels turn slower than commanded uphill and faster downhill.

turning is one for a wheel that is commanded to turn. pitch > 0 is nose down. k [m/s]: 0.6 takes 0.1 m/s of
any speed on a slope of 10 degrees. It is the load torque over the gain of the speed controller, so that a
controller with an integral part shows it for moments only. Without encoders nothing distinguishes it from
`slope_creep`. Drive a slope in several directions.

Source: a speed controller's error under a steady load; Astrom and Murray, Feedback Systems, chapter 10.
"""

import math

from pipeline.models.families import (
    Conditions,
    Effect,
    Excitation,
    Parameter,
    Plausible,
    declare,
    has_no_encoders,
)

_LEAST_SLOPE_RAD = math.radians(1.5)

"""Least half range of pitch: on level ground a vehicle and its localization pitch by as much."""


def _is_sloping(effect: Effect, conditions: Conditions) -> bool:
    """Not on level ground, nor where pitch was not recorded."""
    return conditions.slope_rad >= _LEAST_SLOPE_RAD


GradeLoad = declare(
    "grade_load",
    __doc__,
    "Omega = u + k / r * sin(pitch) * turning",
    Parameter(
        "k",
        "m/s",
        (-5.0, 5.0),
        0.0,
        "speed lost at a slope of 90 degrees (k sin(slope))",
        0.6,
        plausible=Plausible(-0.1, 4.0, "a tenth of the largest speed lost on 10 degrees, up to 5 m/s"),
        one_sign=True,
    ),
    rank=15,
    kinds=("differential", "ackermann"),
    needs=(Excitation.SLOPE,),
    is_equivalent=has_no_encoders,
    can_show=_is_sloping,
)
