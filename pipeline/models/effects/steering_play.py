"""Steering play: wheels stay where they are until the steering has moved through its play.

g [rad], half of the play at the wheels: 0.01 is usual, 0.05 a worn linkage. Steer to both sides, in small and
large steps, while driving.

Source: the play operator; Nordin and Gutman, Automatica 38 (2002): mechanical systems with backlash.
"""

from collections.abc import Mapping

from pipeline.models.families import (
    ACKERMANN,
    Excitation,
    Floats,
    Least,
    Parameter,
    Plausible,
    Resets,
    declare,
)
from pipeline.models.filters import follow_with_play


def _walk(
    values: Mapping[str, float], signal: Floats, step_s: float, resets: Resets, start: Floats
) -> Floats:
    return follow_with_play(signal, values["g"], resets)


SteeringPlay = declare(
    "steering_play",
    __doc__,
    "delta = min(max(delta, u - g), u + g)",
    Parameter(
        "g",
        "rad",
        (0.0, 0.3),
        0.0,
        "half of the play, at the wheels",
        0.05,
        starts=(0.02, 0.06),
        step=1e-3,
        least=Least(0.004, Least.DATA_SHEET),
        plausible=Plausible(0.0, 0.15, "three times a worn linkage"),
    ),
    rank=65,
    kinds=ACKERMANN,
    needs=(Excitation.STEERING, Excitation.CHANGES),
    walk=_walk,
    signal="delta",
)
