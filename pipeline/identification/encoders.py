"""How late the encoders are: what they say of turning against what the gyro says of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.identification.comparison import Comparison, Input
from pipeline.models.catalogue import find_late_effect
from pipeline.models.effect import Late
from pipeline.models.forward import Timing
from pipeline.runs.errors import MotionError

if TYPE_CHECKING:
    from pipeline.runs.recording import MotionRun
    from pipeline.vehicles import Vehicle

Floats = NDArray[np.float64]

_RATE_HZ = 50.0
_FEWEST = 20
_LATEST_S = 0.6
_COARSE_S = 0.05
_TAUS_S = (0.1, 0.2, 0.4, 0.8, 1.6)
_PLAINLY = 0.95
_LEAST_S = 0.03
_CLIP = 3.0
_HALVINGS = 3


def measure_wheel_delay(run: MotionRun, vehicle: Vehicle) -> float:
    """How late the encoders are against the gyro [s], at least zero; zero where it cannot be told.

    Only turning is compared, which the gyro knows to the millisecond. A body that follows its wheels late
    hides a part of the delay, so a lag of the body is tried too, and believed where it explains the turning
    plainly better. Less than 30 ms is no more than encoders and their interpolation leave uncertain.
    """
    if run.wheels is None:
        return 0.0
    try:
        comparison = Comparison(run, vehicle, Input.MEASURED, rate_hz=_RATE_HZ)
    except MotionError:
        return 0.0
    if not comparison.has_gyro or comparison.windows.start.size < _FEWEST:
        return 0.0
    net, plain = _search(comparison, 0.0, np.arange(-_COARSE_S, _LATEST_S, _COARSE_S))
    best, least = net, plain
    for tau in _TAUS_S:
        at = np.clip(net + tau * np.array([0.0, 0.25, 0.5, 0.75, 1.0]), 0.0, _LATEST_S)
        late, loss = _search(comparison, tau, np.unique(np.append(at, 0.0)))
        if loss < least:
            best, least = late, loss
    delay = best if least < _PLAINLY * plain else net
    return delay if delay >= _LEAST_S else 0.0


def _search(comparison: Comparison, tau: float, delays: Floats) -> tuple[float, float]:
    """The best delay [s] for a lag of the body, and what it leaves of the turning."""
    effects = (find_late_effect(Late.BODY).of_delay(tau),) if tau > 0.0 else ()
    timing = comparison.usual_delay

    def judge(late: float) -> float:
        rest = comparison.find_residuals(effects, Timing(timing, late))[:, 2]
        return _leave(comparison.turning, comparison.turning - rest)

    losses = [judge(float(late)) for late in delays]
    place = int(np.argmin(losses))
    best, least = float(delays[place]), losses[place]
    step = 0.5 * float(np.median(np.diff(delays))) if delays.size > 1 else 0.5 * _COARSE_S
    for _ in range(_HALVINGS):
        for late in (best - step, best + step):
            loss = judge(late)
            if loss < least:
                best, least = late, loss
        step *= 0.5
    return best, least


def _leave(measured: Floats, predicted: Floats) -> float:
    """Robust mean square that the best multiple of a prediction leaves."""
    weight = np.ones(measured.size)
    loss = 0.0
    for _ in range(4):
        scale = float(np.sum(weight * measured * predicted) / max(np.sum(weight * predicted**2), 1e-12))
        left = np.abs(measured - scale * predicted)
        spread = max(1.4826 * float(np.median(left)), 1e-6)
        weight = np.minimum(1.0, _CLIP * spread / np.maximum(left, 1e-12))
        loss = float(np.mean(np.minimum(left, 6.0 * spread) ** 2))
    return loss
