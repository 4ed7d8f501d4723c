"""Since when is a number another one: changes of level over dates."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core.arrays import Floats, Ints
from pipeline.core.numerics import student_quantile
from pipeline.fleet.levels import FEWEST_OF_SPREAD, Sample, make_sample, maximize_likelihood
from pipeline.fleet.rank_tests import CONFIDENCE, FEWER_DRAWS, LEVEL, TIE, check_values

# Orders beyond what the level takes, so that p can be below it.
_PER_LEVEL = 4.0
# Orders at a time, which bounds the memory.
_CHUNK = 2_000


@dataclass(frozen=True)
class Change:
    """A step in a series.

    Attributes:
        index: first value of the new level.
        before: mean from the step before (or the start) to this one.
        after: mean from here to the next step (or the end).
        p: how often the largest step of the same values in random order is as large.
    """

    index: int
    before: float
    after: float
    p: float


def find_changes(
    values: ArrayLike, *, level: float = LEVEL, fewest: int = FEWEST_OF_SPREAD, seed: int = 0
) -> tuple[Change, ...]:
    """Split a series where its mean steps, as long as the step is more than chance.

    The best split is the one with the largest weighted difference of means; its p comes from the largest
    split of the same values in random order, so that looking everywhere is paid for. Then each side is
    searched in turn with half the level (binary segmentation). Sources: Scott and Knott, Biometrics 30
    (1974); for the permutation Matteson and James, Journal of the American Statistical Association 109
    (2014).

    Args:
        values: one a run, in the order of time, shape (n,).
        level: chance of finding a step where there is none.
        fewest: runs that a level must have.
        seed: of the random orders.

    Returns:
        The changes in the order of time; empty where there are fewer than twice ``fewest`` values.

    Raises:
        StatisticsError: a value is not finite.
    """
    series = check_values(values, what="values of the series", fewest=0)
    changes = sorted(_split(series, 0, series.size, level, fewest, np.random.default_rng(seed)))
    edges = [0, *(index for index, _ in changes), series.size]
    means = [float(series[start:end].mean()) for start, end in itertools.pairwise(edges) if changes]
    return tuple(
        Change(index=index, before=means[i], after=means[i + 1], p=p) for i, (index, p) in enumerate(changes)
    )


def _split(
    series: Floats, start: int, end: int, level: float, fewest: int, generator: np.random.Generator
) -> list[tuple[int, float]]:
    piece = series[start:end]
    if piece.size < 2 * fewest or float(np.ptp(piece)) == 0.0:
        return []
    observed = _weigh_splits(piece[None, :], fewest)[0]
    draws = max(FEWER_DRAWS, round(_PER_LEVEL / level))
    least = float(observed.max()) * (1.0 - TIE)
    as_large = 1
    for done in range(0, draws, _CHUNK):
        orders = generator.permuted(np.tile(piece, (min(_CHUNK, draws - done), 1)), axis=1)
        as_large += int(np.count_nonzero(_weigh_splits(orders, fewest).max(axis=1) >= least))
        # However the rest turns out, it is chance.
        if as_large / (draws + 1) > level:
            return []
    middle = start + fewest + int(observed.argmax())
    return [
        *_split(series, start, middle, level / 2.0, fewest, generator),
        (middle, as_large / (draws + 1)),
        *_split(series, middle, end, level / 2.0, fewest, generator),
    ]


def _weigh_splits(rows: Floats, fewest: int) -> Floats:
    """Weighted difference of means at each split that leaves ``fewest`` a side, shape (rows, splits)."""
    count = rows.shape[1]
    before = np.arange(fewest, count - fewest + 1, dtype=np.float64)
    sums = np.cumsum(rows - rows.mean(axis=1, keepdims=True), axis=1)[:, fewest - 1 : count - fewest]
    weighted: Floats = np.abs(sums) * np.sqrt(count / (before * (count - before)))
    return weighted


# Since when is a number another one? Changes of level over dates, whatever ground each run was on.
#
#     y_r = mu_g(r) + sum_j d_j [r >= t_j] + b_r + e_r,    b ~ N(0, run spread^2),  var e_r known
#
# The model of `levels` with a mean for each group, and steps that all groups share. The step that explains
# most is taken; its p is how often the largest step of drawn runs without any explains as much, by the F
# ratio, which needs no scale to be known: looking everywhere is paid for, and few runs need a large step.
# Then the next one is looked for beside it. Sources: Worsley, Journal of the American Statistical Association
# 74 (1979), for the largest of all splits; Barnard, Technometrics 5 (1963), for p by drawing.

FEWEST_FREE = 2
"""Degrees of freedom that runs must leave beside their groups and one step: four runs of one group do."""
_SHIFT_DRAWS = 4_999
"""Drawn runs without a step: p = 0.05 is then known to a standard error of 0.003."""
_MOST = 3
"""Steps of a series: more is no step but a trend."""
# A step that the groups explain to this part of its size cannot be told from them.
_RANK_TOLERANCE = 1e-6
# Spreads between runs on a grid, as parts of the scatter of all values.
_SPREADS = np.geomspace(1e-2, 3.0, 32)


@dataclass(frozen=True)
class Shift:
    """A change of level.

    Attributes:
        index: first value of the new level.
        earliest, latest: between which that value is, at 95 %.
        before, after: level on average over the groups of all values.
        p: chance of as large a step anywhere where there is none.
    """

    index: int
    earliest: int
    latest: int
    before: float
    after: float
    p: float


@dataclass(frozen=True)
class ShiftSearch:
    """What became of a search.

    Attributes:
        shifts: in the order of time.
        level: expected value of each, shape (n,).
        half: half of the width within which all n lie around it, at 95 % together, shape (n,); NaN where the
            values leave no freedom.
        freedom: degrees of freedom beside the groups and one step; below `FEWEST_FREE` nothing was tested.
        least: smallest further step that would be told where it is told best; infinite where none would be.
    """

    shifts: tuple[Shift, ...]
    level: Floats
    half: Floats
    freedom: int
    least: float


def find_shifts(
    values: ArrayLike, errors: ArrayLike, groups: Sequence[str], *, level: float = 0.05, seed: int = 0
) -> ShiftSearch:
    """Fit the model above, with at most three steps.

    Args:
        values: one number a run, in the order of time, shape (n,), n >= 1.
        errors: standard deviations of the numbers, shape (n,), positive.
        groups: label of each run's group, n of them.
        level: chance of finding a step where there is none.
        seed: of the draws.

    Raises:
        StatisticsError: as of `split_levels`.
    """
    sample, names = make_sample(values, errors, groups)
    member = np.eye(len(names))[sample.group]
    rng = np.random.default_rng(seed)
    taken: dict[int, tuple[int, int, float]] = {}
    while True:
        scan = _Scan.make(sample, member, sorted(taken))
        # A step beside others was looked for where they left most: it must be rarer.
        share = level / (1 + len(taken))
        p, limit = scan.ask(rng, share)
        if p > share or len(taken) == _MOST:
            break
        taken[scan.best] = (*scan.bound(), p)
    places = sorted(taken)
    fitted, sizes, half = scan.fit()
    steps = np.concatenate(([0.0], np.cumsum(sizes)))
    base = float(np.mean(fitted - steps[np.searchsorted(places, np.arange(fitted.size), side="right")]))
    shifts = tuple(
        Shift(index, *taken[index][:2], base + float(steps[i]), base + float(steps[i + 1]), taken[index][2])
        for i, index in enumerate(places)
    )
    return ShiftSearch(shifts, fitted, half, scan.freedom, math.sqrt(limit) * scan.grain)


def guess_shift(values: ArrayLike, errors: ArrayLike, groups: Sequence[str]) -> int:
    """First value of the new level where the largest step is, real or not; zero where none can be."""
    sample, names = make_sample(values, errors, groups)
    return _Scan.make(sample, np.eye(len(names))[sample.group], []).best


@dataclass(frozen=True)
class _Scan:
    """All steps that could be added to a design.

    Attributes:
        within: the values, those of one level as a group.
        y: values by their deviations, shape (n,).
        root: one over the deviations, shape (n,).
        design: groups, then steps that are there, by deviations, shape (n, k).
        basis: the same, orthonormal, shape (n, rank).
        groups: how many of its columns are groups.
        steps: unit vectors of steps beside the design, shape (n, m); `places` their first values, (m,).
        norms: sizes of those vectors before, shape (m,).
    """

    within: Sample
    y: Floats
    root: Floats
    design: Floats
    groups: int
    basis: Floats
    steps: Floats
    places: Ints
    norms: Floats

    @classmethod
    def make(cls, sample: Sample, member: Floats, there: Sequence[int]) -> _Scan:
        """With the spread between runs that is likely under the design."""
        order = np.arange(sample.y.size)
        after = (order[:, None] >= np.array(there, dtype=np.int64)[None, :]).astype(np.float64)
        period = after.sum(axis=1).astype(np.int64)
        _, groups = np.unique(sample.group * (len(there) + 1) + period, return_inverse=True)
        within = Sample(sample.y, sample.known, groups, int(groups.max()) + 1)
        run = maximize_likelihood(within, common=False)[1]
        root = 1.0 / np.sqrt(sample.known + run)
        design = root[:, None] * np.concatenate((member, after), axis=1)
        vectors, singular, _ = np.linalg.svd(design, full_matrices=False)
        basis = vectors[:, singular > _RANK_TOLERANCE * singular[0]]
        raw = root[:, None] * (order[:, None] >= order[None, 1:])
        steps = raw - basis @ (basis.T @ raw)
        norms = np.linalg.norm(steps, axis=0)
        independent = norms > _RANK_TOLERANCE * float(np.linalg.norm(root))
        return cls(
            within,
            root * sample.y,
            root,
            design,
            member.shape[1],
            basis,
            steps[:, independent] / norms[independent],
            order[1:][independent],
            norms[independent],
        )

    @property
    def freedom(self) -> int:
        """Degrees of freedom beside the design and one more step."""
        return int(self.y.size - self.basis.shape[1] - 1)

    @property
    def best(self) -> int:
        """First value after the step that explains most; zero where no step can be."""
        if not self.places.size:
            return 0
        index = int(np.argmax(self._weigh(self.y[None, :])[0][0]))
        return int(self.places[index])

    @property
    def grain(self) -> float:
        """Deviation of the size of the step that is told best."""
        if not self.places.size or self.freedom < FEWEST_FREE:
            return math.inf
        explained, whole = self._weigh(self.y[None, :])
        scale = (float(whole[0]) - float(explained.max())) / self.freedom
        return math.sqrt(max(scale, 0.0)) / float(self.norms.max())

    def ask(self, rng: np.random.Generator, level: float) -> tuple[float, float]:
        """Chance of a step as large where there is none, and the F ratio of chance `level`."""
        if not self.places.size or self.freedom < FEWEST_FREE:
            return 1.0, math.inf
        drawn = self._rate(rng.standard_normal((_SHIFT_DRAWS, self.y.size)) * self.draw_deviations(rng))
        limit = float(np.quantile(drawn, 1.0 - level))
        whole = self._weigh(self.y[None, :])[1]
        if float(whole[0]) <= 1e-18 * float(self.y @ self.y):
            return 1.0, limit
        seen = self._rate(self.y[None, :])[0]
        return (1 + int(np.count_nonzero(drawn >= seen))) / (_SHIFT_DRAWS + 1), limit

    def draw_deviations(self, rng: np.random.Generator) -> Floats:
        """Deviations of drawn values by those taken for true, as runs may scatter, shape (draws, n)."""
        size = float(np.sqrt(np.var(self.within.y) + self.within.known.mean()))
        spreads = size * _SPREADS
        # On a grid of equal ratios a flat density counts by its spread.
        score = np.log(spreads) - 0.5 * np.array([self.within.rate_within(one**2)[0] for one in spreads])
        chance = np.exp(score - score.max())
        spread = rng.choice(spreads, _SHIFT_DRAWS, p=chance / chance.sum())
        deviations: Floats = np.sqrt(self.within.known + spread[:, None] ** 2) * self.root
        return deviations

    def bound(self) -> tuple[int, int]:
        """Places around the best that explain hardly less: the sum of squares tells them apart by t."""
        explained, whole = self._weigh(self.y[None, :])
        residual = float(whole[0]) - explained[0]
        slack = student_quantile(CONFIDENCE, self.freedom) ** 2 / self.freedom
        near = self.places[residual <= (1.0 + slack) * residual.min()]
        return int(near.min()), int(near.max())

    def fit(self) -> tuple[Floats, Floats, Floats]:
        """Expected values, sizes of the steps that are there, and half of the width that holds all values."""
        solved: Floats = np.asarray(np.linalg.lstsq(self.design, self.y, rcond=None)[0], dtype=np.float64)
        fitted: Floats = self.design @ solved
        count, freedom = self.y.size, self.y.size - self.basis.shape[1]
        half: Floats = np.full(count, math.nan)
        if freedom > 0:
            scale = math.sqrt(float(np.sum((self.y - fitted) ** 2)) / freedom)
            half = student_quantile(1.0 - (1.0 - CONFIDENCE) / count, freedom) * scale / self.root
        level: Floats = fitted / self.root
        return level, solved[self.groups :], half

    def _weigh(self, rows: Floats) -> tuple[Floats, Floats]:
        """What each step explains of the squares of each row, and those squares: (rows, m), (rows,)."""
        rest = rows - (rows @ self.basis) @ self.basis.T
        explained: Floats = (rest @ self.steps) ** 2
        return explained, np.sum(rest**2, axis=1)

    def _rate(self, rows: Floats) -> Floats:
        """F ratio of the step that explains most, of each row."""
        explained, whole = self._weigh(rows)
        most = explained.max(axis=1)
        ratio: Floats = most * self.freedom / np.maximum(whole - most, 1e-300)
        return ratio
