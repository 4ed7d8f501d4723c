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
from scipy.special import stdtr

from pipeline.core import NORMAL_95, Budget, format_share
from pipeline.estimation.candidates import PRICE, Candidate, Screen, list_starts
from pipeline.estimation.fit import PathFit, approach, approach_each, fit_path
from pipeline.estimation.intervals import find_covariance
from pipeline.estimation.noise import huber_cost
from pipeline.estimation.path_residuals import HORIZONS_S
from pipeline.estimation.plausibility import is_nameable, is_too_small, list_implausible

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from pipeline.core import Floats, Ints
    from pipeline.estimation.model_state import ModelState
    from pipeline.estimation.noise import Noise
    from pipeline.estimation.path_residuals import HorizonError, PathResiduals
    from pipeline.models import Conditions, Effect

LEAST_T = 5.0
"""Standard errors that an effect must be from none: the largest t of some 30 candidates on logs without any
effect stays below."""
STABLE_T = 0.5 * LEAST_T
"""The same without the ten seconds that contribute most: one event is not enough."""
EQUAL = 12.0
"""Difference of two models' scores below which the data do not decide between them."""
LEAST_WAY_SHARE = 0.005
"""Share of the distance driven that an effect must move: half a 5 cm cell after 5 m."""
LEAST_TURN_RAD = 0.0025
"""Heading change that it must make otherwise [rad]: a quarter of such a cell beside the path."""
_FELT_S = (2.0, 10.0)
"""Horizons over which it may: a track that is off by 1 % is felt after a turn, not in two seconds of it."""
_UNUSUAL = 8.0
"""Cost of an effect that no controller has a parameter for: before any data it is e^4 times less common than
a wrong track, a lag or a limit."""
SHOWN = 0.1
"""Share by which an effect must lower a held-out error over one of `HORIZONS_S`."""
_RISE = SHOWN / 2.0
"""Share by which it may raise one: a smaller rise is nothing that anybody would notice."""
_RISEN = 0.02
"""Probability below which a rise of any of the held-out errors by `_RISE` is no chance. Where few
blocks tell nothing of chance, none may rise by more than the largest fall."""
_ALIKE = 0.3
"""Correlation of two numbers from which on their effects may stand for one common cause."""
_MOST_EFFECTS = 8
"""Most effects that a search adds on one path: a longer list explains nothing."""
_SINGLES, _PAIRS = 4, 3
"""Extensions by one effect and by two that are fitted in each round."""
_NEAR = 0.2
"""Share of what the best one explains that it may lack after them to be fitted to the end."""
_SURE = 0.95
"""Share of resampled recordings in which an effect must be better than a special case of it."""
_TRIED = 2
"""Extensions that are begun for each place."""
_DRAWS = 400
"""Resamples of blocks: a frequency near 0.95 has a standard error of 0.01."""


@dataclass(frozen=True)
class Judged:
    """An extension of a model, fitted and judged.

    Attributes:
        base: the smaller model.
        fit: the larger model.
        added: ids of its new effects.
        refusal: why it is not accepted; empty where it is.
        gain: share of the smaller model's held-out cost that it removes.
        frequency: share of resampled recordings in which it removes some of it.
        evidence: fall of the cost in each stretch of ten seconds, shape (b,).
        falls: relative fall of each held-out error, position and heading over each of `HORIZONS_S`, shape
            (4, 2), NaN where nothing is predicted so far.
    """

    base: PathFit
    fit: PathFit
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


def find_cost(fit: PathFit) -> float:
    """Minus twice the log-likelihood of a fit, with the price of its numbers and of unusual effects."""
    return fit.score + _find_price(fit.state, fit.numbers)


def _find_price(state: ModelState, numbers: int) -> float:
    """What a model must bring for its numbers and unusual effects."""
    unusual = sum(not any(p.quantities for p in effect.parameters) for effect in state.effects)
    return PRICE * numbers + _UNUSUAL * unusual


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
class SearchResult:
    """The result of a search on one path.

    Attributes:
        start: the model to start from, fitted.
        final: the model that no extension improves, fitted; effects too small for a name are in it, too.
        new: ids of the effects that are named.
        judged: how each of its effects was judged against the model without it, by id.
        rivals: models that the data do not separate from it.
        screen: what candidates explain of its residuals.
    """

    start: PathFit
    final: PathFit
    new: tuple[str, ...]
    judged: dict[str, Judged]
    rivals: tuple[Rival, ...]
    screen: Screen


