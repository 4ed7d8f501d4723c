"""Many pairs at once: p values corrected so that one false alarm in the whole family stays unlikely."""

import functools
import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core.arrays import Floats
from pipeline.fleet.statistics.arrays import check_values
from pipeline.fleet.statistics.permutation import DRAWS, LARGEST_EXACT

MOST_GROUPS = 8
_TIE = 1e-9
_MOST_RUNS = 1_000


def adjust_holm(p_values: ArrayLike) -> Floats:
    """Holm's step-down correction (Scandinavian Journal of Statistics 6, 1979).

    Args:
        p_values: one a pair, shape (n,).

    Returns:
        Corrected p values in the same order, shape (n,).

    Raises:
        StatisticsError: a p value is not finite.
    """
    values = check_values(p_values, what="p values", fewest=0)
    order = np.argsort(values, kind="stable")
    stepped = np.maximum.accumulate(values[order] * np.arange(values.size, 0, -1))
    corrected = np.empty_like(values)
    corrected[order] = np.minimum(stepped, 1.0)
    return corrected


def adjust_max_t(groups: Sequence[ArrayLike], *, seed: int = 0, draws: int = DRAWS) -> Floats:
    """Corrected p of every pair of groups: closed testing with the largest difference (max-T).

    A pair is called different only if every way in which it could be equal, together with any other groups,
    is rejected. Each of these hypotheses splits the groups into sets of equal ones; its test relabels the
    units within each set and looks at the largest weighted difference of means, so it is exact, and the
    family's error is controlled whichever groups differ. Stronger than `adjust_holm` for few runs: a large
    difference keeps the p of its own pair. Sources: Marcus, Peritz and Gabriel, Biometrika 63 (1976);
    Westfall and Young, Resampling-Based Multiple Testing (1993).

    Args:
        groups: units of each group (usually logarithms of run medians); at most `MOST_GROUPS` groups. Pairs
            of two groups with a single unit each are left out of the family.
        seed: of random labellings, used where there are more than `LARGEST_EXACT`.
        draws: how many random labellings.

    Returns:
        Corrected p values, symmetric, one on the diagonal and for pairs left out, shape (groups, groups).

    Raises:
        StatisticsError: a group is empty or holds a value that is not finite.
        ValueError: there are more than `MOST_GROUPS` groups.
    """
    if len(groups) > MOST_GROUPS:
        raise ValueError(f"closed testing takes at most {MOST_GROUPS} groups, not {len(groups)}")
    values = [check_values(group, what="values of a group") for group in groups]
    count = len(values)
    nulls = {
        chosen: _list_largest([values[i] for i in chosen], seed=seed, draws=draws)
        for size in range(2, count + 1)
        for chosen in itertools.combinations(range(count), size)
    }
    corrected = np.zeros((count, count))
    for partition in _list_partitions(tuple(range(count))):
        sets = [chosen for chosen in partition if len(chosen) > 1]
        if not sets:
            continue
        observed = max(nulls[chosen][0] for chosen in sets)
        tie = _TIE * max(float(nulls[chosen][1].max()) for chosen in sets)
        none_larger = 1.0
        for chosen in sets:
            none_larger *= 1.0 - float(np.mean(nulls[chosen][1] >= observed - tie))
        for chosen in sets:
            for i, j in itertools.combinations(chosen, 2):
                corrected[i, j] = corrected[j, i] = max(corrected[i, j], 1.0 - none_larger)
    for i, j in itertools.product(range(count), repeat=2):
        if i == j or values[i].size == values[j].size == 1:
            corrected[i, j] = 1.0
    return np.minimum(corrected, 1.0)


def runs_needed(pairs: int, *, level: float = 0.05) -> int:
    """Runs a side with which Holm's correction of ``pairs`` pairs can reach ``level`` at all.

    4 for one pair, 5 for up to six, 6 for up to 23.
    """
    for runs in range(2, _MOST_RUNS):
        if 2.0 / math.comb(2 * runs, runs) * max(pairs, 1) <= level:
            return runs
    return _MOST_RUNS


def _list_largest(groups: list[Floats], *, seed: int, draws: int) -> tuple[float, Floats]:
    """Largest weighted difference between any two of the groups: as observed, and for every labelling."""
    sizes = np.array([group.size for group in groups])
    values = np.concatenate(groups)
    values = values - values.mean()
    labels = np.repeat(np.arange(sizes.size), sizes)
    rows = _list_labels(tuple(sizes.tolist()), seed, draws)
    means = np.stack([(rows == i) @ values / sizes[i] for i in range(sizes.size)], axis=1)
    given = np.array([values[labels == i].mean() for i in range(sizes.size)])[None, :]
    return float(_take_largest(given, sizes)[0]), _take_largest(means, sizes)


def _take_largest(means: Floats, sizes: np.ndarray[tuple[int], np.dtype[np.int_]]) -> Floats:
    largest = np.zeros(means.shape[0])
    for i, j in itertools.combinations(range(sizes.size), 2):
        if sizes[i] == sizes[j] == 1:
            continue
        weight = math.sqrt(sizes[i] * sizes[j] / (sizes[i] + sizes[j]))
        largest = np.maximum(largest, weight * np.abs(means[:, i] - means[:, j]))
    return largest


@functools.lru_cache(maxsize=256)
def _list_labels(
    sizes: tuple[int, ...], seed: int, draws: int
) -> np.ndarray[tuple[int, int], np.dtype[np.int8]]:
    """Labels of every labelling of groups with these sizes, or of the given one and random ones."""
    labels = np.repeat(np.arange(len(sizes), dtype=np.int8), sizes)
    total = math.factorial(sum(sizes)) // math.prod(math.factorial(size) for size in sizes)
    if total <= LARGEST_EXACT:
        return np.array(list(_list_arrangements(list(sizes))), dtype=np.int8)
    rows = np.tile(labels, (draws + 1, 1))
    rows[1:] = np.random.default_rng(seed).permuted(rows[1:], axis=1)
    return rows


def _list_arrangements(left: list[int]) -> Iterator[tuple[int, ...]]:
    if not any(left):
        yield ()
        return
    for label, count in enumerate(left):
        if count:
            rest = [*left[:label], count - 1, *left[label + 1 :]]
            for tail in _list_arrangements(rest):
                yield (label, *tail)


def _list_partitions(items: tuple[int, ...]) -> Iterator[list[tuple[int, ...]]]:
    """All ways to split the items into sets."""
    if not items:
        yield []
        return
    head, rest = items[0], items[1:]
    for size in range(len(rest) + 1):
        for friends in itertools.combinations(rest, size):
            others = tuple(item for item in rest if item not in friends)
            for partition in _list_partitions(others):
                yield [(head, *friends), *partition]
