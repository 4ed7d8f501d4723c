"""Joint estimation of many parameters over many runs, with correlations and unidentified parameters.

    x_r = mu + a_g(r) + b_r,    a ~ N(0, diag(group spread^2)),  b ~ N(0, diag(run spread^2))

The model is that of `levels`, per parameter. Each run contributes its normal equations, which may be
singular: near its fit, minus twice the log likelihood is x' N x - 2 h' x (Gelman and Hill, Data Analysis
Using Regression, 2007, chapter 13). Spreads are drawn per parameter from the estimates of single runs,
weighted by their errors; then all parameters are drawn jointly given the spreads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Flags, Floats
from pipeline.fleet.levels import draw_spreads, find_outlier

_VAGUE = 10.0
"""Prior standard deviation of a parameter in usual sizes: keeps unidentified parameters finite."""
_NONE = 1e-4
"""Zero spread in usual sizes; not exactly zero, so that its inverse is finite."""
ODD = 0.01
"""Significance level of outlying runs: one fleet in a hundred has a false outlier."""


@dataclass(frozen=True)
class RunEvidence:
    """Information of one run on p parameters.

    Attributes:
        run: name of the run.
        group: label of its group.
        normal: matrix N of its normal equations, shape (p, p): the inverse covariance where it exists.
        pull: right side h, shape (p,): N times the parameters that fit the run best.
    """

    run: str
    group: str
    normal: Floats
    pull: Floats


@dataclass(frozen=True)
class JointDraws:
    """Joint draws of p parameters.

    Attributes:
        group: means of the group, shape (n, p).
        run: parameters in another run of that group, shape (n, p).
        odd: outlying runs by parameter, which are ignored for it.
        runs_known: number of runs that determine each parameter, shape (p,).
    """

    group: Floats
    run: Floats
    odd: tuple[tuple[str, ...], ...]
    runs_known: tuple[int, ...]


def draw_joint_run(
    runs: Sequence[RunEvidence],
    group: str,
    *,
    centre: Floats,
    usual: Floats,
    size: Floats,
    shared: Flags,
    count: int,
    rng: np.random.Generator,
) -> JointDraws:
    """Draw all parameters jointly as in another run of a group.

    Args:
        runs: information of each run, one or more.
        group: group of the other run; may have no runs.
        centre: centre of the draws of unidentified parameters, shape (p,).
        usual: prior scales of the spreads between groups and between runs of a group, shape (2, p).
        size: usual sizes of the parameters, shape (p,), positive.
        shared: parameters that all groups have in common, shape (p,).
        count: number of draws.
        rng: random generator.
    """
    # In usual sizes, about the centre: parameters of different units share one matrix.
    normals = np.array([size[:, None] * run.normal * size for run in runs])
    pulls = np.array([size * (run.pull - run.normal @ centre) for run in runs])
    groups = [run.group for run in runs]
    vague = np.eye(size.size) / _VAGUE**2
    single = np.linalg.inv(normals + vague)
    values = (single @ pulls[:, :, None])[:, :, 0]
    errors = np.sqrt(np.diagonal(single, axis1=1, axis2=2))
    wide, narrow = np.empty((2, count, size.size))
    odd: list[tuple[str, ...]] = []
    runs_known: list[int] = []
    free = np.zeros((len(runs), size.size), dtype=bool)
    for column in range(size.size):
        # A run that does not determine a parameter gives no information on its spread.
        known = errors[:, column] < 0.5 * _VAGUE
        labels = [""] * len(runs) if shared[column] else groups
        apart = find_odd(values[:, column], errors[:, column], labels, known)
        free[apart, column] = True
        bound_by = known & ~free[:, column]
        odd.append(tuple(runs[which].run for which in apart))
        runs_known.append(int(bound_by.sum()))
        spreads = (float(one) / float(size[column]) for one in usual[:, column])
        wide[:, column], narrow[:, column] = draw_spreads(
            values[bound_by, column],
            errors[bound_by, column],
            [name for name, one in zip(labels, bound_by.tolist(), strict=True) if one],
            usual=(next(spreads), next(spreads)),
            count=count,
            rng=rng,
        )
    wide[:, shared] = _NONE
    means, others = np.empty((2, count, size.size))
    names = sorted(set(groups))
    for draw in range(count):
        between, within = wide[draw] ** 2, narrow[draw] ** 2
        by_group = {name: (np.zeros_like(vague), np.zeros(size.size)) for name in names}
        for normal, pull, name, loose in zip(normals, pulls, groups, free, strict=True):
            weight, pulled = _widen(normal, pull, np.where(loose, _VAGUE**2, within))
            by_group[name] = (by_group[name][0] + weight, by_group[name][1] + pulled)
        upper = [_widen(weight, pulled, between) for weight, pulled in by_group.values()]
        common = _draw_normal(
            vague + sum(one for one, _ in upper), np.sum([h for _, h in upper], axis=0), rng
        )
        own, pulled = by_group.get(group, (np.zeros_like(vague), np.zeros(size.size)))
        sharp = np.diag(1.0 / between)
        means[draw] = _draw_normal(own + sharp, pulled + common / between, rng)
        others[draw] = means[draw] + narrow[draw] * rng.standard_normal(size.size)
    return JointDraws(centre + size * means, centre + size * others, tuple(odd), tuple(runs_known))


def find_odd(values: Floats, errors: Floats, groups: Sequence[str], known: Flags) -> list[int]:
    """Indices of the runs that are outliers of their group, found one after the other."""
    remaining = np.flatnonzero(known).tolist()
    odd: list[int] = []
    while remaining:
        index = find_outlier(
            values[remaining], errors[remaining], [groups[one] for one in remaining], chance=ODD
        )
        if index is None:
            return odd
        odd.append(remaining.pop(index))
    return odd


def _widen(normal: Floats, pull: Floats, spread: Floats) -> tuple[Floats, Floats]:
    """Normal equations of the mean, if parameters scatter about it with these variances."""
    factor = np.linalg.inv(np.eye(spread.size) + normal * spread)
    weight: Floats = factor @ normal
    pulled: Floats = factor @ pull
    even: Floats = 0.5 * (weight + weight.T)
    return even, pulled


def _draw_normal(sharp: Floats, pull: Floats, rng: np.random.Generator) -> Floats:
    """Draw from the normal distribution with this precision matrix and precision times mean."""
    lower = np.linalg.cholesky(sharp)
    mean = np.linalg.solve(sharp, pull)
    return np.asarray(mean + np.linalg.solve(lower.T, rng.standard_normal(pull.size)), dtype=np.float64)
