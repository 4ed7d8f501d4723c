"""One parameter over many runs: its common value, its values by group, and the prediction of another run.

    y_r = mu + a_g(r) + b_r + e_r,    var a = group spread^2,  var b = run spread^2,  var e_r known

A linear mixed model with known variances of the estimates, fitted by restricted maximum likelihood (Patterson
and Thompson, Biometrika 58, 1971). Intervals use Student's t, for the common mean with Satterthwaite's
degrees of freedom (Biometrics Bulletin 2, 1946), so that few runs give wide ones. An F test relative to the
scatter of runs within groups tests whether groups differ. Cochran's Q tests whether runs scatter by more than
their errors explain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core import CONFIDENCE, FEWEST_OF_SPREAD, Floats, Ints, student_quantile
from pipeline.datasets.rank_tests import Interval, StatisticsError, check_values

_NORMAL = 1e6
"""Degrees of freedom of a known variance: Student's t is then normal."""
# Starting spreads of the likelihood search, relative to the scatter: both large, or one of them small.
_STARTS = ((0.7, 0.7), (0.7, 0.1), (0.1, 0.7))
# A variance below this fraction of the total counts as zero.
_NONE = 1e-8
ODD = 0.01
"""Significance level of outlying runs: one parameter in a hundred has a false outlier."""


@dataclass(frozen=True)
class GroupMean:
    """Mean of the runs of one group, its interval, and the number of runs."""

    value: float
    interval: Interval | None
    runs: int


@dataclass(frozen=True)
class LevelFit:
    """Parameter split into levels.

    Attributes:
        value: the common mean mu.
        interval: interval of the common mean; None with fewer than three runs.
        spread_group, spread_run: standard deviations between groups and between runs of a group; NaN if no
            group has two runs, the first also if there is only one group.
        scatter: standard deviation of the estimates of runs about their group, errors included.
        groups: means by label; their intervals assume the same scatter in all groups, None for a group of
            fewer than three runs.
        p_groups: p value of equal groups (F test); NaN if it cannot be tested.
        p_runs: p value of no spread between runs within groups (Cochran's Q); NaN likewise.
        chi_square: reduced chi-square of runs within groups relative to their errors; NaN likewise.
        freedom: degrees of freedom of the runs within groups.
    """

    value: float
    interval: Interval | None
    spread_group: float
    spread_run: float
    scatter: float
    groups: dict[str, GroupMean]
    p_groups: float
    p_runs: float
    chi_square: float
    freedom: int


def split_levels(values: ArrayLike, errors: ArrayLike, groups: Sequence[str]) -> LevelFit:
    """Fit the model above.

    Args:
        values: one estimate per run, shape (n,), n >= 1.
        errors: standard errors of the estimates, shape (n,), positive.
        groups: group label of each run, n of them.

    Raises:
        StatisticsError: ``too_few_values``, ``not_finite``, or ``bad_errors``: shapes differ, or an error is
            not positive.
    """
    from scipy.special import chdtrc, fdtrc  # noqa: PLC0415 - heavy

    sample, names = make_sample(values, errors, groups)
    freedom = sample.y.size - len(names)
    within = maximize_likelihood(sample, common=False)[1]
    between, run = maximize_likelihood(sample, common=True)
    p_groups = p_runs = chi_square = math.nan
    if freedom:
        scatter = sample.add_within(0.0)
        p_runs, chi_square = float(chdtrc(freedom, scatter)), scatter / freedom
        if len(names) > 1:
            ratio = sample.add_between(within) / (len(names) - 1)
            p_groups = float(fdtrc(len(names) - 1, freedom, ratio))
    return LevelFit(
        value=sample.find_mean(between, run)[0],
        interval=_bound_mean(sample, between, run),
        spread_group=math.sqrt(between) if freedom and len(names) > 1 else math.nan,
        spread_run=math.sqrt(run) if freedom else math.nan,
        scatter=math.sqrt(run + float(np.median(sample.known))),
        groups=_list_group_means(sample, names, within, freedom),
        p_groups=p_groups,
        p_runs=p_runs,
        chi_square=chi_square,
        freedom=freedom,
    )


