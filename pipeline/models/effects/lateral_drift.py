"""Lateral drift: the vehicle moves sideways at a constant rate while its wheels turn.

turning is one while the wheels turn. c [m/s]. Drive forward and backward to tell it from a misaligned sensor.

Source: constant term of the slip model of Seegmiller and Kelly, RSS 2014.
"""

from pipeline.models.families import Excitation, Parameter, declare

LateralDrift = declare(
    "lateral_drift",
    __doc__,
    "v_y += c * turning",
    Parameter("c", "m/s", (-0.5, 0.5), 0.0, "speed to the left", 0.05),
    needs=(Excitation.BOTH_SIGNS,),
)
