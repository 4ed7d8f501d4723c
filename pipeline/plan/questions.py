"""Questions of a diagnosis that a plan answers, and the information that each manoeuvre adds to them.

Two models are separated by the difference of their predictions that remains after a refit of the wrong model
to the motion of the right one, the logs so far included (T-optimality; Atkinson and Fedorov, Biometrika 62,
1975). A loss that falls by c weighted squares has a block t of sqrt(c) / 2 on average. The precision of a
parameter follows from its information (A-optimality). Both are sums over windows: manoeuvres that begin and
end at rest add up.
"""

import functools
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri, stdtrit

from pipeline.core import FEWEST_OF_SPREAD, NORMAL_95, STRETCH_S, Flags, Floats, Ints, suffix_unit
from pipeline.estimation import EstimationData, Free
from pipeline.estimation.driving_need import find_goal
from pipeline.models import (
    Effect,
    Excitation,
    FormulaEffect,
    Largest,
    explain_idle,
    find_effect,
    list_effects,
)
from pipeline.plan.manoeuvres import PlanError
from pipeline.plan.rehearsal import CLOCK_S, Hypothesis, Knowledge, Rehearsal, start_state
from pipeline.results import INTERVAL_SHARE

# The diagnosis decides between two candidates at t = 1.6. A t has a standard deviation of one, and nearly
# every drive of a plan must reach a decision.
DECIDED_T = 5.0
# Block length of the jackknife of intervals [s]: command steps are joined to at least six seconds.
_BLOCK_S = 7.0


@dataclass(frozen=True)
class Separation:
    """Which of two models is true.

    Attributes:
        text: the question.
        effects: ids of the effects concerned.
        models: the two models; each in turn is assumed true, and the other is refitted.
        both_ways: whether either may be true; otherwise only the first.
        now: block t of the logs so far in favour of the first.
        is_presence: whether the question is if an effect acts at all.
    """

    text: str
    effects: tuple[str, ...]
    models: tuple[Hypothesis, Hypothesis]
    both_ways: bool = True
    now: float = 0.0
    is_presence: bool = False


@dataclass(frozen=True)
class Precision:
    """Precision of one parameter of a model.

    Attributes:
        text: the question.
        effects: id of its effect.
        model: model with this parameter.
        number: row of the parameter in the model's information.
        goal: half-width of its 95 % interval to reach.
        now: half-width before the drive: that of the diagnosis, else by the model's information.
    """

    text: str
    effects: tuple[str, ...]
    model: Hypothesis
    number: int
    goal: float
    now: float


Question = Separation | Precision


@dataclass(frozen=True)
class Evidence:
    """Information of groups of windows on one model, in units of the noise.

    Attributes:
        normal: information on its parameters and the clock by group, shape (k, q, q).
        pull: product of derivatives and difference from the true model, shape (k, q); zero for the true one.
        power: squared difference from the true model, shape (k,).
        prior: information of the logs so far, shape (q, q).
    """

    normal: Floats
    pull: Floats
    power: Floats
    prior: Floats

    def separate(self, weight: Floats) -> Floats:
        """Squared difference that remains in each group after a refit, shape (..., k).

        Args:
            weight: how often each group is driven, shape (..., k).
        """
        pull = weight @ self.pull
        step = np.linalg.solve(self._add_up(weight), pull[..., None])
        curved = (step * step.swapaxes(-1, -2)).reshape(*pull.shape[:-1], -1)
        remaining = (
            self.power
            - 2.0 * step[..., 0] @ self.pull.T
            + curved @ self.normal.reshape(len(self.power), -1).T
        )
        return np.maximum(np.asarray(remaining, dtype=np.float64), 0.0)

    def spread(self, weight: Floats, number: int) -> Floats:
        """Standard error of one parameter of the model, shape (...)."""
        return np.asarray(np.sqrt(np.linalg.inv(self._add_up(weight))[..., number, number]))

    def _add_up(self, weight: Floats) -> Floats:
        """Information on the model's parameters, shape (..., q, q)."""
        return np.asarray(self.prior + np.tensordot(weight, self.normal, 1))


@dataclass(frozen=True)
class Groups:
    """Groups of windows, each driven as a whole or not at all.

    Attributes:
        seconds: duration of each [s], shape (k,).
        stretch: number of each group's stretch of driving, ascending from 0, shape (k,); a block t needs
            several stretches.
        before_s: duration of the logs so far [s].
        excited: by kind of excitation, what of it each group contains, shape (k, parts).
    """

    seconds: Floats
    stretch: Ints
    before_s: float = 0.0
    excited: Mapping[Excitation, Flags] = field(default_factory=dict)