def find_outliers(values: Floats, errors: Floats, groups: Sequence[str]) -> list[int]:
    """Indices of the runs that are outliers of their group, identified one after the other.

    The most distant run is removed and compared with the prediction of the others for its group by Student's
    t, with a Bonferroni correction for the number of candidate runs. Groups of fewer than three runs are not
    tested: with two runs the outlier is ambiguous. A parameter has a false outlier with probability `ODD`.

    Args:
        values: as for `split_levels`, shape (n,).
        errors: as for `split_levels`, shape (n,).
        groups: as for `split_levels`.
    """
    remaining, odd = list(range(len(values))), list[int]()
    while remaining:
        sample, _ = make_sample(values[remaining], errors[remaining], [groups[one] for one in remaining])
        if (index := _find_outlier(sample)) is None:
            break
        odd.append(remaining.pop(index))
    return odd


def _find_outlier(sample: Sample) -> int | None:
    from scipy.special import stdtr  # noqa: PLC0415 - heavy, and only this function of it

    runs = np.bincount(sample.group, minlength=sample.count)[sample.group]
    asked = runs > 2  # noqa: PLR2004 - with two runs the outlier is ambiguous
    if not asked.any():
        return None
    weight, means, total = sample.weigh(0.0)
    size = np.abs(sample.y - means[sample.group]) / np.sqrt(
        np.maximum(1.0 / weight - 1.0 / total[sample.group], 1e-300)
    )
    worst = int(np.argmax(np.where(asked, size, -1.0)))
    mask = np.arange(sample.y.size) != worst
    others = Sample(sample.y[mask], sample.known[mask], sample.group[mask], sample.count)
    freedom = others.y.size - others.count
    if freedom < FEWEST_OF_SPREAD:
        return None
    run = maximize_likelihood(others, common=False)[1]
    _, means, total = others.weigh(run)
    group = sample.group[worst]
    deviation = math.sqrt(sample.known[worst] + run + 1.0 / float(total[group]))
    farther = 2.0 * float(stdtr(freedom, -abs(sample.y[worst] - means[group]) / deviation))
    return worst if farther * int(asked.sum()) < ODD else None


def make_sample(values: ArrayLike, errors: ArrayLike, groups: Sequence[str]) -> tuple[Sample, list[str]]:
    """Checked values with their group indices, and the names of the groups; errors as for `split_levels`."""
    y, s = check_values(values, what="values"), check_values(errors, what="errors")
    if not y.size == s.size == len(groups) or np.any(s <= 0.0):
        raise StatisticsError(
            "bad_errors",
            f"{y.size} values have {s.size} errors and {len(groups)} groups, the least error is {s.min():g}",
            hint="Give every value a group and a positive error.",
        )
    names = sorted(set(groups))
    number = np.array([names.index(name) for name in groups], dtype=np.int64)
    return Sample(y, s**2, number, len(names)), names


@dataclass(frozen=True)
class Sample:
    """Values, their known variances, the group index of each, and the number of groups."""

    y: Floats
    known: Floats
    group: Ints
    count: int

    def weigh(self, run: float) -> tuple[Floats, Floats, Floats]:
        """Weights of runs, and mean and weight of each group, for a variance between runs."""
        weight = 1.0 / (self.known + run)
        total: Floats = np.asarray(np.bincount(self.group, weight, minlength=self.count), dtype=np.float64)
        return weight, np.bincount(self.group, weight * self.y, minlength=self.count) / total, total

    def add_within(self, run: float) -> float:
        """Weighted sum of squares of the runs about their groups' means."""
        weight, means, _ = self.weigh(run)
        return float(np.sum(weight * (self.y - means[self.group]) ** 2))

    def add_between(self, run: float) -> float:
        """Weighted sum of squares of the groups' means about the common mean."""
        _, means, total = self.weigh(run)
        return float(np.sum(total * (means - np.sum(total * means) / total.sum()) ** 2))

    def find_mean(self, between: float, run: float) -> tuple[float, float]:
        """The common mean and its variance."""
        _, means, total = self.weigh(run)
        weight = 1.0 / (between + 1.0 / total)
        return float(np.sum(weight * means) / weight.sum()), 1.0 / float(weight.sum())


