"""Whether values of an effect are possible, and how far an effect moves predictions."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import suffix_unit
from pipeline.models import OVERSHOOT, Conditions, Effect, Parameter, find_effect
from pipeline.recording import Finding
from pipeline.results import Moves, Named

if TYPE_CHECKING:
    from pipeline.estimation.fit import PathFit
    from pipeline.estimation.model_fit import Fitted

_AT_BOUND = 1e-3
"""Fraction of a parameter's range; a value closer than this to a bound is at the bound."""
_UNCERTAIN = 1.5
"""Multiple of a limit's value at which its interval may end: it is not known during a search."""

_PROVEN_T = 20.0
"""Standard errors beyond the observed range at which a value counts all the same: that range is what was seen
before, not what can be."""


def is_possible(fit: PathFit, effect: Effect, conditions: Conditions) -> bool:
    """Whether an effect can be named: its values are plausible, or proven to be beyond what was observed."""
    if is_nameable(effect, conditions):
        return True
    wild = list_implausible(effect)
    ends = {one.name: one.nearest_plausible(effect.values[one.name]) for one in wild}
    inside = effect.change(**ends)
    if not wild or not is_nameable(inside, conditions) or is_exceeded(effect, conditions):
        return False
    errors = np.sqrt(np.diag(fit.covariance))
    numbers = [number for number in fit.free if number.effect == effect.id]
    return all(
        not _is_at_bound(effect.values[name], effect.parameter(name))
        and any(number.name == name and number.is_smooth for number in numbers)
        and all(
            abs(effect.values[name] - end) > _PROVEN_T * float(error)
            for number, error in zip(fit.free, errors, strict=True)
            if number in numbers and number.name == name
        )
        for name, end in ends.items()
    )


def note_unusual(effects: Iterable[Named]) -> list[Finding]:
    """A finding for each named effect with a value beyond what was observed."""
    findings = []
    for named in effects:
        known = find_effect(named.id)
        for p in known.parameters:
            value = named.parameters[p.name].value if p.name in named.parameters else p.neutral
            if p.plausible is None or not math.isfinite(value):
                continue
            low, high = p.plausible.low, p.plausible.high
            if low <= value <= high:
                continue
            values = {"value": value, "parameter": p.name, "unit": p.unit, "low": low, "high": high}
            findings.append(Finding("unusual_value", "warning", named.id, values))
    return findings


def is_nameable(effect: Effect, conditions: Conditions) -> bool:
    """Whether an effect is large enough to report, plausible and not a degenerate form of another effect."""
    itself = _has_its_sign(effect) and not effect.is_degenerate(conditions)
    if not itself or not is_large_enough(effect, conditions):
        return False
    return not is_exceeded(effect, conditions) and not list_implausible(effect)


def is_too_small(effect: Effect, conditions: Conditions) -> bool:
    """Whether all that keeps an effect from a name is its size: others may only imitate it."""
    itself = _has_its_sign(effect) and not effect.is_degenerate(conditions)
    return itself and not list_implausible(effect) and not is_large_enough(effect, conditions)


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


def is_exceeded(effect: Effect, conditions: Conditions) -> bool:
    """Whether measured wheels exceed a limit: its cause is another effect then."""
    for parameter in effect.parameters:
        most = conditions.exceeded.get(parameter.relative_to)
        if most is not None and most > OVERSHOOT * _UNCERTAIN * effect.values[parameter.name]:
            return True
    return False


def list_implausible(effect: Effect) -> list[Parameter]:
    """Parameters whose values are outside the observed range."""
    wild = []
    for parameter in effect.parameters:
        value, shown = effect.values[parameter.name], parameter.plausible
        low, high = parameter.bounds if shown is None else (shown.low, shown.high)
        if math.isfinite(value) and (not low <= value <= high or _is_at_bound(value, parameter)):
            wild.append(parameter)
    return wild


def explain_form(effect: Effect, conditions: Conditions) -> str:
    """What is wrong with values of the wrong sign, or that make it another effect; empty if nothing is."""
    for parameter in effect.parameters:
        value = effect.values[parameter.name]
        if parameter.one_sign and value <= parameter.neutral:
            return _refuse_value(
                parameter, value, f"it must be above {_format_value(parameter.neutral, parameter)}"
            )
    if not effect.is_degenerate(conditions):
        return ""
    simpler = effect.collapse()
    as_what = "it has no effect of its own on this run" if simpler is None else f"it acts as {simpler.id}"
    return f"with these values {as_what}"


def explain_impossible(effect: Effect, conditions: Conditions) -> str:
    """Which value of an effect that is not possible is not, and by what; see `is_possible`."""
    if form := explain_form(effect, conditions):
        return form
    for parameter in list_implausible(effect):
        value, shown = effect.values[parameter.name], parameter.plausible
        low, high = parameter.bounds if shown is None else (shown.low, shown.high)
        what = "it is at the end of its range," if low <= value <= high else "vehicles have"
        ends = f"{_format_value(low, parameter)} to {_format_value(high, parameter)}"
        return _refuse_value(parameter, value, f"{what} {ends}")
    for parameter in effect.parameters:
        most = conditions.exceeded.get(parameter.relative_to)
        if most is not None and is_exceeded(effect, conditions):
            reached = f"the measured wheels reach {_format_value(most, parameter)}"
            return _refuse_value(parameter, effect.values[parameter.name], reached)
    return "its values are not possible"


def _refuse_value(parameter: Parameter, value: float, why: str) -> str:
    return f"{parameter.name} = {_format_value(value, parameter, digits=2)} is not possible: {why}"


def _format_value(value: float, parameter: Parameter, digits: int = 3) -> str:
    return f"{value:.{digits}g}{suffix_unit(parameter.unit)}"


def measure_moves(fitted: Fitted, effect: Effect) -> Moves | None:
    """Change of a fitted model's predictions by one of its effects; None where the model lacks the effect.

    The other effects keep their values, although one of them might compensate in a new fit. Rare large
    changes, as of a limit, count by their square.
    """
    state = fitted.state
    if effect.id not in state.ids:
        return None
    shifts = [
        run_residuals.find_horizon_shifts(
            state.effects_of(run),
            [other for other in state.effects_of(run) if other.id != effect.id],
            state.timing[run],
        )
        for run, run_residuals in enumerate(fitted.data.residuals_by_run)
    ]
    distance, turn, length = (
        float(np.sqrt(np.mean(np.concatenate(column) ** 2))) for column in zip(*shifts, strict=True)
    )
    return Moves(distance, turn, distance / length if length > 0.0 else 0.0)