@dataclass(frozen=True)
class Answerable:
    """A question with the information of groups of windows on it."""

    question: Question
    evidence: tuple[Evidence, ...] = field(repr=False)
    groups: Groups = field(repr=False)

    def measure(self, weight: Floats) -> Floats:
        """Expected block t of a separation, or half-width of a parameter's 95 % interval, shape (...).

        Args:
            weight: how often each group is driven, shape (..., k).
        """
        if isinstance(self.question, Separation):
            powers = [np.sum(weight * one.separate(weight), axis=-1) for one in self.evidence]
            return np.asarray(0.5 * np.sqrt(np.min(powers, axis=0) + self._known))
        return np.asarray(self._inflation * self._find_width(weight, self.question.number))

    def _find_width(self, weight: Floats, number: int) -> Floats:
        """Half-width by the information on a parameter; Student's t of the estimate from the blocks."""
        wide = stdtrit(self._count_freedom(weight), 0.975)
        return np.asarray(wide * self.evidence[0].spread(weight, number))

    @functools.cached_property
    def _inflation(self) -> float:
        """Half-width that the logs so far left, relative to that of their information.

        At least one: a jackknife of few blocks may state a narrow interval by chance.
        """
        if isinstance(self.question, Separation) or not self.groups.before_s:
            return 1.0
        nothing = np.zeros(self.groups.seconds.size)
        return max(self.question.now / float(self._find_width(nothing, self.question.number)), 1.0)

    @functools.cached_property
    def _known(self) -> float:
        """What the logs so far say: squared difference of a separation, information on a parameter."""
        if isinstance(self.question, Separation):
            return (2.0 * self.question.now) ** 2
        number = self.question.number
        return float(self.evidence[0].prior[number, number]) if self.groups.before_s else 0.0

    def bound(self, weight: Floats) -> Floats:
        """Half-width that the jackknife does not exceed in 95 of 100 drives: with few blocks it scatters."""
        freedom = self._count_freedom(weight)
        return np.asarray(self.measure(weight) * np.sqrt(chdtri(freedom, 0.05) / freedom))

    def answer(self, weight: Floats, reserve: float = 1.0) -> Floats:
        """Fraction of the goal that is reached, one if the question is answered, shape (...).

        Args:
            weight: how often each group is driven, shape (..., k).
            reserve: factor on the required t, the number of stretches and the interval's narrowness.
        """
        if isinstance(self.question, Precision):
            shown = self.evidence[0].normal[:, self.question.number, self.question.number]
            share = (self.question.goal / reserve / self.bound(weight)) ** 2
            return np.minimum(share, 1.0) * self._spread_out(weight, shown, reserve) * self._cover(weight)
        shares = []
        for one in self.evidence:
            remaining = one.separate(weight)
            power = np.sum(weight * remaining, axis=-1) + self._known
            decided = 0.25 * power / (reserve * DECIDED_T) ** 2
            shares.append(np.minimum(decided, 1.0) * self._spread_out(weight, remaining, reserve))
        return np.asarray(np.min(shares, axis=0)) * self._cover(weight)

    def _list_needed(self) -> list[tuple[Excitation, Floats]]:
        if not self.groups.excited:
            return []
        needs = {need for one in list_concerned(self.question) for need in one.needs}
        return [(need, parts.astype(float)) for need, parts in self.groups.excited.items() if need in needs]

    def _cover(self, weight: Floats) -> Floats:
        """Share of the excitation that the question's effects declare to need, shape (...)."""
        parts = [known for _, known in self._list_needed()]
        if not parts:
            return np.ones(weight.shape[:-1])
        return np.asarray((weight @ np.hstack(parts) > 0.0).mean(axis=-1))

    def _spread_out(self, weight: Floats, shown: Floats, reserve: float) -> Floats:
        """Fraction of the required stretches, from each group's contribution, shape (..., k)."""
        # A group that is driven twice counts as two stretches.
        first, again = np.minimum(weight, 1.0) * shown, np.maximum(weight - 1.0, 0.0)
        starts = np.flatnonzero(np.diff(self.groups.stretch, prepend=-1))
        sums = np.add.reduceat(first, starts, axis=-1)
        earlier, known = self.groups.before_s / STRETCH_S, self._known
        power = np.sum(sums**2, axis=-1) + np.sum(again * shown**2, axis=-1)
        power += known**2 / earlier if earlier else 0.0
        whole = (np.sum(weight * shown, axis=-1) + known) ** 2
        driven = weight @ self.groups.seconds / STRETCH_S + (earlier if known else 0.0)
        stretches = np.minimum(whole / np.where(power > 0.0, power, np.inf), driven)
        return np.asarray(np.minimum(stretches / (reserve * FEWEST_OF_SPREAD), 1.0))

    def _count_freedom(self, weight: Floats) -> Floats:
        """Blocks of the jackknife less one: those that carry the information of logs so far and of the drive.

        A drive that tells nothing of a parameter adds no block.
        """
        shown, known = self.groups.seconds, self.groups.before_s
        if isinstance(self.question, Precision):
            number = self.question.number
            shown = np.diagonal(self.evidence[0].normal, axis1=1, axis2=2)[:, number]
            known = self._known
        earlier = self.groups.before_s / _BLOCK_S
        power = weight @ shown**2 + (known**2 / earlier if earlier else 0.0)
        blocks = (weight @ shown + known) ** 2 / np.where(power > 0.0, power, np.inf)
        driven = weight @ self.groups.seconds / _BLOCK_S + earlier
        return np.asarray(np.maximum(np.minimum(blocks, driven) - 1.0, 1.0))


