"""The evidence of a recording for a model and for everything that could be added to it.

For ten-second stretches: the normal equations of the residuals, of the columns of the model's own numbers and
of those of every candidate, whitened and weighted. What one or two effects more would take off the residuals
follows from these small matrices; only what they promise is fitted.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Floats, Ints
from pipeline.core.parallel import map_parallel
from pipeline.estimation.noise import Noise, Tiles, learn_noise, tile_windows
from pipeline.identification.proposals import Candidate, leave_out_silent, list_trials

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pipeline.identification.fit import PartFit
    from pipeline.identification.parts import Part
    from pipeline.identification.state import State
    from pipeline.models.conditions import Largest
    from pipeline.models.effect import Effect

_RIDGE = 1e-6
_FOLDS = 10
_MOST_STEPS = 10
_CLIP = 6.0
_PAIRED = 16
"""Candidates that are looked at in pairs: the most promising ones."""
_STARTS = 2
"""Starts of each of them in pairs."""


@dataclass(frozen=True)
class Start:
    """A candidate at one of its starts.

    Attributes:
        effect: with its values there.
        own: those of each run alone, by run, of a clock that every run has of its own.
        places: of its columns in the evidence.
    """

    effect: Effect
    own: tuple[float, ...]
    places: tuple[int, ...]

    @property
    def numbers(self) -> int:
        """How many numbers a fit from there has: an effect that starts as a whole has one column for all."""
        free = (name for name, value in self.effect.values.items() if np.isfinite(value))
        return max(len(self.places), len(set(free) - self.effect.fixed))

    def add_to(self, state: State) -> State:
        """The state with the effect."""
        extended = state.add(self.effect)
        return extended.set_clocks(self.effect, self.own) if self.own else extended


@dataclass(frozen=True)
class Hypothesis:
    """One or two effects that could be added to a model.

    Attributes:
        starts: one of each effect.
        chi_square: that they promise to take off the innovations.
    """

    starts: tuple[Start, ...]
    chi_square: float

    @property
    def numbers(self) -> int:
        """How many numbers its fit has."""
        return sum(start.numbers for start in self.starts)


class Evidence:
    """Evidence for what a fitted model lacks on one part of the way.

    Args:
        part: of the way.
        fit: the model.
        candidates: effects that could be added.
        largest: what relative starts are shares of.
        noise: of the residuals where it is known.

    Attributes:
        noise: of the residuals that no candidate explains.
        starts: every candidate at every start.
        itself: chi-square that the effect which was left out promises itself; zero where none was.
    """

    itself: float = 0.0

    def __init__(
        self,
        part: Part,
        fit: PartFit,
        candidates: Sequence[Candidate],
        largest: Largest,
        noise: Noise | None = None,
    ) -> None:
        self.part, self.fit = part, fit
        tiles = tile_windows(part)
        absent = [candidate for candidate in candidates if fit.state.find(candidate.id) is None]
        own = fit.jacobian[tiles.rows]
        columns, starts, count = [own], list[Start](), 0
        for found in map_parallel(partial(_collect, part, fit, largest, tiles), absent):
            for effect, own_values, block in found:
                places = tuple(range(count, count + block.shape[2]))
                starts.append(Start(effect, own_values, places))
                columns.append(block)
                count += block.shape[2]
        self.starts = tuple(starts)
        self._own = own.shape[2]
        self.noise = noise or self._find_noise(tiles, np.concatenate(columns, axis=2))
        self._names = fit.state.ids
        columns += [
            (part.find_residuals(fit.state.drop([name])) - fit.residual)[tiles.rows, :, None]
            for name in self._names
        ]
        white = self.noise.whiten(np.concatenate((self._residual(tiles), *columns), axis=2))
        self._normal = _sum_normals(tiles.unit, self._weigh(white)).sum(axis=0)

    def _residual(self, tiles: Tiles) -> Floats:
        return self.fit.residual[tiles.rows, :, None]

    def _find_noise(self, tiles: Tiles, columns: Floats) -> Noise:
        """Noise of what the candidates together cannot predict of stretches that they were not fitted to.

        Columns are added one effect at a time as long as unseen stretches are predicted better. Channels in
        which that is of no use keep the model's own residuals.
        """
        factor = self.fit.weights.factors(self.fit.residual)[tiles.rows][:, :, None]
        rows = np.concatenate((self._residual(tiles), columns), axis=2) * factor
        size = np.sqrt((rows**2).sum(axis=(0, 1))) + 1e-300
        normals = _sum_normals(tiles.unit, rows / size)
        fold = np.arange(normals.shape[0]) % _FOLDS
        folds = np.array([normals[fold == number].sum(axis=0) for number in np.unique(fold)])
        groups = [[self._own + place for place in start.places] for start in self.starts]
        chosen = _choose_columns(folds, self._own, groups)
        residual = self.fit.residual[tiles.rows]
        held = residual.copy()
        stretch = np.unique(tiles.unit, return_inverse=True)[1]
        if chosen:
            places = np.array(chosen) + 1
            for number, left_out in enumerate(folds):
                normal = folds.sum(axis=0) - left_out
                step = _solve(normal, places) * size[0] / size[places]
                mine = stretch % _FOLDS == number
                held[mine] -= columns[mine][:, :, chosen] @ step
        for channel in range(held.shape[1]):
            if _clipped_rms(held[:, channel]) >= _clipped_rms(residual[:, channel]):
                held[:, channel] = residual[:, channel]
        return learn_noise(tiles, self.part.channels, held)

    @staticmethod
    def _weigh(white: Floats) -> Floats:
        """Whitened rows with Huber's weights of the residual, which is the first column."""
        size = np.abs(white[:, :, :1])
        weighed: Floats = white * np.sqrt(_CLIP / np.maximum(size, _CLIP))
        return weighed

    @cached_property
    def _projected(self) -> tuple[Floats, Floats]:
        """Normal matrix and pull of the candidates' columns beside the model's own numbers."""
        whole = self._normal
        size = np.sqrt(np.diag(whole)) + 1e-300
        size[0] = 1.0
        whole = whole / size / size[:, None]
        own, rest = slice(1, self._own + 1), slice(self._own + 1, None)
        normal, across, pull = whole[rest, rest], whole[rest, own], whole[rest, 0]
        if self._own:
            inner = whole[own, own] + _RIDGE * np.eye(self._own)
            solved = np.linalg.solve(inner, np.column_stack((across.T, whole[own, 0])))
            normal, pull = normal - across @ solved[:, :-1], pull - across @ solved[:, -1]
        return normal, pull

    def leave_out(self, name: str) -> Evidence:
        """The same evidence without the starts of one candidate."""
        fewer = copy(self)
        fewer.starts = tuple(start for start in self.starts if start.effect.id != name)
        return fewer

    def without(self, name: str) -> Evidence:
        """The evidence at the model without one of its effects, to first order."""
        mine = {1 + place for place, number in enumerate(self.fit.free) if number.effect == name}
        absence = self._normal.shape[0] - len(self._names) + self._names.index(name)
        # What the model without it leaves is the residual and what the effect takes off it.
        whole = self._normal.copy()
        whole[0] += whole[absence]
        whole[:, 0] += whole[:, absence]
        order = [place for place in range(whole.shape[0]) if place not in mine]
        order += sorted(mine)
        fewer = copy(self)
        fewer.__dict__.pop("_projected", None)
        fewer._normal = whole[np.ix_(order, order)]  # noqa: SLF001 - of its own kind
        fewer._own = self._own - len(mine)  # noqa: SLF001
        last = whole.shape[0] - 1 - self._own
        itself = [absence - 1 - self._own, *range(last, last + len(mine))]
        fewer.itself = fewer.promise(itself)
        return fewer

    def promise(self, places: Sequence[int]) -> float:
        """Chi-square that columns would take off the innovations, the model's own numbers fitted anew."""
        normal, pull = self._projected
        at = np.array(places)
        step = np.linalg.solve(normal[np.ix_(at, at)] + 1e-6 * np.eye(at.size), pull[at])
        return float(pull[at] @ step)

    def rank_singles(self, price: float) -> list[Hypothesis]:
        """The best start of every candidate, the most promising first.

        Args:
            price: chi-square that each number must be worth.
        """
        return [options[0] for options in self._rank_starts(price)]

    def rank_pairs(self, price: float) -> list[Hypothesis]:
        """Pairs of the most promising candidates, the best starts of each pair, the best pair first."""
        options = [one[:_STARTS] for one in self._rank_starts(price)[:_PAIRED]]
        pairs = [
            max(
                (self._join(one, other) for one in first for other in second),
                key=lambda pair: pair.chi_square - price * pair.numbers,
            )
            for first, second in combinations(options, 2)
        ]
        return sorted(pairs, key=lambda pair: price * pair.numbers - pair.chi_square)

    def _join(self, one: Hypothesis, other: Hypothesis) -> Hypothesis:
        starts = (*one.starts, *other.starts)
        return Hypothesis(starts, self.promise([place for start in starts for place in start.places]))

    def _rank_starts(self, price: float) -> list[list[Hypothesis]]:
        found: dict[str, list[Hypothesis]] = {}
        for start in self.starts:
            hypothesis = Hypothesis((start,), self.promise(start.places))
            found.setdefault(start.effect.id, []).append(hypothesis)

        def cost(one: Hypothesis) -> float:
            return price * one.numbers - one.chi_square

        return sorted((sorted(one, key=cost) for one in found.values()), key=lambda one: cost(one[0]))


