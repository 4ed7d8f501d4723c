"""Effects added to a model: which to try next, what each removes, and why one does not help.

The effects of the run's diagnosis come first, then candidates in the order of their evidence.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import format_share
from pipeline.estimation.decision import LEAST_T, measure_t
from pipeline.estimation.intervals import estimate_intervals
from pipeline.estimation.ladder import LadderStep, judge_whole, lowers_errors, raises_errors
from pipeline.estimation.matrix import Matrix
from pipeline.estimation.model_fit import Fitted
from pipeline.models import Model, explain_idle
from pipeline.results import CHANCE, Errors, format_rises, list_rises
from pipeline.run import MotionError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pipeline.core import Floats
    from pipeline.estimation.candidates import Candidate
    from pipeline.estimation.estimation_data import EstimationData
    from pipeline.models import Conditions, Effect, Parameter

Interval = tuple[float, float]

MOST_FITTED = 6
"""Candidates of drivetrain and of ground that are fitted: the gain of others does not justify a fit."""
_TWIN = 0.95
"""Cosine between the residual changes of two effects above which they are twins: they share nine tenths of
the squared change."""


@dataclass(frozen=True)
class Addition:
    """An effect that could be added to a model.

    Attributes:
        effect: with its values.
        errors: of the model with it.
        remaining: remaining share of the 2 s errors: that of position times that of heading.
        refusal: why it does not help; None where it helps.
        twins: ids of effects that reduce the error of the run equally.
        helps: whether it lowers an error by more than chance.
    """

    effect: Effect
    errors: Errors
    remaining: float
    refusal: str | None = None
    twins: tuple[str, ...] = ()
    helps: bool = True


def rank_named(
    judge: Callable[[Model], Errors], model: Model, before: Errors, named: Sequence[Effect]
) -> list[Addition]:
    """What a diagnosis has beyond a model, the largest error reduction first.

    What raises the errors is left out: it may help once others are in the model.

    Args:
        judge: held-out errors of a model, fitted: what it has once the effect was added.
        model: the model.
        before: its errors.
        named: effects and the suggested formula of the diagnosis, with their values.
    """
    additions = []
    for effect in (one for one in named if one.id not in model):
        errors = judge(model + effect)
        if not raises_errors(before, errors):
            additions.append(
                Addition(
                    effect,
                    errors,
                    _measure_remaining(before, errors),
                    helps=lowers_errors(before, errors),
                )
            )
    return sorted(additions, key=lambda one: one.remaining)


def list_promising(data: EstimationData, fitted: Fitted) -> list[Candidate]:
    """Effects whose expected gain exceeds the price of their parameters, per path the largest gain first."""
    candidates = data.list_candidates(data.source)
    by_id = {candidate.id: candidate for candidate in candidates}
    promising = []
    for path, fit in zip(data.paths, fitted.fits, strict=True):
        ids = fitted.model.ids
        effects = [one for one in candidates if one.id not in ids and one().acts_in(ids)]
        mine = [candidate for candidate in effects if path.owns(candidate())]
        matrix = Matrix(fit, mine, data.largest)
        paying = [one for one in matrix.list_singles() if matrix.expect_change(one) < 0.0]
        promising += [by_id[matrix.trials[one.added[0]].effect.id] for one in paying[:MOST_FITTED]]
    return promising


class Tries:
    """Effects tried one by one on top of a model.

    Args:
        data: the run.
        model: the current model.
        suggested: formulas to try beside the catalogue.
    """

    def __init__(self, data: EstimationData, model: Model, suggested: Sequence[Effect] = ()) -> None:
        self._data, self._model = data, model
        self._base = judge_whole(data, model)
        self._moves: dict[str, Floats] = {}
        self.before = self._base.errors
        promising = [candidate() for candidate in list_promising(data, self._base.fitted)]
        self.candidates = [*promising, *(one for one in suggested if one.id not in model)]

    def try_each(self) -> Iterator[Addition | None]:
        """Each candidate, fitted and judged; None for one that cannot be fitted to this run."""
        for candidate in self.candidates:
            try:
                after = judge_whole(self._data, self._model + candidate)
            except (MotionError, ArithmeticError, ValueError):
                yield None
                continue
            yield self._judge(candidate.id, after)

    def _judge(self, name: str, after: LadderStep) -> Addition | None:
        effect = next((one for one in after.fitted.state.effects if one.id == name), None)
        if effect is None:
            return None
        reasons = explain_refusals(
            self._data,
            self._base,
            after,
            lambda: estimate_intervals(after.fitted).shared_intervals,
        )
        remaining, held = _measure_remaining(self.before, after.errors), self._base.held_out.residuals
        self._moves[name] = _unit(after.held_out.residuals - held, held)
        return Addition(effect, after.errors, remaining, reasons.get(name))

    def fold(self, additions: Sequence[Addition]) -> list[Addition]:
        """Helpful effects, largest reduction first; twins are listed under the one with fewest parameters."""
        folded: list[Addition] = []
        helping = [one for one in additions if one.refusal is None]
        for one in sorted(helping, key=lambda one: (_count_numbers(one.effect), one.remaining)):
            index = next((i for i, other in enumerate(folded) if self._are_twins(one, other)), None)
            if index is None:
                folded.append(one)
            else:
                folded[index] = replace(folded[index], twins=(*folded[index].twins, one.effect.id))
        return sorted(folded, key=lambda one: one.remaining)

    def _are_twins(self, one: Addition, other: Addition) -> bool:
        return abs(float(self._moves[one.effect.id] @ self._moves[other.effect.id])) > _TWIN


def explain_refusals(
    data: EstimationData,
    before: LadderStep,
    after: LadderStep,
    intervals: Callable[[], Mapping[str, Interval]],
) -> dict[str, str]:
    """Reasons why the additional effects of a larger model do not help, by id; empty where they help.

    The first kind of reason is reported: impossible or degenerate values, the errors of all additional
    effects together, an interval that includes the neutral value.

    Args:
        data: the runs.
        before: the smaller model.
        after: the larger one.
        intervals: computes the 95 % intervals by label ``effect.parameter``, the slowest step.
    """
    added = [effect for effect in after.fitted.model if effect.id not in before.effects]
    if not added:
        return {}
    idle = {one.id: explain_idle(one, after.effects) for one in added}
    if any(idle.values()):
        return {name: f"it {text}" for name, text in idle.items() if text}
    conditions = data.conditions
    if alone := {one.id: why for one in added if (why := explain_refusal(one, {}, conditions))}:
        return alone
    t = min(measure_t(fit, one) for one in added for fit in after.fitted.fits if fit.path.owns(one))
    if together := explain_errors(before.errors, after.errors, t):
        return dict.fromkeys((one.id for one in added), together)
    fitted = intervals()
    return {one.id: why for one in added if (why := explain_refusal(one, fitted))}


def explain_errors(
    before: Errors | Mapping[str, object], after: Errors | Mapping[str, object], t: float
) -> str | None:
    """Reason why the held-out errors contradict the addition; None where they support it.

    Args:
        before: errors without it.
        after: errors with it.
        t: standard errors by which its numbers are away from none.
    """
    if rises := format_rises(before, after, CHANCE):
        return rises
    if not list_rises(after, before, CHANCE):
        return f"no error over 2 s falls by more than {format_share(CHANCE)}"
    if t >= LEAST_T:
        return None
    return f"the reduction is not significant (t = {t:.1f}, required {LEAST_T:g})"


def explain_refusal(
    effect: Effect, intervals: Mapping[str, Interval], conditions: Conditions | None = None
) -> str | None:
    """Reason why an effect with these values does not help a model; None where there is none.

    Args:
        effect: with its fitted values.
        intervals: 95 % intervals by label ``effect.parameter``.
        conditions: what the runs can show; None where that is not known.
    """
    for parameter in effect.parameters:
        value = effect.values[parameter.name]
        if parameter.one_sign and value <= parameter.neutral:
            return (
                f"{parameter.name} = {_format_value(value, parameter, digits=2)} is not possible: "
                f"it must be above {_format_value(parameter.neutral, parameter)}"
            )
    if conditions is not None and effect.is_degenerate(conditions):
        simpler = effect.collapse()
        as_what = "it has no effect of its own on this run" if simpler is None else f"it acts as {simpler.id}"
        return f"with these values {as_what}"
    return explain_interval(effect, {name: intervals.get(f"{effect.id}.{name}") for name in effect.values})


def explain_interval(effect: Effect, intervals: Mapping[str, Interval | None]) -> str | None:
    """Clause stating that all intervals include the neutral value; None where one does not or none is known.

    Args:
        effect: with its fitted values.
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
        f"includes {at} (no effect)"
    )


