"""Noise floor: what no model of these runs can predict."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import Floats
from pipeline.estimation.evidence import regress
from pipeline.estimation.fit import whiten
from pipeline.estimation.held_out import score
from pipeline.estimation.parts import HORIZONS_S
from pipeline.estimation.window_residuals import average_lags, make_features
from pipeline.models import Timing
from pipeline.run import HORIZON_S, SPAN_S

if TYPE_CHECKING:
    from pipeline.estimation.comparison import Comparison
    from pipeline.estimation.errors import Errors
    from pipeline.estimation.parts import Part
    from pipeline.estimation.problem import Problem
    from pipeline.estimation.state import State

_ROUNDS = 2
"""Times that the noise is learned: of what a model leaves, and of what the regression leaves of that."""


def estimate_floor(problem: Problem, state: State) -> Errors:
    """The errors of a model that explains everything but noise and random motion.

    A regression on the input of the last two seconds and on the attitude stands for the best model: the
    errors of a model are lowered by as much as it lowers the sums of what that model leaves. Its numbers
    are as large as the data show beside the noise, so that it explains no noise. The errors refer to
    measured wheels if all runs have them, else to the command.

    Args:
        problem: the runs.
        state: a model with its values.
    """
    part = problem.parts[0]
    residual = part.find_residuals(state)
    rest = _explain_all(part, residual)
    errors = score(problem if len(problem.parts) == 1 else problem.behind_wheels, state).pooled
    before, after = (_measure(part, one) for one in (residual, rest))
    x, y, w, t, r = np.minimum(after / np.maximum(before, 1e-12), 1.0).tolist()
    names = {name: t if name.startswith("t_") else r for name in vars(errors) if name[:2] in ("t_", "r_")}
    return replace(
        errors,
        velocity_rms=tuple(np.multiply(errors.velocity_rms, (x, y, w)).tolist()),
        velocity_spread=tuple(np.multiply(errors.velocity_spread, (x, y, w)).tolist()),
        **{name: share * getattr(errors, name) for name, share in names.items()},
    )


def _measure(part: Part, residual: Floats) -> Floats:
    """Root mean square of what increments add up to: x, y, w over a window, position and heading over 2 s."""
    over = part.list_horizon_errors(residual)[HORIZONS_S.index(HORIZON_S)]
    count = max(round(SPAN_S / float(np.median(part.spans))), 1)
    sums = np.vstack((np.zeros(3), np.cumsum(residual, axis=0)))
    piece = np.cumsum(part.fresh)
    whole = np.flatnonzero(piece[count - 1 :] == piece[: piece.size - count + 1])
    squares = (sums[whole + count] - sums[whole]) ** 2
    means = np.append(squares.mean(axis=0), (over.position.mean(), over.heading.mean()))
    return np.asarray(np.sqrt(means), dtype=np.float64)


def _explain_all(part: Part, residual: Floats) -> Floats:
    """What a regression on the input's past and the attitude leaves of increments, shape (n, 3)."""
    inputs = [_list_inputs(part, run, comparison) for run, comparison in enumerate(part.comparisons)]
    columns = np.concatenate(inputs)
    repeated = np.repeat(columns[:, None, :], 3, axis=1)
    rest = np.array(residual)
    for _ in range(_ROUNDS):
        noise = part.learn(rest)
        white = whiten(part, noise, residual, repeated)
        channel = np.tile(noise.known, part.run.size)
        for run in range(len(part.comparisons)):
            mine = part.run == run
            for known in noise.known:
                rows = (channel == known) & mine[white.rows]
                size = np.sqrt((white.columns[rows] ** 2).mean(axis=0))
                live = np.flatnonzero(size > 0.0)
                numbers = regress(white.columns[rows][:, live] / size[live], white.residual[rows])
                rest[mine, known] = residual[mine, known] - columns[mine][:, live] @ (numbers / size[live])
    return rest


def _list_inputs(part: Part, run: int, comparison: Comparison) -> Floats:
    """Input of the last two seconds and attitude in every step of a run, shape (m, p)."""
    context = comparison.context
    lags = average_lags(comparison, comparison.predict_velocity((), Timing()))
    middle = part.times[part.run == run].mean(axis=1)
    roll, pitch = (np.interp(middle, context.times, column) for column in context.attitude[:, :2].T)
    speed = np.abs(lags[:, 0, 0])
    return np.column_stack(
        (make_features(lags), roll, pitch, speed * roll, speed * pitch, np.ones(middle.size))
    )