@dataclass
class Search:
    """A search on one path.

    Attributes:
        path: the path.
        candidates: effects that may be named.
        conditions: what the runs can show.
        given: ids of effects that stay.
        budget: of CPU time.
        shapes: of how many shapes each candidate is the best one: the evidence for it is reduced accordingly.
    """

    path: PathResiduals
    candidates: tuple[Candidate, ...]
    conditions: Conditions
    given: frozenset[str] = frozenset()
    budget: Budget = field(default_factory=Budget)
    shapes: int = 1
    _fits: dict[tuple[object, ...], PathFit] = field(default_factory=dict)
    _rivals: dict[tuple[object, ...], list[Judged]] = field(default_factory=dict, init=False)

    def run(self, start: ModelState) -> SearchResult:
        """Search from a model."""
        first, asked = self.fit(start), self.given
        extended = self._extend_all(first)
        result, other = self._conclude(first, extended)
        # What is a part of the extended model was passed by on the way to it.
        while other is not None and not set(other.ids) <= set(extended.ids):
            # Models are compared with all that improves them, what is not accepted in the end included.
            before, given = find_cost(extended), self.given
            self.given = asked | {one.id for one in self._list_small(other)}
            extended = self._extend_all(other)
            if self.budget.is_spent() or not find_cost(extended) < before - EQUAL:
                self.given = given
                break
            result, other = self._conclude(first, extended)
        return result

    def _conclude(self, first: PathFit, extended: PathFit) -> tuple[SearchResult, PathFit | None]:
        """The result with a model's accepted effects, and a better model with others in the place of one."""
        current, judged = self._restore(*self.refuse(extended), extended)
        rivals, better = list[Rival](), list[Judged]()
        for name, one in judged.items():
            for other in self.list_rivals(current, one.base, [name]):
                behind = other.cost - find_cost(current)
                is_new = behind < EQUAL and not set(other.added) & set(current.ids)
                # An error of the data sheet, too small for a name, may be as good an explanation as a name.
                if is_new and self._is_fine(other) and self.replaces(current, other):
                    rivals.append(Rival(name, other, behind))
                if self._is_better(other, current):
                    better.append(other)
        result = SearchResult(first, current, tuple(judged), judged, tuple(rivals), self.screen(current))
        chosen = _choose(better)
        return result, None if chosen is None else self.prune(chosen.fit)

    def _extend_all(self, current: PathFit) -> PathFit:
        """The model extended until nothing is accepted."""
        while not self.budget.is_spent():
            self.budget.report(self.path.title, current.ids)
            known = current.ids
            fine = [one for one in self._extend(current) if self._is_fine(one)]
            small = _choose([one for one in fine if self._list_small(one.fit, known)])
            chosen = _choose([one for one in fine if not self._list_small(one.fit, known)])
            if (
                small is not None
                and small.cost < find_cost(current if chosen is None else chosen.fit) - EQUAL
            ):
                # An effect that is too small for a name, as sampling makes: others would only imitate it.
                self.given |= {one.id for one in self._list_small(small.fit, known)}
                current = small.fit
                continue
            better = None if chosen is None else self.prune(chosen.fit)
            if better is None or not find_cost(better) < find_cost(current):
                # What an extension makes superfluous may have been worth more than it.
                better = self._exchange(current)
            if better is None or not find_cost(better) < find_cost(current):
                break
            self.given |= {one.id for one in self._list_small(better, current.ids)}
            current = better
        return current

    def _exchange(self, current: PathFit) -> PathFit | None:
        """A better model with others in the place of one effect, or with an effect for its special cases."""
        companions = {name for effect in current.state.effects for name in effect.companions}
        for candidate in self.candidates:
            whole = self._try_whole(current, candidate)
            if whole is None and candidate.id in companions:
                whole = self._try_beside(current, candidate)
            if whole is not None:
                return whole
        for name in current.ids:
            if name in self.given or self.budget.is_spent():
                continue
            others = self.list_rivals(current, self._drop(current, [name]), [name])
            best = _choose([one for one in others if self._is_better(one, current)])
            if best is not None:
                return self.prune(best.fit)
        return None

    def _is_better(self, other: Judged, current: PathFit) -> bool:
        """Whether a model is accepted, more likely than another one, and raises no error beyond chance."""
        if other.refusal or other.cost >= find_cost(current) - EQUAL:
            return False
        _, rise, _ = _compare_horizons(current.horizon_errors, other.fit.horizon_errors)
        return rise <= _RISE

    @property
    def _least_t(self) -> float:
        return math.sqrt(LEAST_T**2 + 2.0 * math.log(self.shapes))

    def _judge(self, base: PathFit, fit: PathFit, *, is_final: bool) -> Judged:
        small = self._list_small(fit, base.ids)
        named = set(fit.ids) - set(base.ids) - {one.id for one in small}
        if small and named:
            # What is too small for a name has none, and keeps what comes with it from none. It stays as it
            # is beside that: fitted without, it would spread the trace of what shows but once.
            held = [one.fix(*one.values) for one in small]
            base = self.fit(fit.state.drop(named).add(*held))
        return judge(base, fit, self.conditions, self._least_t, is_final=is_final)

    def _list_small(self, fit: PathFit, known: Collection[str] = ()) -> list[Effect]:
        """Effects of a model, but for the known ones, that only their size keeps from a name."""
        new = (effect for effect in fit.state.effects if effect.id not in known)
        return [
            one for one in new if all(is_too_small(each, self.conditions) for each in _list_acting(fit, one))
        ]

    def _is_fine(self, judged: Judged) -> bool:
        """Whether a model is accepted, or refused for the size of its new effects alone."""
        small = self._list_small(judged.fit, judged.base.ids)
        return not judged.refusal or (bool(small) and len(small) == len(judged.added))

    def fit(self, state: ModelState, most: float = math.inf, noise: Noise | None = None) -> PathFit:
        """The fit from a state; made once, unless it ended early as it cannot cost less than `most`."""
        key = _make_key(state)
        if key in self._fits:
            return self._fits[key]
        target = most - _find_price(state, len(self.path.list_free(state)))
        fit = fit_path(self.path, state, noise=noise, target=target)
        if find_cost(fit) < most:
            self._fits[key] = fit
        return fit

    def _drop(self, fit: PathFit, names: Collection[str]) -> PathFit:
        return self.fit(fit.state.drop(names))

    def screen(self, fit: PathFit, without: Collection[str] = ()) -> Screen:
        """What could be added to a model; special cases of its effects are in it already."""
        known = set(without).union(*({*effect.contains} for effect in fit.state.effects))
        acting = [one for one in self.candidates if one.id not in known and one().acts_in(fit.ids)]
        return Screen(fit, acting, self.conditions.largest)

    def _extend(self, current: PathFit) -> list[Judged]:
        """Extensions of a model, accepted or refused."""
        if len(current.ids) - len(self.given) >= _MOST_EFFECTS:
            return []
        return self._judge_extensions(current, self.screen(current), _SINGLES, _PAIRS)

    def _judge_extensions(
        self,
        base: PathFit,
        screen: Screen,
        singles: int,
        pairs: int,
        wanted: float = 0.0,
        reached: float = math.inf,
    ) -> list[Judged]:
        """The most promising extensions of a model, fitted and judged.

        Args:
            base: the model.
            screen: what they promise.
            singles: most that are by one effect and better than none.
            pairs: most that are by two.
            wanted: expected gain, less price, that they must exceed.
            reached: cost of the model that they would replace.
        """
        judged, before, rough = dict[tuple[str, ...], Judged](), find_cost(base), list[PathFit]()
        most, reached = min(before, reached + EQUAL), min(before, reached)
        for extensions, places in ((screen.list_singles(), singles), (screen.list_pairs(), pairs)):
            # Some steps show which may come near the best, and which keep nothing of what they promise.
            for extension in extensions[: _TRIED * places]:
                if not places or not extension.net > wanted:
                    break
                rough.append(approach(base, extension.add_to(base.state), screen.saturated.noise))
                places -= find_cost(rough[-1]) < before  # noqa: PLW2901
        expected = [(find_cost(one) - one.expected_fall, one) for one in rough]
        for cost, start in sorted(expected, key=lambda pair: pair[0]):
            if cost > reached + EQUAL + _NEAR * (before - reached):
                break
            fit = self._reduce(self.fit(start.state, most, start.noise), base)
            if set(fit.ids) == set(base.ids):
                continue
            one = self._judge(base, fit, is_final=False)
            if fit.ids not in judged or one.cost < judged[fit.ids].cost:
                judged[fit.ids] = one
            if not one.refusal:
                reached = min(reached, one.cost)
        return list(judged.values())

    def _reduce(self, fit: PathFit, base: PathFit) -> PathFit:
        """The fit with the simpler form of a new effect that has become one, and without idle old ones."""
        for effect in fit.state.effects:
            if effect.id in self.given or is_nameable(effect, self.conditions):
                continue
            simpler = effect.collapse() if effect.is_degenerate(self.conditions) else None
            known = {one.id for one in self.candidates} - set(fit.ids)
            if simpler is not None and simpler.id in known:
                return self._reduce(self.fit(fit.state.drop([effect.id]).add(simpler)), base)
            # A number of several that the driving leaves free may end anywhere: it is held at none.
            free = [p for p in effect.parameters if p.name not in effect.fixed and math.isfinite(p.neutral)]
            loose = {p.name: p.neutral for p in list_implausible(effect) if p in free}
            least = [p for p in free if p.least is not None]
            if loose and len(loose) < len(least):
                held = effect.change(**loose).fix(*loose)
                return self._reduce(self.fit(fit.state.add(held)), base)
            if effect.id in base.ids:
                # An effect that another one makes superfluous goes with it.
                return self._reduce(self._drop(fit, [effect.id]), base)
        return fit

    def prune(self, fit: PathFit) -> PathFit:
        """The model without effects that its others have made superfluous, the least evident first."""
        while True:
            free = [effect for effect in fit.state.effects if effect.id not in self.given]
            weak = [one for effect in free if (one := (measure_t(fit, effect), effect.id))[0] < self._least_t]
            if not weak:
                return fit
            fit = self._drop(fit, [min(weak)[1]])

    def refuse(self, fit: PathFit) -> tuple[PathFit, dict[str, Judged]]:
        """The model without effects that are not accepted beside its others, and how each was judged.

        Effects whose numbers are correlated are judged together, too: one may only undo what the other does.
        """
        while True:
            groups = self._list_groups(fit)
            alone = {names[0]: self._judge_last(fit, names) for names in groups if len(names) == 1}
            refused = [one for one in alone.values() if one.refusal]
            if not refused:
                pairs = (self._judge_last(fit, names) for names in groups if len(names) > 1)
                refused = [one for one in pairs if one.refusal]
            if not refused:
                simpler = self._simplify(fit)
                if simpler is None:
                    return fit, alone
                fit = simpler
            while refused:
                # The least gain goes first; without it the next may be accepted.
                least = min(refused, key=lambda one: (float(np.nan_to_num(one.gain)), one.added))
                fit = self._drop(fit, least.added)
                others = [one.added for one in refused if not set(one.added) & set(least.added)]
                refused = [one for names in others if (one := self._judge_last(fit, names)).refusal]

    def _restore(
        self, fit: PathFit, judged: dict[str, Judged], extended: PathFit
    ) -> tuple[PathFit, dict[str, Judged]]:
        """The model with what was refused beside effects that went after it, and is accepted without them."""
        gone = [effect for effect in extended.state.effects if effect.id not in fit.ids]
        for _ in gone:
            tried = (self.fit(fit.state.add(one)) for one in gone if one.id not in fit.ids)
            others = [self._judge(fit, one, is_final=True) for one in tried]
            best = min((one for one in others if not one.refusal), key=lambda one: one.cost, default=None)
            if best is None or not best.cost < find_cost(fit) - EQUAL:
                break
            fit, judged = self.refuse(best.fit)
        return fit, judged

    def _simplify(self, fit: PathFit) -> PathFit | None:
        """The model with a special case in the place of what is not accepted, or not surely, beyond it."""
        for effect in fit.state.effects:
            taken = {effect.id, *self.given, *fit.ids}
            cases = [one for one in self.candidates if one.id in effect.contains and one.id not in taken]
            if effect.id in self.given or not cases:
                continue
            without = self._drop(fit, [effect.id])
            for start in Screen(without, cases, self.conditions.largest).list_singles():
                simpler = self.fit(start.add_to(without.state))
                judged = self._judge(simpler, fit, is_final=True)
                if judged.refusal or judged.frequency < _SURE:
                    return simpler
        return None

    def _judge_last(self, fit: PathFit, names: Collection[str]) -> Judged:
        """How effects of the last model are judged against the model without them."""
        return self._judge(self._drop(fit, names), fit, is_final=True)

    def _list_groups(self, current: PathFit) -> list[tuple[str, ...]]:
        """Effects that may stand for others: each, and each two whose numbers the data hardly separate."""
        free = [name for name in current.ids if name not in self.given]
        size = np.sqrt(np.maximum(np.diag(current.covariance), 1e-300))
        alike = np.abs(current.covariance / np.outer(size, size)) > _ALIKE
        pairs = {
            tuple(sorted((current.free[one].effect, current.free[other].effect)))
            for one, other in zip(*np.nonzero(np.triu(alike, 1)), strict=True)
        }
        return [*((name,) for name in free), *(two for two in combinations(sorted(free), 2) if two in pairs)]

    def list_rivals(self, current: PathFit, without: PathFit, names: Sequence[str]) -> list[Judged]:
        """Models with other effects in the place of some, judged against the one with neither; made once."""
        key = (_make_key(current.state), *names, self.given)
        if key not in self._rivals:
            screen = self.screen(without, names)
            own = without.score - current.score
            wanted = 0.3 * own - PRICE * len(names)
            self._rivals[key] = self._judge_extensions(without, screen, 4, 1, wanted, find_cost(current))
        return self._rivals[key]

    def replaces(self, current: PathFit, other: Judged, margin: float = 0.0) -> bool:
        """Whether other effects do what one of a model does, and not only something else.

        Beside them it adds nothing then, and no part of them beside it is as good as they are.

        Args:
            current: the model.
            other: the others in the place of one of its effects.
            margin: by how much they must be better than each of them beside it.
        """
        new = [effect for effect in other.fit.state.effects if effect.id not in current.ids]
        if find_cost(self.fit(current.state.add(*new))) < other.cost - EQUAL:
            return False
        parts = new if len(new) > 1 else []
        return all(find_cost(self.fit(current.state.add(one))) > other.cost + margin for one in parts)

    def _try_whole(self, current: PathFit, candidate: Candidate) -> PathFit | None:
        """The model with an effect in the place of its special cases and companions, where it is better."""
        effect = candidate()
        cases = [name for name in current.ids if name in (*effect.contains, *effect.companions)]
        cases = [name for name in cases if name not in self.given]
        if not effect.contains or not (cases or effect.starts) or candidate.id in current.ids:
            return None
        base, most = self._drop(current, cases), find_cost(current) - EQUAL
        # Some steps show whether it may come near what its special cases explain.
        rough = self._approach_all(base, candidate, current.noise)
        near = most + EQUAL + _NEAR * (find_cost(base) - find_cost(current))
        fits = [self.fit(one.state, most, one.noise) for one in rough if find_cost(one) < near]
        fit = min(fits, key=find_cost, default=base)
        if find_cost(fit) > most:
            return None
        judged = self._judge(base, fit, is_final=False)
        return None if judged.refusal else self.prune(fit)

    def _approach_all(self, base: PathFit, candidate: Candidate, noise: Noise) -> list[PathFit]:
        """Some steps of the model with a candidate, from the better half of its starts."""
        values = list_starts(candidate, self.conditions.largest)
        return approach_each(base, [base.state.add(candidate(**one)) for one in values], noise)

    def _try_beside(self, current: PathFit, candidate: Candidate) -> PathFit | None:
        """The model with a companion of its effects, where it is better.

        What a limit of the command promises to first order says nothing beside a servo, all of whose numbers
        change with it.
        """
        if candidate.id in current.ids or not candidate().acts_in(current.ids):
            return None
        most = find_cost(current) - EQUAL
        best = min(self._approach_all(current, candidate, current.noise), key=find_cost, default=None)
        if best is None:
            return None
        fit = self._reduce(self.fit(best.state, most, best.noise), current)
        judged = self._judge(current, fit, is_final=False)
        is_better = judged.added and not judged.refusal and judged.cost < most
        return self.prune(fit) if is_better else None


