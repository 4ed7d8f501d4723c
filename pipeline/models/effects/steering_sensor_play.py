"""Steering sensor play: wheels stay where they are until their sensor has moved through the play.

    delta = min(max(delta, u_delta - g), u_delta + g)

u_delta [rad] is the measured steering, delta that of the wheels, g [rad] half of the play between them: a
sensor on the column or the rack does not see the play of joints and tie rods. What sensor and wheels share is
steering_play; from the command alone the two are one. Steer to both sides, in small and large steps, while
driving.

Source: the play operator; Nordin and Gutman, Automatica 38 (2002): mechanical systems with backlash.
"""

from dataclasses import replace

import numpy as np

from pipeline.models.effect import ACKERMANN, KinematicEffect
from pipeline.models.effects.steering_play import SteeringPlay
from pipeline.models.filters import follow_with_play
from pipeline.models.parameter import Conditions
from pipeline.run import Rolling, RunContext


class SteeringSensorPlay(KinematicEffect):
    """Steering sensor play: wheels stay where they are until their sensor has moved through the play."""

    id = "steering_sensor_play"
    # As the offset of the sensor, before all effects that scale the rolling velocity.
    rank = -1
    kinds = ACKERMANN
    parameters = (
        replace(SteeringPlay.parameters[0], about="half of the play between steering sensor and wheels"),
    )
    needs, confused_with = SteeringPlay.needs, SteeringPlay.confused_with

    def roll(self, rolling: Rolling, context: RunContext) -> Rolling:
        """See the formula above."""
        if self.is_neutral:
            return rolling
        steering = rolling.wheels.steering
        behind = follow_with_play(steering, self.values["g"], context.spans)
        turned = rolling.v0 * (np.tan(behind) - np.tan(steering)) / (context.vehicle.wheelbase_m or 1.0)
        return replace(rolling, w0=rolling.w0 + turned)

    def can_show(self, conditions: Conditions) -> bool:
        """Without measured steering it is the same as steering play."""
        return conditions.encoders
