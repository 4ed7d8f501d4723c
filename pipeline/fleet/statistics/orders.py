"""Do two measures put things in the same order?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.fleet.statistics.arrays import check_values

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


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
