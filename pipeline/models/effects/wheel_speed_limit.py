"""Wheel speed limit: the speed of every wheel is limited.

Omega is kept within +-limit. limit [rad/s], 13 on a Warthog. A limit that no command reaches is only
bounded from below; where wheels are measured, it is neither below what they exceed for half a second nor
above all that they reach.

Source: saturation of the drive; measured on the DRIVE recordings.
"""

from pipeline.models.families import (
    INF,
    WHEELED,
    Excitation,
    Level,
    Parameter,
    Quantity,
    Spread,
    declare,
    never_attained,
)

WheelSpeedLimit = declare(
    "wheel_speed_limit",
    __doc__,
    "Omega = clip(Omega, limit)",
    Parameter(
        "limit",
        "rad/s",
        (0.05, 500.0),
        INF,
        "largest wheel speed",
        4.5,
        starts=(0.3, 0.5, 0.7, 0.85, 0.95),
        relative_to="wheel",
        step=1e-2,
        quantities=(Quantity.WHEEL_SPEED_LIMIT,),
        between_runs=Spread(0.2),
        level=Level.VEHICLE,
    ),
    rank=4,
    kinds=WHEELED,
    needs=(Excitation.LARGE,),
    is_degenerate=never_attained,
)
