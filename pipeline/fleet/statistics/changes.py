"""When did a quantity change? Levels of a series of runs, and the places where they step."""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core.arrays import Floats
from pipeline.fleet.statistics.arrays import check_values

FEWEST_RUNS = 3
_DRAWS = 1_999
# Orders beyond what the level takes, so that p can be below it.
_PER_LEVEL = 4.0
# Orders at a time, which bounds the memory.
_CHUNK = 2_000
_TIE = 1e-9


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
    values: ArrayLike, *, level: float = 0.05, fewest: int = FEWEST_RUNS, seed: int = 0
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
    found = sorted(_split(series, 0, series.size, level, fewest, np.random.default_rng(seed)))
    edges = [0, *(index for index, _ in found), series.size]
    means = [float(series[start:end].mean()) for start, end in itertools.pairwise(edges) if found]
    return tuple(
        Change(index=index, before=means[i], after=means[i + 1], p=p) for i, (index, p) in enumerate(found)
    )


def _split(
    series: Floats, start: int, end: int, level: float, fewest: int, generator: np.random.Generator
) -> list[tuple[int, float]]:
    piece = series[start:end]
    if piece.size < 2 * fewest or float(np.ptp(piece)) == 0.0:
        return []
    observed = _weigh_splits(piece[None, :], fewest)[0]
    draws = max(_DRAWS, round(_PER_LEVEL / level))
    least = float(observed.max()) * (1.0 - _TIE)
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
    left = np.arange(fewest, count - fewest + 1, dtype=np.float64)
    sums = np.cumsum(rows - rows.mean(axis=1, keepdims=True), axis=1)[:, fewest - 1 : count - fewest]
    weighted: Floats = np.abs(sums) * np.sqrt(count / (left * (count - left)))
    return weighted
