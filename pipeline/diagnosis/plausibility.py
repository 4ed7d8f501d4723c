"""What is too small to be named, and what no vehicle does: as an effect's file declares it."""

import math
from collections.abc import Mapping

import numpy as np

from pipeline.models.conditions import Conditions
from pipeline.models.effect import Effect, Parameter

_AT_BOUND = 1e-3
# Wheels run over their limit by no more: rounding of encoders and a motor that overshoots.
_OVERSHOOT = 1.05
# While a search goes on nobody knows the interval of a limit yet: of half a minute it may end there.
_UNCERTAIN = 1.5
HALVES = 0.5
"""Share of the loss of all that is plausible to which an effect beyond its range must bring it: what halves
an error is named, as a stand-in."""
EXCEEDED_SHARE = 0.1
"""In so much of the time no limit is exceeded."""


def is_nameable(effect: Effect, conditions: Conditions, *, as_if: bool = False) -> bool:
    """Whether an effect is large enough to be named, of a vehicle's size, and not another one in disguise.

    Args:
        effect: with its values.
        conditions: what the runs can show.
        as_if: it may have values beyond what vehicles show, as long as the recordings determine them.
    """
    itself = _has_its_sign(effect) and not effect.is_degenerate(conditions)
    if not itself or not is_large_enough(effect, conditions):
        return False
    highs = {name: _UNCERTAIN * value for name, value in effect.values.items()}
    if find_exceeded(effect, highs, conditions.exceeded) is not None:
        return False
    return find_implausible(effect) is None or (as_if and find_beyond(effect) is not None)


def is_large_enough(effect: Effect, conditions: Conditions) -> bool:
    """Whether an effect is more than stamps, mounting and data sheets make of nothing."""
    sizes = []
    for parameter in effect.parameters:
        if parameter.least is not None:
            least, size = parameter.least, abs(effect.values[parameter.name] - parameter.neutral)
            sizes.append(size >= max(least.size, least.sampled * conditions.least_delay_s))
    return not sizes or any(sizes)


def _has_its_sign(effect: Effect) -> bool:
    """Whether an effect takes from the motion what physics takes, and does not give."""
    return all(effect.values[p.name] > p.neutral for p in effect.parameters if p.one_sign)


def _is_at_bound(value: float, parameter: Parameter) -> bool:
    """Whether a number only stopped because it may go no further; at no effect it may well stand."""
    if value == parameter.neutral:
        return False
    low, high = parameter.bounds
    margin = _AT_BOUND * (high - low) if math.isfinite(high - low) else 0.0
    return value <= low + margin < parameter.neutral or value >= high - margin > parameter.neutral


def find_exceeded(effect: Effect, highs: Mapping[str, float], exceeded: Mapping[str, float]) -> str | None:
    """In words that measured wheels contradict a limit, None where they keep it.

    Args:
        effect: with its values.
        highs: upper end of the interval by parameter, NaN where there is none.
        exceeded: what measured wheels exceed in `EXCEEDED_SHARE` of the time, see `Conditions`.
    """
    for parameter in effect.parameters:
        most = exceeded.get(parameter.relative_to)
        value, high = effect.values[parameter.name], highs.get(parameter.name, math.nan)
        if most is not None and most > _OVERSHOOT * max(value, float(np.nan_to_num(high))):
            return (
                f"{effect.id}: {parameter.name} = {value:.3g} {parameter.unit} is no limit: measured wheels "
                f"exceed {most:.3g} {parameter.unit} in {EXCEEDED_SHARE:.0%} of the time; it may stand for "
                "another cause"
            )
    return None


def find_beyond(effect: Effect) -> str | None:
    """In words the numbers beyond what vehicles show; None where there are none, or one is at its bound."""
    found = []
    for parameter in effect.parameters:
        value, shown = effect.values[parameter.name], parameter.plausible
        if not math.isfinite(value):
            continue
        if _is_at_bound(value, parameter):
            return None
        if shown is not None and not shown.low <= value <= shown.high:
            unit = "" if parameter.unit == "1" else f" {parameter.unit}"
            found.append(
                f"as if {parameter.name} = {value:.3g}{unit}: beyond what vehicles show "
                f"({shown.low:g} to {shown.high:g}{unit}, {shown.source})"
            )
    return "; ".join(found) or None


def find_implausible(effect: Effect) -> str | None:
    """In words what no vehicle does, None where the numbers are those of a vehicle."""
    for parameter in effect.parameters:
        value = effect.values[parameter.name]
        if not math.isfinite(value):
            continue
        shown = parameter.plausible
        low, high = parameter.bounds if shown is None else (shown.low, shown.high)
        if not low <= value <= high or _is_at_bound(value, parameter):
            unit = "" if parameter.unit == "1" else f" {parameter.unit}"
            return (
                f"{effect.id}: {parameter.name} = {value:.3g}{unit} is outside of what vehicles show "
                f"({low:g} to {high:g}{unit}); it may stand for another cause"
            )
    return None
