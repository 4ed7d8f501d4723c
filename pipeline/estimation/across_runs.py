"""Across runs and grounds: joint fits, fits with a prior from other runs, and bands of predictions.

A joint fit of one model to many runs weights each by its own residual scale:

    minimize  sum over runs r and channels of  w_r n_r (log(s_r) + mean(cost(residual / s_r)) / 2),

the likelihood of runs with unknown noise of their own: a gentle run counts as much as a fast one, whose
residuals are larger by a factor of ten, so that fast runs do not dominate the fit. The scale s_r of a run is
the one that minimizes this (Huber's concomitant scale), so that steps of weighted least squares decrease the
objective. w_r is 1, and less for runs on other grounds than the requested one. Residuals are those of models
whose states are reset to measured ones at the start of each prediction over 2 s (`Part.restarted`).

Source: Huber, Robust Statistics, 1981, chapter 7.

A ground parameter has one value per ground, shared by the runs on it; all other parameters belong to the
vehicle and have one value.

Bands of predictions over 2 s are conformal, by groups, and adapted during a run. An error is divided by the
distance predicted until then. The band of a model is the 95 % quantile of these ratios on grounds that it was
not fitted on: all grounds have the same weight, and so have all ten-second stretches of a ground. During a
run, the band adapts to the preceding errors (adaptive conformal inference; Gibbs and Candes, NeurIPS 2021),
so that its long-run coverage is 19 of 20 on any ground.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import CONFIDENCE, format_share
from pipeline.core.arrays import Floats, Ints, guarded_spread
from pipeline.estimation.comparison import Comparison
from pipeline.estimation.fit import Fitted, PartFit, fit_model, solve_step
from pipeline.estimation.folds import HeldOut, number_predictions
from pipeline.estimation.intervals import (
    SHORTEST_TIME_S,
    count_repeats,
)
from pipeline.estimation.parts import CLIP, BodyPart, Part, measure_spread
from pipeline.estimation.problem import Problem
from pipeline.estimation.state import Prior, State, Weights, make_columns, pick_windows, weigh_columns
from pipeline.models.learned_term import LEAST_WAY_M, Bands
from pipeline.models.model import Model

if TYPE_CHECKING:
    from pipeline.estimation.parts import Part
    from pipeline.estimation.state import Free, State


_ITERATIONS = 20
"""Maximum number of steps of a joint fit: a safeguard, `_ENOUGH` ends it."""
_SCALE_ROUNDS = 20
"""Maximum number of rounds of a scale: a safeguard, each round reduces its error tenfold."""
_SAME_SCALE = 1e-6
"""Relative change below which a scale counts as unchanged."""
_DAMPINGS = (1e-3, 1e-1, 1e1)
"""Damping relative to the diagonal, tried in turn until a step lowers the loss: nearly Gauss-Newton first,
nearly steepest descent last."""
_ENOUGH = 1e-5
"""Decrease of the mean logarithm of the spread below which a fit ends."""


@dataclass(frozen=True)
class RunNormal:
    """Normal equations of one run for the free parameters of a joint fit (`fleet.joint_levels.RunEvidence`).

    Attributes:
        labels: ``effect.name`` of the parameters.
        normal: normal matrix for independent residuals of the run's own scale, shape (p, p).
        pull: right side, shape (p,).
    """

    labels: tuple[str, ...]
    normal: Floats
    pull: Floats


def fit_part_jointly(part: Part, state: State, run_weights: Floats | None = None) -> PartFit:
    """Fit the shared parameters of runs on one part of the path, from their current values, and run delays.

    The fit uses predictions over 2 s whose states begin at measured ones: the parameters serve such
    predictions, and model errors do not accumulate over a long drive.

    Args:
        part: part of the path, of several runs.
        state: effects with the values to start from.
        run_weights: weight of each run, shape (runs,); equal by default.

    Returns:
        The fit, with the weights of residuals within their own run.
    """
    part = part.restarted
    shares = np.ones(len(part.comparisons)) if run_weights is None else run_weights
    by_ground = list_ground_labels(state)
    free = tuple(number for number in part.list_free(state, by_ground) if number.is_smooth)
    ties = _tie_grounds(part, free, by_ground)
    best = _look(part, state, free, shares)
    for _ in range(_ITERATIONS if free else 0):
        jacobian = part.differentiate(best.state, best.residual, free)
        for damping in _DAMPINGS:
            step, _ = solve_step(jacobian @ ties, best.residual, _share(part, best.weights, shares), damping)
            tried = _look(part, best.state.move(free, (ties @ step).tolist()), free, shares)
            if tried.loss < best.loss:
                break
        else:
            break
        fall, best = best.loss - tried.loss, tried
        if fall < _ENOUGH:
            break
    jacobian = part.differentiate(best.state, best.residual, free)
    return replace(best, state=best.state.centred, jacobian=jacobian)


def list_ground_labels(state: State) -> list[str]:
    """Labels of the parameters of a state with one value per ground."""
    return [label for effect in state.effects for label in effect.ground_labels]


def _tie_grounds(part: Part, free: Sequence[Free], by_ground: Sequence[str]) -> Floats:
    """Matrix from shared to single parameters, shape (p, q): ground parameters are equal in its runs."""
    grounds = [comparison.run.terrain for comparison in part.comparisons]
    keys = [
        (
            number.label,
            grounds[number.run] if number.label in by_ground and number.run is not None else number.run,
        )
        for number in free
    ]
    places = {key: index for index, key in enumerate(dict.fromkeys(keys))}
    ties = np.zeros((len(keys), len(places)))
    ties[np.arange(len(keys)), [places[key] for key in keys]] = 1.0
    return ties


def _look(part: Part, state: State, free: tuple[Free, ...], shares: Floats) -> PartFit:
    """A state with its loss and with weights by each run's own scale."""
    residual = part.find_residuals(state)
    scale = measure_spread(residual, part, _measure_scale)
    weights = Weights(scale, np.full(scale.shape, CLIP))
    channels = list(part.channels)
    costs = np.log(scale[:, channels]).mean(axis=1) + 0.5 * weights.cost(residual) / len(channels)
    loss = float(np.average(costs[part.live], weights=shares[part.run[part.live]]))
    return PartFit(state, free, residual, make_columns(residual.shape[0], len(free)), weights, loss)


