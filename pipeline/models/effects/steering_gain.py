"""Steering gain: the steering angle is a constant multiple of its command.

g is a plain number, 0.85 for worn linkage. Steer to both sides at several angles.

Source: kinematic bicycle with an uncalibrated steering; Becker et al. 2023.
"""

from pipeline.models.families import ACKERMANN, Excitation, Least, Parameter, Plausible, Quantity, declare

SteeringGain = declare(
    "steering_gain",
    __doc__,
    "delta = g * delta",
    Parameter(
        "g",
        "1",
        (0.05, 5.0),
        1.0,
        "actual over commanded steering angle",
        0.85,
        least=Least(0.01, Least.DATA_SHEET),
        plausible=Plausible(0.5, 1.5, "wider than the 0.85 of a worn linkage"),
        quantities=(Quantity.STEERING_GAIN,),
    ),
    rank=50,
    kinds=ACKERMANN,
    needs=(Excitation.STEERING,),
)
