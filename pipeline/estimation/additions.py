"""What would be accepted next in a model: effects fitted beside its others, and judged as the search does."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.decision import SHOWN, find_expected_fall, judge
from pipeline.estimation.ladder import LadderStep, judge_whole, lowers_errors
from pipeline.estimation.matrix import Matrix
from pipeline.estimation.plausibility import explain_form, is_nameable
from pipeline.models import Model, explain_idle, find_effect
from pipeline.run import MotionError

if TYPE_CHECKING:
    from collections.abc import Collection

    from pipeline.core import Floats
    from pipeline.estimation.estimation_data import EstimationData
    from pipeline.estimation.model_fit import Fitted
    from pipeline.models import Effect
    from pipeline.results import Errors

MOST_FITTED = 6
"""Candidates of drivetrain and of ground that are fitted: the gain of others does not justify a fit."""
_MOST_REFUSED = 3
"""The same of those that may be refused."""
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
        refusal: why it would not be accepted; empty where it would.
        twins: ids of effects that reduce the error of the run equally.
    """

    effect: Effect
    errors: Errors
    remaining: float
    refusal: str = ""
    twins: tuple[str, ...] = ()


def weigh_addition(before: LadderStep, after: LadderStep, name: str) -> Addition | None:
    """An effect as an addition to a fitted model; None where it does not act there.

    Args:
        before: the model without it.
        after: the model with it.
        name: its id.
    """
    effect = after.fitted.state.find(name)
    if effect is None:
        return None
    refusal = explain_refusals(after, (name,)).get(name, "")
    return Addition(effect, after.errors, _measure_remaining(before.errors, after.errors), refusal)


def list_beyond(data: EstimationData, model: Model, known: Sequence[Effect]) -> list[Effect]:
    """Of the effects of a diagnosis those that a model lacks, and that act on the input."""
    return [one for one in data.active_effects(Model(model.vehicle, tuple(known))) if one.id not in model]


def explain_refusals(step: LadderStep, names: Collection[str]) -> dict[str, str]:
    """Why effects of a fitted model would not be accepted beside its others, by id; empty where they would.

    Args:
        step: the model.
        names: ids of the effects that are asked.
    """
    data = step.fitted.data
    refusals = dict[str, str]()
    for fit in step.fitted.fits:
        asked = [one for one in fit.state.effects if one.id in names and fit.path.owns(one)]
        if not asked:
            continue
        matrix = Matrix(fit, (), data.largest)
        for effect in asked:
            if idle := explain_idle(effect, step.effects):
                refusals[effect.id] = f"it {idle}"
            elif why := judge(fit, effect, matrix, data.conditions).refusal:
                refusals[effect.id] = explain_form(effect, data.conditions) or why
    return refusals


def list_promising(data: EstimationData, fitted: Fitted) -> list[str]:
    """Ids of effects whose expected gain exceeds their price, per path the largest gain first."""
    return [
        matrix.trials[one.added[0]].effect.id
        for matrix in _list_matrices(data, fitted)
        for one in [one for one in matrix.list_singles() if matrix.expect_change(one) < 0.0][:MOST_FITTED]
    ]


def find_refused(before: LadderStep) -> list[Addition]:
    """Effects that would lower an error of a model as much as one must, and lack the evidence for a name.

    Values that no vehicle has explain nothing: such effects are left out.

    Args:
        before: the model, fitted.

    Returns:
        With the reason against each; what leaves least first.
    """
    fitted, refused = before.fitted, list[Addition]()
    for fit, matrix in zip(fitted.fits, _list_matrices(fitted.data, fitted), strict=True):
        for move in matrix.list_singles()[:_MOST_REFUSED]:
            added = matrix.list_states(move)[0]
            there = replace(fit, state=added, residual=fit.path.find_residuals(added))
            if find_expected_fall(there, fit.residual - there.residual) < SHOWN:
                continue
            name = matrix.trials[move.added[0]].effect.id
            with suppress(MotionError, ArithmeticError, ValueError):
                after = judge_whole(fitted.data, fitted.model + find_effect(name)())
                falls = 1.0 - np.array(after.errors.ratios(before.errors)[-2:])
                if not lowers_errors(before.errors, after.errors) or np.nanmax(falls) < SHOWN:
                    continue
                refused += _list_unproven(before, after, name)
    return sorted(refused, key=lambda one: one.remaining)


def _list_unproven(before: LadderStep, after: LadderStep, name: str) -> Iterator[Addition]:
    """An effect of a model as an addition to that without it, where nothing but evidence is wanting."""
    data = after.fitted.data
    for fit in after.fitted.fits:
        effect = fit.state.find(name)
        if effect is None or not fit.path.owns(effect) or not is_nameable(effect, data.conditions):
            continue
        judged = judge(fit, effect, Matrix(fit, (), data.largest), data.conditions)
        if judged.refusal and not judged.is_proven:
            remaining = _measure_remaining(before.errors, after.errors)
            yield Addition(effect, after.errors, remaining, judged.refusal)


def _list_matrices(data: EstimationData, fitted: Fitted) -> Iterator[Matrix]:
    """Of each path, what effects beside those of a model would explain."""
    ids = fitted.model.ids
    effects = [one for one in data.list_candidates(data.source) if one.id not in ids and one().acts_in(ids)]
    for path, fit in zip(data.paths, fitted.fits, strict=True):
        yield Matrix(fit, [one for one in effects if path.owns(one())], data.largest)


class Tries:
    """Effects tried one by one on top of a model.

    Args:
        data: the run.
        model: the current model.
        known: effects and the formula of a diagnosis, with their values, which are tried first.
    """

    def __init__(self, data: EstimationData, model: Model, known: Sequence[Effect] = ()) -> None:
        self._data, self._model = data, model
        self._base = judge_whole(data, model)
        self._moves: dict[str, Floats] = {}
        self.before = self._base.errors
        first = list_beyond(data, model, known)
        ids = {one.id for one in first}
        promising = [find_effect(name)() for name in list_promising(data, self._base.fitted)]
        self.candidates = [*first, *(one for one in promising if one.id not in ids)]

    def try_each(self) -> Iterator[Addition | None]:
        """Each candidate, fitted and judged; None for one that cannot be fitted to this run."""
        for candidate in self.candidates:
            try:
                after = judge_whole(self._data, self._model + candidate)
            except (MotionError, ArithmeticError, ValueError):
                yield None
                continue
            held = self._base.held_out.residuals
            self._moves[candidate.id] = _unit(after.held_out.residuals - held, held)
            yield weigh_addition(self._base, after, candidate.id)

    def fold(self, additions: Sequence[Addition]) -> list[Addition]:
        """What is accepted, largest reduction first; twins are listed under the one with fewest numbers."""
        folded: list[Addition] = []
        accepted = [one for one in additions if not one.refusal]
        for one in sorted(accepted, key=lambda one: (_count_numbers(one.effect), one.remaining)):
            index = next((i for i, other in enumerate(folded) if self._are_twins(one, other)), None)
            if index is None:
                folded.append(one)
            else:
                folded[index] = replace(folded[index], twins=(*folded[index].twins, one.effect.id))
        return sorted(folded, key=lambda one: one.remaining)

    def _are_twins(self, one: Addition, other: Addition) -> bool:
        return abs(float(self._moves[one.effect.id] @ self._moves[other.effect.id])) > _TWIN


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