def list_concerned(question: Question) -> list[Effect]:
    """The effects of a question, as its models have them."""
    models = question.models if isinstance(question, Separation) else (question.model,)
    known = {one.id: one for model in models for one in model.effects}
    return [known[name] for name in question.effects]


class Judge:
    """Information of rehearsed commands on hypotheses.

    Args:
        rehearsal: the commands.
        knowledge: the noise, and the model whose poses and headings replace the measured ones.
        edges: times [s] between which windows belong to one group, shape (k + 1,).
        stretches: whether groups follow each other, so that one stretch of driving contains several;
            otherwise each is driven separately.
    """

    def __init__(
        self, rehearsal: Rehearsal, knowledge: Knowledge, edges: Floats, *, stretches: bool = False
    ) -> None:
        self.data: EstimationData = rehearsal.prepare(knowledge.base.effects)
        self.noise = knowledge.noise
        self.size = edges.size - 1
        stretch = edges[:-1] // STRETCH_S if stretches else np.arange(self.size)
        excited = rehearsal.find_excitation(edges)
        self.groups = Groups(np.diff(edges), stretch.astype(np.int64), knowledge.driven_s, excited)
        self._group = [
            np.clip(np.searchsorted(edges, path.times[:, 1], side="left") - 1, 0, self.size - 1)
            for path in self.data.paths
        ]
        self._known: dict[Hypothesis, tuple[list[Floats], tuple[Free, ...], list[Floats]]] = {}

    def judge(self, questions: Sequence[Question]) -> list[Answerable]:
        """Every question with the information of every group."""
        return [Answerable(question, self._collect(question), self.groups) for question in questions]

    def _collect(self, question: Question) -> tuple[Evidence, ...]:
        if isinstance(question, Precision):
            return (self._weigh(question.model, question.model),)
        one, other = question.models
        first = self._weigh(other, one)
        return (first, self._weigh(one, other)) if question.both_ways else (first,)

    def _weigh(self, model: Hypothesis, truth: Hypothesis) -> Evidence:
        """Information of the windows on a model while another one is true."""
        predicted, free, jacobians = self._look(model)
        true = self._look(truth)[0]
        size = len(free)
        normal, pull = np.zeros((self.size, size, size)), np.zeros((self.size, size))
        power = np.zeros(self.size)
        for rest, own, columns, group, noise in zip(
            true, predicted, jacobians, self._group, self.noise, strict=True
        ):
            # Residuals are measured less predicted: their difference is that of the predictions.
            apart = (own - rest) / noise
            rows = columns / noise[:, None]
            np.add.at(power, group, (apart**2).sum(axis=1))
            np.add.at(pull, group, np.einsum("ncp,nc->np", rows, apart))
            np.add.at(normal, group, np.einsum("ncp,ncq->npq", rows, rows))
        prior = np.zeros((size, size))
        known = len(model.free)
        prior[:known, :known] = model.information
        prior[known:, known:] = np.eye(size - known) / CLOCK_S**2
        return Evidence(normal, pull, power, prior)

    def _look(self, model: Hypothesis) -> tuple[list[Floats], tuple[Free, ...], list[Floats]]:
        """Residuals by part, free parameters with the clocks, and derivatives by part."""
        if model not in self._known:
            state = start_state(model.effects)
            delays = {name: None for path in self.data.paths for name in path.delays}
            free = state.list_free(tuple(delays))
            clocks = tuple(number for number in free if not number.effect)
            numbers = (*model.free, *clocks)
            residuals = [path.find_residuals(state) for path in self.data.paths]
            jacobians = []
            for path, residual in zip(self.data.paths, residuals, strict=True):
                columns = np.zeros((*residual.shape, len(numbers)))
                mine = [
                    index
                    for index, number in enumerate(numbers)
                    if (
                        any(e.id == number.effect and path.owns(e) for e in model.effects)
                        if number.effect
                        else number.name in path.delays
                    )
                ]
                columns[:, :, mine] = path.differentiate(state, residual, [numbers[i] for i in mine])
                jacobians.append(columns)
            self._known[model] = (residuals, numbers, jacobians)
        return self._known[model]


