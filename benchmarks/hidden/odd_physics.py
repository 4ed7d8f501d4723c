"""Physics that no catalogue has: what `diagnose` must flag as unexplained, not name for something else."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from pipeline.simulate import State, Vehicle

Push = Callable[[State], tuple[float, float, float]]


@dataclass(frozen=True)
class Odd:
    """One cause: what it does, the channels it acts on, and its physics for a vehicle."""

    about: str
    channels: str
    make: Callable[[Vehicle], Push]


def _crosswind(vehicle: Vehicle) -> Push:
    size = 0.1 * min(vehicle.max_speed_mps, 2.0)

    def push(state: State) -> tuple[float, float, float]:
        moving = min(abs(state.v0) / 0.1, 1.0)
        return size * math.cos(state.yaw) * moving, -size * math.sin(state.yaw) * moving, 0.0

    return push


def _reverse_slip(vehicle: Vehicle) -> Push:
    del vehicle

    def push(state: State) -> tuple[float, float, float]:
        return (-0.25 * state.v0 if state.v0 < 0.0 else 0.0), 0.0, 0.0

    return push


def _right_turns(vehicle: Vehicle) -> Push:
    del vehicle

    def push(state: State) -> tuple[float, float, float]:
        return 0.0, 0.0, (-0.3 * state.w0 if state.w0 < 0.0 else 0.0)

    return push


def _oval_wheel(vehicle: Vehicle) -> Push:
    def push(state: State) -> tuple[float, float, float]:
        uneven = 0.12 * math.sin(state.left_angle)
        rim = vehicle.wheel_radius_m * state.left_speed
        return 0.5 * uneven * rim, 0.0, -uneven * rim / vehicle.track_width_m

    return push


def _grass_patch(vehicle: Vehicle) -> Push:
    del vehicle

    def push(state: State) -> tuple[float, float, float]:
        inside = math.sin(state.x / 1.5) > 0.0
        return (-0.25 * state.v0 if inside else 0.0), 0.0, 0.0

    return push


def _magnetic_floor(vehicle: Vehicle) -> Push:
    size = 0.08 * vehicle.max_turn_radps

    def push(state: State) -> tuple[float, float, float]:
        moving = min(abs(state.v0) / 0.1, 1.0)
        return 0.0, 0.0, size * math.sin(2.0 * state.yaw) * moving

    return push


def _turn_climb(vehicle: Vehicle) -> Push:
    size = 0.12 * min(vehicle.max_speed_mps, 2.0)

    def push(state: State) -> tuple[float, float, float]:
        return 0.0, size * math.tanh(2.0 * state.w0) * abs(state.w0) / (0.3 + abs(state.w0)), 0.0

    return push


def _fast_left(vehicle: Vehicle) -> Push:
    threshold = 0.4 * vehicle.max_speed_mps

    def push(state: State) -> tuple[float, float, float]:
        over = max(abs(state.v0) - threshold, 0.0)
        return 0.0, 0.25 * over, 0.0

    return push


ODD: dict[str, Odd] = {
    "crosswind": Odd("a steady wind pushes in one direction of the world", "xy", _crosswind),
    "reverse_slip": Odd("wheels slip in reverse only", "x", _reverse_slip),
    "right_turns": Odd("turning right falls short, turning left does not", "w", _right_turns),
    "oval_wheel": Odd("the left wheel is out of round", "xw", _oval_wheel),
    "grass_patch": Odd("stripes of grass across the map slow it down", "x", _grass_patch),
    "magnetic_floor": Odd(
        "the floor turns the vehicle towards two directions of the world", "w", _magnetic_floor
    ),
    "turn_climb": Odd("sideways motion that saturates with the yaw rate", "y", _turn_climb),
    "fast_left": Odd("above a speed the vehicle is pushed to the left", "y", _fast_left),
}
