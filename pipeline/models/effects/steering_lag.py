"""Steering lag: the steering angle follows its command like a first-order system.

    tau * ddelta/dt = u_delta - delta

tau [s], about 0.4. Change the steering often.

Source: actuator model of a kinematic bicycle; Becker et al. 2023.
"""

from dataclasses import replace

from pipeline.models.effect import ACKERMANN, DriveEffect, Excitation, Least
from pipeline.models.effects.drive_lag import TIME_CONSTANT
from pipeline.models.filters import lag_signal
from pipeline.models.parameter import Quantity
from pipeline.run.signals import RunContext, Wheels


class SteeringLag(DriveEffect):
    """Steering lag: the steering angle follows its command like a first-order system."""

    id = "steering_lag"
    rank = 60
    kinds = ACKERMANN
    parameters = (
        replace(
            TIME_CONSTANT,
            typical=0.4,
            least=Least(0.015, Least.STAMPS, sampled=1.0),
            plausible=None,
            quantities=(Quantity.STEERING_LAG,),
        ),
    )
    motion = "Steering lag: time constant {tau:.2f} s"
    clause = "steers with a time constant of {tau:.2g} s"
    needs = (Excitation.CHANGES, Excitation.STEERING)
    confused_with = ("transport_delay",)
    python_state = ("lag_steering",)
    python = """
        keep = math.exp(-step_s / {tau}) if {tau} > 0.0 else 0.0
        lag_steering = steering + (lag_steering - steering) * keep
        steering = lag_steering"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        spans = context.spans
        lagged = lag_signal(wheels.steering, self.values["tau"], context.step_s, spans, spans.start[:, 3])
        return replace(wheels, steering=lagged)
