"""Two sides compared: whole runs where there are any, blocks where each side is one run."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.core.arrays import Flags, Floats, Ints
from pipeline.fleet.statistics.arrays import check_values
from pipeline.fleet.statistics.correlation import TIMES_PER_BLOCK, integrated_time, number_blocks
from pipeline.fleet.statistics.intervals import Interval, bound_shift
from pipeline.fleet.statistics.permutation import DRAWS, PermutationTest, permute_means, permute_studentized
from pipeline.fleet.statistics.ranks import cliffs_delta, shift_between

_FEWEST_BLOCKS = 12
_SMALLEST_SHARE = 0.25


@dataclass(frozen=True)
class Comparison:
    """One side against another.

    Attributes:
        shift: Hodges-Lehmann shift b - a, in the unit of the values.
        interval: of the shift; None where a side has nothing to tell its scatter from.
        delta: Cliff's delta of the units, above zero where b is larger.
        test: permutation of the units' labels.
    """

    shift: float
    interval: Interval | None
    delta: float
    test: PermutationTest


@dataclass(frozen=True)
class Blocks:
    """One run cut into blocks.

    Attributes:
        medians: median of each block, shape (blocks,).
        numbers: block of each sample, shape (n,).
        memory: integrated autocorrelation time [grid steps].
        length: shortest block wanted [grid steps].
    """

    medians: Floats
    numbers: Ints
    memory: float
    length: float


def compare_runs(a: ArrayLike, b: ArrayLike, *, level: float = 0.95) -> Comparison:
    """Compare datasets by the medians of their runs; a run is the unit, whatever its length.

    The test permutes whole runs (difference of means of the logarithms, where all medians are positive).

    Args:
        a: one median a run, shape (n,).
        b: the same of the other dataset, shape (m,).
        level: of the interval.

    Raises:
        StatisticsError: a side is empty or holds a value that is not finite.
    """
    first, second = check_values(a, what="run medians"), check_values(b, what="run medians")
    return Comparison(
        shift=shift_between(first, second),
        interval=bound_shift(first, second, level=level) if first.size + second.size > 2 else None,  # noqa: PLR2004 - two runs have no scatter
        delta=cliffs_delta(first, second),
        test=permute_means(*_take_logarithms(first, second)),
    )


def compare_blocks(a: ArrayLike, b: ArrayLike, *, level: float = 0.95, draws: int = DRAWS) -> Comparison:
    """Compare one run with one other by the medians of their blocks: this run against that, not the terrain.

    The test permutes blocks with Welch's t of the medians themselves, so that it and the interval of the
    shift speak of the same difference.

    Args:
        a: one median a block, shape (n,).
        b: the same of the other run, shape (m,).
        level: of the interval.
        draws: how many random labellings, where not all are counted.

    Raises:
        StatisticsError: a side is empty or holds a value that is not finite.
    """
    first, second = check_values(a, what="block medians"), check_values(b, what="block medians")
    few = min(first.size, second.size) < 2  # noqa: PLR2004 - a single block has no scatter
    return Comparison(
        shift=shift_between(first, second),
        interval=None if few else bound_shift(first, second, level=level),
        delta=cliffs_delta(first, second),
        test=permute_means(first, second) if few else permute_studentized(first, second, draws=draws),
    )


def cut_blocks(values: ArrayLike, ticks: ArrayLike, pieces: ArrayLike, *, step: float) -> Blocks:
    """Cut a run into blocks that may be taken for independent.

    A block is as long as five integrated autocorrelation times or one command step, whichever is longer, and
    crosses no gap. One autocorrelation time is left out between blocks that follow each other without a gap:
    touching ones are correlated by some 5 %, enough to reject 6 % in place of 5 %. Where pieces are shorter
    than that, and neighbouring blocks still rise and fall together, two and two are joined until they no
    longer do. Blocks with less than a quarter of the usual samples are no units of a test; they keep their
    number.

    Args:
        values: samples, shape (n,).
        ticks: number of each sample on the uniform grid, ascending, shape (n,).
        pieces: number of the segment of each sample, shape (n,).
        step: usual length of a command step [grid steps].

    Raises:
        StatisticsError: fewer than two samples, or one that is not finite.
    """
    samples = check_values(values, what="samples", fewest=2)
    positive = bool(np.all(samples > 0.0))
    memory = integrated_time(np.log(samples) if positive else samples, ticks)
    length = max(TIMES_PER_BLOCK * memory, step)
    numbers = number_blocks(ticks, pieces, length)
    index, piece = np.asarray(ticks, dtype=np.int64), np.asarray(pieces)
    medians = _measure_blocks(samples, numbers, _keep_apart(index, piece, numbers, memory))
    while medians.size >= 2 * _FEWEST_BLOCKS and _rise_together(medians):
        numbers = numbers // 2
        medians = _measure_blocks(samples, numbers, _keep_apart(index, piece, numbers, memory))
    return Blocks(medians, numbers, memory, length)


def _keep_apart(ticks: Ints, pieces: NDArray[np.generic], numbers: Ints, gap: float) -> Flags:
    """False for the first ``gap`` grid steps of blocks that continue the piece of the block before."""
    first = np.flatnonzero(np.diff(numbers, prepend=-1))
    continues = np.zeros(first.size, dtype=bool)
    continues[1:] = pieces[first[1:]] == pieces[first[1:] - 1]
    rank = np.cumsum(np.diff(numbers, prepend=-1) != 0) - 1
    kept: Flags = ~continues[rank] | (ticks - ticks[first[rank]] >= gap)
    return kept


def _measure_blocks(samples: Floats, numbers: Ints, kept_samples: Flags) -> Floats:
    """Median of each block that has at least a quarter of the usual samples."""
    samples, numbers = samples[kept_samples], numbers[kept_samples]
    edges = np.concatenate((np.flatnonzero(np.diff(numbers, prepend=-1)), [samples.size]))
    sizes = np.diff(edges)
    kept = sizes >= _SMALLEST_SHARE * np.median(sizes)
    return np.array([np.median(samples[edges[i] : edges[i + 1]]) for i in np.flatnonzero(kept)])


def _rise_together(medians: Floats) -> bool:
    """Whether neighbours are correlated beyond chance (one-sided 5 %)."""
    deviation = medians - medians.mean()
    variance = float(np.mean(deviation**2))
    if variance == 0.0:
        return False
    correlation = float(np.mean(deviation[1:] * deviation[:-1])) / variance
    return bool(correlation > 1.645 / medians.size**0.5)  # 1.645: the 95th percentile of a normal


def _take_logarithms(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    if min(a.min(), b.min()) <= 0.0:
        return a, b
    return np.log(a), np.log(b)
