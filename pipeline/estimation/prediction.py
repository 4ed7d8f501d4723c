"""Predictions of a run by a model: body velocities, and poses over the next seconds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import join_parts, turn_units
from pipeline.estimation.run_residuals import Input, RunResiduals
from pipeline.models import Effect, Model, Timing
from pipeline.run import HORIZON_S, MotionRun

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core import Floats


@dataclass(frozen=True)
class Prediction:
    """Predictions of a run by a model.

    Attributes:
        start_times: times at which predictions begin [s], shape (k,).
        poses: (x [m], y [m], yaw [rad]) in the map, by prediction and time since its start, shape (k, m, 3).
        horizon_times: times since a prediction's start [s], shape (m,).
    """

    start_times: Floats
    poses: Floats
    horizon_times: Floats


def predict_from(
    run_residuals: RunResiduals, effects: Sequence[Effect], timing: Timing, *, rate_hz: float = 20.0
) -> Prediction:
    """Predict a run over `HORIZON_S`, repeatedly from measured poses.

    Args:
        run_residuals: the run and its input.
        effects: effects of the model, with their values.
        timing: delays of the recording.
        rate_hz: rate of the result; the model itself runs at `choose_rate`.
    """
    velocity = run_residuals.predict_velocity(effects, timing)
    grid = run_residuals.grid
    start_times, start = run_residuals.list_starts()
    turned = grid.sum_up(velocity.w)
    own = turn_units(0.5 * (turned[1:] + turned[:-1]))
    travelled = grid.sum_up(join_parts(velocity.x, velocity.y) * own)
    since = np.arange(0.0, HORIZON_S + 0.5 / rate_hz, 1.0 / rate_hz)
    at = grid.locate_edges((start_times[:, None] + since).ravel())
    index = np.arange(turned.size, dtype=np.float64)
    yaw = np.interp(at, index, turned).reshape(start_times.size, since.size)
    path = np.interp(at, index, travelled.real) + 1j * np.interp(at, index, travelled.imag)
    path = path.reshape(yaw.shape)
    origin = run_residuals.run.origin
    turned = start[:, 2:] + yaw - yaw[:, :1] + origin.heading
    turn = np.exp(1j * (start[:, 2] - yaw[:, 0] + origin.heading))
    begin = origin.put_back(join_parts(start[:, 0], start[:, 1]))
    along = begin[:, None] + turn[:, None] * (path - path[:, :1])
    poses = np.stack((along.real, along.imag, turned), axis=-1)
    return Prediction(start_times + origin.time_s, poses, since)


def predict_at(model: Model, run: MotionRun, source: Input, at: Floats) -> Floats:
    """Body velocities of a model at given times; measured ones less these are slip relative to the model.

    Args:
        model: model with its values.
        run: run with the commands or wheels.
        source: input of the model.
        at: times of aligned poses [s], shape (n,).

    Returns:
        (v_x [m/s], v_y [m/s], v_w [rad/s]) as the localization would report them, NaN in gaps of the
        recording, shape (n, 3).

    Raises:
        MotionError: the run lacks the input.
    """
    run_residuals = RunResiduals(run, model.vehicle, source)
    return predict_at_from(run_residuals, model.effects, Timing(), at)


def predict_at_from(
    run_residuals: RunResiduals, effects: Sequence[Effect], timing: Timing, at: Floats
) -> Floats:
    """As `predict_at`, for a prepared run.

    Args:
        run_residuals: the run and its input.
        effects: effects of the model, with their values.
        timing: delays of the recording.
        at: times of aligned poses [s], shape (n,).
    """
    velocity = run_residuals.predict_velocity(effects, timing)
    grid = run_residuals.grid
    at = at - run_residuals.run.origin.time_s
    columns = [np.interp(at, grid.times, values) for values in (velocity.x, velocity.y, velocity.w)]
    predicted = np.column_stack(columns)
    predicted[grid.find_span(at) < 0] = np.nan
    return predicted
