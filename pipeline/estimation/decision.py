"""The one decision: which effects a model lacks.

A search adds the effects that the data ask for until none is accepted; what `judge` decides is not changed
by anything after it. Models are compared by their likelihood less `PRICE` for each number. Of models within
`EQUAL` of the best the one with fewest numbers is taken, and the others are reported as undecided.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import FOLDS
from pipeline.core.compute import Budget
from pipeline.estimation.candidates import PRICE, Candidate, Extension, Screen
from pipeline.estimation.fit import PartFit, fit_part, hold_out
from pipeline.estimation.noise import huber_cost
from pipeline.estimation.parts import HORIZONS_S
from pipeline.estimation.plausibility import is_nameable

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from pipeline.core.arrays import Floats, Ints
    from pipeline.estimation.noise import Noise
    from pipeline.estimation.parts import HorizonError, Part
    from pipeline.estimation.state import State
    from pipeline.models.effect import Effect
    from pipeline.models.parameter import Conditions

LEAST_T = 5.0
"""Standard errors that an effect must be from none: the largest t of some 30 candidates on logs without any
effect stays below."""
STABLE_T = 0.5 * LEAST_T
"""The same without the ten seconds that contribute most: one event is not enough."""
EQUAL = 12.0
"""Difference of two models' scores below which the data do not decide between them."""
SHOWN = 0.05
"""Share by which an effect must lower a held-out error over one of `HORIZONS_S`."""
_RISEN = 2.0
"""Standard errors by which no held-out error may rise."""
_NO_CHANGE = 0.01
"""Relative rise of an error that does not matter."""
_MOST_EFFECTS = 8
"""Most effects that a search adds on one path: a longer list explains nothing."""
_SINGLES, _PAIRS = 4, 3
"""Extensions by one effect and by two that are fitted in each round."""
_DRAWS = 400
"""Resamples of blocks: a frequency near 0.95 has a standard error of 0.01."""
_FEWEST_RUNS = 3
"""Runs from which on whole runs are held out in place of blocks."""


@dataclass(frozen=True)
class Judged:
    """An extension of a model, fitted and judged.

    Attributes:
        fit: the larger model.
        added: ids of its new effects.
        refusal: why it is not accepted; empty where it is.
        gain: share of the smaller model's held-out cost that it removes.
        frequency: share of resampled recordings in which it removes some of it.
        evidence: fall of the cost in each stretch of ten seconds, shape (b,).
        falls: relative fall of each held-out error, position and heading over each of `HORIZONS_S`, shape
            (4, 2), NaN where nothing is predicted so far.
    """

    fit: PartFit
    added: tuple[str, ...]
    refusal: str
    gain: float = math.nan
    frequency: float = math.nan
    evidence: Floats = field(default_factory=lambda: np.zeros(0))
    falls: Floats = field(default_factory=lambda: np.full((len(HORIZONS_S), 2), math.nan))

    @property
    def cost(self) -> float:
        """Score with the price of its numbers: smaller is better."""
        return find_cost(self.fit)


def find_cost(fit: PartFit) -> float:
    """Minus twice the log-likelihood of a fit, with the price of its numbers."""
    return fit.score + PRICE * fit.numbers


@dataclass(frozen=True)
class Rival:
    """A model with other effects in the place of one that was chosen.

    Attributes:
        effect: id of the chosen effect.
        judged: the other model, judged against the one without that effect.
        behind: its cost less that of the chosen model.
    """

    effect: str
    judged: Judged
    behind: float


@dataclass(frozen=True)
class Found:
    """The result of a search on one part of the path.

    Attributes:
        start: the model to start from, fitted.
        final: the model that no extension improves, fitted.
        judged: how each of its effects was judged against the model without it, by id.
        rivals: models that the data do not separate from it.
        refused: extensions of it that were not accepted.
        screen: what candidates explain of its residuals.
    """

    start: PartFit
    final: PartFit
    judged: dict[str, Judged]
    rivals: tuple[Rival, ...]
    refused: tuple[Judged, ...]
    screen: Screen

    @property
    def new(self) -> tuple[str, ...]:
        """Ids of the effects that were added."""
        return tuple(name for name in self.final.ids if name not in self.start.ids)


