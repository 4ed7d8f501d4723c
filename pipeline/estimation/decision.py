"""The one decision: which effects a model lacks.

At a model, `Matrix` says what every set of effects near it promises. The best sets are looked at with one
evaluation each, the best of these fitted, and the matrix made anew there, until nothing is cheaper. A model
costs minus twice its log-likelihood and the price of its numbers; special cases within `EQUAL` are taken in
the place of an effect. What stays has a name where `judge` accepts it, and nothing after it changes that.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import NORMAL_95, Budget, format_share
from pipeline.estimation.candidates import PRICE, Candidate, find_rarity, list_starts
from pipeline.estimation.fit import (
    PathFit,
    begin_fit,
    fit_path,
    fit_roughly,
    go_on,
    invert,
    measure_cost,
    whiten,
)
from pipeline.estimation.intervals import find_covariance
from pipeline.estimation.matrix import Matrix, Move
from pipeline.estimation.model_state import combine_columns, pick_columns
from pipeline.estimation.noise import huber_cost
from pipeline.estimation.plausibility import explain_impossible, is_nameable, is_possible, is_too_small
from pipeline.models import Least
from pipeline.models import Search as HowSearched

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    from pipeline.core import Floats
    from pipeline.estimation.model_state import ModelState
    from pipeline.estimation.noise import Noise
    from pipeline.estimation.path_residuals import PathResiduals
    from pipeline.models import Conditions, Effect

LEAST_T = 5.0
"""Standard errors that an effect must be from none: the largest t of some 30 candidates on logs without any
effect stays below."""
STABLE_T = 0.5 * LEAST_T
"""The same without the ten seconds that contribute most: one event is not enough."""
EQUAL = 12.0
"""Difference of two models' costs below which the data do not decide between them."""
SHOWN = 0.1
"""Share by which an effect is expected to lower an error over one of `HORIZONS_S`."""
LEAST_WAY_SHARE = 0.005
"""Share of the distance driven that an effect must move: half a 5 cm cell after 5 m."""
LEAST_TURN_RAD = 0.0025
"""Heading change that it must make otherwise [rad]: a quarter of such a cell beside the path."""
_FELT_S = (2.0, 10.0)
"""Horizons over which it may: a track that is off by 1 % is felt after a turn, not in two seconds of it."""
_SURE = 0.85
"""Share of resampled recordings in which an effect pays its price: what one block brings is in .63 of them,
what two bring in .86."""
_DRAWS = 400
"""Resamples of blocks: a frequency near 0.85 has a standard error of 0.018."""
_AS_EXPECTED = 0.1
"""Share of what an effect brings by which the model without it may be worse than its derivatives promise."""
_OFTEN = 0.1
"""Share of them in which others in its place that cost more than `EQUAL` must cost less, to be as good."""
_PROMISING = 0.5
"""Share of what an effect brings that others in its place may promise less, to be fitted."""
_FAR = 4.0 * EQUAL
"""How far behind their fits end."""
_RIVALS = 8
"""Others that are fitted in the place of each effect."""
_ROUNDS = 14
"""Most times that a model is improved."""
_LOOKED, _LOOKS = 12, 2
"""Sets that are looked at together, and how often where none of them is better."""
_FITTED, _NEAR = 3, 0.3
"""Most of them that are fitted, and the share of what the best one brings at first sight that others must."""
_STEPS, _FEW_STEPS, _HARD_STEPS = 8, 3, 6
"""Steps of a fit with the noise as it is: of a set, of the model before, of a whole in its parts' place."""
_ANOTHER_STEPS = 5
"""The same from another start of an effect."""
_FALL = 1.0
"""Fall of the cost that is worth a move."""
_WHOLE_FALL = 100.0
"""Fall of the cost by which an effect of many numbers must beat its special cases to take their place."""
_WHOLE_NEAR, _WHOLE_SHARE = 300.0, 0.2
"""How far behind them, or what share of what they explain, it may be after some steps to be fitted."""
_FEWEST_STARTS = 2
"""Numbers without linear influence from which on an effect has several valleys."""
_BANS = 5
"""Most times that the search goes on without effects whose values are not possible."""
_BETTER = 2
"""Most times that it begins again from what others in the place of one effect make."""


