"""How runs differ: a value of a run is a level of its vehicle, of its ground, and of the run itself.

    y_r = mu + a_g(r) + b_r + e_r,    var a = spread of grounds^2,  var b = spread of runs^2,  var e known

A linear mixed model with known variances of the values, fitted by restricted maximum likelihood (Patterson
and Thompson, Biometrika 58, 1971): the spread between runs of one ground from the runs about the means of
their grounds, and with it the spread between grounds from those means about the vehicle's. Intervals use
Student's t with the degrees of freedom of that spread, so that few runs give wide ones; without two degrees
of freedom no spread is known, and there are none. Pairs of grounds are compared by Tukey and Kramer (Kramer,
Biometrics 12, 1956).
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pipeline.core import CONFIDENCE, FEWEST_OF_SPREAD, Floats, SlipError, student_quantile

LEVEL = 1.0 - CONFIDENCE
"""Significance level."""
_SPREADS = np.geomspace(1e-4, 4.0, 60)
"""Spreads at which the likelihood is looked at before it is climbed, relative to the scatter of all
values."""
_NONE = 1e-12
"""Variance below which nothing scatters, as a share of the values' mean square."""
_SURE = 1e9
"""Degrees of freedom of a spread that is known."""


class StatisticsError(SlipError):
    """Values for which a statistic is not defined."""


@dataclass(frozen=True)
class Difference:
    """Difference of the levels of two groups, b - a.

    Attributes:
        value: the difference.
        error: its standard error; NaN where no spread between runs is known, and so are all below.
        low, high: 95 % interval, of all pairs of the family at once.
        p: two-sided p of the pair alone.
        p_adjusted: p over all pairs of the family.
    """

    value: float
    error: float
    low: float
    high: float
    p: float
    p_adjusted: float


@dataclass(frozen=True)
class Levels:
    """Levels of groups of runs.

    Attributes:
        names: names of the groups, sorted, g of them.
        means: their levels, shape (g,).
        covariance: covariance of the levels, shape (g, g); the errors of the values alone where no spread is
            known.
        counts: number of runs of each, shape (g,).
        spread: standard deviation between runs of a group; NaN where it is not known.
        freedom: its degrees of freedom: runs less groups; `_SURE` where it is given.
        p_spread: p of no spread between runs beside the errors (Cochran's Q); NaN where it cannot be tested.
    """

    names: tuple[str, ...]
    means: Floats
    covariance: Floats
    counts: Floats
    spread: float
    freedom: float
    p_spread: float = field(default=math.nan)

    @property
    def is_known(self) -> bool:
        """Whether these runs tell how much runs differ."""
        return math.isfinite(self.spread)

    def bound(self, index: int, *, another_run: bool = False) -> tuple[float, float]:
        """95 % interval of the level of a group, or of the value of another of its runs; NaN if not known."""
        own = self.spread**2 if another_run else 0.0
        half = self._find_quantile() * math.sqrt(float(self.covariance[index, index]) + own)
        return float(self.means[index]) - half, float(self.means[index]) + half

    def compare(self, a: str, b: str, family: int = 2) -> Difference:
        """Compare two groups of a family of so many; with two it is Student's t."""
        from scipy.stats import t  # noqa: PLC0415 - heavy

        contrast = np.zeros(len(self.names))
        contrast[self.names.index(b)], contrast[self.names.index(a)] = 1.0, -1.0
        value, variance = float(contrast @ self.means), float(contrast @ self.covariance @ contrast)
        error = math.sqrt(max(variance, 0.0)) if self.is_known else math.nan
        if not error > 0.0:
            return Difference(value, *[math.nan] * 5)
        score, half = abs(value) / error, error * find_limit(family, self.freedom)
        p = 2.0 * float(t.sf(score, self.freedom))
        adjusted = p if family < 3 else find_range_p(score, family, self.freedom)  # noqa: PLR2004 - more than a pair
        return Difference(value, error, value - half, value + half, p, adjusted)

    def pool(self) -> "Pooled":
        """The level of the vehicle, and how much its grounds differ."""
        from scipy.stats import f as ratios  # noqa: PLC0415 - heavy

        count = len(self.names)
        whole = fit_levels(self.means, ["*"] * count, self.covariance, fewest=1)
        mean, between = float(whole.means[0]), whole.spread if count > 1 and self.is_known else math.nan
        variance = float(whole.covariance[0, 0])
        p = math.nan
        if count > 1 and self.is_known:
            weights = np.linalg.inv(self.covariance)
            rest = self.means - np.ones(count) @ weights @ self.means / weights.sum()
            p = float(ratios.sf(rest @ weights @ rest / (count - 1), count - 1, self.freedom))
        # Where grounds differ, it is they that tell how sure their mean is.
        freedom = float(count - 1) if between > 0.0 else self.freedom
        half = student_quantile(CONFIDENCE, freedom) * math.sqrt(variance) if self.is_known else math.nan
        return Pooled(mean, mean - half, mean + half, variance, freedom, between, p)

    def _find_quantile(self) -> float:
        return student_quantile(CONFIDENCE, self.freedom) if self.is_known else math.nan


@dataclass(frozen=True)
class Pooled:
    """The level of a vehicle.

    Attributes:
        value: the mean over its grounds.
        low, high: its 95 % interval; NaN where no spread is known.
        variance, freedom: of the value.
        spread: standard deviation between grounds; NaN of one ground, or where no spread is known.
        p: p of grounds that do not differ (F test); NaN likewise.
    """

    value: float
    low: float
    high: float
    variance: float
    freedom: float
    spread: float
    p: float


