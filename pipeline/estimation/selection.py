"""Runs made ready for a search, and selection among models of one part: fits, losses and evidence."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import cast

from pipeline.core import SlipError
from pipeline.core.arrays import Floats
from pipeline.core.compute import Budget
from pipeline.estimation.acceptance import HALVES, LEAST_T, Improvement, compare, is_nameable
from pipeline.estimation.comparison import Input
from pipeline.estimation.evidence import Evidence, Hypothesis, Noise
from pipeline.estimation.fit import PartFit, fit_part, try_part
from pipeline.estimation.folds import Fold, hold_out_part, make_folds
from pipeline.estimation.parts import Part, make_weights
from pipeline.estimation.problem import Problem
from pipeline.estimation.proposals import Candidate
from pipeline.estimation.state import State, Weights
from pipeline.models.catalogue import list_effects
from pipeline.models.effect import Effect, Place
from pipeline.models.parameter import Conditions, Largest, is_of_one_run
from pipeline.run import MotionError, MotionRun
from pipeline.run.signals import GROUND_UNOBSERVABLE
from pipeline.sources import Vehicle


class DiagnosisError(SlipError):
    """A diagnosis that cannot be made, in one line."""


_FEWEST_WINDOWS = 60
"""Half seconds of driving with poses that a diagnosis needs: a quarter of a minute, windows overlapping."""
_DRIVETRAIN = frozenset({Place.COMMAND, Place.DRIVE})


@dataclass(frozen=True)
class Context:
    """Runs of one vehicle, ready to be asked.

    Attributes:
        problem: the runs on the leading input.
    """

    problem: Problem

    @property
    def runs(self) -> tuple[MotionRun, ...]:
        """The recordings."""
        return self.problem.runs

    @property
    def vehicle(self) -> Vehicle:
        """Geometry."""
        return self.problem.vehicle

    @property
    def largest(self) -> Largest:
        """What relative starts are shares of."""
        return self.problem.largest

    @property
    def has_encoders(self) -> bool:
        """Whether every run has measured wheels."""
        return all(run.wheels is not None for run in self.runs)

    @property
    def is_drive_alone(self) -> bool:
        """Whether the poses are the motion of the wheels, so that only the drivetrain is observable."""
        return any(run.is_drive_alone for run in self.runs)

    @property
    def has_gyro(self) -> bool:
        """Whether every run has a good gyro as heading and clock."""
        return all(comparison.has_gyro for comparison in self.problem.comparisons)

    @cached_property
    def conditions(self) -> Conditions:
        """What the runs can show; every search looks at measured wheels where there are any."""
        encoders = self.has_encoders or self.is_drive_alone
        sampling = self.sampling_s if encoders else 0.0
        exceeded = self.problem.exceeded
        slope = max(comparison.context.slope_rad for comparison in self.problem.comparisons)
        return Conditions(self.largest, encoders, self.has_gyro, sampling, exceeded, slope)

    @property
    def sampling_s(self) -> float:
        """Delay that sampled encoders may feign: a little more than half their period."""
        return 0.6 * max(run.wheel_period_s for run in self.runs)

    def list_candidates(self, source: Input) -> tuple[Candidate, ...]:
        """Effects that can be identified from an input of this vehicle."""
        if self.is_drive_alone:
            return self.list_drivetrain()
        hidden = _DRIVETRAIN if source is Input.MEASURED else frozenset()
        return tuple(
            cast("Candidate", effect)
            for effect in list_effects()
            if self.vehicle.kind in effect.kinds
            and effect.place not in hidden
            and not effect.parts
            and effect().can_show(self.conditions)
        )

    def list_drivetrain(self) -> tuple[Candidate, ...]:
        """Effects between command and wheels."""
        return tuple(
            cast("Candidate", effect)
            for effect in list_effects()
            if self.vehicle.kind in effect.kinds
            and effect.place in _DRIVETRAIN
            and effect().can_show(self.conditions)
        )


def prepare(runs: Sequence[MotionRun], vehicle: Vehicle, source: Input) -> Context:
    """Make runs ready.

    Raises:
        DiagnosisError: ``no_input``; ``too_short``, fewer than a quarter of a minute of driving can be
            compared.
    """
    where = ", ".join(run.name for run in runs)
    try:
        problem = Problem(runs, vehicle, source)
    except MotionError as error:
        if error.code != f"no_{source.value}":
            raise
        other = Input.MEASURED if source is Input.COMMAND else Input.COMMAND
        what = f"there is no {'command' if source is Input.COMMAND else 'measured wheel'} to diagnose from"
        raise DiagnosisError("no_input", what, where=where, hint=f"Try --input {other.value}.") from error
    _require_alike(runs)
    windows = problem.whole.run.size
    if windows < _FEWEST_WINDOWS:
        what = f"only {windows} stretches of half a second have both a live input and valid poses"
        hint = f"{_FEWEST_WINDOWS} are needed: drive longer, or check the poses with `slip inspect`."
        raise DiagnosisError("too_short", what, where=where, hint=hint)
    return Context(problem)


def _require_alike(runs: Sequence[MotionRun]) -> None:
    """Refuse to judge runs with poses and runs without together.

    Raises:
        DiagnosisError: ``ground_unobservable``.
    """
    alone = [run.name for run in runs if run.is_drive_alone]
    if alone and len(alone) < len(runs):
        what = (
            "the log holds no pose, so that only its drivetrain is observable; others of these logs hold one"
        )
        hint = "Diagnose it without the others."
        raise DiagnosisError(GROUND_UNOBSERVABLE, what, where=", ".join(alone), hint=hint)


PRICE = 0.5 * LEAST_T**2
"""Chi-square of a parameter required to compete with a model that has one less: half of what is asked."""
_BATCH = 4
"""Extensions that are fitted at once; more only where less than these may be named."""
_COMPARABLE = 0.5
"""Extensions are fitted that promise at least this share of what the best one does."""
_BETTER = 0.005
"""Share of the sum of both losses by which a model with no more numbers must be better to take another's
place, see `Selection.sum_losses`."""
USEFUL = 1.1
"""Loss of a rival over that of the model above which it is not fitted to the end: exchanges that are accepted
on the recordings have 0.9 at most."""
_PAIRS = 2
"""Pairs that are fitted: the most promising ones."""


@dataclass(frozen=True)
class CandidateModel:
    """A fitted model.

    Attributes:
        part: that it is fitted to.
        fit: the model.
        folds: held-out blocks.
        is_rough: whether only some steps of its fit were taken, see `Selection.approach_each`.
    """

    part: Part = field(repr=False)
    fit: PartFit
    folds: tuple[Fold, ...]
    is_rough: bool = False

    @cached_property
    def restarted(self) -> Floats:
        """Residuals where states begin anew, from what was measured, at each prediction, shape (n, 3)."""
        return self.part.restarted.find_residuals(self.state)

    @cached_property
    def held(self) -> Floats:
        """Residuals under parameters fitted elsewhere, shape (n, 3)."""
        return hold_out_part(self.fit, self.folds)

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


@dataclass(frozen=True)
class Rivals:
    """Models in the place of some effects of a model.

    Attributes:
        weights: under which they were fitted.
        models: those with fewer numbers first, then by loss.
    """

    weights: Weights
    models: list[CandidateModel]


@dataclass
class Selection:
    """Selection among models of one part of the path.

    Attributes:
        part: what is explained.
        candidates: effects that may be named.
        conditions: what the runs can show.
        folds: held-out blocks.
        weights: cost of residuals at the current model.
        given: effects that are never dropped: those of the model to start from.
        budget: how long the search may take.
        noise: of the residuals, as the newest evidence has it.
        rivals: models in the place of effects of a model, by the ids of all its effects and of these.
        shapes: of how many shapes a candidate was the best one before it entered, by id.
        as_if: ids of effects that may have values beyond the observed range.
    """

    part: Part
    candidates: tuple[Candidate, ...]
    conditions: Conditions
    folds: tuple[Fold, ...]
    weights: Weights
    given: frozenset[str] = frozenset()
    budget: Budget = field(default_factory=Budget)
    noise: Noise | None = None
    rivals: dict[tuple[tuple[str, ...], ...], Rivals] = field(default_factory=dict)
    shapes: Mapping[str, int] = field(default_factory=dict)
    as_if: set[str] = field(default_factory=set)
    _dropped: dict[tuple[str, ...], CandidateModel] = field(default_factory=dict)

    @property
    def largest(self) -> Largest:
        """What was asked for."""
        return self.conditions.largest

    def enter(self, start: State | PartFit) -> CandidateModel:
        """Fit a state, or a fit further."""
        return self.enter_each([start])[0]

    def enter_each(self, starts: Sequence[State | PartFit], useful: float = math.inf) -> list[CandidateModel]:
        """Fit states, those to the end that may reach a loss that makes them useful."""
        fitted = [fit_part(self.part, self.weights, start, useful=useful) for start in starts]
        return [CandidateModel(self.part, fit, self.folds) for fit in fitted]

    def approach_each(
        self, base: CandidateModel, states: Sequence[State], useful: float
    ) -> list[CandidateModel]:
        """Fit states that differ little from a model, and only the useful ones to the end.

        A new parameter that needs a grid, which a rough fit does not search, is always fitted to the end.

        Args:
            base: the model, whose derivatives are used for the first steps.
            states: it with other effects or values.
            useful: loss that makes a state useful.
        """
        tried = [try_part(self.part, self.weights, state, base=base.fit) for state in states]
        models = [CandidateModel(self.part, fit, self.folds, is_rough=True) for fit in tried]
        grids = len(base.fit.free) - len(base.fit.smooth)
        near = [
            index
            for index, fit in enumerate(tried)
            if fit.loss <= useful or len(fit.free) - len(fit.smooth) > grids
        ]
        fitted = self.enter_each([tried[index].state for index in near], useful)
        for index, model in zip(near, fitted, strict=True):
            models[index] = model
        return models

    def drop(self, current: CandidateModel, names: Iterable[str]) -> CandidateModel:
        """A model without some of its effects, fitted anew."""
        return self.drop_each(current, [names])[0]

    def drop_each(self, current: CandidateModel, groups: Iterable[Iterable[str]]) -> list[CandidateModel]:
        """A model without each group of its effects, fitted anew."""
        states = [current.state.drop(names) for names in groups]
        new = [state for state in states if state.ids not in self._dropped]
        self._dropped.update(zip((state.ids for state in new), self.enter_each(new), strict=True))
        return [self._dropped[state.ids] for state in states]

    def loss(self, model: CandidateModel) -> float:
        """Mean cost of a model's residuals."""
        return self.weights.loss(model.fit.residual)

    def is_better(self, model: CandidateModel, best: CandidateModel) -> bool:
        """Whether a model with no more numbers has a smaller sum of losses, and not a much larger first one.

        Several lags and limits in series can follow the wheels of a whole recording as well as the speed loop
        that drives them, and yet predict badly: nobody knows their states where a prediction begins.
        """
        if self.loss(model) > USEFUL * self.loss(best):
            return False
        return self.compare_losses(model, best) < 1.0 - _BETTER

    def compare_losses(self, model: CandidateModel, best: CandidateModel) -> float:
        """Sum of a model's losses over another's, by the weights of either: these forgive their own model."""
        weights = [make_weights(one.fit.residual, self.part) for one in (model, best)]
        return math.sqrt(math.prod(_sum_losses(one, model) / _sum_losses(one, best) for one in weights))

    def sum_losses(self, model: CandidateModel) -> float:
        """Mean cost of residuals, plus that where states begin anew with each prediction over 2 s."""
        return _sum_losses(self.weights, model)

    def judge(self, before: CandidateModel, after: CandidateModel) -> Improvement:
        """How much better ``after``, which has more numbers, is."""
        noise = self.noise or self.take_evidence(before).noise
        return compare(
            noise, self.weights, before.fit.residual, after.fit.residual,
            numbers=after.numbers - before.numbers,
            shapes=math.prod(self.shapes.get(name, 1) for name in set(after.ids) - set(before.ids)),
            restarted=(before.restarted, after.restarted),
        )  # fmt: skip

    def take_weights(self, weights: Weights) -> None:
        """Judge by other weights; models fitted without some effects under the present ones are forgotten."""
        self.weights = weights
        self._dropped.clear()

    def reweight(self, model: CandidateModel) -> CandidateModel:
        """Take the weights from a model's own residuals, and fit it anew."""
        self.take_weights(make_weights(model.fit.residual, self.part))
        self.budget.report(self.part.title, model.ids)
        return self.enter(model.fit)

    def list_acting(self, ids: Collection[str]) -> list[Candidate]:
        """Candidates that act in a model of these effects."""
        return [one for one in self.candidates if one().acts_in(ids)]

    def take_evidence(
        self, base: CandidateModel, without: Iterable[str] = (), noise: Noise | None = None
    ) -> Evidence:
        """Evidence for what could be added to a model, some effects left out; under a noise that is known.

        Special cases of an effect of the model are left out, and other forms of some of them: beside it they
        share its work at random.
        """
        cases = [{*effect.contains} for effect in base.state.effects]
        forms = (one.id for one in self.candidates if any(set() < {*one().contains} < own for own in cases))
        excluded = {*without, *forms}.union(*cases)
        candidates = [one for one in self.list_acting(base.ids) if one.id not in excluded]
        return Evidence(self.part, base.fit, candidates, self.largest, noise)

    def fit_hypotheses(
        self,
        base: CandidateModel,
        evidence: Evidence,
        least: float = 0.0,
        useful: float = math.inf,
        beyond: list[CandidateModel] | None = None,
    ) -> list[CandidateModel]:
        """The most promising extensions of a model by one effect or by two, fitted.

        Args:
            base: the model.
            evidence: taken at it.
            least: chi-square that an extension must promise.
            useful: loss above which an extension need not be fitted to the end.
            beyond: takes the extensions by an effect with values beyond the observed range.

        Returns:
            Models of which every effect may be named, those with fewer numbers first, then by loss.
        """
        singles = [one for one in evidence.rank_singles(PRICE) if one.chi_square >= least]
        models, best = dict[tuple[str, ...], CandidateModel](), 0.0
        while singles and not best and singles[0].chi_square > PRICE * singles[0].numbers:
            enough = _COMPARABLE * singles[0].chi_square
            batch = [one for one in singles[:_BATCH] if one.chi_square >= enough]
            singles = singles[len(batch) :]
            for hypothesis, model in zip(batch, self._fit_each(base, batch, useful, beyond), strict=True):
                if self._keep(model, base, models) and self.judge(base, model).is_significant:
                    best = max(best, hypothesis.chi_square - PRICE * hypothesis.numbers)
        together = [one for one in evidence.rank_pairs(PRICE) if one.chi_square >= max(least, best + PRICE)]
        for model in self._fit_each(base, together[:_PAIRS], useful):
            self._keep(model, base, models)
        return self.sort(models.values())

    def sort(self, models: Iterable[CandidateModel]) -> list[CandidateModel]:
        """Models with fewer numbers first, then by loss."""
        return sorted(models, key=lambda one: (one.numbers, self.loss(one)))

    def admit(
        self, base: CandidateModel, models: list[CandidateModel], beyond: Iterable[CandidateModel]
    ) -> list[CandidateModel]:
        """Extensions with those beyond the observed range that halve the loss of all that are plausible."""
        least = HALVES * min(self.loss(one) for one in (base, *models))
        admitted = [one for one in beyond if self.loss(one) < least]
        self.as_if.update(name for one in admitted for name in one.ids if name not in base.ids)
        return self.sort([*models, *admitted])

    def _fit_each(
        self,
        base: CandidateModel,
        hypotheses: Iterable[Hypothesis],
        useful: float,
        beyond: list[CandidateModel] | None = None,
    ) -> list[CandidateModel]:
        """A model with each of some extensions, fitted; those beyond the observed range go there, too."""
        states = []
        for hypothesis in hypotheses:
            state = base.state
            for start in hypothesis.starts:
                state = start.add_to(state)
            states.append(state)
        is_rival = useful < math.inf
        fitted = self.approach_each(base, states, useful) if is_rival else self.enter_each(states)
        if beyond is not None:
            beyond += [model for model in fitted if self._is_beyond(model, base)]
        return [self._simplify(model, base, useful) for model in fitted]

    def _is_beyond(self, model: CandidateModel, base: CandidateModel) -> bool:
        """Whether all that keeps a model from being sound are values of new effects beyond their range."""
        new = set(model.ids) - set(base.ids)
        return not self.is_sound(model) and all(
            self.may_stay(effect, model.state, as_if=effect.id in new) for effect in model.state.effects
        )

    def _keep(
        self, model: CandidateModel, base: CandidateModel, models: dict[tuple[str, ...], CandidateModel]
    ) -> bool:
        """Add a model, of several with the same effects the better one; whether it may be named."""
        if set(model.ids) <= set(base.ids) or not self.is_sound(model):
            return False
        models[model.ids] = min(models.get(model.ids, model), model, key=self.loss)
        return True

    def _simplify(self, model: CandidateModel, base: CandidateModel, useful: float) -> CandidateModel:
        """An extension without effects that a new one makes superfluous, or with their simpler forms.

        Lags together imitate a delay, a slow steering a limit: put in beside their imitation they leave it
        at nothing. Where nothing new would be left the extension stays as it is, and is not named.
        """
        reduced = self.reduce(model.state)
        if reduced is None or set(reduced.ids) <= set(base.ids):
            return model
        return self.enter_each([reduced], useful)[0]

    def reduce(self, state: State) -> State | None:
        """The state with the simpler forms of effects that may not be named; None if all may be."""
        gone = [effect for effect in state.effects if not self.may_stay(effect, state)]
        reduced = state.drop([effect.id for effect in gone])
        known = {one.id for one in self.candidates} - set(reduced.ids)
        simpler = (effect.collapse() for effect in gone)
        return reduced.add(*(one for one in simpler if one and one.id in known)) if gone else None

    def is_sound(self, model: CandidateModel) -> bool:
        """Whether every effect is large enough to be named, and no degenerate form of another."""
        return all(self.may_stay(effect, model.state) for effect in model.state.effects)

    def may_stay(self, effect: Effect, state: State, *, as_if: bool = False) -> bool:
        """Whether an effect of a state is known, or may be named as it acts in one of the runs.

        Args:
            effect: of the state.
            state: the state.
            as_if: it may have values beyond the observed range, though it was not admitted with them.
        """
        if effect.id in self.given:
            return True
        if not effect.acts_in(state.ids):
            return False
        acting = state.list_as_it_acts(effect)
        if len(acting) > 1:
            # Of clocks that differ, the earliest is early against the latest, which no delay of a drive is.
            delays = [one.delay for one in acting]
            acting.append(effect.of_delay(min(delays) - max(delays)))
        as_if = as_if or effect.id in self.as_if
        return any(is_nameable(one, self.conditions, as_if=as_if) for one in acting)


def open_selection(
    part: Part, start: State, candidates: tuple[Candidate, ...], conditions: Conditions, budget: Budget
) -> tuple[Selection, CandidateModel]:
    """The selection of a part of the path, and the model to start from, fitted."""
    weights = make_weights(part.find_residuals(start), part)
    # What acts from a moment on is the best of as many moments as the recording has stretches.
    moments = len(set(part.unit.tolist()))
    shapes = {one.id: moments for one in candidates if is_of_one_run(one.parameters)}
    selection = Selection(
        part, candidates, conditions, make_folds(part), weights,
        given=frozenset(start.ids), budget=budget, shapes=shapes,
    )  # fmt: skip
    return selection, selection.reweight(selection.enter(start))


def _sum_losses(weights: Weights, model: CandidateModel) -> float:
    return weights.loss(model.fit.residual) + weights.loss(model.restarted)
