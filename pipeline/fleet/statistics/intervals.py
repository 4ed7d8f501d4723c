"""Intervals: over runs for a dataset, over blocks for a single run."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core.arrays import Floats
from pipeline.core.numbers import student_quantile
from pipeline.fleet.statistics.arrays import check_values
from pipeline.fleet.statistics.ranks import shift_between

_BINS = 512


@dataclass(frozen=True)
class Interval:
    """Two ends, and how often an interval made this way holds the truth (``level``)."""

    low: float
    high: float
    level: float


def bound_mean(values: ArrayLike, *, level: float = 0.95) -> Interval:
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


def bound_typical(medians: ArrayLike, *, level: float = 0.95) -> Interval:
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
    found = bound_mean(np.log(checked), level=level)
    return Interval(float(np.exp(found.low)), float(np.exp(found.high)), level)


def bound_shift(a: ArrayLike, b: ArrayLike, *, level: float = 0.95) -> Interval:
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


def bound_difference(a: ArrayLike, b: ArrayLike, *, level: float = 0.95) -> Interval:
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
    values: ArrayLike, blocks: ArrayLike, *, level: float = 0.95, draws: int = 2_000, seed: int = 0
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
    place = np.argmax(cumulated >= half, axis=1)
    rows = np.arange(place.size)
    before = np.where(place > 0, cumulated[rows, np.maximum(place - 1, 0)], 0.0)
    inside = np.maximum(cumulated[rows, place] - before, 1e-300)
    share = (half[:, 0] - before) / inside
    medians: Floats = edges[place] + share * (edges[place + 1] - edges[place])
    return medians