def fit_levels(
    values: Floats,
    groups: Sequence[str],
    errors: Floats | None = None,
    *,
    spread: float | None = None,
    fewest: int = FEWEST_OF_SPREAD - 1,
) -> Levels:
    """Fit the levels of groups of runs, with one spread between runs for all groups.

    Args:
        values: one value a run, shape (n,), n >= 1.
        groups: the group of each run, n of them.
        errors: known variances of the values, shape (n,), or their covariance, shape (n, n); None for none.
        spread: standard deviation between runs of a group, if it is known; None to estimate it.
        fewest: degrees of freedom from which on a spread is known.

    Raises:
        StatisticsError: ``bad_values``: values are not finite, or shapes differ, or a variance is negative.
    """
    names = tuple(sorted(set(groups)))
    known = np.zeros(len(values)) if errors is None else np.asarray(errors, np.float64)
    finite = bool(np.isfinite(values).all() and np.isfinite(known).all())
    if not (
        finite
        and len(values) == len(groups) == known.shape[0]
        and (np.diag(known) if known.ndim > 1 else known).min() >= 0.0
    ):
        what = f"{len(values)} values of {len(groups)} runs, {known.shape[0]} errors, all finite: {finite}"
        raise StatisticsError("bad_values", what, hint="Give every run a finite value and a variance.")
    y, members = (
        np.asarray(values, np.float64),
        np.equal.outer(np.array(groups), np.array(names)).astype(np.float64),
    )
    counts = members.sum(axis=0)
    if known.ndim > 1:
        # In the axes of their errors values are independent, with one more variance in common.
        axes = np.linalg.eigh(known)
        known = axes.eigenvalues.clip(0.0)
        y, members = axes.eigenvectors.T @ y, axes.eigenvectors.T @ members
    freedom = float(len(y) - len(names))
    p = math.nan
    if spread is not None:
        run, freedom = spread, _SURE
    elif freedom < fewest:
        run = math.nan
    else:
        run = _climb(y, members, known)
        if known.min() > 0.0:
            from scipy.special import chdtrc  # noqa: PLC0415 - heavy

            p = float(chdtrc(freedom, _weigh(y, members, known)[2]))
    inner = known + (0.0 if math.isnan(run) else run**2)
    inner = np.maximum(inner, _NONE * float(np.mean(y**2)) + 1e-300)
    means, covariance, _, _ = _weigh(y, members, inner)
    if run == 0.0 and not known.any():
        run = math.nan
    return Levels(names, means, covariance, counts, run, freedom, p)


def _weigh(y: Floats, members: Floats, variances: Floats) -> tuple[Floats, Floats, float, float]:
    """Weighted means, their covariance, the weighted sum of squares about them, and the log determinant."""
    weighted = members / variances[:, None]
    normal = members.T @ weighted
    covariance: Floats = np.asarray(np.linalg.inv(normal), np.float64)
    means: Floats = np.asarray(covariance @ (weighted.T @ y), np.float64)
    squares = float(np.sum((y - members @ means) ** 2 / variances))
    return means, covariance, squares, float(np.linalg.slogdet(normal)[1])


def _climb(y: Floats, members: Floats, known: Floats) -> float:
    """Standard deviation between runs with the largest restricted likelihood."""
    means, _, squares, _ = _weigh(y, members, np.ones(len(y)))
    freedom = len(y) - len(means)
    if not known.any():
        return math.sqrt(squares / freedom)
    from scipy.optimize import minimize_scalar  # noqa: PLC0415 - heavy

    floor = known + _NONE * float(np.mean(y**2)) + 1e-300

    def look(spread: float) -> float:
        _, _, rest, determinant = _weigh(y, members, floor + spread**2)
        return rest + float(np.log(floor + spread**2).sum()) + determinant

    sizes = np.r_[0.0, math.sqrt(squares / freedom + float(known.mean())) * _SPREADS]
    best = int(np.argmin([look(size) for size in sizes]))
    if best == 0:
        return 0.0
    ends = (float(sizes[best - 1]), float(sizes[min(best + 1, len(sizes) - 1)]))
    return float(minimize_scalar(look, bounds=ends, method="bounded", options={"xatol": 1e-6 * ends[1]}).x)


def adjust(ps: Sequence[float | None]) -> list[float | None]:
    """P of tests, over all of them (Benjamini and Hochberg, J. R. Stat. Soc. B 57, 1995); None stays None."""
    from scipy.stats import false_discovery_control  # noqa: PLC0415 - heavy

    known = [p for p in ps if p is not None]
    adjusted = iter(false_discovery_control(known).tolist() if known else [])
    return [None if p is None else float(next(adjusted)) for p in ps]


def find_range_p(score: float, groups: int, freedom: float) -> float:
    """Probability that the largest difference of so many equal groups is larger, in its standard errors."""
    from scipy.stats import studentized_range  # noqa: PLC0415 - heavy

    p = float(studentized_range.sf(math.sqrt(2.0) * score, groups, min(freedom, 1e5)))
    return min(max(p, 0.0), 1.0)


@functools.lru_cache(maxsize=256)
def find_limit(groups: int, freedom: float) -> float:
    """Difference of equal groups, in standard errors, that the largest exceeds at the significance level."""
    from scipy.stats import studentized_range, t  # noqa: PLC0415 - heavy

    if groups < 3:  # noqa: PLR2004 - a pair, whose range is Student's t
        return float(t.isf(0.5 * LEVEL, freedom))
    return float(studentized_range.isf(LEVEL, groups, min(freedom, 1e5))) / math.sqrt(2.0)
