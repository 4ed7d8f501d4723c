"""Noise floor: what no model of these runs can predict."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec.structs import replace

from pipeline.core import FOLDS, Floats, robust_spreads
from pipeline.estimation.evidence import regress
from pipeline.estimation.held_out import score
from pipeline.estimation.noise import find_weights
from pipeline.estimation.path_residuals import HORIZONS_S
from pipeline.estimation.window_residuals import average_lags, locate_windows, make_features
from pipeline.models import Timing
from pipeline.run import HORIZON_S, MOVING_MPS, SPAN_S

if TYPE_CHECKING:
    from pipeline.estimation.estimation_data import EstimationData
    from pipeline.estimation.model_state import ModelState
    from pipeline.estimation.path_residuals import PathResiduals
    from pipeline.estimation.run_residuals import RunResiduals
    from pipeline.results import Errors

_NEAREST = 25
"""Nearest moments whose mean is taken."""
_MOST_NEAR = 4000
"""About how many moments are looked among: more take long, and are hardly nearer."""
_INPUT_S = np.arange(0.0, 2.01, 0.1)
_MOTION_S = (0.0, 0.1, 0.2, 0.4, 0.8)
"""How long ago input and motion count [s]."""
_ROUNDS = 2
"""Times that the noise is learned: of what a model leaves, and of what the regression leaves of that."""


def estimate_floor(data: EstimationData, state: ModelState | None = None) -> Errors:
    """The errors of a model that explains everything but noise and random motion.

    Two rests stand for the best model: a regression on the input of the last two seconds, the attitude, the
    heading and turned wheels, whose numbers are as large as the data show beside the noise; and the mean of
    the moments in other stretches whose input and motion were nearest, which no form binds. The errors of a
    model are lowered by as much as the better one lowers the sums of what that model leaves. They refer to
    measured wheels if all runs have them, else to the command.

    Args:
        data: the runs.
        state: a model with its values; by default the ideal model.
    """
    path, state = data.paths[0], state or data.start_state()
    residual = path.find_residuals(state)
    rests = (residual, _explain_all(path, residual), _explain_near(path, state, residual))
    before, *after = (_measure(path, one) for one in rests)
    errors = score(data if len(data.paths) == 1 else data.behind_wheels, state).pooled
    lowered: dict[str, Any] = {}
    for name, size in before.items():
        least = np.minimum.reduce([size, *(one[name] for one in after)])
        value = np.multiply(getattr(errors, name), least / np.maximum(size, 1e-12))
        lowered[name] = tuple(value.tolist()) if value.ndim else float(value)
    return replace(errors, **lowered)


def _explain_near(path: PathResiduals, state: ModelState, residual: Floats) -> Floats:
    """What the nearest moments of other blocks leave of increments (n, 3)."""
    from scipy.spatial import KDTree  # noqa: PLC0415 - heavy

    features = np.concatenate([_list_moments(path, state, run) for run in range(len(path.residuals_by_run))])
    features = features[:, np.ptp(features, axis=0) > 0.0]
    fold = np.random.default_rng(0).permutation(int(path.block.max()) + 1)[path.block] % FOLDS
    rest = np.array(residual)
    for number in range(FOLDS):
        known, asked = np.flatnonzero(fold != number), fold == number
        known = known[:: max(1, known.size // _MOST_NEAR)]
        if not known.size or not asked.any():
            continue
        mean, spread = features[known].mean(axis=0), features[known].std(axis=0) + 1e-9
        tree = KDTree((features[known] - mean) / spread)
        _, near = tree.query((features[asked] - mean) / spread, k=range(1, min(_NEAREST, known.size) + 1))
        rest[asked] -= residual[known][near].mean(axis=1)
    return rest


def _list_moments(path: PathResiduals, state: ModelState, run: int) -> Floats:
    """Two seconds of the input and .8 s of the model's motion at every step of a run, shape (m, p)."""
    one, middle = path.residuals_by_run[run], path.times[path.run == run].mean(axis=1)
    effects = [effect for effect in state.effects_of(run) if path.owns(effect)]
    ideal, moved = (one.predict_velocity(own, state.timing[run]) for own in ((), effects))
    pairs = [(ideal, late) for late in _INPUT_S] + [(moved, late) for late in _MOTION_S]
    signals = [(getattr(velocity, name), late) for velocity, late in pairs for name in ("x", "y", "w")]
    columns = [np.interp(middle - late, one.grid.times, signal) for signal, late in signals]
    return np.column_stack(columns)


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