def _count_numbers(effect: Effect) -> int:
    return sum(bool(np.isfinite(value)) for value in effect.values.values())


def _unit(change: Floats, residual: Floats) -> Floats:
    """A change of residuals in units of their spread, scaled to unit length, shape (3 n,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = np.nan_to_num(change / np.nanstd(residual, axis=0), posinf=0.0, neginf=0.0).ravel()
    unit: Floats = scaled / max(float(np.linalg.norm(scaled)), 1e-12)
    return unit


def _measure_remaining(before: Errors, after: Errors) -> float:
    """Remaining share of the 2 s errors: that of position times that of heading."""
    position = after.t_mrmse_m / max(before.t_mrmse_m, 1e-12)
    return position * after.r_mrmse_rad / max(before.r_mrmse_rad, 1e-12)


def _holds_neutral(parameter: Parameter, interval: Interval) -> bool:
    """Whether an interval includes the neutral value, which is infinity for a limit."""
    low, high = interval
    if math.isfinite(parameter.neutral):
        return low <= parameter.neutral <= high
    return math.isinf(parameter.neutral) and low <= parameter.bounds[0]


def _format_value(value: float, parameter: Parameter, digits: int = 3) -> str:
    text = f"{value:.{digits}g}"
    return text if parameter.unit == "1" else f"{text} {parameter.unit}"
