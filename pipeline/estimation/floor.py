"""Noise floor: what no model of these runs can predict."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.errors import Errors
from pipeline.estimation.window_residuals import average_lags, make_features, regress_robustly
from pipeline.models import Timing
from pipeline.run import HORIZON_S, SPAN_S

if TYPE_CHECKING:
    from pipeline.core import Floats
    from pipeline.estimation.comparison import Comparison
    from pipeline.estimation.parts import Part

# Noise floor: the errors that remain for a model that explains all but noise.
#
# A regression on the input of the last two seconds and on the attitude stands for the best model; the noise
# of what it leaves (`noise.Noise`) says in closed form how the sum of increments spreads with time.


def estimate_floor(part: Part, residual: Floats, windows: int) -> Errors:
    """The errors of a model that explains everything but noise and random motion.

    They refer to measured wheels if all runs have them, else to the command.

    Args:
        part: of the path, which ends at the body.
        residual: increments that a model leaves, from which it is estimated, shape (n, 3).
        windows: number of windows of the runs.
    """
    rest = _explain_all(part, residual)
    noise = part.learn(rest)
    after = np.linspace(noise.step_s, HORIZON_S, 8)
    poses, motion = noise.spread_after(after)
    speed = np.concatenate([np.hypot(*_list_speeds(comparison)) for comparison in part.comparisons])
    # An error of the heading turns what is travelled after it: that of the first pose, and a walk since then.
    turned = 0.5 * poses[:, 2] + motion[:, 2] / 3.0
    lever = float(np.mean(speed**2)) * after**2 * turned
    position = np.sqrt(poses[:, 0] + poses[:, 1] + motion[:, 0] + motion[:, 1] + lever)
    yaw = np.sqrt(poses[:, 2] + motion[:, 2])
    at_window, moved = noise.spread_after(np.array([SPAN_S]))
    x, y, w = (np.sqrt(at_window[0] + moved[0]) / SPAN_S).tolist()
    # For normal errors, the size of two coordinates is Rayleigh distributed, that of one half-normal.
    return Errors(
        velocity_rms=(x, y, w),
        velocity_spread=(x, y, w),
        t_mrmse_m=float(np.sqrt(np.mean(position**2))),
        r_mrmse_rad=float(np.sqrt(np.mean(yaw**2))),
        t_mean_m=0.5 * math.sqrt(math.pi) * float(position.mean()),
        r_mean_rad=math.sqrt(2.0 / math.pi) * float(yaw.mean()),
        t_median_m=math.sqrt(math.log(2.0)) * float(position.mean()),
        r_median_rad=0.6745 * float(yaw.mean()),
        windows=windows,
    )


def _list_speeds(comparison: Comparison) -> tuple[Floats, Floats]:
    velocity = comparison.predict_velocity((), Timing())
    return velocity.x, velocity.y


def _explain_all(part: Part, residual: Floats) -> Floats:
    """What a regression on the input's past and the attitude leaves of increments, shape (n, 3)."""
    rest = np.array(residual)
    for run, comparison in enumerate(part.comparisons):
        rows = part.run == run
        context = comparison.context
        lags = average_lags(comparison, comparison.predict_velocity((), Timing()))
        middle = part.times[rows].mean(axis=1)
        roll, pitch = (np.interp(middle, context.times, column) for column in context.attitude[:, :2].T)
        speed = np.abs(lags[:, 0, 0])
        columns = np.column_stack((make_features(lags), roll, pitch, speed * roll, speed * pitch))
        for channel in part.channels:
            rest[rows, channel] = regress_robustly(columns, residual[rows, channel])
    return rest