def maximize_likelihood(sample: Sample, *, common: bool) -> tuple[float, float]:
    """Maximum likelihood variances between groups and between runs, neither below zero.

    The search runs over spreads; the likelihood is an even function of them, so zero is not a boundary.

    Args:
        sample: the runs.
        common: whether there is a common mean; otherwise one per group and no variance between groups.
    """
    from scipy.optimize import minimize  # noqa: PLC0415 - heavy

    scale = float(np.sqrt(np.var(sample.y) + sample.known.mean()))
    free = np.array([common and sample.count > 1, sample.y.size > sample.count])
    if not free.any():
        return 0.0, 0.0

    def look(spreads: Floats) -> float:
        wide, narrow = (scale * spreads * free)[:, None]
        likelihood = rate_levels(sample, wide, narrow)[4] if common else rate_spreads(sample, narrow)[2]
        return -2.0 * float(likelihood.item())

    climbs = [minimize(look, start, method="BFGS") for start in _STARTS]
    best = min(climbs, key=lambda one: float(one.fun))
    variances = (scale * np.asarray(best.x) * free) ** 2
    between, run = np.where(variances > _NONE * scale**2, variances, 0.0).tolist()
    return between, run


def _bound_mean(sample: Sample, between: float, run: float) -> Interval | None:
    """Interval of the common mean; its degrees of freedom are those of the nonzero variances."""
    if sample.y.size < FEWEST_OF_SPREAD:
        return None
    weight, _, total = sample.weigh(run)
    outer = 1.0 / (between + 1.0 / total)
    mean, variance = sample.find_mean(between, run)
    inner = np.bincount(sample.group, weight**2, minlength=sample.count) / total**2
    slopes = variance**2 * np.array([np.sum(outer**2), np.sum(outer**2 * inner)])
    there = np.array([between, run]) > 0.0
    freedom = _NORMAL
    if there.any():
        information = _inform(sample, between, run)[np.ix_(there, there)]
        scatter = float(slopes[there] @ np.linalg.solve(information, slopes[there]))
        freedom = min(max(2.0 * variance**2 / scatter, 1.0), _NORMAL)
    half = student_quantile(CONFIDENCE, freedom) * math.sqrt(variance)
    return Interval(mean - half, mean + half)


def _inform(sample: Sample, between: float, run: float) -> Floats:
    """Expected information of the restricted likelihood on both variances, shape (2, 2)."""
    weight, _, total = sample.weigh(run)
    shrinkage = 1.0 / (1.0 + between * total)
    pull = weight * shrinkage[sample.group]
    same = sample.group[:, None] == sample.group[None, :]
    projected = np.diag(weight) - np.where(same, np.outer(weight, between * pull), 0.0)
    projected -= np.outer(pull, pull) / pull.sum()
    by_group = np.zeros((sample.count, weight.size))
    np.add.at(by_group, sample.group, projected)
    by_pair = np.zeros((sample.count, sample.count))
    np.add.at(by_pair, sample.group, by_group.T)
    both, mixed, single = (float(np.sum(part**2)) for part in (by_pair, by_group, projected))
    return 0.5 * np.array([[both, mixed], [mixed, single]])


def _list_group_means(sample: Sample, names: Sequence[str], run: float, freedom: int) -> dict[str, GroupMean]:
    """Means of the groups; their intervals use the runs within all groups."""
    runs = np.bincount(sample.group, minlength=sample.count)
    _, means, total = sample.weigh(run)
    means_by_name = {}
    for name, mean, weight, count in zip(names, means.tolist(), total.tolist(), runs.tolist(), strict=True):
        interval = None
        if count >= FEWEST_OF_SPREAD:
            half = student_quantile(CONFIDENCE, freedom) / math.sqrt(weight)
            interval = Interval(mean - half, mean + half)
        means_by_name[name] = GroupMean(mean, interval, count)
    return means_by_name


# Prediction of a parameter in another run: draws from the model of levels with unknown spreads.
#
#     y_r = mu + a_g(r) + b_r + e_r,    a ~ N(0, group spread^2),  b ~ N(0, run spread^2),  var e_r known
#
# as in `levels`, with a flat prior on mu and a half-normal one on either spread (Gelman, Bayesian Analysis 1,
# 2006). The draws average over the posterior of the spreads, so that few runs give wide intervals, also with
# one run or a group without runs.

# Grid of spreads, relative to the usual ones: steps of a fifth, from far below any relevant one.
_GRID = np.geomspace(1e-3, 5.0, 48)


