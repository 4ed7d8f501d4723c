"""Reversal pause: a wheel that is commanded to reverse stands still for a while first.

    Omega = 0 for d seconds after the sign of u changes, each wheel

d [s]: the time that play between motor and wheel takes, or a controller's pause before it reverses. Drive
forward and backward, and turn on the spot to both sides.

Source: Nordin and Gutman, Automatica 38 (2002): mechanical systems with backlash.
"""

from pipeline.models.effect import WHEELED, DriveEffect, Excitation, Least, Parameter, Plausible
from pipeline.models.filters import wait_at_reversal
from pipeline.run.signals import RunContext, Wheels


class ReversalPause(DriveEffect):
    """Reversal pause: a wheel that is commanded to reverse stands still for a while first."""

    id = "reversal_pause"
    rank = 5
    kinds = WHEELED
    parameters = (
        Parameter(
            "d",
            "s",
            (0.0, 3.0),
            0.0,
            "time at standstill before a wheel reverses",
            0.4,
            starts=(0.15, 0.5),
            step=1e-2,
            # A pause causes half the position error of a reversal that is late by the same time.
            least=Least(0.03, Least.STAMPS, sampled=2.0),
            plausible=Plausible(0.0, 1.5, "longer than controllers wait"),
        ),
    )
    motion = "Reversal pause: a wheel stops for {d:.2f} s before it reverses"
    clause = "stops each wheel for {d:.2g} s before it reverses"
    needs = (Excitation.BOTH_SIGNS, Excitation.CHANGES)
    confused_with = ("acceleration_limit", "drive_lag", "transport_delay", "deadband")
    python_state = ("ways", "waited")
    python = """
        wheels, ways, waited = split(left, right, sideways), ways or [0.0] * 4, waited or [math.inf] * 4
        waited = [0.0 if was * wheel < 0.0 else s + step_s for was, wheel, s in zip(ways, wheels, waited)]
        ways = [sign(wheel) or was for was, wheel in zip(ways, wheels)]
        left, right, sideways = join([wheel if s >= {d} else 0.0 for wheel, s in zip(wheels, waited)])"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        d, spans = self.values["d"], context.spans
        if d <= 0.0:
            return wheels
        return wheels.change_each_wheel(
            lambda speed, *_: wait_at_reversal(speed, d, context.step_s, spans), context
        )
