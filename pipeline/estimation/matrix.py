"""The matrix of a model: what every set of effects near it would explain, to second order.

Columns are the model's residual, what changes when each of its effects is taken out, the derivatives of its
numbers, and what changes when each candidate is put in, at each of its starts: all as innovations of the
noise that no candidate explains. The cost of any set is a quadratic form of their Gram matrix.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.candidates import PRICE, find_rarity, list_all_trials
from pipeline.estimation.fit import invert, whiten_columns
from pipeline.estimation.model_state import stack_columns
from pipeline.models import Late

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence

    from pipeline.core import Floats, Ints
    from pipeline.estimation.candidates import Candidate, Trial
    from pipeline.estimation.fit import PathFit
    from pipeline.estimation.model_state import ModelState
    from pipeline.estimation.noise import Noise
    from pipeline.models import Largest

_INDEPENDENT = 0.02
"""Share of a column that the others of its set must leave."""
_RIDGE = 1e-6
"""Regularization of the cost of a set, columns of unit size."""
_SATURATED = 1e-3
"""Regularization of the fit of all candidates at once, columns of unit size."""
_PASSES = 2
"""Times that the noise is learned from what no candidate explains."""
_PAIRED = 16
"""Candidates that are combined in pairs."""
_BESIDE = 5
"""Best single moves that are looked at beside the sets on the way to the best one."""
_FALL = 1.0
"""Fall of the cost that is worth a move."""
_SHARES = (0.1, 2.0)
"""Least and most of a start that a secant of one number may promise."""
_CLAMPED = 4
"""Rounds in which numbers are held to their bounds."""


@dataclass(frozen=True)
class Move:
    """A set of effects, as what changes in a model.

    Attributes:
        gone: ids of effects that go.
        added: places of the trials that come, in order.
    """

    gone: frozenset[str] = frozenset()
    added: tuple[int, ...] = ()

    def drop(self, *names: str) -> Move:
        """The change with more effects gone."""
        return Move(self.gone.union(names), self.added)

    def add(self, *trials: int) -> Move:
        """The change with more trials."""
        return Move(self.gone, tuple(sorted((*self.added, *trials))))

    def without(self, *trials: int) -> Move:
        """The change without some trials."""
        return Move(self.gone, tuple(one for one in self.added if one not in trials))


class Matrix:
    """What sets of effects near a model would explain.

    Args:
        fit: the model.
        candidates: effects that could be added.
        largest: reference of relative starts.

    Attributes:
        fit: the model with the noise of what no candidate explains. That of its own residuals takes a slow
            hidden effect for a slow disturbance, and hides it.
        trials: starts of the candidates.
        without: residuals of the model without each of its effects, shape (n, 3), by id.
    """

    def __init__(self, fit: PathFit, candidates: Sequence[Candidate], largest: Largest) -> None:
        path, state = fit.path, fit.state
        self.trials = list_all_trials(fit, candidates, largest)
        self.without = {name: path.find_residuals(state.drop([name])) for name in fit.ids}
        drops = [residual - fit.residual for residual in self.without.values()]
        columns = [fit.residual[:, :, None], *([stack_columns(drops)] if drops else []), fit.columns]
        columns += [trial.columns for trial in self.trials]
        places = np.split(np.arange(sum(map(_width, columns))), np.cumsum([*map(_width, columns)])[:-1])
        self._places: list[Ints] = places[len(columns) - len(self.trials) :]
        # What takes the place of special cases does so wholly: its last column is no number.
        self._moved = [
            at[:-1] if one.replaces else at for one, at in zip(self.trials, self._places, strict=True)
        ]
        joined = np.concatenate(columns, axis=2)
        self._first = 1 + len(drops)
        self._dropped = {name: 1 + index for index, name in enumerate(fit.ids)}
        self._own: dict[str, list[int]] = {}
        for index in fit.smooth:
            self._own.setdefault(fit.free[index].effect, []).append(index)
        self.fit = self._learn_noise(fit, joined)
        white = whiten_columns(self.fit, joined)
        self._white: Floats = white / self._deviation
        self._gram: Floats = self._white.T @ self._white
        self._bounds = self._find_bounds()
        self._solved: dict[Move, tuple[float, Floats]] = {}

    @property
    def noise(self) -> Noise:
        """The noise of what no candidate explains."""
        return self.fit.noise

    @cached_property
    def _deviation(self) -> float:
        return math.sqrt(max(float(np.mean(self.fit.white.residual**2)), 1e-6))

    def _learn_noise(self, fit: PathFit, columns: Floats) -> PathFit:
        chosen = [*range(self._first, self._first + len(fit.free)), *self._list_best_columns(fit, columns)]
        for _ in range(_PASSES if len(chosen) > len(fit.free) else 0):
            white = whiten_columns(fit, columns[:, :, chosen])
            size = np.sqrt(np.einsum("ij,ij->j", white, white)) + 1e-12
            normal = (white / size).T @ (white / size) + _SATURATED * np.eye(size.size)
            step = np.linalg.solve(normal, (white / size).T @ fit.white.residual) / size
            fit = replace(fit, noise=fit.path.learn(fit.residual - columns[:, :, chosen] @ step, fit.noise))
        return fit

    def _list_best_columns(self, fit: PathFit, columns: Floats) -> list[int]:
        """Columns of the best start of each candidate, beside the model's numbers."""
        white, residual = whiten_columns(fit, columns[:, :, self._first :]), fit.white.residual
        count = len(fit.free)
        if count:
            basis = np.linalg.qr(white[:, :count] / (np.linalg.norm(white[:, :count], axis=0) + 1e-12))[0]
            white, residual = white - basis @ (basis.T @ white), residual - basis @ (basis.T @ residual)
        best: dict[str, tuple[float, Ints]] = {}
        for trial, places in zip(self.trials, self._places, strict=True):
            mine = white[:, places - self._first]
            pull = mine.T @ residual
            gain = float(pull @ invert(mine.T @ mine) @ pull)
            if gain > best.get(trial.effect.id, (-math.inf,))[0]:
                best[trial.effect.id] = gain, places
        return [column for _, places in best.values() for column in places.tolist()]

    def _find_bounds(self) -> tuple[Floats, Floats]:
        """Least and largest step of each column's number, infinite where none is known, shape (2, q)."""
        low, high = np.full(self._gram.shape[0], -math.inf), np.full(self._gram.shape[0], math.inf)
        for index, number in enumerate(self.fit.free):
            low[self._first + index], high[self._first + index] = self.fit.state.find_room(number)
        for trial, places in zip(self.trials, self._places, strict=True):
            for name, column in zip(trial.names, places.tolist(), strict=False):
                parameter, value = trial.effect.parameter(name), trial.effect.values[name]
                if math.isfinite(parameter.neutral):
                    low[column], high[column] = (bound - value for bound in parameter.bounds)
        return low, high

    def add(self, *trials: int, to: Move = Move()) -> Move:
        """A set with trials, in the place of what they replace."""
        return to.drop(*(name for index in trials for name in self.trials[index].replaces)).add(*trials)

    def name(self, change: Move) -> tuple[str, ...]:
        """Ids of the effects of a set."""
        stay = [name for name in self.fit.ids if name not in change.gone]
        return tuple(sorted([*stay, *(self.trials[index].effect.id for index in change.added)]))

    def find_price(self, change: Move) -> float:
        """What the numbers and unusual effects of a set must bring."""
        stay = [effect for effect in self.fit.state.effects if effect.id not in change.gone]
        ids = {*(effect.id for effect in stay)} | (set() if self._brings_dead_time(change) else {""})
        numbers = sum(number.effect in ids for number in self.fit.free)
        own = PRICE * numbers + sum(map(find_rarity, stay))
        return own + sum(self.trials[index].price for index in change.added)

    def measure(self, change: Move) -> float:
        """Expected cost of a set with its price; infinite where it cannot be."""
        return self._solve(change)[0]

    def expect_change(self, change: Move) -> float:
        """Expected change of the cost."""
        return self.measure(change) - self.measure(Move())

    def _list_columns(self, change: Move) -> Ints:
        ids = [name for name in self.fit.ids if name not in change.gone]
        ids += [] if self._brings_dead_time(change) else [""]
        own = [self._first + index for name in ids for index in self._own.get(name, ())]
        return np.array([*own, *(c for i in change.added for c in self._moved[i].tolist())], dtype=np.int64)

    def _brings_dead_time(self, change: Move) -> bool:
        """Whether a delay of the commands comes that takes over those of the encoders."""
        late = (self.trials[index].effect.late for index in change.added)
        return not self.fit.path.is_delayed and Late.COMMANDS in late

    def _aim(self, change: Move) -> Floats:
        """What the columns of a set must explain: the residual with what goes taken out, shape (q,)."""
        aim = np.zeros(self._gram.shape[0])
        whole = [index for index in change.added if self.trials[index].replaces]
        gone = change.gone.difference(*(self.trials[index].replaces for index in whole))
        aim[[0, *(self._dropped[name] for name in gone)]] = 1.0
        aim[[int(self._places[index][-1]) for index in whole]] = -1.0
        return aim

    def _solve(self, change: Move) -> tuple[float, Floats]:
        """Expected cost of a set, and the step of its columns."""
        if change not in self._solved:
            self._solved[change] = self._solve_anew(change)
        return self._solved[change]

    def _solve_anew(self, change: Move) -> tuple[float, Floats]:
        trials = [self.trials[index] for index in change.added]
        if any(self._is_in(one, change) for one in trials):
            return math.inf, np.zeros(0)
        columns, aim = self._list_columns(change), self._aim(change)
        pulled = self._gram @ aim
        cost = float(aim @ pulled) + self.find_price(change)
        if not columns.size:
            return cost, np.zeros(0)
        normal = self._gram[np.ix_(columns, columns)]
        size = np.sqrt(np.maximum(np.diag(normal), 1e-24))
        normal, pull = normal / np.outer(size, size) + _RIDGE * np.eye(size.size), pulled[columns] / size
        inverse = np.linalg.inv(normal)
        new = self._count_new(change)
        if new and (1.0 / np.diag(inverse)[-new:]).min() < _INDEPENDENT:
            return math.inf, np.zeros(0)
        scaled = self._hold(normal, pull, inverse @ pull, columns, size)
        step = scaled / size
        for trial, own in zip(trials, self._split(step, change), strict=True):
            if not trial.is_possible(own):
                return math.inf, step
        return cost - float(2.0 * scaled @ pull - scaled @ (normal @ scaled)), step

    def _is_in(self, trial: Trial, change: Move) -> bool:
        """Whether a trial contains what stays, or is a special case of what comes."""
        ids = self.name(change)
        others = (self.trials[index].effect for index in change.added)
        return bool({*trial.effect.contains} & {*ids}) or any(
            trial.effect.id in one.contains for one in others
        )

    def _hold(self, normal: Floats, pull: Floats, step: Floats, columns: Ints, size: Floats) -> Floats:
        """The step with numbers held to their bounds, the others adapted."""
        low, high = (bound[columns] * size for bound in self._bounds)
        held, moved = np.zeros(size.size, dtype=bool), step
        for _ in range(_CLAMPED):
            out = ~held & ((moved < low - 1e-9) | (moved > high + 1e-9))
            if not out.any():
                break
            held |= out
            moved = np.clip(moved, low, high)
            free = ~held
            if free.any():
                rest = pull[free] - normal[np.ix_(free, held)] @ moved[held]
                moved[free] = np.linalg.solve(normal[np.ix_(free, free)], rest)
        return np.clip(moved, low, high) if held.any() else moved

    def _count_new(self, change: Move) -> int:
        return sum(self._moved[index].size for index in change.added)

    def _split(self, step: Floats, change: Move) -> Iterator[tuple[float, ...]]:
        """The part of a step of each trial."""
        begin = step.size - self._count_new(change)
        for index in change.added:
            end = begin + self._moved[index].size
            yield tuple(step[begin:end].tolist())
            begin = end

    def list_states(self, change: Move) -> list[ModelState]:
        """The set at its expected values; where a number acts by a secant, also at the whole and at half."""
        step = self._solve(change)[1]
        state = self.fit.state.drop(change.gone) if change.gone else self.fit.state
        own = self._list_columns(change)[: step.size - self._count_new(change)] - self._first
        state = state.move([self.fit.free[index] for index in own.tolist()], step[: own.size].tolist())
        shares: list[dict[str, float]] = [{}, {}, {}]
        for index, mine in zip(change.added, self._split(step, change), strict=True):
            trial = self.trials[index]
            state = trial.add_to(state, mine)
            if trial.is_one_number:
                for each, share in zip(
                    shares, (min(max(mine[0], _SHARES[0]), _SHARES[1]), 1.0, 0.5), strict=True
                ):
                    each[trial.effect.id] = share
        if not shares[0]:
            return [state]
        made = []
        for each in shares:
            weakened = state
            for name, share in each.items():
                weakened = weakened.weaken({name}, share)
            made.append(weakened)
        return made

    @cached_property
    def _leading(self) -> list[Move]:
        """The best start of each candidate, the best candidate first; impossible ones last."""
        return self._pick(sorted(map(self.add, range(len(self.trials))), key=self.measure))

    def list_singles(self) -> list[Move]:
        """The best start of each candidate that is possible, the best candidate first."""
        return [one for one in self._leading if math.isfinite(self.measure(one))]

    def list_replacements(self, name: str) -> list[Move]:
        """The best start of each candidate in the place of an effect, the best candidate first."""
        changes = [self.add(index, to=Move().drop(name)) for index in range(len(self.trials))]
        first = self._pick(sorted(changes, key=self.measure))
        return [one for one in first if math.isfinite(self.measure(one))]

    def choose(
        self,
        given: Collection[str],
        banned: Collection[tuple[str, ...]] = (),
        excluded: Collection[str] = (),
    ) -> list[Move]:
        """Sets that promise less cost, the best first: those on the way of steepest moves, and others near.

        Args:
            given: ids of effects that stay.
            banned: names of sets that are not chosen.
            excluded: ids of effects that are in none.
        """
        start, now = self.measure(Move()), Move().drop(*{*self.fit.ids}.intersection(excluded))
        steps, seen = list[Move](), {now: None}
        while True:
            moves = dict.fromkeys(self._list_moves(now, given, excluded))
            seen |= moves
            best = min(moves, key=self.measure, default=now)
            if not self.measure(best) < self.measure(now) - _FALL:
                break
            now = best
            steps.append(now)
        paying = sorted((one for one in seen if self.measure(one) < start - _FALL), key=self.measure)
        single = [one for one in paying if len(one.gone) <= 1 and len(one.added) <= 1]
        chosen = self._pick((*steps, *self._pick(single)[:_BESIDE], *paying))
        return [one for one in chosen if self.name(one) not in banned]

    def _pick(self, changes: Iterable[Move]) -> list[Move]:
        """The first of each set."""
        first: dict[tuple[str, ...], Move] = {}
        for one in changes:
            first.setdefault(self.name(one), one)
        return list(first.values())

    def _list_moves(self, now: Move, given: Collection[str], excluded: Collection[str]) -> Iterator[Move]:
        """What one move makes of a set: drop, add, exchange, one for two, two, a whole for its parts."""
        ids = [trial.effect.id for trial in self.trials]
        stay = [name for name in self.fit.ids if name not in now.gone and name not in given]
        have, free = {ids[index] for index in now.added}, {*self.fit.ids}.difference(given)
        known = have.union(excluded)
        new = [i for i, one in enumerate(self.trials) if ids[i] not in known and one.replaces <= free]
        for index in now.added:
            rest = now.without(index)
            yield rest
            yield from (self.add(other, to=rest) for other in range(len(ids)) if ids[other] == ids[index])
            yield from (self.add(other, to=rest) for other in new)
        back = [name for name in self.fit.ids if name in now.gone and name not in excluded]
        yield from (Move(now.gone - {name}, now.added) for name in back)
        yield from (self.add(index, to=now) for index in new)
        for name in stay:
            yield now.drop(name)
            yield from (self.add(index, to=now.drop(name)) for index in new)
        for two in combinations(stay, 2):
            yield from (self.add(index, to=now.drop(*two)) for index in new)
        leading = [index for one in self._leading[:_PAIRED] for index in one.added]
        for pair in combinations(leading, 2):
            if not known & {ids[index] for index in pair} and all(
                self.trials[i].replaces <= free for i in pair
            ):
                yield self.add(*pair, to=now)
        for index in new:
            effect = self.trials[index].effect
            parts = [name for name in stay if name in effect.contains or name in effect.companions]
            if len(parts) > 1:
                yield self.add(index, to=now.drop(*parts))

    def sum_blocks(self, change: Move) -> Floats:
        """Expected cost of a set in each block, without price, shape (blocks,)."""
        columns, aim = self._list_columns(change), self._aim(change)
        aim[columns] -= self._solve(change)[1]
        block = self.fit.path.block[self.fit.white.rows]
        return np.asarray(np.bincount(block, (self._white @ aim) ** 2), dtype=np.float64)


def _width(columns: Floats) -> int:
    return int(columns.shape[2])
