"""Steering sensor offset: the steering angle is not zero where its sensor reads zero.

    w0 += v0 * (tan(delta + o) - tan(delta)) / l

delta [rad] is the measured steering, o [rad] what the tyres steer beyond it, about 0.02: a sensor that was
zeroed off centre, a bent linkage, or a "measured" angle that repeats the command. What sensor and tyres share
is steering_offset; from the command alone the two are one. Drive straight at several speeds.

Source: kinematic bicycle with an uncalibrated steering; Becker et al. 2023.
"""

from dataclasses import replace

import numpy as np

from pipeline.models.effect import ACKERMANN, KinematicEffect
from pipeline.models.effects.steering_offset import SteeringOffset
from pipeline.models.parameter import Conditions
from pipeline.run.signals import Rolling, RunContext


class SteeringSensorOffset(KinematicEffect):
    """Steering sensor offset: the steering angle is not zero where its sensor reads zero."""

    id = "steering_sensor_offset"
    # It belongs to the steering: before understeer and all effects that scale the rolling velocity.
    rank = 0
    kinds = ACKERMANN
    parameters = (
        replace(SteeringOffset.parameters[0], about="true minus measured steering angle", typical=0.02),
    )
    motion = "Steering sensor offset: the tyres are {angle} to the {way} of its reading"
    clause = "the tyres are {angle} to the {way} of the steering sensor's reading"
    needs, confused_with = SteeringOffset.needs, SteeringOffset.confused_with
    equivalent_to = ("steering_offset",)
    equivalent_when = SteeringOffset.equivalent_when
    python = "w0 = w0 + v0 * (math.tan(steering + {o}) - math.tan(steering)) / WHEELBASE"

    def roll(self, rolling: Rolling, context: RunContext) -> Rolling:
        """See the formula above."""
        steering = rolling.wheels.steering
        beyond = np.tan(steering + self.values["o"]) - np.tan(steering)
        return replace(rolling, w0=rolling.w0 + rolling.v0 * beyond / (context.vehicle.wheelbase_m or 1.0))

    def can_show(self, conditions: Conditions) -> bool:
        """Without measured steering it is the same as a steering offset."""
        return conditions.encoders
