"""Confidence intervals over runs or blocks, autocorrelation time of slip, comparison of two sides."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.core import CONFIDENCE, TIMES_PER_BLOCK, Flags, Floats, Ints, student_quantile
from pipeline.datasets.rank_tests import (
    DRAWS,
    PermutationTest,
    bound_permuted,
    check_values,
    cliffs_delta,
    permute_means,
    permute_studentized,
    shift_between,
)

_FEWEST_PAIRS = 20
"""Minimum number of sample pairs for a correlation: with 20 its standard error is 0.22."""
_LONGEST_SHARE = 0.25
"""Largest lag as a share of the series: autocovariances at longer lags rest on few pairs (Box and Jenkins
advise a quarter)."""
_LONG_GAP = 12_000
"""Missing samples that no lag spans: ten minutes at 20 Hz, where a correlation lasts seconds."""
_WINDOW = 3.0
"""Length of the summation window in tau: six of Sokal's tau, which is half of this one and for which he takes
4 to 10. An exponential correlation has decayed to 0.25 % there; a longer window adds noise."""


def integrated_time(values: ArrayLike, ticks: ArrayLike) -> float:
    """Integrated autocorrelation time tau = 1 + 2 sum of rho_k, in grid steps; at least one.

    The mean of n samples has the variance of the mean of n / tau independent ones. The sum ends at the first
    lag above 3 tau (Sokal 1997), or where the correlation is no longer positive. Missing samples, for example
    in gaps between segments, are omitted pair by pair.

    Args:
        values: samples, shape (n,).
        ticks: number of each sample on the uniform grid, ascending, shape (n,).

    Raises:
        StatisticsError: a value is not finite, or there are fewer than two.
    """
    samples = check_values(values, what="samples", fewest=2)
    # How long a long silence lasts does not matter: no lag of a correlation spans it.
    steps = np.minimum(np.diff(np.asarray(ticks, dtype=np.int64)), _LONG_GAP)
    index = np.append(0, np.cumsum(steps))
    span = int(index[-1]) + 1
    size = 1 << (2 * span - 1).bit_length()
    filled, there = np.zeros(span), np.zeros(span)
    filled[index], there[index] = samples - samples.mean(), 1.0
    products, pairs = _autocorrelate(filled, size)[:span], _autocorrelate(there, size)[:span]
    if products[0] <= 0.0:
        return 1.0
    variance = products[0] / pairs[0]
    tau = 1.0
    for lag in range(1, max(int(span * _LONGEST_SHARE), 2)):
        if lag >= span or pairs[lag] < _FEWEST_PAIRS:
            break
        rho = products[lag] / pairs[lag] / variance
        if rho <= 0.0 or lag > _WINDOW * tau:
            break
        tau += 2.0 * float(rho)
    return tau


def number_blocks(ticks: ArrayLike, pieces: ArrayLike, length: float) -> Ints:
    """Cut samples into blocks of about ``length`` grid steps; no block crosses the end of a piece.

    A piece is cut into as many equal blocks of at least that length as fit; a shorter piece is one block.

    Args:
        ticks: number of each sample on the uniform grid, ascending, shape (n,).
        pieces: number of the segment of each sample, shape (n,).
        length: minimum block length [grid steps].

    Returns:
        Block numbers from zero, shape (n,).
    """
    index = np.asarray(ticks, dtype=np.int64)
    if not index.size:
        return np.zeros(0, dtype=np.int64)
    _, piece = np.unique(np.asarray(pieces), return_inverse=True)
    first = np.full(piece.max() + 1, np.iinfo(np.int64).max)
    last = np.full(piece.max() + 1, np.iinfo(np.int64).min)
    np.minimum.at(first, piece, index)
    np.maximum.at(last, piece, index)
    span = (last - first + 1).astype(np.float64)
    count = np.maximum(np.floor(span / max(length, 1.0)), 1.0).astype(np.int64)
    within = ((index - first[piece]) * count[piece] / span[piece]).astype(np.int64)
    offset = np.concatenate(([0], np.cumsum(count)[:-1]))
    _, block = np.unique(offset[piece] + within, return_inverse=True)
    return block.astype(np.int64)


def _autocorrelate(signal: Floats, size: int) -> Floats:
    spectrum = np.fft.rfft(signal, size)
    return np.fft.irfft(spectrum * np.conj(spectrum), size)


_BINS = 512
"""Number of quantile bins for counting samples: the median is then known to 0.2 % of the samples, and
resampling does not take longer for longer runs."""


@dataclass(frozen=True)
class Interval:
    """Confidence interval: two bounds and their coverage probability (``level``)."""

    low: float
    high: float
    level: float


def bootstrap_median(
    values: ArrayLike, blocks: ArrayLike, *, level: float = CONFIDENCE, draws: int = 2_000, seed: int = 0
) -> Interval:
    """Interval of one run's median by a block bootstrap (percentiles).

    It is the uncertainty of the median of this run, not of other runs. The samples are first counted in 512
    quantile bins, so the cost does not grow with their number. Source: Künsch, Annals of Statistics 17
    (1989); Davison and Hinkley, Bootstrap Methods (1997), chapter 8.

    Args:
        values: samples, shape (n,).
        blocks: block number of each sample, from zero, shape (n,).
        level: confidence level.
        draws: number of resamples.
        seed: seed of the resamples.

    Raises:
        StatisticsError: fewer than two samples, or one that is not finite.
    """
    samples = check_values(values, what="samples", fewest=2)
    number = np.asarray(blocks, dtype=np.int64)
    edges = np.unique(np.quantile(samples, np.linspace(0.0, 1.0, _BINS + 1)))
    if edges.size < 2:  # noqa: PLR2004 - two edges make a bin
        return Interval(float(edges[0]), float(edges[0]), level)
    bins = np.clip(np.searchsorted(edges, samples, side="right") - 1, 0, edges.size - 2)
    counts = np.zeros((int(number.max()) + 1, edges.size - 1))
    np.add.at(counts, (number, bins), 1.0)
    generator = np.random.default_rng(seed)
    blocks_there = counts.shape[0]
    drawn = generator.multinomial(blocks_there, np.full(blocks_there, 1.0 / blocks_there), size=draws)
    medians = _read_medians(np.cumsum(drawn @ counts, axis=1), edges)
    # With few blocks percentiles are too narrow: by sqrt((n - 1) / n), and by normal instead of t quantiles.
    widen = (
        student_quantile(level, max(blocks_there - 1, 1)) / student_quantile(level, 1e6) * _grow(blocks_there)
    )
    centre = float(np.median(samples))
    low, high = np.quantile(medians, [(1.0 - level) / 2.0, (1.0 + level) / 2.0])
    return Interval(
        max(centre + widen * (float(low) - centre), float(edges[0])),
        min(centre + widen * (float(high) - centre), float(edges[-1])),
        level,
    )


def _grow(blocks: int) -> float:
    return float((blocks / max(blocks - 1, 1)) ** 0.5)


def _read_medians(cumulated: Floats, edges: Floats) -> Floats:
    half = cumulated[:, -1:] / 2.0
    index = np.argmax(cumulated >= half, axis=1)
    rows = np.arange(index.size)
    before = np.where(index > 0, cumulated[rows, np.maximum(index - 1, 0)], 0.0)
    inside = np.maximum(cumulated[rows, index] - before, 1e-300)
    share = (half[:, 0] - before) / inside
    medians: Floats = edges[index] + share * (edges[index + 1] - edges[index])
    return medians


_FEWEST_BLOCKS = 12
"""Minimum number of blocks after joining neighbours: a t quantile (2.2) is still close to the normal one
(2.0)."""
_SMALLEST_SHARE = 0.25
"""Fraction of the median block size below which a block is omitted: its median would have twice the standard
deviation of the others."""


@dataclass(frozen=True)
class Comparison:
    """Comparison of two sides.

    Attributes:
        shift: Hodges-Lehmann shift b - a, in the unit of the values.
        interval: the differences that the test does not reject; None where it can reject none.
        delta: Cliff's delta of the units, above zero if b is larger.
    """

    shift: float
    interval: Interval | None
    delta: float


@dataclass(frozen=True)
class Blocks:
    """One run cut into blocks.

    Attributes:
        medians: median of each block, shape (blocks,).
        numbers: block number of each sample, shape (n,).
        memory: integrated autocorrelation time [grid steps].
        length: minimum block length [grid steps].
    """

    medians: Floats
    numbers: Ints
    memory: float
    length: float


def spread_ratio(a: Floats, b: Floats, difference: float) -> float:
    """Difference of the medians of two sides, from that of their logarithms and the mean of these."""
    mean, share = float(np.concatenate((a, b)).mean()), b.size / (a.size + b.size)
    return float(np.exp(mean + (1.0 - share) * difference) - np.exp(mean - share * difference))


def compare_blocks(
    a: ArrayLike, b: ArrayLike, *, level: float = CONFIDENCE, draws: int = DRAWS
) -> tuple[Comparison, PermutationTest]:
    """Compare two single runs by the medians of their blocks; this does not compare terrains.

    The test permutes blocks with Welch's t of the medians themselves, and the interval holds the differences
    that it does not reject.

    Args:
        a: one median per block, shape (n,).
        b: the same for the other run, shape (m,).
        level: confidence level of the interval.
        draws: number of random labellings, unless all are counted.

    Raises:
        StatisticsError: a side is empty or contains a value that is not finite.
    """
    first, second = check_values(a, what="block medians"), check_values(b, what="block medians")
    few = min(first.size, second.size) < 2  # noqa: PLR2004 - a single block has no scatter
    permute = permute_means if few else permute_studentized
    bounds = bound_permuted(first, second, studentized=not few, level=1.0 - level, draws=draws)
    comparison = Comparison(
        shift=shift_between(first, second),
        interval=None if bounds is None else Interval(*bounds, level),
        delta=cliffs_delta(first, second),
    )
    return comparison, permute(first, second, draws=draws)


def cut_blocks(values: ArrayLike, ticks: ArrayLike, pieces: ArrayLike, *, step: float) -> Blocks:
    """Cut a run into blocks that can be treated as independent.

    A block is at least five integrated autocorrelation times or one command step long, whichever is longer,
    and crosses no gap. Consecutive blocks without a gap are separated by one autocorrelation time: adjacent
    ones are correlated by some 5 %, enough for a rejection rate of 6 % instead of 5 %. If pieces are shorter
    than that and neighbouring blocks are still correlated, pairs of blocks are joined until they are not.
    Blocks with less than a quarter of the usual samples are excluded from the test; they keep their number.

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
    apart: Flags = ~continues[rank] | (ticks - ticks[first[rank]] >= gap)
    return apart


def _measure_blocks(samples: Floats, numbers: Ints, used: Flags) -> Floats:
    """Median of each block that has at least a quarter of the usual number of samples."""
    samples, numbers = samples[used], numbers[used]
    edges = np.concatenate((np.flatnonzero(np.diff(numbers, prepend=-1)), [samples.size]))
    sizes = np.diff(edges)
    large = sizes >= _SMALLEST_SHARE * np.median(sizes)
    return np.array([np.median(samples[edges[i] : edges[i + 1]]) for i in np.flatnonzero(large)])


def _rise_together(medians: Floats) -> bool:
    """Whether neighbouring blocks are correlated significantly (one-sided 5 %)."""
    deviation = medians - medians.mean()
    variance = float(np.mean(deviation**2))
    if variance == 0.0:
        return False
    correlation = float(np.mean(deviation[1:] * deviation[:-1])) / variance
    return bool(correlation > 1.645 / medians.size**0.5)  # 1.645: the 95th percentile of a normal