@dataclass
class Search:
    """A search on one part of the path.

    Attributes:
        part: the part.
        candidates: effects that may be named.
        conditions: what the runs can show.
        given: ids of effects that stay.
        budget: of CPU time.
        shapes: of how many shapes each candidate is the best one: the evidence for it is reduced accordingly.
    """

    part: Part
    candidates: tuple[Candidate, ...]
    conditions: Conditions
    given: frozenset[str] = frozenset()
    budget: Budget = field(default_factory=Budget)
    shapes: int = 1
    _fits: dict[tuple[object, ...], PartFit] = field(default_factory=dict)

    def run(self, start: State) -> Found:
        """Search from a model."""
        first = current = self._fit(start)
        seen, refused = {current.ids}, list[Judged]()
        while not self.budget.is_spent():
            self.budget.report(self.part.title, current.ids)
            judged, refused = self._extend(current)
            chosen = _choose(judged)
            better = self._exchange(current) if chosen is None else self._prune(chosen.fit)
            if better is None or better.ids in seen:
                break
            seen.add(better.ids)
            current = better
        return self._conclude(first, current, refused)

    def _conclude(self, first: PartFit, current: PartFit, refused: Iterable[Judged]) -> Found:
        judged, rivals = dict[str, Judged](), list[Rival]()
        for name in (name for name in current.ids if name not in self.given):
            without = self._drop(current, [name])
            judged[name] = self._judge(without, current)
            for other in self._list_rivals(current, without, [name]):
                behind = other.cost - find_cost(current)
                if behind < EQUAL and not set(other.added) & set(current.ids):
                    rivals.append(Rival(name, other, behind))
        return Found(first, current, judged, tuple(rivals), tuple(refused), self._screen(current))

    @property
    def _least_t(self) -> float:
        return math.sqrt(LEAST_T**2 + 2.0 * math.log(self.shapes))

    def _judge(self, base: PartFit, fit: PartFit) -> Judged:
        return judge(base, fit, self.conditions, self._least_t)

    def _fit(self, state: State, noise: Noise | None = None) -> PartFit:
        key = (*(effect.key for effect in state.effects), repr(state.own))
        if key not in self._fits:
            self._fits[key] = fit_part(self.part, state, noise=noise)
        return self._fits[key]

    def _drop(self, fit: PartFit, names: Collection[str]) -> PartFit:
        return self._fit(fit.state.drop(names))

    def _screen(self, fit: PartFit, without: Collection[str] = ()) -> Screen:
        """What could be added to a model; special cases of its effects are in it already."""
        known = set(without).union(*({*effect.contains} for effect in fit.state.effects))
        acting = [one for one in self.candidates if one.id not in known and one().acts_in(fit.ids)]
        return Screen(fit, acting, self.conditions.largest)

    def _extend(self, current: PartFit) -> tuple[list[Judged], list[Judged]]:
        """Accepted and refused extensions of a model."""
        if len(current.ids) - len(self.given) >= _MOST_EFFECTS:
            return [], []
        judged = self._judge_extensions(current, self._screen(current), _SINGLES, _PAIRS)
        return [one for one in judged if not one.refusal], [one for one in judged if one.refusal]

    def _judge_extensions(
        self, base: PartFit, screen: Screen, singles: int, pairs: int, wanted: float = 0.0
    ) -> list[Judged]:
        """The most promising extensions of a model, fitted and judged."""
        extensions: list[Extension] = [one for one in screen.list_singles() if one.net > wanted][:singles]
        extensions += [one for one in screen.list_pairs() if one.net > wanted][:pairs]
        judged = dict[tuple[str, ...], Judged]()
        for extension in extensions:
            fit = self._fit(extension.add_to(base.state), base.noise)
            fit = self._reduce(fit, base)
            if set(fit.ids) == set(base.ids):
                continue
            one = self._judge(base, fit)
            if fit.ids not in judged or one.cost < judged[fit.ids].cost:
                judged[fit.ids] = one
        return list(judged.values())

    def _reduce(self, fit: PartFit, base: PartFit) -> PartFit:
        """The fit with the simpler form of a new effect that has become one, and without idle old ones."""
        for effect in fit.state.effects:
            if effect.id in self.given or is_nameable(effect, self.conditions):
                continue
            simpler = effect.collapse() if effect.is_degenerate(self.conditions) else None
            known = {one.id for one in self.candidates} - set(fit.ids)
            if simpler is not None and simpler.id in known:
                return self._fit(fit.state.drop([effect.id]).add(simpler))
            if effect.id in base.ids:
                # An effect that another one makes superfluous goes with it.
                return self._reduce(self._drop(fit, [effect.id]), base)
        return fit

    def _prune(self, fit: PartFit) -> PartFit:
        """The model without effects that its others have made superfluous, the least evident first."""
        while True:
            free = [effect for effect in fit.state.effects if effect.id not in self.given]
            weak = [one for effect in free if (one := (measure_t(fit, effect), effect.id))[0] < self._least_t]
            if not weak:
                judged = ((self._judge(self._drop(fit, [e.id]), fit), e.id) for e in free)
                weak = [(one.gain, name) for one, name in judged if one.refusal]
            if not weak:
                return fit
            fit = self._drop(fit, [min(weak)[1]])

    def _exchange(self, current: PartFit) -> PartFit | None:
        """A better model with others in the place of one effect, or with an effect for its special cases."""
        for names in self._list_groups(current):
            if self.budget.is_spent():
                return None
            without = self._drop(current, names)
            best = _choose([one for one in self._list_rivals(current, without, names) if not one.refusal])
            if best is not None and best.cost < find_cost(current) - EQUAL:
                return self._prune(best.fit)
        for candidate in self.candidates:
            whole = self._try_whole(current, candidate)
            if whole is not None:
                return whole
        return None

    def _list_groups(self, current: PartFit) -> list[tuple[str, ...]]:
        """Effects that may stand for others: each, and each two of them."""
        free = [name for name in current.ids if name not in self.given]
        return [*((name,) for name in free), *combinations(free, 2)]

    def _list_rivals(self, current: PartFit, without: PartFit, names: Sequence[str]) -> list[Judged]:
        """Models with other effects in the place of some, judged against the one with neither."""
        screen = self._screen(without, names)
        own = without.score - current.score
        return self._judge_extensions(without, screen, 2, 1, 0.3 * own - PRICE * len(names))

    def _try_whole(self, current: PartFit, candidate: Candidate) -> PartFit | None:
        """The model with an effect in the place of its special cases and companions, where it is better."""
        effect = candidate()
        cases = [name for name in current.ids if name in (*effect.contains, *effect.companions)]
        cases = [name for name in cases if name not in self.given]
        if not effect.contains or not effect.starts or candidate.id in current.ids:
            return None
        base, largest = self._drop(current, cases), self.conditions.largest
        starts = [base.state.add(candidate(**values)) for values in effect.list_starts(largest)]
        fits = [self._fit(state, base.noise) for state in starts]
        fit = min(fits, key=find_cost)
        if find_cost(fit) > find_cost(current) - EQUAL:
            return None
        judged = self._judge(base, fit)
        return None if judged.refusal else self._prune(fit)


