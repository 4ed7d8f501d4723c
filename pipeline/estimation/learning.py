"""Intervals by driving time, fits with a prior, and estimates of effects that a model lacks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from pipeline.core.arrays import Floats, Ints
from pipeline.estimation.fit import Fitted, PartFit, fit_model, solve_step
from pipeline.estimation.intervals import (
    SHORTEST_TIME_S,
    Estimate,
    count_repeats,
    estimate_part,
    join_blocks,
    narrow_part,
)
from pipeline.estimation.parts import BodyPart, Part
from pipeline.estimation.problem import Problem
from pipeline.estimation.state import Prior
from pipeline.models.catalogue import find_effect
from pipeline.models.effect import Effect
from pipeline.models.model import Model

INTERVAL_SHARE = 0.05
"""Target half-width of a 95 % interval as a share of the parameter's size."""
_POINTS = 60
"""Maximum number of points of a curve in a figure."""


@dataclass(frozen=True)
class Curve:
    """Values by the seconds of driving, both of shape (k,)."""

    seconds: Floats
    values: Floats


def pick_points(count: int) -> Ints:
    """Indices of the points of a curve that are reported: at most sixty, including the first and the last."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, _POINTS)).round().astype(np.int64))


def narrow_intervals(fitted: Fitted) -> dict[str, Curve]:
    """Half-widths of the 95 % intervals of all smooth parameters of effects, by label ``effect.name``.

    See `narrow_part`; parameters of single runs are excluded.
    """
    curves: dict[str, Curve] = {}
    for part, fit in zip(fitted.problem.parts, fitted.fits, strict=True):
        if not fit.free:
            continue
        seconds, halves = narrow_part(part, fit)
        curves |= {
            number.label: Curve(seconds, halves[:, index])
            for index, number in enumerate(fit.free)
            if number.effect and number.run is None and number.is_smooth
        }
    return curves


def find_goal(effect: str, name: str, value: float) -> float:
    """Target half-width for a parameter: a share of its size, or of its typical size if that is larger."""
    parameter = find_effect(effect)().parameter(name)
    neutral = parameter.neutral if math.isfinite(parameter.neutral) else 0.0
    return INTERVAL_SHARE * max(abs(value), abs(parameter.typical - neutral))


def last_until(curve: Curve, goal: float) -> float:
    """Seconds after which a curve stays at or below a goal; infinite if it ends above it."""
    above = np.flatnonzero(~(curve.values <= goal))
    if above.size == 0:
        return float(curve.seconds[0])
    if above[-1] == curve.seconds.size - 1:
        return math.inf
    return float(curve.seconds[above[-1] + 1])


def extrapolate(curve: Curve, goal: float) -> float:
    """Seconds of such driving after which a width would reach a goal; infinite if it never would.

    The square of a width is the sum of a part that falls with the driving time, and of a constant: more
    driving does not reduce the clock errors. Both are fitted to the later half of the curve.
    """
    seconds, squares = curve.seconds, curve.values**2
    later = np.isfinite(squares) & (seconds >= 0.5 * seconds[-1])
    if later.sum() < 2:  # noqa: PLR2004 - two numbers are read from it
        return float(seconds[-1] * squares[-1] / goal**2)
    slope, stays = np.polyfit(1.0 / seconds[later], squares[later], 1)
    # The extrapolation begins at the last width, even if the fit deviates from it.
    falls = float(np.clip(slope / seconds[-1], 0.0, squares[-1]))
    stays = float(squares[-1]) - falls
    return math.inf if stays >= goal**2 else float(seconds[-1]) * falls / (goal**2 - stays)


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


def estimate_unnamed(fitted: Fitted, candidates: Iterable[Effect]) -> tuple[Estimate, ...]:
    """Estimates of effects that a fitted model lacks, each added to it alone.

    Excluded are effects that the model has, that do not act on its input, or whose parameters derivatives
    cannot optimize, and parameters that are not observable or undetermined within their bounds.

    Args:
        fitted: a converged fit.
        candidates: effects at neutral values.
    """
    estimates: list[Estimate] = []
    labels = [join_blocks(part, fit) for part, fit in zip(fitted.problem.parts, fitted.fits, strict=True)]
    for effect in candidates:
        if effect.id in fitted.model or not all(math.isfinite(p.neutral) for p in effect.parameters):
            continue
        for part, fit, label in zip(fitted.problem.parts, fitted.fits, labels, strict=True):
            if part.owns(effect):
                estimates += _estimate_added(part, fit, label, effect)
                break
    return tuple(estimates)


def _estimate_added(part: Part, fit: PartFit, label: Ints, effect: Effect) -> list[Estimate]:
    added = fit.state.add(effect)
    new = tuple(n for n in part.list_free(added) if n.effect == effect.id)
    if not all(number.is_smooth for number in new):
        return []
    columns = part.differentiate(added, fit.residual, new)
    grown = PartFit(
        added,
        (*fit.free, *new),
        fit.residual,
        np.concatenate((fit.jacobian, columns), axis=2),
        fit.weights,
        fit.loss,
    )
    step, _ = solve_step(grown.jacobian, grown.residual, grown.weights)
    made = {item.free: item for item in estimate_part(part, grown, step, label).items}
    if not all(made[number].observable for number in new):
        return []
    return [replace(made[number], at_bound=False) for number in new if math.isfinite(made[number].low)]
