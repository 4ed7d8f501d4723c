"""What to add to a model next: what the diagnosis of its run named, then what the evidence ranks first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.evidence import Evidence
from pipeline.estimation.fit import Fitted, fit_model
from pipeline.estimation.folds import Errors, HeldOut, hold_out, score
from pipeline.estimation.intervals import estimate_intervals
from pipeline.estimation.ladder import LadderStep
from pipeline.estimation.refusal import explain_refusals
from pipeline.estimation.selection import PRICE, Context
from pipeline.models import Model
from pipeline.run.recording import MotionError

if TYPE_CHECKING:
    from pipeline.core.arrays import Floats
    from pipeline.estimation.problem import Problem
    from pipeline.estimation.proposals import Candidate
    from pipeline.estimation.state import State
    from pipeline.models.effect import Effect

MOST_FITTED = 6
"""Candidates of drivetrain and of ground that are fitted: beyond six the expected gain is not worth a fit."""
_TWIN = 0.95
"""Cosine between what two effects take off the residuals, from which on they are called twins: nine tenths
of the square of what one does the other does too."""


@dataclass(frozen=True)
class Addition:
    """An effect that could be added to a model.

    Attributes:
        effect: with its values.
        errors: of the model with it.
        remaining: share of the errors over 2 s that stays: of position times of heading.
        refusal: why it is no help; None where it is one.
        twins: ids of effects that reduce the error of the run equally.
    """

    effect: Effect
    errors: Errors
    remaining: float
    refusal: str | None = None
    twins: tuple[str, ...] = ()


def rank_named(problem: Problem, state: State, named: Sequence[Effect]) -> list[Addition]:
    """The effects that a diagnosis named and a model lacks, the furthest fall of the errors first.

    They are scored with the values of the diagnosis, nothing is fitted.

    Args:
        problem: the run.
        state: the model.
        named: effects of the diagnosis, with their values.
    """
    active = problem.active_effects(Model(problem.vehicle, tuple(named)))
    missing = [effect for effect in active if effect.id not in state.ids]
    before = score(problem, state).pooled if missing else None
    additions = []
    for effect in missing:
        errors = score(problem, state.add(effect)).pooled
        additions.append(Addition(effect, errors, _measure_remaining(before or errors, errors)))
    return sorted(additions, key=lambda one: one.remaining)


def list_promising(problem: Problem, fitted: Fitted) -> list[Candidate]:
    """Effects that pay for their numbers beside a model, of drivetrain and ground the largest gain first."""
    candidates = Context(problem).list_candidates(problem.source)
    by_id = {candidate.id: candidate for candidate in candidates}
    promising = []
    for part, fit in zip(problem.parts, fitted.fits, strict=True):
        mine = [candidate for candidate in candidates if part.owns(candidate())]
        ranked = Evidence(part, fit, mine, problem.largest).rank_singles(PRICE)
        paying = [one for one in ranked if one.chi_square > PRICE * one.numbers]
        promising += [by_id[one.starts[0].effect.id] for one in paying[:MOST_FITTED]]
    return promising


class Tries:
    """Effects tried one by one on top of a model.

    Args:
        problem: the run.
        model: as it stands.
    """

    def __init__(self, problem: Problem, model: Model) -> None:
        self._problem, self._model = problem, model
        self._base = fit_model(problem, model)
        self._held = hold_out(problem, self._base)
        self._moves: dict[str, Floats] = {}
        self.before = self._held.pooled
        self.candidates = list_promising(problem, self._base)

    def try_each(self) -> Iterator[Addition | None]:
        """Each candidate, fitted and judged; None for what cannot be fitted to this run."""
        for candidate in self.candidates:
            try:
                fitted = fit_model(self._problem, self._model + candidate())
                held = hold_out(self._problem, fitted)
            except (MotionError, ArithmeticError, ValueError):
                yield None
                continue
            yield self._judge(candidate.id, fitted, held)

    def _judge(self, name: str, fitted: Fitted, held: HeldOut) -> Addition | None:
        effect = next((one for one in fitted.state.effects if one.id == name), None)
        if effect is None:
            return None
        before, after = LadderStep(self._base, self._held), LadderStep(fitted, held)
        reasons = explain_refusals(
            self._problem,
            before,
            after,
            lambda: estimate_intervals(self._problem, fitted).shared_intervals,
        )
        remaining = _measure_remaining(self.before, held.pooled)
        self._moves[name] = _unit(held.residuals - self._held.residuals, self._held.residuals)
        return Addition(effect, held.pooled, remaining, reasons.get(name))

    def fold(self, additions: Sequence[Addition]) -> list[Addition]:
        """What helps, twins in one entry, that with the fewest numbers; the furthest fall first."""
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


def _count_numbers(effect: Effect) -> int:
    return sum(bool(np.isfinite(value)) for value in effect.values.values())


def _unit(change: Floats, residual: Floats) -> Floats:
    """A change of residuals in units of their spread, of unit length, shape (3 n,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = np.nan_to_num(change / np.nanstd(residual, axis=0), posinf=0.0, neginf=0.0).ravel()
    unit: Floats = scaled / max(float(np.linalg.norm(scaled)), 1e-12)
    return unit


def _measure_remaining(before: Errors, after: Errors) -> float:
    """What stays of the errors over 2 s that people are shown: of position times of heading."""
    position = after.t_mrmse_m / max(before.t_mrmse_m, 1e-12)
    return position * after.r_mrmse_rad / max(before.r_mrmse_rad, 1e-12)
