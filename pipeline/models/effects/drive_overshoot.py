"""Drive overshoot: wheels swing past the commanded speed before they settle.

tau [s] is one over the natural frequency, damping a plain number: 1 and more is a lag, 0.5 overshoots a step
by 16 %. Change commands often, in steps.

Source: second-order systems; Astrom and Murray, Feedback Systems, chapter 7.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import cast

from pipeline.models.effects.drive_lag import DriveLag
from pipeline.models.families import (
    NAN,
    TIME_CONSTANT,
    WHEELED,
    Conditions,
    Effect,
    Excitation,
    Floats,
    Least,
    Parameter,
    Plausible,
    Resets,
    Search,
    declare,
)
from pipeline.models.filters import swing_signal

LEAST_OVERSHOOT = 0.03
"""Share of a step: the settling tolerance of a controller."""


def _find_damping(values: Mapping[str, float]) -> float:
    """Its damping, critical if not given."""
    return 1.0 if math.isnan(values["damping"]) else values["damping"]


def _walk(
    values: Mapping[str, float], signal: Floats, step_s: float, resets: Resets, start: Floats
) -> Floats:
    return swing_signal(signal, values["tau"], _find_damping(values), step_s, resets, start)


def _never_shows(effect: Effect, conditions: Conditions) -> bool:
    """Never in a search, which confuses it with a lag of the servos; it can be added by hand."""
    return False


def _is_lag(effect: Effect, conditions: Conditions) -> bool:
    """Whether the overshoot is negligible: it is a lag."""
    damping = _find_damping(effect.values)
    return damping >= 1.0 or math.exp(-math.pi * damping / math.sqrt(1.0 - damping**2)) < LEAST_OVERSHOOT


def _collapse(effect: Effect) -> Effect:
    """A lag with the same delay."""
    return cast("Effect", DriveLag.of_delay(2.0 * _find_damping(effect.values) * effect.values["tau"]))


DriveOvershoot = declare(
    "drive_overshoot",
    __doc__,
    "tau^2 * d2Omega/dt2 + 2 * damping * tau * dOmega/dt = u - Omega",
    replace(
        TIME_CONSTANT,
        about="inverse natural frequency",
        typical=0.2,
        starts=(),
        search=Search.STARTS,
        least=Least(0.03, Least.STAMPS, sampled=1.0),
        plausible=Plausible(0.0, 1.5, "wheels swing slower than 0.1 Hz on no controller"),
    ),
    Parameter(
        "damping",
        "1",
        (0.02, 1.5),
        NAN,
        "damping ratio",
        0.4,
        search=Search.STARTS,
        step=5e-3,
    ),
    rank=26,
    kinds=WHEELED,
    starts=({"tau": 0.1, "damping": 0.4}, {"tau": 0.25, "damping": 0.4}, {"tau": 0.6, "damping": 0.4}),
    needs=(Excitation.CHANGES,),
    walk=_walk,
    is_degenerate=_is_lag,
    collapse=_collapse,
    can_show=_never_shows,
)
