"""Steering lag: the steering angle follows its command like a first-order system.

tau [s], about 0.4. Change the steering often.

Source: actuator model of a kinematic bicycle; Becker et al. 2023.
"""

from dataclasses import replace

from pipeline.models.families import ACKERMANN, TIME_CONSTANT, Excitation, Least, Quantity, declare

SteeringLag = declare(
    "steering_lag",
    __doc__,
    "tau * ddelta/dt = u - delta",
    replace(
        TIME_CONSTANT,
        typical=0.4,
        least=Least(0.015, Least.STAMPS, sampled=1.0),
        plausible=None,
        quantities=(Quantity.STEERING_LAG,),
    ),
    rank=60,
    kinds=ACKERMANN,
    needs=(Excitation.CHANGES, Excitation.STEERING),
)
