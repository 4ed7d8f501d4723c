"""Driving in closed loop: a controller steers by the pose, and so answers the random motion of the body.

What is random moves the commands a moment later, which open-loop programs never show. The simulator makes a
run at once, so that the two take turns: the controller asks for some seconds by the motion that it expects of
this vehicle, random motion included, and the simulator says where hidden effects and slopes have brought it.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from pipeline.simulate import Disturbance, Scenario, State, simulate_run
from pipeline.simulate.run import Truth
from pipeline.simulate.scenario import Commands

_STEP_S = 0.01
_EVERY = 5
_LATE = 10
_STANDS_S = 2.0
_GAIN = 2.0
_NEAR_M = 0.4
_STANDING = 1e-6
_LOOK = 1000
_LAGS_S = (0.0, 0.1, 0.2, 0.4, 0.8, 1.6)


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
    goals = _place_goals(draw, max(6.0 * fastest, 4.0))
    own = scene.extra

    def push(state: State) -> tuple[float, float, float]:
        odd = own(state) if own else (0.0, 0.0, 0.0)
        if abs(state.v0) + abs(state.w0) <= _STANDING:
            return odd
        x, y, w = pushes[min(int(state.t / _STEP_S), count - 1)].tolist()
        return odd[0] + x, odd[1] + y, odd[2] + w

    controller = _Controller(goals, fastest, sharpest, (_STANDS_S, scene.duration_s - _STANDS_S), pushes)
    closed = replace(scene, disturbance=Disturbance(), extra=push, start_pose=(0.0, 0.0, 0.0))
    for begin in range(0, count, _LOOK):
        controller.drive(begin, min(begin + _LOOK, count))
        asked = controller.asked[::_EVERY]
        closed = replace(closed, played=Commands(np.arange(len(asked)) * _EVERY * _STEP_S, *asked.T))
        controller.see(simulate_run(closed).truth, begin + _LOOK)
    return closed


class _Controller:
    """Follows way points; between two looks at the vehicle it expects a lag and a gain of what it asks for.

    Attributes:
        asked: speed [m/s] and yaw rate [rad/s], shape (n, 2).
    """

    def __init__(
        self,
        goals: Sequence[complex],
        fastest: float,
        sharpest: float,
        live: tuple[float, float],
        pushes: np.ndarray,
    ) -> None:
        self.asked = np.zeros((len(pushes), 2))
        self._goals, self._goal, self._live, self._pushes = goals, 0, live, pushes
        self._fastest, self._sharpest = fastest, sharpest
        self._position, self._yaw = np.zeros(len(pushes) + 1, dtype=complex), np.zeros(len(pushes) + 1)
        self._gains, self._lags_s, self._rates = [1.0, 1.0], [0.0, 0.0], [0.0, 0.0]

    def drive(self, begin: int, end: int) -> None:
        """Ask for the steps from one to another, by the motion that is expected."""
        kept = [_keep(lag) for lag in self._lags_s]
        for now in range(begin, end):
            if now % _EVERY == 0:
                seen = max(now - _LATE, 0)
                away = self._goals[self._goal % len(self._goals)] - self._position[seen]
                if abs(away) < _NEAR_M:
                    self._goal += 1
                off = math.remainder(float(np.angle(away)) - self._yaw[seen], math.tau)
                is_live = self._live[0] <= now * _STEP_S <= self._live[1]
                speed = is_live * self._fastest * max(math.cos(off), 0.0)
                turn = is_live * float(np.clip(_GAIN * off, -self._sharpest, self._sharpest))
            self.asked[now] = speed, turn
            self._rates = [
                keep * rate + (1.0 - keep) * asked
                for keep, rate, asked in zip(kept, self._rates, (speed, turn), strict=True)
            ]
            x, y, w = (self._pushes[now] * (abs(speed) + abs(turn) > _STANDING)).tolist()
            v, w = self._gains[0] * self._rates[0] + x, self._gains[1] * self._rates[1] + w
            middle = self._yaw[now] + 0.5 * w * _STEP_S
            self._position[now + 1] = self._position[now] + complex(v, y) * np.exp(1j * middle) * _STEP_S
            self._yaw[now + 1] = self._yaw[now] + w * _STEP_S

    def see(self, truth: Truth, now: int) -> None:
        """Take over where the vehicle is, and how it has answered."""
        path = truth.path
        stride = round(_STEP_S / float(path.time_s[1] - path.time_s[0]))
        now = min(now, len(path.velocity) // stride)
        edges = slice(0, now * stride + 1, stride)
        self._position[: now + 1] = path.position[edges, :2] @ np.array([1.0, 1.0j])
        x, y, z, w = path.quaternion[edges].T
        self._yaw[: now + 1] = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        moved = path.velocity[: now * stride].reshape(now, stride, 3).mean(axis=1) - self._pushes[:now]
        for number, rate in enumerate((moved[:, 0], moved[:, 2])):
            fits = []
            for lag in _LAGS_S:
                answer = lfilter([1.0 - _keep(lag)], [1.0, -_keep(lag)], self.asked[:now, number])
                gain = float(answer @ rate) / max(float(answer @ answer), _STANDING)
                fits.append((float(np.sum((rate - gain * answer) ** 2)), gain, lag, float(answer[-1])))
            _, self._gains[number], self._lags_s[number], self._rates[number] = min(fits)


def _keep(lag_s: float) -> float:
    return math.exp(-_STEP_S / lag_s) if lag_s else 0.0


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