def _choose(judged: Sequence[Judged]) -> Judged | None:
    """Of models within `EQUAL` of the best, that with fewest numbers; None of none."""
    least = min((one.cost for one in judged), default=math.inf)
    near = [one for one in judged if one.cost < least + EQUAL]
    return min(near, key=lambda one: (one.fit.numbers, one.cost), default=None)


def measure_t(fit: PartFit, effect: Effect) -> float:
    """Standard errors by which the numbers of an effect are away from none, together.

    A limit acts in proportion to its inverse. Numbers that only say where an effect begins do not count.
    """
    indices, aways = list[int](), list[float]()
    for index, number in enumerate(fit.free):
        if number.effect != effect.id:
            continue
        neutral, value = effect.parameter(number.name).neutral, fit.state.get(number)
        if math.isnan(neutral):
            continue
        indices.append(index)
        aways.append(value if math.isinf(neutral) else value - neutral)
    if not indices:
        return 0.0
    away, covariance = np.array(aways), fit.covariance[np.ix_(indices, indices)]
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    scaled = covariance / np.outer(size, size) + 1e-9 * np.eye(size.size)
    total = float((away / size) @ np.linalg.solve(scaled, away / size))
    return math.sqrt(max(total - (len(indices) - 1), 0.0))


def judge(base: PartFit, fit: PartFit, conditions: Conditions, least_t: float = LEAST_T) -> Judged:
    """Accept an extension of a model, or say why not.

    Both are judged by the noise of the larger model: that of the smaller one would hide what it lacks.

    Args:
        base: the smaller model.
        fit: the larger one.
        conditions: what the runs can show.
        least_t: standard errors that each new effect must be from none.
    """
    added = tuple(name for name in fit.ids if name not in base.ids)
    new = [effect for effect in fit.state.effects if effect.id in added]
    for effect in new:
        acting = fit.state.list_as_it_acts(effect)
        if not any(is_nameable(one, conditions) for one in acting):
            return Judged(fit, added, f"{effect.id}: its values are not possible")
        t = measure_t(fit, effect)
        if t < least_t:
            return Judged(fit, added, f"{effect.id}: t = {t:.1f}")
    part, noise = fit.part, fit.noise
    folds = make_folds(part)
    before, after = (hold_out(one, one.noise, folds) for one in (base, fit))
    costs = [list_costs(part, noise, residual) for residual in (before, after)]
    gain = 1.0 - float(costs[1].sum()) / max(float(costs[0].sum()), 1e-300)
    own = list_costs(part, noise, base.residual) - list_costs(part, noise, fit.residual)
    by_unit = np.asarray(np.bincount(part.unit, own), dtype=np.float64)
    stable = math.sqrt(max(float(by_unit.sum() - by_unit.max()), 0.0))
    falls, rises = _compare_horizons(part.list_horizon_errors(before), part.list_horizon_errors(after))
    refusal = ""
    if not gain > 0.0:
        refusal = "the held-out error does not fall"
    elif stable < STABLE_T:
        refusal = "ten seconds bring it all"
    elif rises:
        refusal = f"the error {rises} rises"
    elif not np.nanmax(falls, initial=0.0) >= SHOWN:
        refusal = f"no error falls by more than {np.nanmax(falls, initial=0.0):.1%}"
    sums = [np.bincount(part.block, cost) for cost in costs]
    draws = np.random.default_rng(0).integers(0, sums[0].size, (_DRAWS, sums[0].size))
    frequency = float(np.mean(sums[1][draws].sum(axis=1) < sums[0][draws].sum(axis=1)))
    return Judged(fit, added, refusal, gain, frequency, by_unit, falls)


