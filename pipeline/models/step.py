"""What a model makes of a step of the command: from rest, on level ground."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from pipeline.models.model import ForwardModel, Timing
from pipeline.run import DriveSeries, Grid, Resets, RunContext, Velocity

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core import Floats
    from pipeline.models.effect import Effect
    from pipeline.sources import Vehicle

STEP_CELL_S = 0.02
"""Step of the model [s], that of its fits."""
_RESTS_S = 1.0
"""Time at rest before the step [s]: more than the longest dead time."""
_COMMAND_S = 0.05
_LEAST_REST = 1e-3
"""Rest of a motion that has ended."""
_RISEN = 1.0 - math.exp(-1.0)
"""Share of its end value that a first-order lag reaches after its time constant."""


def predict_step(
    vehicle: Vehicle, effects: Sequence[Effect], speed: float, turn: float, duration_s: float
) -> Velocity:
    """Velocity of a vehicle that stands and is then given a constant body command.

    Args:
        vehicle: geometry.
        effects: of its model.
        speed: commanded speed [m/s].
        turn: commanded yaw rate [rad/s].
        duration_s: time after the step.

    Returns:
        At every `STEP_CELL_S` after the step.
    """
    whole, rests = _RESTS_S + duration_s, round(_RESTS_S / STEP_CELL_S)
    count = round(whole / STEP_CELL_S)
    times: Floats = (np.arange(count, dtype=np.float64) + 0.5) * STEP_CELL_S
    zero = np.zeros(1, dtype=np.int64)
    grid = Grid(STEP_CELL_S, times, np.zeros(count, dtype=np.int64), zero, np.zeros(1), np.array((whole,)))
    context = RunContext(
        vehicle=vehicle, times=times, start_s=0.0, step_s=STEP_CELL_S, duration_s=whole,
        spans=_reset(count, 4), wheels=_reset(count, 4), body=_reset(count, 3),
        attitude=np.zeros((count, 3)), position=np.zeros((count, 2)),
    )  # fmt: skip
    body = (np.array((speed,)), np.zeros(1), np.array((turn,)))
    inputs = {name: float(value[0]) for name, value in vehicle.kinematics.inverse(body, vehicle).items()}
    own = inputs.get("speed", 0.0) / vehicle.wheel_radius_m
    stamps = np.arange(0.0, whole, _COMMAND_S)
    steering = np.full(stamps.size, inputs.get("steering", 0.0))

    def hold(value: float) -> Floats:
        return np.where(stamps < _RESTS_S - 0.5 * _COMMAND_S, 0.0, value)

    series = DriveSeries(
        stamps,
        hold(inputs.get("left", own)),
        hold(inputs.get("right", own)),
        steering,
        hold(inputs["sideways"]) if "sideways" in inputs else None,
    )
    forward = ForwardModel(series, grid, context, encoders=None, has_gyro=False)
    moved = forward.run_commands(effects, Timing())
    return Velocity(moved.x[rests:], moved.y[rests:], moved.w[rests:])


def time_rise(share: Floats) -> float:
    """Time to 63 % [s]: of a first-order lag its time constant; NaN where it is not reached.

    Args:
        share: motion over its end, or over its command, at every `STEP_CELL_S` after a step, shape (n,).
    """
    reached = np.flatnonzero(share >= _RISEN)
    if not reached.size:
        return math.nan
    after = int(reached[0])
    if after == 0:
        return 0.0
    # Values are those of the middles of the cells; between two of them it is taken for a first-order lag.
    passed = -np.log(np.maximum(1.0 - share[after - 1 : after + 1], _LEAST_REST))
    return STEP_CELL_S * float(np.interp(1.0, passed, (after - 0.5, after + 0.5)))


def _reset(count: int, signals: int) -> Resets:
    """A run that begins once, with its first input."""
    zero = np.zeros(1, dtype=np.int64)
    return Resets(np.zeros(count, dtype=np.int64), zero, zero, np.full((1, signals), math.nan))
