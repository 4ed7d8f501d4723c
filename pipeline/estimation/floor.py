"""Noise floor: what no model of these runs can predict."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.core import Floats, robust_spreads
from pipeline.estimation.evidence import regress
from pipeline.estimation.held_out import score
from pipeline.estimation.noise import find_weights
from pipeline.estimation.path_residuals import HORIZONS_S
from pipeline.estimation.window_residuals import average_lags, locate_windows, make_features
from pipeline.models import Timing
from pipeline.run import HORIZON_S, MOVING_MPS, SPAN_S

if TYPE_CHECKING:
    from pipeline.estimation.errors import Errors
    from pipeline.estimation.estimation_data import EstimationData
    from pipeline.estimation.model_state import ModelState
    from pipeline.estimation.path_residuals import PathResiduals
    from pipeline.estimation.run_residuals import RunResiduals

_ROUNDS = 2
"""Times that the noise is learned: of what a model leaves, and of what the regression leaves of that."""


def estimate_floor(data: EstimationData, state: ModelState | None = None) -> Errors:
    """The errors of a model that explains everything but noise and random motion.

    A regression on the input of the last two seconds, the attitude, the heading and turned wheels
    stands for the best model: the errors of a model are lowered by as much as it lowers the sums of
    what that model leaves. Its numbers are as large as the data show beside the noise, so that it
    explains no noise. The errors refer to measured wheels if all runs have them, else to the command.

    Args:
        data: the runs.
        state: a model with its values; by default the ideal model.
    """
    path, state = data.paths[0], state or data.start_state()
    residual = path.find_residuals(state)
    before, after = (_measure(path, one) for one in (residual, _explain_all(path, residual)))
    errors = score(data if len(data.paths) == 1 else data.behind_wheels, state).pooled
    lowered: dict[str, Any] = {}
    for name, size in before.items():
        value = np.multiply(getattr(errors, name), np.minimum(after[name] / np.maximum(size, 1e-12), 1.0))
        lowered[name] = tuple(value.tolist()) if value.ndim else float(value)
    return replace(errors, **lowered)


def _measure(path: PathResiduals, residual: Floats) -> dict[str, Floats]:
    """Sizes of what increments add up to, by the names of `Errors`; empty where no prediction lasts 2 s."""
    over = path.list_horizon_errors(residual)[HORIZONS_S.index(HORIZON_S)]
    count = max(round(SPAN_S / float(np.median(path.spans))), 1)
    sums = np.vstack((np.zeros(3), np.cumsum(residual, axis=0)))
    piece = np.cumsum(path.fresh)
    whole = np.flatnonzero(piece[count - 1 :] == piece[: piece.size - count + 1])
    moved = sums[whole + count] - sums[whole]
    if not moved.size or not over.position.size:
        return {}
    sizes: dict[str, Floats] = {
        "velocity_rms": np.sqrt(np.mean(moved**2, axis=0)),
        "velocity_spread": robust_spreads(moved),
    }
    for letter, unit, squares in (("t", "m", over.position), ("r", "rad", over.heading)):
        sizes |= {
            f"{letter}_mrmse_{unit}": np.sqrt(squares.mean()),
            f"{letter}_mean_{unit}": np.sqrt(squares).mean(),
            f"{letter}_median_{unit}": np.median(np.sqrt(squares)),
        }
    return sizes


def _explain_all(path: PathResiduals, residual: Floats) -> Floats:
    """What a regression on the input's past, the attitude and turned wheels leaves of increments (n, 3)."""
    inputs = np.concatenate([_list_inputs(path, *one) for one in enumerate(path.residuals_by_run)])
    alike = np.broadcast_to(inputs[:, None, :], (*residual.shape, inputs.shape[1]))
    grounds = [np.flatnonzero(np.isin(path.run, group) if group else path.run >= 0) for group in path.grounds]
    rest = np.array(residual)
    for _ in range(_ROUNDS):
        noise = path.learn(rest)
        target = noise.whiten(residual[:, :, None], path.steps)[:, :, 0]
        weights = np.sqrt(find_weights(target))
        columns, target = noise.whiten(alike, path.steps, weights), weights * target
        for rows, known in product(grounds, noise.known):
            own = columns[rows, known]
            size = np.sqrt((own**2).mean(axis=0))
            live = np.flatnonzero(size > 0.0)
            numbers = regress(own[:, live] / size[live], target[rows, known])
            rest[rows, known] = residual[rows, known] - inputs[rows][:, live] @ (numbers / size[live])
    return rest


def _list_inputs(path: PathResiduals, run: int, run_residuals: RunResiduals) -> Floats:
    """Input of the last two seconds, attitude and turned wheels in every step of a run, shape (m, p)."""
    context, spans = run_residuals.context, locate_windows(run_residuals)
    velocity = run_residuals.predict_velocity((), Timing())
    lags = average_lags(run_residuals, velocity)
    middle = path.times[path.run == run].mean(axis=1)
    roll, pitch = (np.interp(middle, context.times, column) for column in context.attitude[:, :2].T)
    speed = np.abs(lags[:, 0, 0])
    yaw = context.attitude[:, 2]
    moves = np.tanh(np.abs(velocity.x) / MOVING_MPS)
    signals = [moves * wave(times * yaw) for times in (1.0, 2.0) for wave in (np.sin, np.cos)]
    if context.vehicle.kind == "differential":
        sides = (velocity.x + half * context.track_m * velocity.w for half in (-0.5, 0.5))
        for side in sides:
            turned = np.cumsum(side) * context.step_s / context.vehicle.wheel_radius_m
            signals += [side * np.sin(turned), side * np.cos(turned)]
    repeating = [spans.average(run_residuals, signal) for signal in signals]
    return np.column_stack(
        (make_features(lags), roll, pitch, speed * roll, speed * pitch, *repeating, np.ones(middle.size))
    )
