"""Steering sensor offset: the steering angle is not zero where its sensor reads zero.

delta [rad] is the measured steering, o [rad] what the wheels steer beyond it, about 0.02: a sensor that was
zeroed off centre, a bent linkage, or a "measured" angle that repeats the command. What sensor and wheels
share is steering_offset; from the command alone the two are one. Drive straight at several speeds.

Source: kinematic bicycle with an uncalibrated steering; Becker et al. 2023.
"""

from dataclasses import replace

from pipeline.models.effects.steering_offset import SteeringOffset
from pipeline.models.families import ACKERMANN, declare, has_encoders

SteeringSensorOffset = declare(
    "steering_sensor_offset",
    __doc__,
    "w0 = w0 + v0 * (tan(delta + o) - tan(delta)) / l",
    replace(SteeringOffset.parameters[0], about="true minus measured steering angle", typical=0.02),
    kinds=ACKERMANN,
    needs=SteeringOffset.needs,
    can_show=has_encoders,
)