def _measure_scale(size: Floats, clip: float, least: float) -> float:
    """Huber's concomitant scale of residuals of these sizes, shape (k,)."""
    scale = guarded_spread(size, clip, least)
    for _ in range(_SCALE_ROUNDS):
        weight = clip * scale / np.maximum(size, clip * scale)
        before, scale = scale, max(float(np.sqrt(np.mean(weight * size**2))), least)
        if abs(scale - before) < _SAME_SCALE * scale:
            break
    return scale


def _share(part: Part, weights: Weights, shares: Floats) -> Weights:
    """The weights times those of the runs."""
    root = np.sqrt(shares[part.run])[:, None]
    return Weights(weights.scale / root, weights.clip * root)


def split_normals(part: Part, fit: PartFit) -> list[RunNormal]:
    """Normal equations of each run of a fit, with parameters of single runs and delays eliminated.

    For a ground parameter, a run contributes to the value of its own ground.
    """
    by_ground = list_ground_labels(fit.state)
    excess = measure_excess(part, fit)
    factor = fit.weights.factors(fit.residual)
    values = np.array([fit.state.get(number) for number in fit.free])
    normals = []
    for run in range(len(part.comparisons)):
        common = [
            index
            for index, number in enumerate(fit.free)
            if number.effect and (number.run is None or (number.run == run and number.label in by_ground))
        ]
        rows = part.run == run
        columns = weigh_columns(pick_windows(fit.jacobian, rows), factor[rows])
        normal = columns.T @ columns / excess
        pull = columns.T @ (fit.residual[rows] * factor[rows]).reshape(-1) / excess + normal @ values
        own = [n for n in range(len(fit.free)) if n not in common and fit.free[n].run in {None, run}]
        shared = normal[np.ix_(common, own)] @ np.linalg.pinv(normal[np.ix_(own, own)])
        normals.append(
            RunNormal(
                tuple(fit.free[index].label for index in common),
                normal[np.ix_(common, common)] - shared @ normal[np.ix_(own, common)],
                pull[common] - shared @ pull[own],
            )
        )
    return normals


