"""Why an effect that was added to a model is no help."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pipeline.estimation.acceptance import LEAST_GAIN, LEAST_T, Improvement, compare
from pipeline.estimation.describe import describe_rises
from pipeline.estimation.evidence import learn_noise, tile_windows
from pipeline.estimation.ladder import CHANCE, list_rises
from pipeline.estimation.parts import make_weights

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.estimation.folds import Errors, HeldOut
    from pipeline.estimation.problem import Problem
    from pipeline.models.effect import Effect, Parameter
    from pipeline.models.parameter import Conditions

Interval = tuple[float, float]


def explain_refusal(
    effect: Effect,
    intervals: Mapping[str, Interval],
    gain: Improvement | None = None,
    conditions: Conditions | None = None,
) -> str | None:
    """Say why an effect is no help to a model; None where it is one.

    Args:
        effect: as it was fitted.
        intervals: 95 % intervals by label ``effect.parameter``.
        gain: what it improves held-out data by; None where that is not known.
        conditions: what the runs can show; None where that is not known.
    """
    for parameter in effect.parameters:
        value = effect.values[parameter.name]
        if parameter.one_sign and value <= parameter.neutral:
            return (
                f"{parameter.name} = {_say(value, parameter)} is not possible: "
                f"only values above {_say(parameter.neutral, parameter)} are"
            )
    if conditions is not None and effect.is_degenerate(conditions):
        simpler = effect.collapse()
        as_what = "it has no effect of its own on this run" if simpler is None else f"it acts as {simpler.id}"
        return f"with these values {as_what}"
    known = [
        (parameter, interval)
        for parameter in effect.parameters
        if (interval := intervals.get(f"{effect.id}.{parameter.name}")) and math.isfinite(sum(interval))
    ]
    if known and all(_holds_neutral(*one) for one in known):
        parameter, (low, high) = known[0]
        at = _say(parameter.neutral, parameter) if math.isfinite(parameter.neutral) else "no limit"
        return (
            f"the 95 % interval of {parameter.name}, {low:.3g} to {_say(high, parameter)}, "
            f"includes {at}: no effect"
        )
    if gain is not None and not gain.is_significant:
        if gain.gain < LEAST_GAIN:
            return f"the held-out error falls by less than {LEAST_GAIN:.0%}"
        t = gain.share * LEAST_T
        return f"its gain is within the noise (t = {t:.1f}; {LEAST_T:g} is needed)"
    return None


def explain_refusals(
    below: Errors | Mapping[str, object],
    errors: Errors | Mapping[str, object],
    effects: Sequence[Effect],
    intervals: Mapping[str, Interval],
) -> str:
    """Say why effects that were added together are no help; empty where they are.

    Args:
        below: held-out errors without the effects, or the rung in JSON.
        errors: with them.
        effects: as they were fitted.
        intervals: 95 % intervals by label ``effect.parameter``; numbers without one are judged by the errors.
    """
    reasons = describe_rises(below, errors, CHANCE)
    if not reasons and not list_rises(errors, below, CHANCE):
        reasons.append(f"no error over 2 s falls by more than chance ({CHANCE:.0%})")
    reasons += [f"{one.id}: {why}" for one in effects if (why := explain_refusal(one, intervals))]
    return "; ".join(reasons)


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
    """Whether an interval includes doing nothing; a limit does nothing at infinity."""
    low, high = interval
    if math.isfinite(parameter.neutral):
        return low <= parameter.neutral <= high
    return math.isinf(parameter.neutral) and low <= parameter.bounds[0]


def _say(value: float, parameter: Parameter) -> str:
    return f"{value:.3g}" if parameter.unit == "1" else f"{value:.3g} {parameter.unit}"