@dataclass(frozen=True)
class Judged:
    """An effect of a model, judged against the model without it.

    Attributes:
        base: the model without it, its other numbers adapted linearly.
        fit: the model.
        effect: its id.
        refusal: why it has no name; empty where it has one.
        is_proven: whether it stays in the model: without a name, where only nobody would feel it.
        t: standard errors by which its numbers are away from none.
        frequency: share of resampled recordings in which it pays its price.
        gain: share of the held-out cost of the model without it that it removes.
        evidence: fall of the cost in each stretch of ten seconds, shape (b,).
    """

    base: PathFit
    fit: PathFit
    effect: str
    refusal: str
    is_proven: bool
    t: float
    frequency: float
    gain: float
    evidence: Floats = field(repr=False)


def find_cost(fit: PathFit) -> float:
    """Minus twice the log-likelihood of a fit, with the price of its numbers and of unusual effects."""
    return fit.score + _find_price(fit.state, fit.numbers)


def _find_price(state: ModelState, numbers: int) -> float:
    """What a model must bring for its numbers and unusual effects."""
    return PRICE * numbers + sum(map(find_rarity, state.effects))


@dataclass(frozen=True)
class Alternative:
    """Another effect in the place of one that was chosen.

    Attributes:
        effect: id of the chosen effect.
        other: id of the other.
        fit: the model with it.
        behind: its cost less that of the chosen model.
    """

    effect: str
    other: str
    fit: PathFit
    behind: float


@dataclass(frozen=True)
class SearchResult:
    """The result of a search on one path.

    Attributes:
        start: the model to start from, fitted.
        final: the cheapest model, fitted; effects too small for a name are in it, too.
        new: ids of the effects that are named.
        judged: how each effect was judged, by id, but for given ones and those too small for a name.
        rivals: effects that the data do not separate from one of them.
        matrix: of the final model.
    """

    start: PathFit
    final: PathFit
    new: tuple[str, ...]
    judged: dict[str, Judged]
    rivals: tuple[Alternative, ...]
    matrix: Matrix


