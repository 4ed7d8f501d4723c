"""Clocks first: how late the poses, their heading and the encoders are, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.core import timegrid
from pipeline.motion.evidence import LEAST_DELAY_S
from pipeline.motion.heading import has_barred

if TYPE_CHECKING:
    from pipeline.motion.heading import GyroFit
    from pipeline.motion.recording import MotionRun

Floats = NDArray[np.float64]

_WINDOW_S = 0.5
_UNIT_S = 10.0
_SURE = 4.0
_STEP_S = 0.02


@dataclass(frozen=True)
class YawDelay:
    """How late the reported heading is against the gyro.

    Attributes:
        seconds: the delay.
        error: its standard error, from stretches of ten seconds.
    """

    seconds: float
    error: float

    @property
    def is_certain(self) -> bool:
        """Whether it is a delay beyond doubt."""
        return abs(self.seconds) >= LEAST_DELAY_S and abs(self.seconds) > _SURE * self.error


def measure_yaw_delay(run: MotionRun, fit: GyroFit) -> YawDelay:
    """Refine the delay of the heading against the gyro by least squares on turning over half a second."""
    if run.gyro is None:
        return YawDelay(0.0, np.inf)
    times, rate = run.gyro
    angle = timegrid.integrate_rate(times, rate) * fit.signed_scale
    track = run.track
    second = np.searchsorted(track.times, track.times + _WINDOW_S - 0.02)
    first = np.arange(track.times.size)
    inside = second < track.times.size
    first, second = first[inside], second[inside]
    start, end = track.times[first], track.times[second]
    kept = (track.segment[first] == track.segment[second]) & (end - start < 1.6 * _WINDOW_S)
    kept &= ~has_barred(run.barred, start, end)
    kept &= (start - 1.0 > times[0]) & (end + 1.0 < times[-1])
    first, second, start, end = first[kept], second[kept], start[kept], end[kept]
    if start.size < 40:  # noqa: PLR2004 - too few to refine
        return YawDelay(fit.yaw_delay_s, np.inf)
    turned = track.heading[second] - track.heading[first]
    delay, error = fit.yaw_delay_s, np.inf
    for _ in range(3):
        change, error = _step(times, angle, start, end, turned, delay)
        delay += float(np.clip(change, -0.05, 0.05))
    return YawDelay(delay, error)


def _step(
    times: Floats, angle: Floats, start: Floats, end: Floats, turned: Floats, delay: float
) -> tuple[float, float]:
    """Correction of the delay and its standard error."""

    def turn(late: float) -> Floats:
        gyro: Floats = np.interp(end - late, times, angle) - np.interp(start - late, times, angle)
        return gyro

    slope = (turn(delay + _STEP_S) - turn(delay - _STEP_S)) / (2.0 * _STEP_S)
    design = np.column_stack((slope, turn(delay), end - start))
    target = turned - turn(delay)
    weight = np.ones(target.size)
    solution: Floats = np.zeros(3)
    for _ in range(3):
        rows = design * weight[:, None]
        solution = np.asarray(np.linalg.solve(rows.T @ design, rows.T @ target), dtype=np.float64)
        rest = np.abs(target - design @ solution)
        spread = 1.4826 * float(np.median(rest)) + 1e-9
        weight = np.minimum(1.0, 3.0 * spread / np.maximum(rest, 1e-12))
    rest = (target - design @ solution) * weight
    bread = np.linalg.pinv((design * weight[:, None]).T @ design)
    unit = np.unique((start // _UNIT_S).astype(np.int64), return_inverse=True)[1]
    pulls = np.zeros((int(unit.max()) + 1, 3))
    np.add.at(pulls, unit, design * rest[:, None])
    covariance = bread @ (pulls.T @ pulls) @ bread
    return float(solution[0]), float(np.sqrt(max(covariance[0, 0], 0.0)))
