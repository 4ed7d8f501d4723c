"""Joint fit of one model to many runs, each weighted by its own residual scale.

    minimize  sum over runs r and channels of  w_r n_r (log(s_r) + mean(cost(residual / s_r)) / 2),

the likelihood of runs with unknown noise of their own: a gentle run counts as much as a fast one, whose
residuals are larger by a factor of ten, so that fast runs do not dominate the fit. The scale s_r of a run is
the one that minimizes this (Huber's concomitant scale), so that steps of weighted least squares decrease the
objective. w_r is 1, and less for runs on other grounds than the requested one. Residuals are those of models
whose states are reset to measured ones at the start of each prediction over 2 s (`Part.restarted`).

Source: Huber, Robust Statistics, 1981, chapter 7.

A ground parameter has one value per ground, shared by the runs on it; all other parameters belong to the
vehicle and have one value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Floats, guarded_spread
from pipeline.estimation.fit import PartFit, solve_step
from pipeline.estimation.learning import measure_excess
from pipeline.estimation.parts import CLIP, measure_spread
from pipeline.estimation.state import Weights, make_columns, pick_windows, weigh_columns

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