def _collect(
    part: Part, fit: PartFit, largest: Largest, tiles: Tiles, candidate: Candidate
) -> list[tuple[Effect, tuple[float, ...], Floats]]:
    """Every start of a candidate with its columns at the tiles; numbers that leave no trace are held."""
    factor, found = fit.weights.factors(fit.residual), []
    for trial in list_trials(part, fit, candidate, largest):
        loud = leave_out_silent(trial, factor)
        if loud is None:
            continue
        columns = loud[0].columns[tiles.rows]
        if trial.shift.any():
            columns = np.concatenate((columns, trial.shift[tiles.rows][:, :, None]), axis=2)
        if np.isfinite(columns).all():
            found.append((loud[0].effect, trial.own, columns))
    return found


def _sum_normals(unit: Ints, rows: Floats) -> Floats:
    """Normal matrices of rows (k, c, m) by ten-second stretch, shape (b, m, m)."""
    edges = np.flatnonzero(np.diff(unit)) + 1
    pieces = (piece.reshape(-1, rows.shape[2]) for piece in np.split(rows, edges))
    return np.array([piece.T @ piece for piece in pieces])


def _solve(normal: Floats, places: Ints) -> Floats:
    """Coefficients of some columns for the residual, which is column 0."""
    inner = normal[np.ix_(places, places)] + _RIDGE * np.eye(places.size)
    return np.asarray(np.linalg.solve(inner, normal[places, 0]), dtype=np.float64)