@dataclass
class Search:
    """A search on one path.

    Attributes:
        path: the path.
        candidates: effects that may be named.
        conditions: what the runs can show.
        given: ids of effects that stay.
        budget: of CPU time.
        least_t: standard errors that each effect must be from none.
    """

    path: PathResiduals
    candidates: tuple[Candidate, ...]
    conditions: Conditions
    given: frozenset[str] = frozenset()
    budget: Budget = field(default_factory=Budget)
    least_t: float = LEAST_T
    _tried: set[object] = field(default_factory=set, init=False)
    _banned: set[tuple[str, ...]] = field(default_factory=set, init=False)
    _excluded: set[str] = field(default_factory=set, init=False)

    @property
    def _allowed(self) -> list[Candidate]:
        """Candidates but for those that turned out impossible, or unproven beside others."""
        return [one for one in self.candidates if one.id not in self._excluded]

    def run(self, start: ModelState) -> SearchResult:
        """Search from a model."""
        first = begin = fit_path(self.path, start)
        for _ in range(1 + _BETTER):
            final, judged = self.name_all(self.search_possible(begin))
            matrix = self.make_matrix(final)
            judged, rivals = self._find_rivals(final, matrix, judged)
            better = min(rivals, key=lambda one: one.behind, default=None)
            if better is None or better.behind > -EQUAL or self.budget.is_spent():
                break
            begin = better.fit
        named = tuple(name for name, one in judged.items() if not one.refusal)
        return SearchResult(first, final, named, judged, tuple(rivals), matrix)

    def make_matrix(self, fit: PathFit) -> Matrix:
        """What sets of effects near a model would explain; special cases of its effects are in it already."""
        known = {*fit.ids}.union(*(effect.contains for effect in fit.state.effects))
        acting = [one for one in self._allowed if one.id not in known and one().acts_in(fit.ids)]
        return Matrix(fit, acting, self.conditions.largest)

    def search_possible(self, first: PathFit) -> PathFit:
        """The cheapest model whose effects all have possible values."""
        current = self._climb(first)
        for _ in range(_BANS):
            wrong = {one.id for one in current.state.effects if self._is_impossible(current, one)}
            if not wrong:
                break
            # What cannot be would keep what is there from the set.
            self._excluded |= wrong
            current = self._climb(fit_path(self.path, current.state.drop(wrong), noise=current.noise))
        return current

    def _is_impossible(self, fit: PathFit, effect: Effect) -> bool:
        acting = _list_acting(fit, effect)
        may_be = any(is_possible(fit, one, self.conditions) for one in acting) or self._is_small(fit, effect)
        return effect.id not in self.given and not may_be

    def _is_small(self, fit: PathFit, effect: Effect) -> bool:
        """Whether only its size keeps an effect from a name: it stays, as others would only imitate it."""
        return all(is_too_small(one, self.conditions) for one in _list_acting(fit, effect))

    def _is_within_tolerance(self, fit: PathFit, effect: Effect) -> bool:
        """Whether only the tolerance of data sheets keeps an effect of a model from a name."""
        reasons = {p.least.reason for p in effect.parameters if p.least is not None}
        return effect.id not in self.given and reasons == {Least.DATA_SHEET} and self._is_small(fit, effect)

    def _climb(self, current: PathFit) -> PathFit:
        """The model improved until nothing is cheaper."""
        restarted = set[tuple[str, ...]]()
        for _ in range(_ROUNDS):
            if self.budget.is_spent():
                break
            self.budget.report(self.path.title, current.ids)
            better = self._improve(current)
            if better is None and current.ids not in restarted:
                restarted.add(current.ids)
                better = self._start_again(current) or self._try_wholes(current)
            if better is None:
                break
            current = better
        return self._simplify(go_on(current))

    def _improve(self, current: PathFit) -> PathFit | None:
        """The cheapest of the sets that promise most; None where none is cheaper."""
        matrix = self.make_matrix(current)
        # All are compared under one noise, and must be cheaper under their own, too.
        noise = matrix.noise
        base = _fit_under(self.path, current.state, noise, _FEW_STEPS)
        learned = replace(current, noise=self.path.learn(current.residual, current.noise))
        own, sets = _measure_under(matrix.fit, noise), iter(matrix.choose(self.given, self._banned))
        for _ in range(_LOOKS):
            looks = (self._look(matrix, one) for one in islice(sets, _LOOKED))
            looked = sorted((cost - own, name, state) for cost, name, state in looks)
            best: tuple[float, PathFit] | None = None
            for brings, _, state in looked[:_FITTED]:
                if best is not None and not brings < _NEAR * looked[0][0]:
                    break
                # A fit ends early where it cannot be cheaper than the best one.
                least = find_cost(base) + (0.0 if best is None else min(best[0], 0.0))
                fit = _fit_under(self.path, state, noise, _STEPS, least)
                fall = find_cost(fit) - find_cost(base)
                fit = replace(fit, noise=self.path.learn(fit.residual, noise))
                if find_cost(fit) < find_cost(learned) and (best is None or fall < best[0]):
                    best = fall, fit
            if best is not None and best[0] < -_FALL:
                return self._simplify(best[1], noise)
        return None

    def _look(self, matrix: Matrix, change: Move) -> tuple[float, tuple[str, ...], ModelState]:
        """Cost of a set at first sight, at the best of its starts, with its name."""
        looks: list[tuple[float, int, ModelState]] = []
        for state in matrix.list_states(change):
            free = self.path.list_free(state)
            cost = measure_cost(self.path, matrix.noise, state, free, self.path.find_residuals(state))
            looks.append((cost + _find_price(state, len(free)), len(looks), state))
        cost, _, state = min(looks, key=lambda one: one[:2])
        return cost, matrix.name(change), state

    def _start_again(self, current: PathFit) -> PathFit | None:
        """The same set from other starts of effects with several valleys; None where none is cheaper."""
        fits = list[PathFit]()
        for effect in current.state.effects:
            candidate = next((one for one in self._allowed if one.id == effect.id), None)
            if candidate is None or sum(one.effect == effect.id for one in current.free) < _FEWEST_STARTS:
                continue
            starts = [candidate(**values) for values in self._list_starts(candidate) if values]
            starts += effect.list_alike()
            started = [begin_fit(self.path, current.state.add(one), current.noise) for one in starts]
            better = sorted(started, key=lambda fit: fit.expected)[: (len(started) + 1) // 2]
            fits += [fit_roughly(one, _ANOTHER_STEPS) for one in better]
        best = min(fits, key=find_cost, default=current)
        is_cheaper = find_cost(best) - find_cost(current) < -EQUAL
        return self._take(best, current, EQUAL) if is_cheaper else None

    def _list_starts(self, candidate: Candidate) -> list[dict[str, float]]:
        return list_starts(candidate, self.conditions.largest)

    def _take(self, start: PathFit, current: PathFit, least: float) -> PathFit | None:
        """A model fitted with its own noise, where it is cheaper by so much."""
        fit = go_on(start)
        return fit if find_cost(fit) < find_cost(current) - least else None

    def _try_wholes(self, current: PathFit) -> PathFit | None:
        """The model with an effect of many numbers in the place of its special cases, where it is better."""
        started = list[tuple[float, str, PathFit]]()
        for candidate in self._allowed:
            effect = candidate()
            searched = sum(p.search is HowSearched.STARTS for p in effect.parameters)
            if not effect.contains or candidate.id in current.ids or searched < _FEWEST_STARTS:
                continue
            free = [name for name in current.ids if name not in self.given]
            cases, beside = ([n for n in free if n in part] for part in (effect.contains, effect.companions))
            if len(cases) + len(beside) < _FEWEST_STARTS or not effect.acts_in({*current.ids} - {*cases}):
                continue
            bases = [current.state.drop(gone) for gone in ([cases, cases + beside] if beside else [cases])]
            states = [
                base.add(candidate(**values)) for base in bases for values in self._list_starts(candidate)
            ]
            fits = [begin_fit(self.path, state, current.noise) for state in states]
            expected = [one.expected + _find_price(one.state, one.numbers) for one in fits]
            cost, _, best = min(zip(expected, range(len(fits)), fits, strict=True), key=lambda one: one[:2])
            started.append((cost, candidate.id, best))
        if not started:
            return None
        nearest = sorted(started, key=lambda one: one[:2])[:2]
        ends = [(fit_roughly(begin, _HARD_STEPS), name) for _, name, begin in nearest]
        fit, name = min(ends, key=lambda one: (find_cost(one[0]), one[1]))
        whole = fit.state.find(name)
        if whole is None or not is_nameable(whole, self.conditions):
            return None
        without = [one for one in current.ids if one in (*whole.contains, *whole.companions)]
        explained = _measure_under(current, current.noise, without) - _measure_under(current, current.noise)
        if find_cost(fit) - find_cost(current) > max(_WHOLE_NEAR, _WHOLE_SHARE * explained):
            return None
        taken = self._take(fit, current, _WHOLE_FALL)
        whole = None if taken is None else taken.state.find(name)
        return taken if whole is not None and is_nameable(whole, self.conditions) else None

    def _simplify(self, fit: PathFit, noise: Noise | None = None) -> PathFit:
        """The model with special cases in the place of effects that they equal.

        Args:
            fit: the model.
            noise: under which models are compared; None for that of each.
        """

        def refit(state: ModelState) -> PathFit:
            if noise is None:
                return fit_path(self.path, state)
            return _fit_under(self.path, state, noise, _STEPS)

        while True:
            collapsed = self._collapse(fit)
            if collapsed is not None:
                # What is degenerate is not tried again: it would only become this.
                self._banned.add(tuple(sorted(fit.ids)))
                fit = refit(collapsed)
                continue
            simpler = list[tuple[float, PathFit]]()
            for name, state in self._list_simpler(fit):
                key = (tuple(sorted(fit.ids)), name, tuple(sorted(state.ids)))
                if key in self._tried:
                    continue
                self._tried.add(key)
                one = refit(state)
                if (rise := find_cost(one) - find_cost(fit)) < EQUAL:
                    simpler.append((rise, one))
            if not simpler:
                return fit
            fit = min(simpler, key=lambda one: one[0])[1]

    def _collapse(self, fit: PathFit) -> ModelState | None:
        """The model with what a degenerate effect has become in its place, or nothing; None without one."""
        known = {one.id for one in self._allowed}
        for effect in fit.state.effects:
            if effect.id not in self.given and effect.is_neutral:
                return fit.state.drop([effect.id])
            if effect.id in self.given or not effect.is_degenerate(self.conditions):
                continue
            simple = effect.collapse()
            if simple is None or simple.id not in known:
                continue
            rest = fit.state.drop([effect.id])
            held = {*rest.ids}.union(*(one.contains for one in rest.effects))
            return rest if simple.id in held else rest.add(simple)
        return None

    def _list_simpler(self, fit: PathFit) -> Iterator[tuple[str, ModelState]]:
        """Models with special cases in the place of an effect, started at its values."""
        for effect in fit.state.effects:
            if effect.id in self.given:
                continue
            rest = fit.state.drop([effect.id])
            for whole in rest.effects:
                if effect.id in whole.contains and {*effect.values} == {"tau"}:
                    slower = {
                        name: value + effect.values["tau"]
                        for name, value in whole.values.items()
                        if name.startswith("tau") and math.isfinite(value)
                    }
                    if slower:
                        yield effect.id, rest.add(whole.change_within(**slower))
            cases = list(self._list_cases(effect, fit.ids))
            if any(case.id in whole.contains for case in cases for whole in rest.effects):
                yield effect.id, rest
            yield from ((effect.id, rest.add(case)) for case in cases)
            if len(cases) > 1:
                yield effect.id, rest.add(*cases)

    def _list_cases(self, effect: Effect, ids: Collection[str]) -> Iterator[Effect]:
        """Special cases of an effect at its values: of equal names its own, of time constants their mean."""
        for candidate in self._allowed:
            if candidate.id not in effect.contains or candidate.id in ids:
                continue
            names = {p.name for p in candidate.parameters}
            same = {name: effect.values[name] for name in names & {*effect.values}}
            taus = [value for name, value in effect.values.items() if name.startswith("tau")]
            if names == {*same} and all(map(math.isfinite, same.values())):
                yield candidate().change_within(**same)
            elif names == {"tau"} and taus:
                yield candidate(tau=sum(taus) / len(taus))

    def name_all(self, fit: PathFit) -> tuple[PathFit, dict[str, Judged]]:
        """The model without effects that are not proven beside its others, and how each was judged.

        What goes may have kept out what is there: the search goes on without it. Of a drive that does not do
        what it is told, nothing is named.
        """
        while True:
            if not self.path.is_followed(fit.residual):
                return fit_path(self.path, fit.state.drop({*fit.ids} - self.given), noise=fit.noise), {}
            judged = self.judge_all(fit)
            least = _find_least_proven(judged)
            if least is None:
                return fit, judged
            self._excluded.add(least)
            fit = self.search_possible(fit_path(self.path, fit.state.drop([least]), noise=fit.noise))

    def choose_proven(self, base: PathFit) -> tuple[PathFit, dict[str, Judged]]:
        """The best set near a model of effects that are all proven, and how each was judged.

        It is chosen on the one matrix of that model, and what is not proven is chosen no more: for candidates
        whose influence is linear, such as the terms of a formula.

        Args:
            base: the model; it is what is returned where no set is better.
        """
        matrix, excluded = self.make_matrix(base), set[str]()
        while True:
            best = min(matrix.choose(self.given, (), excluded), key=matrix.measure, default=None)
            if best is None:
                return base, {}
            without = {matrix.trials[index].effect.id: best.without(index) for index in best.added}
            stay = [name for name in base.ids if name not in best.gone and name not in self.given]
            without |= {name: best.drop(name) for name in stay}
            paid = {name: _find_frequency(matrix, best, one) for name, one in without.items()}
            least = min(paid, key=lambda name: (paid[name], name), default="")
            if paid.get(least, 1.0) < _SURE:
                excluded.add(least)
                continue
            fit = fit_path(self.path, self._look(matrix, best)[2], noise=matrix.noise)
            judged = self.judge_all(fit)
            unproven = _find_least_proven(judged)
            if unproven is None:
                return fit, judged
            excluded.add(unproven)

    def judge_all(self, fit: PathFit) -> dict[str, Judged]:
        """How each effect of a model is judged, but for given ones and those too small for a name."""
        asked = [
            one for one in fit.state.effects if one.id not in self.given and not self._is_small(fit, one)
        ]
        if not asked:
            return {}
        matrix = Matrix(fit, (), self.conditions.largest)
        return {one.id: judge(fit, one, matrix, self.conditions, self.least_t) for one in asked}

    def _find_rivals(
        self, final: PathFit, matrix: Matrix, judged: Mapping[str, Judged]
    ) -> tuple[dict[str, Judged], list[Alternative]]:
        """How effects were judged, and what the data do not separate from those with a name.

        What is within the tolerance of data sheets as one effect may be beyond it as another: on circles one
        way round the wheels of one side are .3 % larger, or the track is 1.5 % wider. Such a one has a name.
        """
        rivals = {
            name: list(self._list_rivals(final, matrix, name))
            for name, one in judged.items()
            if not one.refusal
        }
        judged = dict(judged)
        for effect in final.state.effects:
            if effect.id in judged or not self._is_within_tolerance(final, effect):
                continue
            own = Matrix(final, (), self.conditions.largest)
            one = judge(final, effect, own, self.conditions, self.least_t, whatever_size=True)
            others = [] if one.refusal else list(self._list_rivals(final, matrix, effect.id))
            if others:
                judged[effect.id], rivals[effect.id] = one, others
        return judged, [*chain.from_iterable(rivals.values())]

    def _list_rivals(self, final: PathFit, matrix: Matrix, name: str) -> Iterator[Alternative]:
        """Effects as good as one of a model, or better in a tenth of resampled recordings."""
        own = _sum_blocks(final, final.noise)
        weights = _resample(own.size)
        brings = matrix.expect_change(Move().drop(name))
        others = [
            one for one in matrix.list_replacements(name) if matrix.expect_change(one) < _PROMISING * brings
        ]
        for change in others[:_RIVALS]:
            _, _, state = self._look(matrix, change)
            fit = _fit_under(self.path, state, final.noise, _STEPS, find_cost(final) + _FAR)
            (other,) = (matrix.trials[index].effect.id for index in change.added)
            effect = fit.state.find(other)
            if effect is None or not any(
                is_nameable(one, self.conditions) for one in _list_acting(fit, effect)
            ):
                continue
            behind = _sum_blocks(fit, final.noise) - own
            price = _find_price(fit.state, fit.numbers) - _find_price(final.state, final.numbers)
            apart = find_cost(fit) - find_cost(final)
            is_often = float(np.mean(weights @ behind + price < 0.0)) >= _OFTEN
            if apart < EQUAL or (is_often and apart < _FAR):
                yield Alternative(name, other, fit, apart)


def _fit_under(
    path: PathResiduals, state: ModelState, noise: Noise, steps: int, most: float = math.inf
) -> PathFit:
    """A fit under a given noise; it ends early where it cannot cost less than `most`."""
    fit = begin_fit(path, state, noise)
    return fit_roughly(fit, steps, most - _find_price(state, fit.numbers))


def _measure_under(fit: PathFit, noise: Noise, without: Collection[str] = ()) -> float:
    """Cost of a model under a noise, some effects taken out, but for the logarithms of the variances."""
    path, state = fit.path, fit.state.drop(without) if without else fit.state
    free = path.list_free(state) if without else fit.free
    residual = path.find_residuals(state) if without else fit.residual
    return measure_cost(path, noise, state, free, residual) + _find_price(state, len(free))


@functools.lru_cache(maxsize=8)
def _resample(count: int) -> Floats:
    """How often each block is in each resampled recording, shape (draws, blocks)."""
    drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), size=_DRAWS)
    return np.asarray(drawn, dtype=np.float64)


