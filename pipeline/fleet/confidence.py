"""Intervals over runs or blocks of a run, how long slip remembers, and two sides compared."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.core.arrays import Flags, Floats, Ints
from pipeline.core.numerics import student_quantile
from pipeline.fleet.rank_tests import (
    CONFIDENCE,
    DRAWS,
    PermutationTest,
    check_values,
    cliffs_delta,
    permute_means,
    permute_studentized,
    shift_between,
)

_FEWEST_PAIRS = 20
"""Pairs of samples below which a correlation is noise: of 20 its standard error is 0.22."""
_LONGEST_SHARE = 0.25
"""Share of a series up to which lags are looked at: an autocovariance of longer ones rests on few pairs (Box
and Jenkins advise a quarter)."""
_WINDOW = 3.0
"""Times of tau at which the sum ends: six of Sokal's, who counts half of this tau and takes 4 to 10. Of an
exponential correlation 0.25 % is left there; a longer window adds noise."""
TIMES_PER_BLOCK = 5.0
"""Integrated autocorrelation times in a block: ten time constants of an exponential correlation, so that what
neighbouring blocks share is little beside what they hold."""


def integrated_time(values: ArrayLike, ticks: ArrayLike) -> float:
    """Integrated autocorrelation time tau = 1 + 2 sum of rho_k, in grid steps; at least one.

    The mean of n samples scatters as that of n / tau independent ones. The sum ends at the first lag that is
    3 tau long (Sokal 1997), or where the correlation is no longer positive. Samples that are missing, in
    gaps between segments for example, are left out pair by pair.

    Args:
        values: samples, shape (n,).
        ticks: number of each sample on the uniform grid, ascending, shape (n,).

    Raises:
        StatisticsError: a value is not finite, or there are fewer than two.
    """
    samples = check_values(values, what="samples", fewest=2)
    index = np.asarray(ticks, dtype=np.int64) - int(np.asarray(ticks)[0])
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

    A piece is cut into as many equal blocks of at least that length as fit; a shorter one is a block.

    Args:
        ticks: number of each sample on the uniform grid, ascending, shape (n,).
        pieces: number of the segment or stretch of each sample, shape (n,).
        length: shortest block wanted [grid steps].

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
"""Of equal share, in which samples are counted: a median is then known to 0.2 % of the samples, and
resampling takes no longer for longer runs."""


@dataclass(frozen=True)
class Interval:
    """Two ends, and how often an interval made this way holds the truth (``level``)."""

    low: float
    high: float
    level: float


def bound_mean(values: ArrayLike, *, level: float = CONFIDENCE) -> Interval:
    """Student's t interval of the mean of independent values.

    Args:
        values: one number a run, shape (n,), n >= 2.
        level: confidence level.

    Raises:
        StatisticsError: fewer than two values, or one that is not finite.
    """
    checked = check_values(values, what="values", fewest=2)
    half = student_quantile(level, checked.size - 1) * float(np.std(checked, ddof=1)) / checked.size**0.5
    centre = float(np.mean(checked))
    return Interval(centre - half, centre + half, level)


def bound_typical(medians: ArrayLike, *, level: float = CONFIDENCE) -> Interval:
    """Interval of a dataset's typical median: a t interval on the logarithms of the runs' medians.

    Slip is positive and scatters from run to run by a factor, so logarithms are nearer to normal. Medians
    that are not all positive are taken as they are.

    Args:
        medians: one a run, shape (n,), n >= 2.
        level: confidence level.

    Raises:
        StatisticsError: fewer than two values, or one that is not finite.
    """
    checked = check_values(medians, what="medians", fewest=2)
    if np.any(checked <= 0.0):
        return bound_mean(checked, level=level)
    interval = bound_mean(np.log(checked), level=level)
    return Interval(float(np.exp(interval.low)), float(np.exp(interval.high)), level)


def bound_shift(a: ArrayLike, b: ArrayLike, *, level: float = CONFIDENCE) -> Interval:
    """Interval of the Hodges-Lehmann shift b - a: Welch's standard error and degrees of freedom around it.

    For values near normal the shift scatters as the difference of means does (within 5 % in the limit of many
    values), so Welch's interval fits it. Source: Welch, Biometrika 34 (1947).

    A side of one value is taken to scatter as the other does.

    Args:
        a: one number a unit, shape (n,).
        b: the same for the other side, shape (m,), n + m >= 3.
        level: confidence level.

    Raises:
        StatisticsError: a side is empty, both have a single value, or one is not finite.
    """
    first, second = _check_sides(a, b)
    return _bound_welch(first, second, shift_between(first, second), level)


def bound_difference(a: ArrayLike, b: ArrayLike, *, level: float = CONFIDENCE) -> Interval:
    """Welch's interval of the difference of means b - a; sides as in `bound_shift`.

    Args:
        a: one number a unit, shape (n,).
        b: the same for the other side, shape (m,), n + m >= 3.
        level: confidence level.

    Raises:
        StatisticsError: a side is empty, both have a single value, or one is not finite.
    """
    first, second = _check_sides(a, b)
    return _bound_welch(first, second, float(second.mean() - first.mean()), level)


def _check_sides(a: ArrayLike, b: ArrayLike) -> tuple[Floats, Floats]:
    first = check_values(a, what="values", fewest=1)
    return first, check_values(b, what="values", fewest=2 if first.size == 1 else 1)


def _bound_welch(first: Floats, second: Floats, centre: float, level: float) -> Interval:
    scatter = [float(np.var(side, ddof=1)) for side in (first, second) if side.size > 1]
    freedom = [side.size - 1 for side in (first, second) if side.size > 1]
    parts = [scatter[0] / first.size, scatter[-1] / second.size]
    error = sum(parts) ** 0.5
    if error == 0.0:
        return Interval(centre, centre, level)
    if len(freedom) == 1:
        half = student_quantile(level, freedom[0]) * error
    else:
        weights = sum(part**2 / count for part, count in zip(parts, freedom, strict=True))
        half = student_quantile(level, sum(parts) ** 2 / weights) * error
    return Interval(centre - half, centre + half, level)


def bootstrap_median(
    values: ArrayLike, blocks: ArrayLike, *, level: float = CONFIDENCE, draws: int = 2_000, seed: int = 0
) -> Interval:
    """Interval of one run's median: whole blocks drawn with replacement (percentiles).

    It says where the median of this run could have been, nothing about other runs. The samples are counted in
    512 bins of equal share first, so the cost does not grow with their number. Source: Künsch, Annals of
    Statistics 17 (1989); Davison and Hinkley, Bootstrap Methods (1997), chapter 8.

    Args:
        values: samples, shape (n,).
        blocks: number of the block of each sample, from zero, shape (n,).
        level: confidence level.
        draws: how many resamples.
        seed: of the resamples.

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
    # Percentiles of few blocks are too narrow: by sqrt((n - 1) / n), and by normal in place of t quantiles.
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
"""Blocks that joining neighbours must leave, so that a t quantile (2.2) is still near the normal one
(2.0)."""
_SMALLEST_SHARE = 0.25
"""Share of the usual number of samples below which a block is left out: its median would scatter twice as
much as that of the others."""


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


def compare_runs(a: ArrayLike, b: ArrayLike, *, level: float = CONFIDENCE) -> Comparison:
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


def compare_blocks(
    a: ArrayLike, b: ArrayLike, *, level: float = CONFIDENCE, draws: int = DRAWS
) -> Comparison:
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
    apart: Flags = ~continues[rank] | (ticks - ticks[first[rank]] >= gap)
    return apart


def _measure_blocks(samples: Floats, numbers: Ints, used: Flags) -> Floats:
    """Median of each block that has at least a quarter of the usual samples."""
    samples, numbers = samples[used], numbers[used]
    edges = np.concatenate((np.flatnonzero(np.diff(numbers, prepend=-1)), [samples.size]))
    sizes = np.diff(edges)
    large = sizes >= _SMALLEST_SHARE * np.median(sizes)
    return np.array([np.median(samples[edges[i] : edges[i + 1]]) for i in np.flatnonzero(large)])


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
