"""Statistics of ranks: shift and Cliff's delta, the Mann-Whitney test, Kendall's tau and swaps of order."""

import math

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core.arrays import Floats
from pipeline.fleet.statistics.arrays import check_values

_WORDS = ((0.147, "negligible"), (0.33, "small"), (0.474, "medium"))


def shift_between(a: ArrayLike, b: ArrayLike) -> float:
    """Hodges-Lehmann shift: the median of all differences b - a, in the unit of the values.

    Source: Hodges and Lehmann, Annals of Mathematical Statistics 34 (1963).

    Args:
        a: values of one side, shape (n,).
        b: values of the other side, shape (m,).

    Raises:
        StatisticsError: a side is empty or holds a value that is not finite.
    """
    first, second = check_values(a, what="values"), check_values(b, what="values")
    return float(np.median(second[:, None] - first[None, :]))


def cliffs_delta(a: ArrayLike, b: ArrayLike) -> float:
    """Cliff's delta in [-1, 1]: how much oftener a value of b is above one of a than below it.

    Vargha and Delaney's A12 of b over a is (delta + 1) / 2. Source: Cliff, Psychological Bulletin 114 (1993).

    Args:
        a: values of one side, shape (n,).
        b: values of the other side, shape (m,).

    Raises:
        StatisticsError: a side is empty or holds a value that is not finite.
    """
    first, second = check_values(a, what="values"), check_values(b, what="values")
    pairs = first.size * second.size
    below, ties = _count_pairs(first, second)
    return (below - (pairs - below - ties)) / pairs


def name_delta(delta: float) -> str:
    """Cliff's delta in a word: negligible, small, medium or large.

    The limits 0.147, 0.33 and 0.474 are those of Romano et al. (2006), for normal values the same as Cohen's.
    """
    size = abs(delta)
    return next((word for limit, word in _WORDS if size < limit), "large")


def mann_whitney(a: ArrayLike, b: ArrayLike, *, effective: tuple[float, float] | None = None) -> float:
    """Two-sided p of the Mann-Whitney test in its normal approximation, with ties and continuity.

    With correlated samples the plain p is not valid: two equal runs of ten minutes are called different in
    two cases of three. With ``effective`` the statistic is scaled to so many independent samples a side.
    Source: Mann and Whitney, Annals of Mathematical Statistics 18 (1947).

    Args:
        a: samples of one side, shape (n,).
        b: samples of the other side, shape (m,).
        effective: independent samples that each side is worth; None: every sample counts.

    Raises:
        StatisticsError: a side is empty or holds a value that is not finite.
    """
    first, second = check_values(a, what="samples"), check_values(b, what="samples")
    n, m = float(first.size), float(second.size)
    below, ties = _count_pairs(first, second)
    share = (below + 0.5 * ties) / (n * m)
    _, repeats = np.unique(np.concatenate((first, second)), return_counts=True)
    total = n + m
    tied = float(np.sum(repeats.astype(np.float64) ** 3 - repeats)) / max(total**3 - total, 1.0)
    if tied >= 1.0:
        return 1.0
    rows, columns = effective or (n, m)
    spread = math.sqrt((rows + columns + 1.0) / (12.0 * rows * columns) * (1.0 - tied))
    distance = max(abs(share - 0.5) - 0.5 / (rows * columns), 0.0)
    return math.erfc(distance / spread / math.sqrt(2.0))


def _count_pairs(first: Floats, second: Floats) -> tuple[int, int]:
    """In how many pairs the first value is below the second, and in how many they are equal."""
    ordered = np.sort(first)
    below = int(np.searchsorted(ordered, second, side="left").sum())
    return below, int(np.searchsorted(ordered, second, side="right").sum()) - below


def kendall_tau(a: ArrayLike, b: ArrayLike) -> float:
    """Kendall's tau-b: 1 for the same order, -1 for the reverse; 0 where one of them does not order at all.

    Source: Kendall, Biometrika 33 (1945).

    Args:
        a: one measure of n things, shape (n,).
        b: the other measure of the same things, shape (n,).

    Raises:
        StatisticsError: fewer than two things, or a value that is not finite.
    """
    first, second = check_values(a, what="values", fewest=2), check_values(b, what="values", fewest=2)
    upper = np.triu_indices(first.size, 1)
    left = np.sign(first[:, None] - first[None, :])[upper]
    right = np.sign(second[:, None] - second[None, :])[upper]
    scale = float(np.sqrt(np.sum(left**2) * np.sum(right**2)))
    return float(np.sum(left * right)) / scale if scale else 0.0


def kendall_p(tau: float, count: int) -> tuple[float, float]:
    """Chance of an order as like or unlike as this if there were none, and the least that `count` allow.

    Exact for orders without ties: the number of orders with each count of contradictions grows by one thing
    at a time (Kendall, Biometrika 30, 1938).

    Args:
        tau: as of `kendall_tau`.
        count: how many things were ordered, at least two.
    """
    chances = np.ones(1)
    for size in range(2, count + 1):
        chances = np.convolve(chances, np.full(size, 1.0 / size))
    levels = np.abs(1.0 - 2.0 * np.arange(chances.size) / (chances.size - 1))
    return float(chances[levels >= abs(tau) - 1e-9].sum()), float(chances[levels >= 1.0 - 1e-9].sum())


def list_swaps(a: ArrayLike, b: ArrayLike) -> list[tuple[int, int]]:
    """Pairs (i, j) with ``a[i] > a[j]`` but ``b[i] < b[j]``, the strongest contradiction in ranks first.

    Raises:
        StatisticsError: a value is not finite.
    """
    first, second = check_values(a, what="values"), check_values(b, what="values")
    rank_a, rank_b = first.argsort().argsort(), second.argsort().argsort()
    found = [
        (i, j)
        for i in range(first.size)
        for j in range(first.size)
        if first[i] > first[j] and second[i] < second[j]
    ]
    return sorted(found, key=lambda pair: (_gap(rank_a, rank_b, pair), pair))


def _gap(
    rank_a: np.ndarray[tuple[int], np.dtype[np.intp]],
    rank_b: np.ndarray[tuple[int], np.dtype[np.intp]],
    pair: tuple[int, int],
) -> int:
    i, j = pair
    return -min(int(rank_a[i] - rank_a[j]), int(rank_b[j] - rank_b[i]))
