"""Reversal pause: a wheel that is commanded to reverse stands still for a while first.

d [s]: the time that play between motor and wheel takes, or a controller's pause before it reverses. Drive
forward and backward, and turn on the spot to both sides.

Source: Nordin and Gutman, Automatica 38 (2002): mechanical systems with backlash.
"""

from collections.abc import Mapping

from pipeline.models.families import WHEELED, Excitation, Floats, Least, Parameter, Plausible, Resets, declare
from pipeline.models.filters import wait_at_reversal


def _walk(
    values: Mapping[str, float], signal: Floats, step_s: float, resets: Resets, start: Floats
) -> Floats:
    """A pause, which a known speed in between does not end."""
    return wait_at_reversal(signal, values["d"], step_s, resets)


ReversalPause = declare(
    "reversal_pause",
    __doc__,
    "Omega = 0 for d seconds after the sign of u changes",
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
    rank=5,
    kinds=WHEELED,
    needs=(Excitation.BOTH_SIGNS, Excitation.CHANGES),
    walk=_walk,
)
