"""Why an effect that was added to a model is no help."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.program import format_share
from pipeline.estimation.acceptance import LEAST_GAIN, LEAST_T, Improvement, compare
from pipeline.estimation.describe import format_rises
from pipeline.estimation.evidence import learn_noise, tile_windows
from pipeline.estimation.folds import number_predictions
from pipeline.estimation.ladder import CHANCE, list_rises
from pipeline.estimation.learned_step import explain_no_help
from pipeline.estimation.parts import make_weights
from pipeline.estimation.selection import Context
from pipeline.models.learned_term import LEARNED

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pipeline.estimation.folds import Errors, HeldOut
    from pipeline.estimation.ladder import LadderStep
    from pipeline.estimation.problem import Problem
    from pipeline.models.effect import Effect, Parameter
    from pipeline.models.parameter import Conditions

Interval = tuple[float, float]


def explain_refusals(
    problem: Problem, before: LadderStep, after: LadderStep, intervals: Callable[[], Mapping[str, Interval]]
) -> dict[str, str]:
    """Say why effects that a model has beyond another one are no help, by id; empty where they are.

    The first kind of reason that is found counts: a form that says nothing or cannot be, the errors of all
    of them together, an interval that includes no effect.

    Args:
        problem: the runs.
        before: the smaller model.
        after: the larger one.
        intervals: makes the 95 % intervals by label ``effect.parameter``, which take longest.
    """
    added = [effect for effect in after.fitted.model if effect.id not in before.effects]
    if not added:
        return {}
    if [one.id for one in added] == [LEARNED]:
        stretches = np.concatenate(number_predictions(problem))
        said = explain_no_help(before.held_out, after.held_out, stretches)
        return {LEARNED: said} if said else {}
    conditions = Context(problem).conditions
    if alone := {one.id: why for one in added if (why := explain_refusal(one, {}, conditions))}:
        return alone
    numbers = max(len(after.fitted.free) - len(before.fitted.free), 1)
    gain = measure_gain(problem, before.held_out, after.held_out, numbers)
    if together := explain_errors(before.errors, after.errors, gain):
        return dict.fromkeys((one.id for one in added), together)
    fitted = intervals()
    return {one.id: why for one in added if (why := explain_refusal(one, fitted))}


def explain_errors(
    before: Errors | Mapping[str, object], after: Errors | Mapping[str, object], gain: Improvement
) -> str | None:
    """Say why the held-out errors speak against what was added; None where they speak for it.

    Args:
        before: errors without it.
        after: errors with it.
        gain: what it improves held-out data by.
    """
    if rises := format_rises(before, after, CHANCE):
        return rises
    if not list_rises(after, before, CHANCE):
        return f"no error over 2 s falls by more than chance ({format_share(CHANCE)})"
    if gain.is_significant:
        return None
    if gain.gain < LEAST_GAIN:
        return f"the held-out error falls by less than {format_share(LEAST_GAIN)}"
    return f"its gain is within the noise (t = {gain.share * LEAST_T:.1f}; {LEAST_T:g} is needed)"


def explain_refusal(
    effect: Effect, intervals: Mapping[str, Interval], conditions: Conditions | None = None
) -> str | None:
    """Say why the numbers of an effect make it no help to a model; None where they do not.

    Args:
        effect: as it was fitted.
        intervals: 95 % intervals by label ``effect.parameter``.
        conditions: what the runs can show; None where that is not known.
    """
    for parameter in effect.parameters:
        value = effect.values[parameter.name]
        if parameter.one_sign and value <= parameter.neutral:
            return (
                f"{parameter.name} = {_format_value(value, parameter, digits=2)} is not possible: "
                f"only values above {_format_value(parameter.neutral, parameter)} are"
            )
    if conditions is not None and effect.is_degenerate(conditions):
        simpler = effect.collapse()
        as_what = "it has no effect of its own on this run" if simpler is None else f"it acts as {simpler.id}"
        return f"with these values {as_what}"
    return explain_interval(effect, {name: intervals.get(f"{effect.id}.{name}") for name in effect.values})


def explain_interval(effect: Effect, intervals: Mapping[str, Interval | None]) -> str | None:
    """Say that every interval of an effect includes no effect; None where one does not, or none is known.

    Args:
        effect: as it was fitted.
        intervals: 95 % intervals by parameter.
    """
    known = [
        (parameter, interval)
        for parameter in effect.parameters
        if (interval := intervals.get(parameter.name))
        and not math.isnan(parameter.neutral)
        and math.isfinite(interval[1] - interval[0])
        and interval[1] > interval[0]
    ]
    if not known or not all(_holds_neutral(*one) for one in known):
        return None
    parameter, (low, high) = known[0]
    at = _format_value(parameter.neutral, parameter) if math.isfinite(parameter.neutral) else "no limit"
    return (
        f"the 95 % interval of {parameter.name}, {low:.3g} to {_format_value(high, parameter)}, "
        f"includes {at}: no effect"
    )


def format_refusals(refusals: Mapping[str, str]) -> str:
    """Refusals in one clause: `slope_drift does not help on held-out data (its gain is within the noise)`.

    Args:
        refusals: reasons by id, at least one.
    """
    reasons = list(dict.fromkeys(refusals.values()))
    said = reasons[0] if len(reasons) == 1 else "; ".join(f"{name}: {why}" for name, why in refusals.items())
    verb = "does" if len(refusals) == 1 else "do"
    return f"{', '.join(refusals)} {verb} not help on held-out data ({said})"


def measure_gain(problem: Problem, before: HeldOut, after: HeldOut, numbers: int = 1) -> Improvement:
    """What a larger model improves held-out data by, with the test of significance of the diagnosis.

    Args:
        problem: the runs.
        before: the smaller model.
        after: the larger one.
        numbers: how many more numbers the larger one has.
    """
    part = problem.whole
    tiles = tile_windows(part)
    noise = learn_noise(tiles, part.channels, after.residuals[tiles.rows])
    weights = make_weights(before.residuals, part)
    return compare(noise, weights, before.residuals, after.residuals, numbers=numbers)


def _holds_neutral(parameter: Parameter, interval: Interval) -> bool:
    """Whether an interval includes doing nothing; a limit has no effect at infinity."""
    low, high = interval
    if math.isfinite(parameter.neutral):
        return low <= parameter.neutral <= high
    return math.isinf(parameter.neutral) and low <= parameter.bounds[0]


def _format_value(value: float, parameter: Parameter, digits: int = 3) -> str:
    text = f"{value:.{digits}g}"
    return text if parameter.unit == "1" else f"{text} {parameter.unit}"
