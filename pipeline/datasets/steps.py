"""Changes of level over dates: of a series by permutation, of a parameter by steps of its levels."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core import CONFIDENCE, FEWEST_OF_SPREAD, Floats, Ints, student_quantile
from pipeline.datasets.levels import (
    Sample,
    make_sample,
    maximize_likelihood,
    rate_spreads,
)
from pipeline.datasets.rank_tests import LEVEL, TIE, check_values

_FEWEST_DRAWS = 1_999
"""Random orders: p = 0.05 is then known to a standard error of 0.005."""

# Permutations relative to the reciprocal of the level, so that p can be below it.
_PER_LEVEL = 4.0

# Permutations per batch, which bounds the memory.
_CHUNK = 2_000


@dataclass(frozen=True)
class Shift:
    """Change of level.

    Attributes:
        index: first value of the new level.
        earliest, latest: bounds of that index: 95 % of a parameter, one value on either side of a series.
        before, after: level before and after; of a parameter on average over the groups of all values.
        p: probability of a step as large anywhere without a change.
    """

    index: int
    earliest: int
    latest: int
    before: float
    after: float
    p: float


def find_changes(
    values: ArrayLike, *, level: float = LEVEL, fewest: int = FEWEST_OF_SPREAD, seed: int = 0
) -> tuple[Shift, ...]:
    """Split a series at its significant steps of the mean.

    The best split is the one with the largest weighted difference of means. Its p comes from the largest
    split of the same values in random order, which corrects for the search over all splits. Then each side is
    searched with half the level (binary segmentation). Sources: Scott and Knott, Biometrics 30
    (1974); for the permutation Matteson and James, Journal of the American Statistical Association 109
    (2014).

    Args:
        values: one value per run, in the order of time, shape (n,).
        level: probability of a false step.
        fewest: minimum number of runs of a level.
        seed: seed of the random orders.

    Returns:
        The changes in the order of time; empty if there are fewer than twice ``fewest`` values.

    Raises:
        StatisticsError: a value is not finite.
    """
    series = check_values(values, what="values of the series", fewest=0)
    changes = sorted(_split(series, 0, series.size, level, fewest, np.random.default_rng(seed)))
    edges = [0, *(index for index, _ in changes), series.size]
    means = [float(series[start:end].mean()) for start, end in itertools.pairwise(edges) if changes]
    last = series.size - 1
    return tuple(
        Shift(index, max(index - 1, 1), min(index + 1, last), means[i], means[i + 1], p)
        for i, (index, p) in enumerate(changes)
    )


def _split(
    series: Floats, start: int, end: int, level: float, fewest: int, generator: np.random.Generator
) -> list[tuple[int, float]]:
    piece = series[start:end]
    if piece.size < 2 * fewest or float(np.ptp(piece)) == 0.0:
        return []
    observed = _weigh_splits(piece[None, :], fewest)[0]
    draws = max(_FEWEST_DRAWS, round(_PER_LEVEL / level))
    least = float(observed.max()) * (1.0 - TIE)
    as_large = 1
    for done in range(0, draws, _CHUNK):
        orders = generator.permuted(np.tile(piece, (min(_CHUNK, draws - done), 1)), axis=1)
        as_large += int(np.count_nonzero(_weigh_splits(orders, fewest).max(axis=1) >= least))
        # Further draws cannot make the step significant.
        if as_large / (draws + 1) > level:
            return []
    middle = start + fewest + int(observed.argmax())
    return [
        *_split(series, start, middle, level / 2.0, fewest, generator),
        (middle, as_large / (draws + 1)),
        *_split(series, middle, end, level / 2.0, fewest, generator),
    ]


def _weigh_splits(rows: Floats, fewest: int) -> Floats:
    """Weighted difference of means at each split with at least ``fewest`` a side, shape (rows, splits)."""
    count = rows.shape[1]
    before = np.arange(fewest, count - fewest + 1, dtype=np.float64)
    sums = np.cumsum(rows - rows.mean(axis=1, keepdims=True), axis=1)[:, fewest - 1 : count - fewest]
    weighted: Floats = np.abs(sums) * np.sqrt(count / (before * (count - before)))
    return weighted


# Changes of level of a parameter over dates, with runs on any terrain.
#
#     y_r = mu_g(r) + sum_j d_j [r >= t_j] + b_r + e_r,    b ~ N(0, run spread^2),  var e_r known
#
# The model of `levels` with a mean for each group, and steps shared by all groups. The step with the largest
# explained sum of squares is selected. Its p is the share of simulated series without steps whose largest F
# ratio is as large; this corrects for the search, needs no known scale, and requires a large step for few
# runs. Then further steps are added. Sources: Worsley, Journal of the American Statistical Association 74
# (1979), for the largest of all splits; Barnard, Technometrics 5 (1963), for Monte Carlo p values.

FEWEST_FREE = 2
"""Minimum residual degrees of freedom beside groups and one step: four runs of one group suffice."""
_SHIFT_DRAWS = 4_999
"""Simulated series without a step: p = 0.05 is then known to a standard error of 0.003."""
_MOST = 3
"""Largest number of steps of a series: more than that is a trend."""

# A step with less than this relative part orthogonal to the groups cannot be separated from them.
_RANK_TOLERANCE = 1e-6

# Grid of spreads between runs, relative to the scatter of all values.
_SPREADS = np.geomspace(1e-2, 3.0, 32)


@dataclass(frozen=True)
class ShiftSearch:
    """Result of a search.

    Attributes:
        shifts: shifts in the order of time.
        level: expected value of each, shape (n,).
        half: half-width of the simultaneous 95 % band of all n values, shape (n,); NaN with fewer
            than two residual degrees of freedom.
        freedom: degrees of freedom beside the groups and one step; below `FEWEST_FREE` nothing was tested.
        least: smallest detectable further step at its best position; infinite if none is detectable.
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
        values: one estimate per run, in the order of time, shape (n,), n >= 1.
        errors: standard errors of the estimates, shape (n,), positive.
        groups: group label of each run, n of them.
        level: probability of a false step.
        seed: seed of the draws.

    Raises:
        StatisticsError: as for `split_levels`.
    """
    sample, names = make_sample(values, errors, groups)
    member = np.eye(len(names))[sample.group]
    rng = np.random.default_rng(seed)
    taken: dict[int, tuple[int, int, float]] = {}
    while True:
        scan = _Scan.make(sample, member, sorted(taken))
        # A further step is searched at the largest residual, so its level is lower.
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
    """First value after the largest step, significant or not; zero if no step is possible."""
    sample, names = make_sample(values, errors, groups)
    return _Scan.make(sample, np.eye(len(names))[sample.group], []).best


@dataclass(frozen=True)
class _Scan:
    """All steps that can be added to a design.

    Attributes:
        within: the values, grouped by level.
        y: values over their deviations, shape (n,).
        root: reciprocal deviations, shape (n,).
        design: columns of groups, then of existing steps, over the deviations, shape (n, k).
        basis: orthonormal basis of the design, shape (n, rank).
        groups: number of design columns that are groups.
        steps: unit vectors of steps orthogonal to the design, shape (n, m); `places` their starts, (m,).
        norms: norms of those vectors before scaling, shape (m,).
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
        """Build the scan with the maximum likelihood spread between runs under the design."""
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
        """Residual degrees of freedom beside the design and one more step."""
        return int(self.y.size - self.basis.shape[1] - 1)

    @property
    def best(self) -> int:
        """First value after the step that explains most; zero if no step is possible."""
        if not self.places.size:
            return 0
        index = int(np.argmax(self._weigh(self.y[None, :])[0][0]))
        return int(self.places[index])

    @property
    def grain(self) -> float:
        """Standard error of the size of the step that is determined best; of equal values by their errors."""
        if not self.places.size or self.freedom < FEWEST_FREE:
            return math.inf
        explained, whole = self._weigh(self.y[None, :])
        scale = (float(whole[0]) - float(explained.max())) / self.freedom
        return math.sqrt(1.0 if self._is_level(whole) else max(scale, 0.0)) / float(self.norms.max())

    def _is_level(self, whole: Floats) -> bool:
        """Whether the design leaves no more than rounding of the values."""
        return float(whole[0]) <= 1e-18 * float(self.y @ self.y)

    def ask(self, rng: np.random.Generator, level: float) -> tuple[float, float]:
        """Return p of the largest step, and the F ratio of probability `level`."""
        if not self.places.size or self.freedom < FEWEST_FREE:
            return 1.0, math.inf
        drawn = self._rate(rng.standard_normal((_SHIFT_DRAWS, self.y.size)) * self.draw_deviations(rng))
        limit = float(np.quantile(drawn, 1.0 - level))
        whole = self._weigh(self.y[None, :])[1]
        if self._is_level(whole):
            return 1.0, limit
        seen = self._rate(self.y[None, :])[0]
        return (1 + int(np.count_nonzero(drawn >= seen))) / (_SHIFT_DRAWS + 1), limit

    def draw_deviations(self, rng: np.random.Generator) -> Floats:
        """Ratios of simulated to assumed deviations over the posterior of the spread, shape (draws, n)."""
        size = float(np.sqrt(np.var(self.within.y) + self.within.known.mean()))
        spreads = size * _SPREADS
        # On a geometric grid a flat density is weighted by the spread.
        score = np.log(spreads) + rate_spreads(self.within, spreads)[2]
        chance = np.exp(score - score.max())
        spread = rng.choice(spreads, _SHIFT_DRAWS, p=chance / chance.sum())
        deviations: Floats = np.sqrt(self.within.known + spread[:, None] ** 2) * self.root
        return deviations

    def bound(self) -> tuple[int, int]:
        """95 % range of the step's position, from the increase of the residual sum of squares (t)."""
        explained, whole = self._weigh(self.y[None, :])
        residual = float(whole[0]) - explained[0]
        slack = student_quantile(CONFIDENCE, self.freedom) ** 2 / self.freedom
        near = self.places[residual <= (1.0 + slack) * residual.min()]
        return int(near.min()), int(near.max())

    def fit(self) -> tuple[Floats, Floats, Floats]:
        """Expected values, sizes of the existing steps, and half-width of the simultaneous band."""
        solved: Floats = np.asarray(np.linalg.lstsq(self.design, self.y, rcond=None)[0], dtype=np.float64)
        fitted: Floats = self.design @ solved
        count, freedom = self.y.size, self.y.size - self.basis.shape[1]
        half: Floats = np.full(count, math.nan)
        if freedom >= FEWEST_OF_SPREAD - 1:
            scale = math.sqrt(float(np.sum((self.y - fitted) ** 2)) / freedom)
            half = student_quantile(1.0 - (1.0 - CONFIDENCE) / count, freedom) * scale / self.root
        level: Floats = fitted / self.root
        return level, solved[self.groups :], half

    def _weigh(self, rows: Floats) -> tuple[Floats, Floats]:
        """Sum of squares explained by each step in each row, and the total: (rows, m), (rows,)."""
        rest = rows - (rows @ self.basis) @ self.basis.T
        explained: Floats = (rest @ self.steps) ** 2
        return explained, np.sum(rest**2, axis=1)

    def _rate(self, rows: Floats) -> Floats:
        """F ratio of the step that explains most, for each row."""
        explained, whole = self._weigh(rows)
        most = explained.max(axis=1)
        ratio: Floats = most * self.freedom / np.maximum(whole - most, 1e-300)
        return ratio