def _make_key(state: ModelState) -> tuple[object, ...]:
    """What two equal states have in common."""
    return (*((effect.key, effect.fixed) for effect in state.effects), repr(state.own))


def _choose(judged: Sequence[Judged]) -> Judged | None:
    """Of models within `EQUAL` of the best, that with fewest numbers; None of none."""
    least = min((one.cost for one in judged), default=math.inf)
    near = [one for one in judged if one.cost < least + EQUAL]
    return min(near, key=lambda one: (one.fit.numbers, one.cost), default=None)


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
    base: PathFit, fit: PathFit, conditions: Conditions, least_t: float = LEAST_T, *, is_final: bool = True
) -> Judged:
    """Accept an extension of a model, or say why not.

    Both are judged by the noise of the larger model: that of the smaller one would hide what it lacks.

    Args:
        base: the smaller model.
        fit: the larger one.
        conditions: what the runs can show.
        least_t: standard errors that each new effect must be from none.
        is_final: whether the larger model is the last one. On the way there, errors may rise until what comes
            next is in, and a fall of half as much is enough.
    """
    added = tuple(name for name in fit.ids if name not in base.ids)
    new = [effect for effect in fit.state.effects if effect.id in added]
    for effect in new:
        wrong = _refuse_numbers(base, fit, effect, conditions, least_t, is_final=is_final)
        if wrong:
            return Judged(base, fit, added, f"{effect.id}: {wrong}")
    path, noise = fit.path, fit.noise
    costs = [list_costs(path, noise, one.held_out) for one in (base, fit)]
    gain = 1.0 - float(costs[1].sum()) / max(float(costs[0].sum()), 1e-300)
    own = list_costs(path, noise, base.residual) - list_costs(path, noise, fit.residual)
    by_unit = np.asarray(np.bincount(path.unit, own), dtype=np.float64)
    stable = math.sqrt(max(float(by_unit.sum() - by_unit.max()), 0.0))
    falls, rise, risen = _compare_horizons(base.horizon_errors, fit.horizon_errors)
    most = float(np.nanmax(falls, initial=0.0))
    refusal = ""
    if not gain > 0.0:
        refusal = "the held-out error does not fall"
    elif stable < STABLE_T:
        refusal = "ten seconds bring it all"
    elif (is_final and rise > _RISE) or float(np.nanmin(falls, initial=0.0)) < -most:
        refusal = f"the error {risen} rises"
    elif most < (SHOWN if is_final else SHOWN / 2.0):
        refusal = f"no error falls by more than {format_share(most)}"
    elif not _is_material(path, base.residual - fit.residual):
        refusal = "nobody would notice it"
    sums = [np.bincount(path.block, cost) for cost in costs]
    draws = np.random.default_rng(0).integers(0, sums[0].size, (_DRAWS, sums[0].size))
    frequency = float(np.mean(sums[1][draws].sum(axis=1) < sums[0][draws].sum(axis=1)))
    return Judged(base, fit, added, refusal, gain, frequency, by_unit, falls)


