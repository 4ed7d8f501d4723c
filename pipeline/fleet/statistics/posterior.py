"""What another run would show of a number: draws from the model of levels, its spreads unknown too.

    y_r = mu + a_g(r) + b_r + e_r,    a ~ N(0, group spread^2),  b ~ N(0, run spread^2),  var e_r known

as in `levels`, with a flat prior on mu and a half-normal one on either spread (Gelman, Bayesian Analysis 1,
2006). Likely spreads are weighed, not the likeliest taken, so that few runs give wide answers, one run and a
group never seen included.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core.arrays import Floats
from pipeline.fleet.statistics.arrays import StatisticsError, check_values

# Spreads on a grid, as parts of the usual ones: steps of a fifth, from far below any that matters.
_GRID = np.geomspace(1e-3, 5.0, 48)


@dataclass(frozen=True)
class Draws:
    """Draws of a number, each of shape (n,).

    Attributes:
        group: the mean of the group.
        run: the number in another run of that group.
    """

    group: Floats
    run: Floats


def draw_run(
    values: ArrayLike,
    errors: ArrayLike,
    groups: Sequence[str],
    group: str,
    *,
    usual: tuple[float, float],
    count: int,
    rng: np.random.Generator,
) -> Draws:
    """Draw what another run of a group would show.

    Args:
        values: one number a run, shape (n,), n >= 1.
        errors: standard deviations of the numbers, shape (n,), positive.
        groups: label of each run's group, n of them.
        group: of the other run; may be one without runs.
        usual: spreads between groups and between runs of a group that are seldom exceeded; positive.
        count: how many draws.
        rng: source of chance.

    Raises:
        StatisticsError: ``too_few_values``, ``not_finite``, or ``bad_errors``: shapes differ, or an error or
            a usual spread is not positive.
    """
    y, s = check_values(values, what="values"), check_values(errors, what="errors")
    if not y.size == s.size == len(groups) or min(s.min(), *usual) <= 0.0:
        what = f"{y.size} values have {s.size} errors and {len(groups)} groups, usual spreads {usual}"
        hint = "Give every value a group and a positive error, and positive spreads."
        raise StatisticsError("bad_errors", what, hint=hint)
    names = sorted(set(groups))
    member = np.array([[name == label for label in groups] for name in names], dtype=np.float64)
    wide, narrow = (size * _GRID for size in usual)
    weight = 1.0 / (s**2 + narrow[:, None] ** 2)
    total = weight @ member.T
    means = (weight * y) @ member.T / total
    rest = np.sum(weight * (y - means @ member) ** 2, axis=1)
    within = -0.5 * (rest - np.log(weight).sum(axis=1) + np.log(total).sum(axis=1))
    # Axes: spread between groups, spread between runs, group.
    outer = 1.0 / (wide[:, None, None] ** 2 + 1.0 / total)
    mass = outer.sum(axis=2)
    centre = (outer * means).sum(axis=2) / mass
    away = np.sum(outer * (means - centre[:, :, None]) ** 2, axis=2)
    likelihood = within - 0.5 * (away - np.log(outer).sum(axis=2) + np.log(mass))
    # On a grid of equal ratios a density counts by its spread.
    prior = np.log(_GRID) - 0.5 * _GRID**2
    score = likelihood + prior[:, None] + prior
    chance = np.exp(score - score.max()).ravel()
    picked = rng.choice(chance.size, count, p=chance / chance.sum())
    between, run = np.unravel_index(picked, score.shape)
    common = centre[between, run] + rng.standard_normal(count) / np.sqrt(mass[between, run])
    known = np.zeros(count)
    pull = np.zeros(count)
    if group in names:
        place = names.index(group)
        known = total[run, place]
        pull = known * means[run, place]
    sharp = known + 1.0 / wide[between] ** 2
    own = (pull + common / wide[between] ** 2) / sharp + rng.standard_normal(count) / np.sqrt(sharp)
    return Draws(own, own + narrow[run] * rng.standard_normal(count))