def draw_run(
    values: ArrayLike,
    errors: ArrayLike,
    groups: Sequence[str],
    group: str,
    *,
    usual: tuple[float, float],
    count: int,
    rng: np.random.Generator,
) -> Floats:
    """Draw the parameter as in another run of a group, shape (count,).

    Args:
        values: one estimate per run, shape (n,), n >= 1.
        errors: standard errors of the estimates, shape (n,), positive.
        groups: group label of each run, n of them.
        group: group of the other run; may have no runs.
        usual: prior scales of the spreads between groups and between runs of a group; positive.
        count: number of draws.
        rng: random generator.

    Raises:
        StatisticsError: ``too_few_values``, ``not_finite``, or ``bad_errors``: shapes differ, or an error or
            a usual spread is not positive.
    """
    sample, names = make_sample(values, errors, groups)
    if min(usual) <= 0.0:
        hint = "Give positive spreads."
        raise StatisticsError("bad_errors", f"usual spreads {usual} are not positive", hint=hint)
    wide, narrow = (size * _GRID for size in usual)
    total, means, centre, mass, likelihood = rate_levels(sample, wide, narrow)
    score = likelihood + _PRIOR[:, None] + _PRIOR
    chance = np.exp(score - score.max()).ravel()
    between, run = np.unravel_index(rng.choice(chance.size, count, p=chance / chance.sum()), score.shape)
    common = centre[between, run] + rng.standard_normal(count) / np.sqrt(mass[between, run])
    known = np.zeros(count)
    pull = np.zeros(count)
    if group in names:
        known = total[run, names.index(group)]
        pull = known * means[run, names.index(group)]
    sharp = known + 1.0 / wide[between] ** 2
    own = (pull + common / wide[between] ** 2) / sharp + rng.standard_normal(count) / np.sqrt(sharp)
    drawn: Floats = own + narrow[run] * rng.standard_normal(count)
    return drawn


# On a geometric grid a density is weighted by the spread.
_PRIOR = np.log(_GRID) - 0.5 * _GRID**2


def weigh_run_spreads(
    values: ArrayLike, errors: ArrayLike, groups: Sequence[str], usual: float
) -> tuple[Floats, Floats]:
    """Posterior probabilities of spreads between runs of a group, independent of the groups' means.

    Args:
        values: one estimate per run, shape (n,), n >= 1.
        errors: standard errors of the estimates, shape (n,), positive.
        groups: group label of each run, n of them.
        usual: second element of `usual` in `draw_run`: the scale of the half-normal prior.

    Returns:
        Spreads, and their probabilities, which add up to one; both of shape (k,).

    Raises:
        StatisticsError: as for `split_levels`.
    """
    sample, _ = make_sample(values, errors, groups)
    spreads: Floats = usual * _GRID
    within = rate_spreads(sample, spreads)[2]
    score = within + _PRIOR
    chances = np.exp(score - score.max())
    return spreads, chances / chances.sum()


def rate_spreads(sample: Sample, narrow: Floats) -> tuple[Floats, Floats, Floats]:
    """Weight and mean of each group by spread between runs, shape (k, g), and a log likelihood.

    The last is the restricted log likelihood with a mean for each group, shape (k,).
    """
    member = np.eye(sample.count)[:, sample.group]
    weight = 1.0 / (sample.known + narrow[:, None] ** 2)
    total = weight @ member.T
    means = (weight * sample.y) @ member.T / total
    rest = np.sum(weight * (sample.y - means @ member) ** 2, axis=1)
    return total, means, -0.5 * (rest - np.log(weight).sum(axis=1) + np.log(total).sum(axis=1))


def rate_levels(
    sample: Sample, wide: Floats, narrow: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """As `rate_spreads`, with a common mean and its weight by both spreads, shape (m, k), before the last.

    The restricted log likelihood is then that with a common mean, shape (m, k).
    """
    total, means, within = rate_spreads(sample, narrow)
    # Axes: spread between groups, spread between runs, group.
    outer = 1.0 / (wide[:, None, None] ** 2 + 1.0 / total)
    mass = outer.sum(axis=2)
    centre = (outer * means).sum(axis=2) / mass
    away = np.sum(outer * (means - centre[:, :, None]) ** 2, axis=2)
    likelihood = within - 0.5 * (away - np.log(outer).sum(axis=2) + np.log(mass))
    return total, means, centre, mass, likelihood
