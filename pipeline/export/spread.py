"""What a robot does per command at several speeds: the multipliers that a controller would need at each.

The fitted model is driven by a constant command until its motion is steady.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.core import Floats
from pipeline.export import DRIVEN_SPEED, DRIVEN_TURN, Facts
from pipeline.models import Effect, ForwardModel, Place, Timing
from pipeline.run import DriveSeries, Grid, Resets, RunContext
from pipeline.sources import Vehicle

_SPEEDS = 4
"""Number of speeds: quarters of the largest driven one show a factor that falls or rises with speed."""
_STEADY_S = 20.0
"""Time until the motion counts as steady [s]: twenty times the longest lag that vehicles have."""
_STEP_S = 0.02
"""Step of the model [s], that of its fits."""
_USUAL_TOP = (1.0, 0.5)
"""Speed [m/s] and yaw rate [rad/s] if neither the fit nor the vehicle gives the largest ones."""
_SAME = 0.01
"""Spread of a factor over the speeds that one value still fits: the tolerance of data sheets."""


def find_steady_motion(
    vehicle: Vehicle, effects: Sequence[Effect], speed: float, turn: float
) -> tuple[float, float]:
    """Speed [m/s] and yaw rate [rad/s] of a vehicle under a constant body command.

    Args:
        vehicle: geometry.
        effects: effects of the model; those of the localization are left out.
        speed: commanded speed [m/s].
        turn: commanded yaw rate [rad/s].
    """
    count = round(_STEADY_S / _STEP_S)
    times: Floats = (np.arange(count, dtype=np.float64) + 0.5) * _STEP_S
    zero = np.zeros(1, dtype=np.int64)
    grid = Grid(_STEP_S, times, np.zeros(count, dtype=np.int64), zero, np.zeros(1), np.array((_STEADY_S,)))
    context = RunContext(
        vehicle=vehicle, times=times, start_s=0.0, step_s=_STEP_S, duration_s=_STEADY_S,
        spans=_reset(count, 4), wheels=_reset(count, 4), body=_reset(count, 3),
        attitude=np.zeros((count, 3)), position=np.zeros((count, 2)),
    )  # fmt: skip
    body = (np.array((speed,)), np.zeros(1), np.array((turn,)))
    inputs = {name: float(value[0]) for name, value in vehicle.kinematics.inverse(body, vehicle).items()}
    own = inputs.get("speed", 0.0) / vehicle.wheel_radius_m
    stamps = np.arange(0.0, _STEADY_S, 0.05)

    def hold(value: float) -> Floats:
        return np.full(stamps.size, value)

    series = DriveSeries(
        stamps,
        hold(inputs.get("left", own)),
        hold(inputs.get("right", own)),
        hold(inputs.get("steering", 0.0)),
        hold(inputs["sideways"]) if "sideways" in inputs else None,
    )
    forward = ForwardModel(series, grid, context, encoders=None, has_gyro=False)
    acting = [effect for effect in effects if effect.place is not Place.LOCALIZATION]
    moved = forward.run_commands(acting, Timing())
    return float(moved.x[-1]), float(moved.w[-1])


def _reset(count: int, signals: int) -> Resets:
    """A run that begins once, at rest or with its first input."""
    zero = np.zeros(1, dtype=np.int64)
    return Resets(np.zeros(count, dtype=np.int64), zero, zero, np.full((1, signals), math.nan))


class Response(NamedTuple):
    """Factors of a model: its steady motion over the command, at quarters of the largest driven speed.

    Attributes:
        speeds: commanded speeds [m/s], shape (n,).
        linear: speed over its command when driving straight, shape (n,).
        angular: yaw rate over its command at these speeds, shape (n,).
        turn: the commanded yaw rate [rad/s].
    """

    speeds: Floats
    linear: Floats
    angular: Floats
    turn: float

    @property
    def separation(self) -> Floats:
        """`wheel_separation_multiplier` at each speed, once the radii are corrected by `linear`.

        It is infinite where the vehicle does not turn.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio: Floats = self.linear / self.angular
        return ratio


def find_response(facts: Facts) -> Response:
    """Drive the model at several speeds, straight and in a turn at half of the largest driven yaw rate."""
    vehicle, effects = facts.vehicle, facts.file.model.effects
    top, turn = (max(facts.list_driven(key), default=0.0) for key in (DRIVEN_SPEED, DRIVEN_TURN))
    top, turn = top or vehicle.max_speed_mps or _USUAL_TOP[0], 0.5 * (turn or _USUAL_TOP[1])
    speeds = [float(f"{top * (n + 1) / _SPEEDS:.3g}") for n in range(_SPEEDS)]
    straight = [find_steady_motion(vehicle, effects, speed, 0.0)[0] for speed in speeds]
    curved = [find_steady_motion(vehicle, effects, speed, turn)[1] for speed in speeds]
    return Response(np.array(speeds), np.array(straight) / speeds, np.array(curved) / turn, turn)


def describe_spread(facts: Facts) -> list[str]:
    """Multipliers per speed as lines of a comment, where one for all speeds does not fit; else empty."""
    response = find_response(facts)
    own = facts.vehicle.controller_track_multiplier
    rows = {
        "wheel_separation_multiplier": own * response.separation,
        "wheel_radius_multiplier": response.linear,
    }
    lines = []
    for name, values in rows.items():
        if np.isfinite(values).all() and float(np.ptp(values)) > _SAME * float(np.abs(values).mean()):
            at = ", ".join(
                f"{value:.3f} at {speed:g} m/s"
                for value, speed in zip(values.tolist(), response.speeds.tolist(), strict=True)
            )
            lines.append(f"One {name} does not fit all speeds: {at}.")
    if lines:
        at = f"at a yaw rate of {response.turn:.3g} rad/s"
        lines.append(
            f"These are of all effects together, {at}; each value below is of the effects beside it."
        )
    return lines
