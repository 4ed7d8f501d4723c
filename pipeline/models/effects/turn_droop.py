"""Turn droop: beyond a threshold the difference of the wheels falls short of its command.

D = Omega_r - Omega_l, clip(D, threshold) the part of it within +-threshold. threshold [rad/s]; gain is a
plain number. The Warthog reaches 84 to 100 % of a wheel difference of the same sign, 4 to 80 % after a
change of sign. Turn slowly and quickly, on the spot and while driving.

Source: measured on the DRIVE recordings.
"""

from pipeline.models.families import (
    NAN,
    SIDES,
    Conditions,
    Effect,
    Excitation,
    Largest,
    Least,
    Parameter,
    Plausible,
    declare,
)

# Shares of the largest commanded difference: below it is a gain, above it has no effect.
_THRESHOLDS = (0.1, 0.99)

# Gain beyond the threshold below which it is a limit.
_LEAST_RISE = 0.08

_USUAL_THRESHOLD = 0.4

"""Start value of the threshold as a share of the largest wheel difference: it is within the driven range."""


def _is_gain_or_limit(effect: Effect, conditions: Conditions) -> bool:
    """Whether it is a gain (the same as a wider track without measured wheels) or a limit."""
    low, high = _THRESHOLDS
    bends = low < effect.values["threshold"] / conditions.largest.difference < high
    return not (bends and effect.values["gain"] > _LEAST_RISE)


def _list_usual(effect: Effect, largest: Largest) -> dict[str, float]:
    return {"threshold": _USUAL_THRESHOLD * largest.difference, "gain": effect.parameter("gain").typical}


TurnDroop = declare(
    "turn_droop",
    __doc__,
    "D = D - (1 - gain) * (D - clip(D, threshold))",
    Parameter(
        "threshold",
        "rad/s",
        (0.0, 200.0),
        NAN,
        "threshold, the wheel speed difference above which it falls short",
        1.5,
        starts=(0.5, 1.5, 4.0, 10.0),
        step=1e-2,
    ),
    Parameter(
        "gain",
        "1",
        (0.0, 1.5),
        1.0,
        "share reached, of the difference above the threshold",
        0.4,
        least=Least(0.03, Least.DATA_SHEET),
        plausible=Plausible(0.0, 0.97, "with all of it reached nothing droops"),
    ),
    rank=40,
    kinds=SIDES,
    needs=(Excitation.LARGE, Excitation.TURNING),
    is_degenerate=_is_gain_or_limit,
    list_usual=_list_usual,
)