def _sum_blocks(fit: PathFit, noise: Noise) -> Floats:
    """Cost of the residuals of a fit in each block, shape (blocks,)."""
    return np.asarray(
        np.bincount(fit.path.block, list_costs(fit.path, noise, fit.residual)), dtype=np.float64
    )


def measure_t(
    fit: PathFit, effect: Effect, base: PathFit | None = None, covariance: Floats | None = None
) -> float:
    """Standard errors by which the numbers of an effect are away from none, together.

    A limit acts in proportion to its inverse. Numbers that only say where an effect begins do not count. Of
    one without derivatives, such as a deadband, the fall of chi-square counts.

    Args:
        fit: a model with the effect.
        effect: as it is there.
        base: the model without it; without one, an effect without derivatives counts as evident.
        covariance: of the fit's numbers, shape (p, p); by default as if clocks and lengths were exact.
    """
    covariance = fit.covariance if covariance is None else covariance
    own = [number for number in fit.free if number.effect == effect.id]
    if own and not any(number.is_smooth for number in own):
        if base is None:
            return math.inf
        costs = [list_costs(fit.path, fit.noise, one.residual) for one in (base, fit)]
        return math.sqrt(max(float((costs[0] - costs[1]).sum()) / fit.overdispersion, 0.0))
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
    away, covariance = np.array(aways), covariance[np.ix_(indices, indices)]
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    scaled = covariance / np.outer(size, size) + 1e-9 * np.eye(size.size)
    total = float((away / size) @ np.linalg.solve(scaled, away / size))
    return math.sqrt(max(total - (len(indices) - 1), 0.0))


