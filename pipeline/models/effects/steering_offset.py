"""Steering offset: the steering angle is not zero at zero command.

o [rad], about 0.04. Drive straight at several speeds.

Source: kinematic bicycle with an uncalibrated steering; Becker et al. 2023.
"""

from pipeline.models.families import (
    ACKERMANN,
    Excitation,
    Least,
    Parameter,
    Quantity,
    declare,
    has_no_encoders,
)

SteeringOffset = declare(
    "steering_offset",
    __doc__,
    "delta = delta + o",
    Parameter(
        "o",
        "rad",
        (-0.5, 0.5),
        0.0,
        "steering angle at zero command",
        0.04,
        least=Least(0.002, Least.DATA_SHEET),
        quantities=(Quantity.STEERING_OFFSET,),
    ),
    rank=70,
    kinds=ACKERMANN,
    needs=(Excitation.SPEED_SPREAD,),
    is_equivalent=has_no_encoders,
)
