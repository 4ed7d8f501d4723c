"""Gain drift: the wheels' share of their commanded speed fades over a run, as with a falling battery.

    Omega = (1 - k * t/T) * u, each wheel

T is the length of the run, t the time since its start. k is a plain number, about 10 % a run. A speed
controller without integral part lets it through. Only encoders tell it from a fading motion of the body.

Source: drift of an actuator's gain, a loss of effectiveness; Zhang and Jiang, Annual Reviews in Control 2008.
"""

from dataclasses import replace

from pipeline.models.effect import WHEELED, DriveEffect, Excitation
from pipeline.models.effects.time_drift import FADE, find_fade
from pipeline.models.parameter import Conditions
from pipeline.run.signals import RunContext, Wheels


class GainDrift(DriveEffect):
    """Gain drift: the wheels' share of their commanded speed fades over a run, as with a falling battery."""

    id = "gain_drift"
    rank = 0
    kinds = WHEELED
    parameters = (FADE,)
    motion = "Gain drift: the wheels turn {share} of their command at the end of the run than at its start"
    clause = "turns its wheels {share} of their command at the end than at the start"
    share_of = (1.0, -1.0)
    needs = (Excitation.LONG,)
    confused_with = ("time_drift", "drive_gain")
    python = """
        fade = 1.0 - {k} * t / until_s
        left, right, sideways = fade * left, fade * right, fade * sideways"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        fade = find_fade(self.values["k"], context)
        sideways = None if wheels.sideways is None else fade * wheels.sideways
        return replace(wheels, left=fade * wheels.left, right=fade * wheels.right, sideways=sideways)

    def can_show(self, conditions: Conditions) -> bool:
        """Without measured wheels it is the same as a fading motion of the body."""
        return conditions.encoders