def judge(
    fit: PathFit,
    effect: Effect,
    matrix: Matrix,
    conditions: Conditions,
    least_t: float = LEAST_T,
    *,
    whatever_size: bool = False,
) -> Judged:
    """Give an effect of a model its name, or say why not.

    Args:
        fit: the model.
        effect: as it is there.
        matrix: of the model.
        conditions: what the runs can show.
        least_t: standard errors that it must be from none.
        whatever_size: whether it may be smaller than data sheets and stamps err.
    """
    path, (base, is_linear) = fit.path, _drop_effect(fit, effect.id, matrix.without[effect.id])
    if is_linear:
        frequency = _find_frequency(matrix, Move(), Move().drop(effect.id))
    else:
        brings = _sum_blocks(base, fit.noise) - _sum_blocks(fit, fit.noise)
        price = _find_price(fit.state, fit.numbers) - _find_price(base.state, base.numbers)
        frequency = _count_paying(brings, price)
    costs = [list_costs(path, fit.noise, one.held_out) for one in (base, fit)]
    gain = 1.0 - float(costs[1].sum()) / max(float(costs[0].sum()), 1e-300)
    own = list_costs(path, fit.noise, base.residual) - list_costs(path, fit.noise, fit.residual)
    evidence = np.asarray(np.bincount(path.unit, own), dtype=np.float64)
    t, change = measure_t(fit, effect, base), base.residual - fit.residual
    felt = find_expected_fall(fit, change)
    refusal, is_proven, acting = "", False, _list_acting(fit, effect)
    if t < least_t:
        refusal = f"it is not significant: t = {t:.1f}, required {least_t:.2g}"
    elif not any(
        is_possible(fit, one, conditions) or (whatever_size and is_too_small(one, conditions))
        for one in acting
    ):
        is_small = all(is_too_small(one, conditions) for one in acting)
        refusal = (
            "it is smaller than data sheets and stamps err"
            if is_small
            else explain_impossible(acting[0], conditions)
        )
    elif measure_t(fit, effect, base, find_covariance(fit)) < NORMAL_95:
        refusal = "its 95 % interval includes no effect"
    elif frequency < _SURE:
        refusal = (
            f"it shows in too few stretches of the drive ({format_share(frequency)} of resampled recordings, "
            f"{format_share(_SURE)} required)"
        )
    elif not gain > 0.0:
        refusal = "the error on data that it was not fitted to does not fall"
    else:
        is_proven = True
        if felt < SHOWN and not _outdoes_another(fit, effect):
            refusal = (
                f"no error against {path.target} falls by more than {format_share(felt)}, "
                f"required {format_share(SHOWN)}"
            )
        elif not _is_material(path, change):
            refusal = "what it moves is less than a map resolves"
    return Judged(base, fit, effect.id, refusal, is_proven, t, frequency, gain, evidence)


