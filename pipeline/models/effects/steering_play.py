"""Steering play: tyres stay where they are until the steering has moved through its play.

    delta = min(max(delta, u_delta - g), u_delta + g)

g [rad], half of the play at the tyres: 0.01 is usual, 0.05 a worn linkage. Steer to both sides, in small and
large steps, while driving.

Source: the play operator; Nordin and Gutman, Automatica 38 (2002): mechanical systems with backlash.
"""

from dataclasses import replace

from pipeline.models.effect import ACKERMANN, DriveEffect, Excitation, Least, Parameter, Plausible
from pipeline.models.filters import follow_with_play
from pipeline.run.signals import RunContext, Wheels


class SteeringPlay(DriveEffect):
    """Steering play: tyres stay where they are until the steering has moved through its play."""

    id = "steering_play"
    rank = 65
    kinds = ACKERMANN
    parameters = (
        Parameter(
            "g",
            "rad",
            (0.0, 0.3),
            0.0,
            "half of the play, at the tyres",
            0.05,
            starts=(0.02, 0.06),
            step=1e-3,
            least=Least(0.004, Least.DATA_SHEET),
            plausible=Plausible(0.0, 0.15, "three times a worn linkage"),
        ),
    )
    motion = "Steering play: {angle} of free travel when the steering reverses"
    clause = "has {angle} of free travel in its steering"
    size_in = 2.0
    needs = (Excitation.STEERING, Excitation.CHANGES)
    confused_with = ("steering_gain", "steering_lag")
    python_state = ("played",)
    python = "steering = played = min(max(played, steering - {g}), steering + {g})"

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        if self.is_neutral:
            return wheels
        return replace(wheels, steering=follow_with_play(wheels.steering, self.values["g"], context.spans))