def _refuse_numbers(
    base: PathFit, fit: PathFit, effect: Effect, conditions: Conditions, least_t: float, *, is_final: bool
) -> str:
    """Why an effect's numbers do not allow a name, empty where they do; see `judge`."""
    if not any(is_nameable(one, conditions) for one in _list_acting(fit, effect)):
        return "its values are not possible"
    t = measure_t(fit, effect, base)
    if t < least_t:
        return f"t = {t:.1f}"
    if is_final and measure_t(fit, effect, base, find_covariance(fit)) < NORMAL_95:
        return "its interval holds no effect"
    return ""


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


def _compare_horizons(
    before: Sequence[HorizonError], after: Sequence[HorizonError]
) -> tuple[Floats, float, str]:
    """Relative falls of errors, shape (4, 2), the largest rise beyond chance, and where one rises most."""
    falls, rise, risen = np.full((len(HORIZONS_S), 2), math.nan), 0.0, ""
    least_p, largest = _RISEN / falls.size, 0.0
    for index, (old, new, horizon) in enumerate(zip(before, after, HORIZONS_S, strict=True)):
        for channel, name in enumerate(("position", "heading")):
            one, other = getattr(old, name), getattr(new, name)
            if not one.size or not one.mean() > 0.0:
                continue
            fall = falls[index, channel] = 1.0 - math.sqrt(float(other.mean() / one.mean()))
            if -fall > largest:
                length = "a whole stretch" if math.isinf(horizon) else f"{horizon:g} s"
                largest, risen = -fall, f"in {name} over {length}"
            if -fall > rise and _find_chance(other - one, old.block) < least_p:
                rise = -fall
    return falls, rise, risen


def _find_chance(rises: Floats, block: Ints) -> float:
    """Probability that the sums over blocks are as large as they are by chance, by Student's t."""
    sums = np.bincount(np.unique(block, return_inverse=True)[1], rises)
    if sums.size == 1:
        return 1.0
    t = float(sums.mean()) * math.sqrt(sums.size) / max(float(sums.std(ddof=1)), 1e-300)
    return float(stdtr(sums.size - 1, -t))