def ask_undecided(knowledge: Knowledge, groups: Iterable[Sequence[str]]) -> list[Separation]:
    """Which candidate of each group acts: the first against every other, each fitted to the logs."""
    questions = []
    for group in groups:
        rest = [effect for effect in knowledge.base.effects if effect.id not in group]
        first, *others = [knowledge.suppose([*rest, find_effect(name)()]) for name in group]
        questions += [
            Separation(f"{group[0]} or {name}", (group[0], name), (first, other))
            for name, other in zip(group[1:], others, strict=True)
        ]
    return questions


def ask_apart(knowledge: Knowledge, settled: Container[str] = ()) -> list[Separation]:
    """Whether an identified effect, or several, may be one other effect that resembles them.

    Only alternatives that the logs so far do not exclude are asked about.

    Args:
        knowledge: what is known before the drive.
        settled: ids of effects that other questions cover.
    """
    base = knowledge.base
    named = [effect for effect in base.effects if effect.id not in settled]
    if knowledge.fitted is None:
        return []
    swaps: dict[tuple[tuple[str, ...], str], None] = {}
    for effect in named:
        for name in effect.confused_with:
            alike = tuple(one.id for one in named if name in one.confused_with)
            swaps |= dict.fromkeys([((effect.id,), name), (alike, name)])
    questions = []
    for dropped, name in swaps:
        other = find_effect(name)()
        if knowledge.vehicle.kind not in other.kinds or set(dropped) & {name, *other.contains}:
            continue
        rest = [effect for effect in base.effects if effect.id not in {*dropped, name}]
        rival, apart = knowledge.rival([*rest, other])
        if apart < DECIDED_T:
            text = f"{' and '.join(dropped)} or {name}"
            questions.append(Separation(text, (*dropped, name), (base, rival), both_ways=False, now=apart))
    return questions


def ask_numbers(model: Hypothesis, stated: Mapping[str, float]) -> list[Precision]:
    """Precision of each parameter of a model that is not yet known as well as `find_goal` asks.

    Args:
        model: the model.
        stated: half-widths of 95 % intervals by label ``effect.name``, where the diagnosis states one.
    """
    spread = np.sqrt(np.diag(np.linalg.inv(model.information))) if model.free else np.zeros(0)
    formulas = {effect.id for effect in model.effects if isinstance(effect, FormulaEffect)}
    questions = []
    for index, number in enumerate(model.free):
        value = float(model.values[index])
        # A formula has no usual size.
        goal = INTERVAL_SHARE * abs(value)
        if number.effect not in formulas:
            goal = find_goal(number.effect, number.name, value)
        now = stated.get(number.label, NORMAL_95 * float(spread[index]))
        if now > goal:
            text = f"{number.label} within {goal:.2g}{suffix_unit(number.unit)}"
            questions.append(Precision(text, (number.effect,), model, index, goal, now))
    return questions


def ask_presence(knowledge: Knowledge, names: Iterable[str], largest: Largest) -> list[Separation]:
    """Whether effects act that the logs could not show: each at its usual size, against its absence.

    Raises:
        PlanError: ``wrong_vehicle``, one does not exist on this kind of vehicle; ``acts_beside``, one acts
            only beside an effect that the model lacks.
        MotionError: ``unknown_effect``.
    """
    questions = []
    for name in names:
        effect = find_effect(name)
        if knowledge.vehicle.kind not in effect.kinds:
            what = f"{name} exists on {' or '.join(effect.kinds)} vehicles only"
            raise PlanError("wrong_vehicle", what, where=knowledge.vehicle.id, hint="Choose another effect.")
        if name in knowledge.base.names:
            continue
        if why := explain_idle(effect, knowledge.base.names):
            what = f"{name} {why}, which the model does not contain"
            hint = "Choose another effect, or record logs that identify that one first."
            raise PlanError("acts_beside", what, where=knowledge.vehicle.id, hint=hint)
        with_it = knowledge.base.extend(effect().make_usual(largest))
        models = with_it, knowledge.base
        questions.append(
            Separation(f"whether {name} acts", (name,), models, both_ways=False, is_presence=True)
        )
    return questions


def list_names(knowledge: Knowledge) -> tuple[str, ...]:
    """Every effect of the catalogue that exists on the vehicle, and acts in its model."""
    here = [effect for effect in list_effects() if knowledge.vehicle.kind in effect.kinds]
    return tuple(effect.id for effect in here if effect.acts_in(knowledge.base.names))
