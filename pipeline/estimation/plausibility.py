"""Whether values of an effect are possible, and how far an effect moves predictions."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import format_share, suffix_unit
from pipeline.models import EXCEEDED_SHARE, OVERSHOOT, Conditions, Effect, Parameter
from pipeline.results import Moves

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.estimation.model_fit import Fitted

_AT_BOUND = 1e-3
"""Fraction of a parameter's range; a value closer than this to a bound is at the bound."""
# A limit's interval is not known during a search: in a 30 s run it may end at this multiple of the value.
_UNCERTAIN = 1.5


def is_nameable(effect: Effect, conditions: Conditions) -> bool:
    """Whether an effect is large enough to report, plausible and not a degenerate form of another effect."""
    itself = _has_its_sign(effect) and not effect.is_degenerate(conditions)
    if not itself or not is_large_enough(effect, conditions):
        return False
    highs = {name: _UNCERTAIN * value for name, value in effect.values.items()}
    if find_exceeded(effect, highs, conditions.exceeded) is not None:
        return False
    return find_implausible(effect) is None


def is_too_small(effect: Effect, conditions: Conditions) -> bool:
    """Whether all that keeps an effect from a name is its size: others may only imitate it."""
    itself = _has_its_sign(effect) and not effect.is_degenerate(conditions)
    return itself and find_implausible(effect) is None and not is_large_enough(effect, conditions)


def is_large_enough(effect: Effect, conditions: Conditions) -> bool:
    """Whether an effect exceeds the errors of time stamps, sensor mounting and data sheets."""
    sizes = []
    for parameter in effect.parameters:
        if parameter.least is not None:
            least, size = parameter.least, abs(effect.values[parameter.name] - parameter.neutral)
            sizes.append(size >= max(least.size, least.sampled * conditions.least_delay_s))
    return not sizes or any(sizes)


def _has_its_sign(effect: Effect) -> bool:
    """Whether every parameter with only one physical sign has that sign."""
    return all(effect.values[p.name] > p.neutral for p in effect.parameters if p.one_sign)


def _is_at_bound(value: float, parameter: Parameter) -> bool:
    """Whether a value is at a bound of its parameter; the neutral value never counts as at a bound."""
    if value == parameter.neutral:
        return False
    low, high = parameter.bounds
    margin = _AT_BOUND * (high - low) if math.isfinite(high - low) else 0.0
    return value <= low + margin < parameter.neutral or value >= high - margin > parameter.neutral


def find_exceeded(effect: Effect, highs: Mapping[str, float], exceeded: Mapping[str, float]) -> str | None:
    """Sentence stating that measured wheels exceed a limit; None where they stay within it.

    Args:
        effect: with its values.
        highs: upper end of the interval by parameter, NaN where there is none.
        exceeded: what measured wheels exceed in `EXCEEDED_SHARE` of the time, see `Conditions`.
    """
    for parameter in effect.parameters:
        most = exceeded.get(parameter.relative_to)
        value, high = effect.values[parameter.name], highs.get(parameter.name, math.nan)
        if most is not None and most > OVERSHOOT * max(value, float(np.nan_to_num(high))):
            return (
                f"{effect.id}: {parameter.name} = {value:.3g} {parameter.unit} is not a limit: the measured "
                f"wheels exceed {most:.3g} {parameter.unit} in {format_share(EXCEEDED_SHARE)} of the time; "
                "the cause may be another effect"
            )
    return None


def find_implausible(effect: Effect) -> str | None:
    """Sentence stating the first value outside the observed range; None where all values are plausible."""
    for parameter in effect.parameters:
        value = effect.values[parameter.name]
        if not math.isfinite(value):
            continue
        shown = parameter.plausible
        low, high = parameter.bounds if shown is None else (shown.low, shown.high)
        if not low <= value <= high or _is_at_bound(value, parameter):
            unit = suffix_unit(parameter.unit)
            return (
                f"{effect.id}: {parameter.name} = {value:.3g}{unit} is outside the observed range "
                f"({low:g} to {high:g}{unit}); the cause may be another effect"
            )
    return None


def measure_moves(fitted: Fitted, effect: Effect) -> Moves | None:
    """Change of a fitted model's predictions by one of its effects; None where the model lacks the effect.

    The other effects keep their values, although one of them might compensate in a new fit. Rare large
    changes, as of a limit, count by their square.
    """
    state = fitted.state
    if effect.id not in state.ids:
        return None
    shifts = [
        comparison.find_horizon_shifts(
            state.effects_of(run),
            [other for other in state.effects_of(run) if other.id != effect.id],
            state.timing[run],
        )
        for run, comparison in enumerate(fitted.problem.comparisons)
    ]
    distance, turn, length = (
        float(np.sqrt(np.mean(np.concatenate(column) ** 2))) for column in zip(*shifts, strict=True)
    )
    return Moves(distance, turn, distance / length if length > 0.0 else 0.0)