def tie_to_prior(problem: Problem, model: Model, numbers: Mapping[str, tuple[float, float]]) -> Problem:
    """The problem with a prior on the model's parameters.

    The overdispersion of the residuals is taken from the fit without the prior: a prior that contradicts
    the runs increases the residuals, and would thereby increase its own weight.

    Args:
        problem: the runs.
        model: its effects start at their values.
        numbers: mean and standard deviation by label ``effect.name``.

    Returns:
        The prepared runs, shared with `problem`, with the prior in every part.
    """
    alone = fit_model(problem, model)
    excess = [measure_excess(part, fit) for part, fit in zip(problem.parts, alone.fits, strict=True)]
    return _tie(problem, [Prior(numbers, one) for one in excess])


def fit_with_prior(problem: Problem, model: Model, numbers: Mapping[str, tuple[float, float]]) -> Fitted:
    """Fit a model with a prior on its parameters; see `tie_to_prior`."""
    return fit_model(tie_to_prior(problem, model, numbers), model, exact=True)


def measure_excess(part: Part, fit: PartFit) -> float:
    """Factor by which the summed cost of residuals overstates their information.

    It is the product of two factors. The first is the autocorrelation time of the residuals over their
    distance; that time is at least that of the shortest blocks of `intervals.join_blocks`, as a few seconds
    are too short to estimate it. The second is the mean square of the residuals in units of the spreads of
    their weights, if above one: the model then leaves more than noise.
    """
    live = fit.residual[part.live] if part.live.any() else fit.residual
    scale = fit.weights.scale[part.live] if part.live.any() else fit.weights.scale
    squares = np.mean((live / scale)[:, list(part.channels)] ** 2)
    distance = float(np.median(np.diff(part.times.mean(axis=1))))
    repeats = max(count_repeats(part, fit), SHORTEST_TIME_S / max(distance, 1e-3))
    count = live.shape[0] * len(part.channels) / repeats
    freedom = max(count - len(fit.free), 1.0)
    return float(repeats * max(float(squares) * count / freedom, 1.0))


def _tie(problem: Problem, priors: list[Prior]) -> Problem:
    parts = tuple(copy(part) for part in problem.parts)
    for part, prior in zip(parts, priors, strict=True):
        part.prior = prior
    body = parts[0]
    whole = body if problem.whole is problem.parts[0] and isinstance(body, BodyPart) else problem.whole
    return problem.with_parts(whole, parts)


# Estimates of effects that a model lacks, to first order.
#
# A comparison of runs also needs an estimate of effects not named in a run: it is that of one step of
# the joint fit with the effect added, and its error includes the uncertainty of the other parameters.


_ROUNDING = 1e-9
"""Tolerance of the sum of all weights for the rounding of doubles."""
_STEP = 0.5
"""Change of the logarithm of an adaptive band per unit of coverage error: a missed prediction widens it by
61 %, a covered one narrows it by 2.5 %; in the long run one in twenty is missed."""


@dataclass(frozen=True)
class Ratios:
    """Errors of predictions divided by the distance travelled until then, of one run.

    Attributes:
        group: group of the run, such as its ground.
        position, heading: [m/m] and [rad/m], NaN without a prediction, shape (n,) each.
        stretches: the ten-second stretch of each, shape (n,).
        number: the prediction of each, in order of time, shape (n,).
    """

    group: str
    position: Floats
    heading: Floats
    stretches: Ints
    number: Ints

    def read(self, metric: str) -> Floats:
        """Ratios of `position` or `heading`."""
        return self.position if metric == "position" else self.heading


@dataclass(frozen=True)
class Coverage:
    """Shares of errors within bands.

    Attributes:
        as_it_is: coverage of the fixed bands.
        followed: coverage of bands that adapt during the run.
    """

    as_it_is: float
    followed: float