def _outdoes_another(fit: PathFit, effect: Effect) -> bool:
    """Whether a model of as many effects would be better with an effect, felt there, in the place of another.

    What two effects do alike, each does little of beside the other: the better one would go without a name.
    """

    def leave_out(*names: str) -> PathFit:
        return _fit_under(fit.path, fit.state.drop(names), fit.noise, _STEPS)

    least = find_cost(leave_out(effect.id)) - EQUAL
    for other in fit.ids:
        if other == effect.id:
            continue
        there = leave_out(other)
        if find_cost(there) < least:
            moved = leave_out(other, effect.id).residual - there.residual
            if find_expected_fall(there, moved) >= SHOWN:
                return True
    return False


def _find_frequency(matrix: Matrix, change: Move, without: Move) -> float:
    """Share of resampled recordings in which what a set has beyond another pays for its numbers."""
    brings = matrix.sum_blocks(without) - matrix.sum_blocks(change)
    return _count_paying(brings, matrix.find_price(change) - matrix.find_price(without))


def _count_paying(brings: Floats, price: float) -> float:
    """Share of resampled recordings in which what each block brings, shape (blocks,), exceeds a price."""
    return float(np.mean(_resample(brings.size) @ brings > price))


def _find_least_proven(judged: Mapping[str, Judged]) -> str | None:
    """The effect that is least proven of those that are not; None where all are."""
    refused = (one for one in judged.values() if not one.is_proven)
    least = min(refused, key=lambda one: (one.frequency, one.t, one.effect), default=None)
    return None if least is None else least.effect


