"""Where models compete: a part of the way, its weights and folds, and the effects that may be named."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.core.parallel import map_parallel
from pipeline.diagnosis.budget import Budget
from pipeline.diagnosis.plausibility import is_nameable
from pipeline.diagnosis.verdict import LEAST_GAIN, Verdict, compare
from pipeline.identification.fit import PartFit, fit_part
from pipeline.identification.folds import Fold, hold_out_part, make_folds
from pipeline.identification.parts import Part
from pipeline.identification.proposals import Candidate, Proposal, Trial, propose
from pipeline.identification.state import State
from pipeline.identification.weights import Weights, make_weights
from pipeline.models.effect import Effect
from pipeline.models.evidence import Evidence, Largest

_FIRST_STEPS = 4
_WORTH = 1.15
# Of 874 models tried in the place of effects or beside them as rivals, on recordings, the 34 that served
# promised 1.06 at most.
_HOPE = 1.1


@dataclass(frozen=True)
class CandidateModel:
    """A fitted model with its held-out residuals.

    Attributes:
        fit: the model.
        held: residuals under parameters fitted elsewhere, shape (n, 3).
        score: held-out loss, more for effects that have a price.
    """

    fit: PartFit
    held: Floats
    score: float

    @property
    def state(self) -> State:
        """The model's state."""
        return self.fit.state

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of its effects."""
        return self.fit.state.ids

    @property
    def numbers(self) -> int:
        """How many numbers were fitted."""
        return len(self.fit.free)


@dataclass
class Selection:
    """A part of the way with what is needed to judge models of it.

    Attributes:
        part: of the way that is explained.
        candidates: effects that may be named.
        evidence: what the runs can show.
        kept: effects that are never dropped: those of the model to start from.
        weights: cost of residuals at the current model.
        budget: how long the search may take.
        work: how many times candidates were looked through.
    """

    part: Part
    candidates: tuple[Candidate, ...]
    evidence: Evidence
    folds: tuple[Fold, ...]
    weights: Weights
    kept: frozenset[str] = frozenset()
    budget: Budget = field(default_factory=Budget)
    _dropped: dict[tuple[str, ...], CandidateModel] = field(default_factory=dict)
    _proposed: dict[tuple[object, ...], list[Proposal]] = field(default_factory=dict)
    work: int = 0
    _columns: dict[str, list[Trial]] = field(default_factory=dict)

    def widen(self, candidates: tuple[Candidate, ...]) -> Selection:
        """The same selection with other candidates; nothing that was tried here counts there."""
        return Selection(
            self.part, candidates, self.evidence, self.folds, self.weights,
            kept=self.kept, budget=self.budget,
        )  # fmt: skip

    def is_done(self, most: int) -> bool:
        """Whether candidates were looked through often enough, or for too long."""
        return self.work > most or self.budget.is_spent()

    @property
    def largest(self) -> Largest:
        """What was asked for."""
        return self.evidence.largest

    def enter(self, start: State | PartFit) -> CandidateModel:
        """Fit a state, or a fit further, and hold it out."""
        return self._enter_each([start])[0]

    def _enter_each(self, starts: Sequence[State | PartFit]) -> list[CandidateModel]:
        fitted = map_parallel(partial(_fit_held, self.part, self.weights, self.folds), starts)
        return [CandidateModel(fit, held, self._score(held, fit.state)) for fit, held in fitted]

    def drop(self, current: CandidateModel, names: Iterable[str]) -> CandidateModel:
        """A model without some of its effects, fitted anew."""
        return self.drop_each(current, [names])[0]

    def drop_each(self, current: CandidateModel, groups: Iterable[Iterable[str]]) -> list[CandidateModel]:
        """A model without each group of its effects, fitted anew."""
        states = [current.state.drop(names) for names in groups]
        new = [state for state in states if state.ids not in self._dropped]
        self._dropped.update(zip((state.ids for state in new), self._enter_each(new), strict=True))
        return [self._dropped[state.ids] for state in states]

    def _present(self, fit: PartFit) -> CandidateModel:
        held = hold_out_part(fit, self.folds)
        return CandidateModel(fit, held, self._score(held, fit.state))

    def _score(self, held: Floats, state: State) -> float:
        return self.weights.loss(held) * (1.0 + sum(effect.price for effect in state.effects))

    def judge(self, before: CandidateModel, after: CandidateModel) -> Verdict:
        """How much better ``after`` is."""
        return compare(self.part, self.weights, before.held, after.held)

    def prefers(self, before: CandidateModel, after: CandidateModel, least_gain: float = LEAST_GAIN) -> bool:
        """Whether ``after`` is better beyond doubt, and by enough to matter."""
        return self.judge(before, after).accepts(least_gain)

    def adapt(self, tested: CandidateModel) -> CandidateModel:
        """Take the weights from a model's own residuals, and fit it anew."""
        self.weights = make_weights(tested.fit.residual, self.part)
        self._dropped.clear()
        self._proposed.clear()
        self.budget.report(self.part.way, tested.ids)
        return self.enter(tested.fit)

    def suggest(
        self,
        base: CandidateModel,
        count: int,
        without: Iterable[str] = (),
        *,
        most: float = math.inf,
        known: int = 0,
    ) -> list[CandidateModel]:
        """The best few models with one effect more, fitted, by score.

        Args:
            base: the model to add to.
            count: how many are tried.
            without: effects that are not added.
            most: score from which on a model is of no use: what is promised far more is not fitted.
            known: how many were tried before, and are left out.
        """
        proposals = self._propose(base, frozenset(without))
        next_ones = proposals[_count(proposals, known) if known else 0 : _count(proposals, count)]
        hopeful = [one.state for one in next_ones if one.loss < _HOPE * most]
        # A few steps tell which of them are worth fitting to the end.
        tried = map_parallel(partial(fit_part, self.part, self.weights, iterations=_FIRST_STEPS), hopeful)
        best = min((most, *(fit.loss for fit in tried)))
        finished = iter(self._enter_each([fit for fit in tried if fit.loss < _WORTH * best]))
        entered = [next(finished) if fit.loss < _WORTH * best else self._present(fit) for fit in tried]
        simple = [self._simplify(tested, base) for tested in entered]
        return sorted((c for c in simple if self.is_sound(c)), key=lambda c: c.score)

    def _propose(self, base: CandidateModel, barred: frozenset[str]) -> list[Proposal]:
        """Effects beside a model by what they promise; asked again for more of them."""
        key = (base.ids, barred)
        if key not in self._proposed:
            self.work += 1
            candidates = [c for c in self.candidates if c.id not in barred]
            self._proposed[key] = propose(self.part, base.fit, candidates, self.largest, self._columns)
        return self._proposed[key]

    def _simplify(self, tested: CandidateModel, base: CandidateModel) -> CandidateModel:
        """The model without what a new effect has taken the place of, or with what is left of it.

        Lags together imitate a delay, a slow steering a limit: put in beside their imitation they leave it
        at nothing, and the model with both says less than the one without it.
        """
        known = {candidate.id for candidate in self.candidates} - set(tested.ids)
        gone = [effect for effect in tested.state.effects if not self.may_stay(effect, tested.state)]
        if not gone or len(gone) == len(tested.ids):
            return tested
        simpler = [one for one in (effect.collapse() for effect in gone) if one is not None]
        left = tested.state.drop([effect.id for effect in gone])
        left = left.add(*(one for one in simpler if one.id in known))
        return base if left.ids == base.ids else self.enter(left)

    def is_sound(self, tested: CandidateModel) -> bool:
        """Whether every effect is large enough to be named, and no degenerate form of another."""
        return all(self.may_stay(effect, tested.state) for effect in tested.state.effects)

    def may_stay(self, effect: Effect, state: State) -> bool:
        """Whether an effect of a state is known, or may be named as it acts in one of the runs."""
        if effect.id in self.kept:
            return True
        acting = state.list_as_it_acts(effect)
        if len(acting) > 1:
            # Of clocks that differ, the earliest is early against the latest, which no delay of a drive is.
            delays = [one.delay for one in acting]
            acting.append(effect.of_delay(min(delays) - max(delays)))
        return any(is_nameable(one, self.evidence) for one in acting)


def _fit_held(
    part: Part, weights: Weights, folds: tuple[Fold, ...], start: State | PartFit
) -> tuple[PartFit, Floats]:
    """The fit from a start, and its held-out residuals."""
    fit = fit_part(part, weights, start)
    return fit, hold_out_part(fit, folds)


def _count(proposals: list[Proposal], free: int) -> int:
    """How many proposals hold that many without a price; what has one takes no place from them."""
    priced = [proposal.trial.effect.price > 0.0 for proposal in proposals]
    places = np.cumsum(np.logical_not(priced))
    return int(np.searchsorted(places, free, side="right"))


def open_selection(
    part: Part, start: State, candidates: tuple[Candidate, ...], evidence: Evidence, budget: Budget
) -> tuple[Selection, CandidateModel]:
    """The selection of a part of the way, and the model to start from, fitted."""
    weights = make_weights(part.find_residuals(start), part)
    selection = Selection(
        part, candidates, evidence, make_folds(part), weights, kept=frozenset(start.ids), budget=budget
    )
    return selection, selection.adapt(selection.enter(start))
