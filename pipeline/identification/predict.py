"""Predicting: velocities of a run from a model, and its poses over a horizon from measured states."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Floats, join_parts, turn_units
from pipeline.identification.comparison import Comparison, Input
from pipeline.models.effect import Effect
from pipeline.models.forward import Timing
from pipeline.models.model import Model
from pipeline.runs.recording import MotionRun
from pipeline.runs.windows import HORIZON_S


@dataclass(frozen=True)
class Prediction:
    """What a model says of a run.

    Attributes:
        start_times: times at which predictions begin [s], shape (k,).
        poses: (x [m], y [m], yaw [rad]) in the map, by prediction and time since its start, shape (k, m, 3).
        horizon_times: times since a prediction's start [s], shape (m,).
    """

    start_times: Floats
    poses: Floats
    horizon_times: Floats


def predict_from(
    comparison: Comparison, effects: Sequence[Effect], timing: Timing, *, rate_hz: float = 20.0
) -> Prediction:
    """Predict a run over `HORIZON_S` from where it was measured to be, again and again.

    Args:
        comparison: the run and its input.
        effects: of the model, with their values.
        timing: delays of the recording.
        rate_hz: grid of the result; the model itself runs at `choose_rate`.
    """
    velocity = comparison.predict_velocity(effects, timing)
    cells = comparison.cells
    start_times, start = comparison.list_starts()
    turned = cells.sum_up(velocity.w)
    own = turn_units(0.5 * (turned[1:] + turned[:-1]))
    travelled = cells.sum_up(join_parts(velocity.x, velocity.y) * own)
    since = np.arange(0.0, HORIZON_S + 0.5 / rate_hz, 1.0 / rate_hz)
    at = cells.locate_edges((start_times[:, None] + since).ravel())
    index = np.arange(turned.size, dtype=np.float64)
    yaw = np.interp(at, index, turned).reshape(start_times.size, since.size)
    path = np.interp(at, index, travelled.real) + 1j * np.interp(at, index, travelled.imag)
    path = path.reshape(yaw.shape)
    turn = np.exp(1j * (start[:, 2] - yaw[:, 0]))
    moved = turn[:, None] * (path - path[:, :1])
    x, y, heading = start[:, :1] + moved.real, start[:, 1:2] + moved.imag, start[:, 2:] + yaw - yaw[:, :1]
    return Prediction(start_times, np.stack((x, y, heading), axis=-1), since)


def predict_at(model: Model, run: MotionRun, source: Input, at: Floats) -> Floats:
    """Body velocities of a model at given times, to set measured ones against: slip relative to the model.

    Args:
        model: with its values.
        run: whose commands or wheels are followed.
        source: what the model is fed with.
        at: times of aligned poses [s], shape (n,).

    Returns:
        (v_x [m/s], v_y [m/s], v_w [rad/s]) as the localization would report them, NaN in holes of the
        recording, shape (n, 3).

    Raises:
        MotionError: the run lacks the input.
    """
    comparison = Comparison(run, model.vehicle, source)
    return predict_at_from(comparison, model.effects, Timing(), at)


def predict_at_from(comparison: Comparison, effects: Sequence[Effect], timing: Timing, at: Floats) -> Floats:
    """As `predict_at`, of a run that has been made ready already.

    Args:
        comparison: the run and its input.
        effects: of the model, with their values.
        timing: delays of the recording.
        at: times of aligned poses [s], shape (n,).
    """
    velocity = comparison.predict_velocity(effects, timing)
    cells = comparison.cells
    columns = [np.interp(at, cells.times, values) for values in (velocity.x, velocity.y, velocity.w)]
    found = np.column_stack(columns)
    found[cells.find_span(at) < 0] = np.nan
    return found