def _drop_effect(fit: PathFit, name: str, residual: Floats) -> tuple[PathFit, bool]:
    """A model without one of its effects, its other numbers adapted, and whether linearly.

    Where the adapted model does not do what was expected of it, it is fitted: a delay, for one, promises to
    do what a lag does, and cannot.

    Args:
        fit: the model.
        name: id of the effect.
        residual: of the model without it, its other numbers as they are, shape (n, 3).
    """
    path, state = fit.path, fit.state.drop([name])
    places = [index for index, number in enumerate(fit.free) if number.effect != name]
    free, columns = tuple(fit.free[index] for index in places), pick_columns(fit.columns, places)
    smooth = [index for index, number in enumerate(free) if number.is_smooth]
    linear = PathFit(path, state, free, residual, columns, fit.noise)
    if not smooth:
        return linear, True
    moving = pick_columns(columns, smooth)
    low, high = np.array([state.find_room(free[index]) for index in smooth]).T
    adapted, moved = residual, np.zeros(len(smooth))
    for _ in range(3):
        # Outliers are others without the effect.
        white = whiten(path, fit.noise, adapted, moving)
        step = invert(white.columns.T @ white.columns) @ (white.columns.T @ white.residual)
        moved = np.clip(moved + step, low, high)
        adapted = residual - combine_columns(moving, moved)
    linear = replace(linear, residual=adapted)
    there = state.move([free[index] for index in smooth], moved.tolist())
    own, expected, real = (
        float(list_costs(path, fit.noise, one).sum())
        for one in (fit.residual, adapted, path.find_residuals(there))
    )
    if real - expected <= EQUAL + _AS_EXPECTED * max(expected - own, 0.0):
        return linear, True
    starts = (begin_fit(path, one, fit.noise) for one in (state, there))
    return fit_roughly(min(starts, key=lambda one: one.score), _STEPS), False


