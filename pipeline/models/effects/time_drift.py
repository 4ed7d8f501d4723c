"""Time drift: speed and turning fade over a run, as with a falling battery or heating motors.

    v0 = v0 * (1 - k * t/T),  w0 = w0 * (1 - k * t/T)

T is the length of the run, t the time since its start. k is a plain number, about 10 % a run.

Source: first-order drift of a gain; measured on long deployments.
"""

from pipeline.models.effect import Excitation, KinematicEffect, Least, Parameter, Plausible
from pipeline.run.signals import Floats, Rolling, RunContext

FADE = Parameter(
    "k",
    "1",
    (-0.9, 0.9),
    0.0,
    "share lost at the end of the run",
    0.1,
    least=Least(0.015, Least.DATA_SHEET),
    plausible=Plausible(-0.4, 0.4, "wider than the 10 % of long deployments"),
)


def find_fade(lost: float, context: RunContext) -> Floats:
    """Share that is left, where a share is lost by the end of a run, shape (n,)."""
    share: Floats = 1.0 - lost * (context.times - context.start_s) / context.duration_s
    return share


class TimeDrift(KinematicEffect):
    """Time drift: speed and turning fade over a run, as with a falling battery or heating motors."""

    id = "time_drift"
    rank = 50
    parameters = (FADE,)
    motion = "Time drift: {share} travel and turning at the end of the run than at its start"
    clause = "moves {share} at the end of the run than at its start"
    share_of = (1.0, -1.0)
    needs = (Excitation.LONG,)
    confused_with = ("terrain_change", "wheel_radius", "gain_drift")
    python = """
        fade = 1.0 - {k} * t / until_s
        v0, s0, w0 = fade * v0, fade * s0, fade * w0"""

    def roll(self, rolling: Rolling, context: RunContext) -> Rolling:
        """See the formula above."""
        fade = find_fade(self.values["k"], context)
        return rolling.scale(fade, fade)
