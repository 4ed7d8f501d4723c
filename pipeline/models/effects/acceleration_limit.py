"""Acceleration limit: the drive limits the acceleration of every wheel.

limit [rad/s^2]. Command large steps of speed: small ones are reached at once and do not show it.

Source: acceleration limits of a ros2_control diff_drive_controller; torque limit of the motor.
"""

from pipeline.models.families import (
    INF,
    WHEELED,
    Excitation,
    Parameter,
    Quantity,
    declare,
    is_short,
    take_largest,
)

AccelerationLimit = declare(
    "acceleration_limit",
    __doc__,
    "abs(dOmega/dt) <= limit",
    Parameter(
        "limit",
        "rad/s^2",
        (0.05, 500.0),
        INF,
        "largest wheel acceleration",
        3.0,
        starts=(1.0, 2.5, 6.0, 12.0, 25.0, 60.0),
        step=1e-2,
        quantities=(Quantity.WHEEL_ACCELERATION_LIMIT,),
    ),
    rank=10,
    kinds=WHEELED,
    needs=(Excitation.CHANGES, Excitation.LARGE),
    is_degenerate=is_short("wheel"),
    list_usual=take_largest("wheel"),
)