def _choose_columns(folds: Floats, own: int, groups: Sequence[Sequence[int]]) -> list[int]:
    """Columns that predict unseen stretches best, added group by group to the model's own ones.

    Args:
        folds: normal matrices of the residual, as column 0, and of all columns, by fold, shape (f, m, m).
        own: how many columns the model's own numbers have: they come first.
        groups: columns of each candidate's start.
    """
    whole = folds.sum(axis=0)
    chosen = list(range(own))
    best, found = _cross_validate(folds, whole, chosen), chosen
    for places in _step_forward(whole, chosen, groups, min(_MOST_STEPS, max(folds.shape[0] - 2, 1))):
        chosen = [*chosen, *places]
        loss = _cross_validate(folds, whole, chosen)
        if loss < best:
            best, found = loss, chosen
    return found


def _step_forward(
    whole: Floats, chosen: list[int], groups: Sequence[Sequence[int]], steps: int
) -> Iterator[Sequence[int]]:
    """Groups of columns by what each takes off the residual beside those before it."""
    for _ in range(steps):
        at = np.array(chosen, dtype=np.int64) + 1
        inverse = np.linalg.inv(whole[np.ix_(at, at)] + _RIDGE * np.eye(at.size))
        pull = whole[:, 0] - whole[:, at] @ (inverse @ whole[at, 0])
        best, group = 0.0, None
        for places in groups:
            if set(places) & set(chosen):
                continue
            mine = np.array(places) + 1
            across = whole[np.ix_(mine, at)]
            normal = whole[np.ix_(mine, mine)] - across @ inverse @ across.T + 1e-4 * np.eye(mine.size)
            gain = float(pull[mine] @ np.linalg.solve(normal, pull[mine])) / mine.size
            if gain > best:
                best, group = gain, places
        if group is None:
            return
        chosen = [*chosen, *group]
        yield group


def _cross_validate(folds: Floats, whole: Floats, chosen: Sequence[int]) -> float:
    """Squared residual of every fold under coefficients from the others, over all of it."""
    at = np.array(chosen, dtype=np.int64) + 1
    total = 0.0
    for fold in folds:
        total += float(fold[0, 0])
        if at.size:
            step = _solve(whole - fold, at)
            total += float(step @ fold[np.ix_(at, at)] @ step - 2.0 * step @ fold[at, 0])
    return total


def _clipped_rms(values: Floats) -> float:
    limit = _CLIP * 1.4826 * float(np.median(np.abs(values))) + 1e-12
    return float(np.sqrt(np.mean(np.minimum(np.abs(values), limit) ** 2)))