def make_folds(part: Part) -> Ints:
    """Fold of each step: of runs where there are some, else of blocks, shape (n,)."""
    label = part.run if int(part.run.max(initial=0)) + 1 >= _FEWEST_RUNS else part.block
    number: Ints = np.unique(label, return_inverse=True)[1] % FOLDS
    return number


def list_costs(part: Part, noise: Noise, residual: Floats) -> Floats:
    """Huber's cost of the innovations of each step, shape (n,)."""
    innovations = noise.whiten(residual[:, :, None], part.steps)
    costs: Floats = huber_cost(innovations).sum(axis=(1, 2))
    return costs


def _compare_horizons(before: Sequence[HorizonError], after: Sequence[HorizonError]) -> tuple[Floats, str]:
    """Relative falls of the errors, shape (4, 2), and the first that rises beyond chance; empty if none."""
    falls, risen = np.full((len(HORIZONS_S), 2), math.nan), ""
    for index, (old, new, horizon) in enumerate(zip(before, after, HORIZONS_S, strict=True)):
        for channel, name in enumerate(("position", "heading")):
            one, other = getattr(old, name), getattr(new, name)
            if not one.size or not one.mean() > 0.0:
                continue
            ratio = math.sqrt(float(other.mean() / one.mean()))
            falls[index, channel] = 1.0 - ratio
            if ratio > 1.0 + _NO_CHANGE and _measure_block_t(other - one, old.block) > _RISEN and not risen:
                length = "a whole stretch" if math.isinf(horizon) else f"{horizon:g} s"
                risen = f"in {name} over {length}"
    return falls, risen


def _measure_block_t(values: Floats, block: Ints) -> float:
    """Student's t of the sums over blocks."""
    sums = np.bincount(np.unique(block, return_inverse=True)[1], values)
    if sums.size <= 2:  # noqa: PLR2004 - two blocks say nothing of chance
        return 0.0
    return float(sums.sum() / (math.sqrt(sums.size) * sums.std() + 1e-300))