def list_ratios(problem: Problem, state: State, held_out: HeldOut) -> list[Ratios]:
    """Errors divided by the distance travelled, of each run.

    Args:
        problem: the runs.
        state: the model that predicts the distances.
        held_out: its held-out errors.
    """
    stretches = number_predictions(problem)
    return [
        _divide(comparison, state, run, held_out, stretches[run])
        for run, comparison in enumerate(problem.comparisons)
    ]


def _divide(comparison: Comparison, state: State, run: int, held_out: HeldOut, stretches: Ints) -> Ratios:
    effects = state.effects_of(run)
    travelled_m = comparison.find_horizon_shifts(effects, effects, state.timing[run])[2] + LEAST_WAY_M
    return Ratios(
        comparison.run.terrain,
        held_out.position[run] / travelled_m,
        held_out.yaw[run] / travelled_m,
        stretches,
        comparison.horizons.number,
    )


def make_bands(ratios: Sequence[Ratios], of: str) -> Bands | None:
    """Bands with a coverage of 95 %, with equal weights of groups and of ten-second stretches within them.

    The level includes the finite-sample correction for the number of stretches; None if there are too few.

    Args:
        ratios: ratios of runs, from fits without them.
        of: description of them.
    """
    position, heading = (_find_quantile(ratios, metric) for metric in ("position", "heading"))
    return Bands(position, heading, of) if math.isfinite(position + heading) else None


def _find_quantile(ratios: Sequence[Ratios], metric: str) -> float:
    values, shares, stretches = list[Floats](), list[Floats](), 0
    groups = sorted({one.group for one in ratios})
    for group in groups:
        mine = [one for one in ratios if one.group == group]
        known = [np.isfinite(one.read(metric)) for one in mine]
        value = np.concatenate([one.read(metric)[rows] for one, rows in zip(mine, known, strict=True)])
        # Stretches of two runs may have the same number.
        label = np.concatenate(
            [
                2**32 * run + one.stretches[rows]
                for run, (one, rows) in enumerate(zip(mine, known, strict=True))
            ]
        )
        _, rows_of, counts = np.unique(label, return_inverse=True, return_counts=True)
        if counts.size == 0:
            continue
        values.append(value)
        shares.append(1.0 / (counts.size * counts[rows_of]))
        stretches += counts.size
    if not values:
        return math.nan
    every, weight = np.concatenate(values), np.concatenate(shares) / len(values)
    order = np.argsort(every)
    level = CONFIDENCE * (1.0 + 1.0 / stretches)
    index = int(np.searchsorted(np.cumsum(weight[order]), level - _ROUNDING))
    return float(every[order][index]) if index < every.size else math.inf


def measure_coverage(bands: Bands, ratios: Iterable[Ratios]) -> dict[str, Coverage]:
    """Coverage of bands on runs, for `position` and `heading`."""
    known = list(ratios)
    return {
        metric: Coverage(
            float(
                np.mean(np.concatenate([_hold(one.read(metric), getattr(bands, metric)) for one in known]))
            ),
            float(np.mean(np.concatenate([_follow(one, metric, getattr(bands, metric)) for one in known]))),
        )
        for metric in ("position", "heading")
    }


def describe_coverage(coverages: Mapping[str, Coverage]) -> list[str]:
    """Coverage of bands as a line of text; empty without bands."""
    if not coverages:
        return []
    held = [f"{format_share(one.as_it_is, 0)} of the {name} errors" for name, one in coverages.items()]
    followed = " and ".join(format_share(one.followed, 0) for one in coverages.values())
    return [f"the 95 % bands hold {' and '.join(held)}; following the run, {followed}"]


def _hold(ratios: Floats, band: float) -> Floats:
    return (ratios[np.isfinite(ratios)] <= band).astype(np.float64)


def _follow(ratios: Ratios, metric: str, band: float) -> Floats:
    """Which errors are within a band that adapts to the preceding predictions."""
    every, held = ratios.read(metric), list[Floats]()
    for number in np.unique(ratios.number).tolist():
        now = _hold(every[ratios.number == number], band)
        if now.size:
            held.append(now)
            band *= math.exp(_STEP * (CONFIDENCE - float(now.mean())))
    return np.concatenate(held) if held else np.zeros(0)
