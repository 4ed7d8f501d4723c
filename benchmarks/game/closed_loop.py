"""Driving in closed loop: a controller steers by the pose, and so answers the random motion of the body.

What is random moves the commands a moment later, which open-loop programs never show. The motion is worked
out here, ideal but for that random motion, and its commands are then played.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pipeline.simulate import Disturbance, Scenario, State
from pipeline.simulate.programs import Commands

_STEP_S = 0.01
_CONTROL_S = 0.05
_LATE_S = 0.1
_STANDS_S = 2.0
_GAIN = 2.0
_NEAR_M = 0.4
_STANDING = 1e-6


def close_loop(scene: Scenario, draw: np.random.Generator) -> Scenario:
    """The scenario with commands of a controller that follows way points by poses a moment old."""
    vehicle, noise = scene.vehicle, scene.disturbance
    count = round(scene.duration_s / _STEP_S)
    pushes = np.column_stack(
        [
            _wander(count, size, noise.correlation_s, draw)
            for size in (noise.speed_mps,) * 2 + (noise.turn_radps,)
        ]
    )
    fastest = 0.6 * vehicle.max_speed_mps * scene.program.speed_scale
    sharpest = 0.8 * vehicle.max_turn_radps * scene.program.turn_scale
    goals, goal = _place_goals(draw, max(6.0 * fastest, 4.0)), 0
    every, late = round(_CONTROL_S / _STEP_S), round(_LATE_S / _STEP_S)
    place, yaw = np.zeros(count + 1, dtype=complex), np.zeros(count + 1)
    speed, turn, told = 0.0, 0.0, []
    for now in range(count):
        if now % every == 0:
            seen = max(now - late, 0)
            away = goals[goal % len(goals)] - place[seen]
            if abs(away) < _NEAR_M:
                goal += 1
            off = math.remainder(float(np.angle(away)) - yaw[seen], math.tau)
            live = _STANDS_S <= now * _STEP_S <= scene.duration_s - _STANDS_S
            speed = live * fastest * max(math.cos(off), 0.0)
            turn = live * float(np.clip(_GAIN * off, -sharpest, sharpest))
            told.append((now * _STEP_S, speed, turn))
        moves = abs(speed) + abs(turn) > _STANDING
        x, y, w = (pushes[now] * moves).tolist()
        middle = yaw[now] + 0.5 * (turn + w) * _STEP_S
        place[now + 1] = place[now] + complex(speed + x, y) * np.exp(1j * middle) * _STEP_S
        yaw[now + 1] = yaw[now] + (turn + w) * _STEP_S
    times, speeds, turns = (np.array(column) for column in zip(*told, strict=True))

    def push(state: State) -> tuple[float, float, float]:
        if abs(state.v0) + abs(state.w0) <= _STANDING:
            return 0.0, 0.0, 0.0
        x, y, w = pushes[min(int(state.t / _STEP_S), count - 1)].tolist()
        return x, y, w

    return replace(
        scene,
        disturbance=Disturbance(),
        extra=push,
        played=Commands(times, speeds, turns),
        start_pose=(0.0, 0.0, 0.0),
    )


def _wander(count: int, size: float, lasts_s: float, draw: np.random.Generator) -> np.ndarray:
    """First-order Gauss-Markov noise of a standard deviation, shape (count,)."""
    keep = math.exp(-_STEP_S / lasts_s)
    fresh = size * math.sqrt(1.0 - keep**2) * draw.normal(size=count)
    values = np.empty(count)
    last = size * draw.normal()
    for number, change in enumerate(fresh.tolist()):
        last = keep * last + change
        values[number] = last
    return values


def _place_goals(draw: np.random.Generator, reach: float) -> list[complex]:
    """Way points [m]: drawn at will, a patrol round four corners, or the rows of a lawn mower."""
    kind = str(draw.choice(["way points", "patrol", "rows"]))
    if kind == "patrol":
        return [complex(x, y) for x, y in ((reach, 0.0), (reach, reach), (0.0, reach), (0.0, 0.0))]
    if kind == "rows":
        rows = np.arange(6) * 0.2 * reach
        ends = [(0.0, reach) if number % 2 == 0 else (reach, 0.0) for number in range(rows.size)]
        return [complex(x, y) for y, pair in zip(rows.tolist(), ends, strict=True) for x in pair]
    return [complex(x, y) for x, y in draw.uniform(-reach, reach, (40, 2))]