def find_expected_fall(fit: PathFit, change: Floats) -> float:
    """The largest relative fall of an error that is expected of an effect by the motion it makes.

    What a run's own errors happen to be beside it is chance, above all over few long stretches.

    Args:
        fit: the model with it.
        change: of the predicted increments by it, beside what the other numbers take over, shape (n, 3).
    """
    falls = [0.0]
    errors = zip(fit.horizon_errors, fit.path.list_horizon_errors(change), strict=True)
    for remaining, moved in errors:
        for name in ("position", "heading"):
            one, other = getattr(remaining, name), getattr(moved, name)
            if one.size and one.mean() + other.mean() > 0.0:
                falls.append(1.0 - math.sqrt(one.mean() / (one.mean() + other.mean())))
    return max(falls)


def _list_acting(fit: PathFit, effect: Effect) -> list[Effect]:
    """An effect of a model as it acts in each run, and by how much its delays there differ."""
    acting = fit.state.list_as_it_acts(effect)
    if len(acting) > 1 and effect.late is not None:
        # Clocks of several runs are told by their differences: what they have in common may be a delay.
        delays = [one.delay for one in acting]
        acting.append(effect.of_delay(min(delays) - max(delays)))
    return acting


def _is_material(path: PathResiduals, change: Floats) -> bool:
    """Whether a change of the predicted increments is felt over one of `_FELT_S`, as its rms over the run."""
    sums = np.cumsum(np.concatenate((np.zeros((1, 3)), change)), axis=0)
    for horizon in _FELT_S:
        length = min(max(round(horizon / float(np.median(path.spans))), 1), change.shape[0])
        x, y, turn = np.sqrt(np.mean((sums[length:] - sums[:-length]) ** 2, axis=0)).tolist()
        if math.hypot(x, y) >= LEAST_WAY_SHARE * horizon * path.speed or turn >= LEAST_TURN_RAD:
            return True
    return False


def list_costs(path: PathResiduals, noise: Noise, residual: Floats) -> Floats:
    """Huber's cost of the innovations of each step, shape (n,)."""
    innovations = noise.whiten(residual[:, :, None], path.steps)
    costs: Floats = huber_cost(innovations).sum(axis=(1, 2))
    return costs
