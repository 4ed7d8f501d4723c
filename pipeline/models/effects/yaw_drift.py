"""Yaw drift: the vehicle turns at a constant rate while its wheels turn.

turning is one while the wheels turn. c [rad/s]. Drive straight forward and backward to tell it from uneven
wheels.

Source: constant term of the slip model of Seegmiller and Kelly, RSS 2014.
"""

from pipeline.models.families import Excitation, Parameter, declare

YawDrift = declare(
    "yaw_drift",
    __doc__,
    "v_w += c * turning",
    Parameter("c", "rad/s", (-0.5, 0.5), 0.0, "yaw rate to the left", 0.06),
    needs=(Excitation.BOTH_SIGNS,),
)
