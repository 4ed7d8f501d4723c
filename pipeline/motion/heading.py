"""The heading that models are judged with: of the gyro where there is a good one, else of the poses.

A gyro is a better heading and a better clock than a localization, once its sign, scale and bias are known and
it is brought into the map's frame by the slow part of its difference from the reported heading.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.core import timegrid

if TYPE_CHECKING:
    from pipeline.motion.cells import Cells
    from pipeline.motion.recording import MotionRun, Track

Floats = NDArray[np.float64]

_WINDOW_S = 0.5
_LARGEST_DELAY = 0.7
_DELAY_STEP = 0.01
_FEWEST = 40
_LEAST_TURNING = 0.02
_GOOD = 0.35
_ALIGN_S = 3.0


class HeadingSource(enum.Enum):
    """Whose heading is used: the gyro's where it agrees with the poses, or always the poses'."""

    AUTO = "auto"
    POSE = "pose"


@dataclass(frozen=True)
class GyroFit:
    """Yaw rate = scale * gyro + bias; `scale` carries the sign.

    Attributes:
        scale: with the sign.
        bias: [rad/s].
        yaw_delay_s: how late the reported heading is against the gyro.
        residual: robust spread of what is left over that of the turning itself.
    """

    scale: float
    bias: float
    yaw_delay_s: float
    residual: float


@dataclass(frozen=True)
class Heading:
    """Heading on the cells and at the poses.

    Attributes:
        gyro: how the gyro was used; None where the poses' own heading is.
        edges: gyro heading at the cell edges [rad], shape (n + 1,); empty without a gyro.
        offset: what is added to the gyro's heading to stand in the map, at every pose [rad]; or the reported
            heading itself without a gyro, shape (m,).
    """

    gyro: GyroFit | None
    edges: Floats
    offset: Floats


def choose_heading(run: MotionRun, cells: Cells, source: HeadingSource) -> Heading:
    """Check the gyro against the poses and choose."""
    track = run.track
    fit = fit_gyro(run) if source is HeadingSource.AUTO else None
    if fit is None or run.gyro is None:
        return Heading(None, np.zeros(0), track.heading)
    times, rate = run.gyro
    on_cells = fit.scale * np.interp(cells.times, times, rate) + fit.bias
    edges = np.asarray(cells.sum_up(on_cells), dtype=np.float64)
    seen = np.interp(cells.locate_edges(track.times - fit.yaw_delay_s), np.arange(edges.size), edges)
    difference = track.heading - seen
    offset = np.empty(track.times.size)
    spoilt = _is_barred(run, track.times)
    spans = cells.find_span(track.times)
    for begin, end in _find_pieces(track.segment, spans):
        rows = slice(begin, end)
        good = ~spoilt[rows] if (~spoilt[rows]).any() else np.ones(end - begin, dtype=bool)
        offset[rows] = _smooth(track.times[rows], difference[rows], good)
    return Heading(fit, edges, offset)


def fit_gyro(run: MotionRun) -> GyroFit | None:
    """Compare turning over half a second; None where there is no gyro, little turning, or no agreement."""
    if run.gyro is None:
        return None
    times, rate = run.gyro
    if times.size < _FEWEST:
        return None
    first, second = _pair_up(run.track, run)
    if first.size < _FEWEST:
        return None
    start, end = run.track.times[first], run.track.times[second]
    turned = run.track.heading[second] - run.track.heading[first]
    angle = timegrid.integrate_rate(times, rate)
    spread = float(np.median(np.abs(turned)) + np.std(turned))
    if spread < _LEAST_TURNING:
        return None
    inside = (start - _LARGEST_DELAY > times[0]) & (end + _LARGEST_DELAY < times[-1])
    start, end, turned = start[inside], end[inside], turned[inside]
    if start.size < _FEWEST:
        return None

    def judge(delay: float) -> tuple[float, float, float]:
        gyro = np.interp(end - delay, times, angle) - np.interp(start - delay, times, angle)
        return _fit_robustly(gyro, end - start, turned)

    coarse = np.arange(-_LARGEST_DELAY, _LARGEST_DELAY + 1e-9, 5 * _DELAY_STEP)
    best = float(coarse[np.argmin([judge(float(d))[2] for d in coarse])])
    fine = best + np.arange(-5, 6) * _DELAY_STEP
    losses = np.array([judge(float(d))[2] for d in fine])
    # The loss is a median and not smooth: a parabola through all that is near averages its steps.
    curve = np.polynomial.Polynomial.fit(fine, losses, 2).convert().coef
    delay = float(np.clip(-0.5 * curve[1] / curve[2], fine[0], fine[-1])) if curve[2] > 0.0 else best
    scale, bias, loss = judge(delay)
    residual = loss / float(np.sqrt(np.mean(np.minimum(np.abs(turned), 3.0 * spread) ** 2)))
    if residual > _GOOD or not 0.5 < abs(scale) < 2.0:  # noqa: PLR2004 - no gyro is that wrong
        return None
    # The poses' own errors are no reason to distrust the sensor's scale by a fraction of a percent.
    return GyroFit(scale, bias, delay, residual)


def _pair_up(track: Track, run: MotionRun) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Poses half a second apart in one segment, outside bad stretches."""
    second = np.searchsorted(track.times, track.times + _WINDOW_S - 0.02)
    first = np.arange(track.times.size)
    kept = second < track.times.size
    first, second = first[kept], second[kept].astype(np.int64)
    kept = (track.segment[first] == track.segment[second]) & (track.times[second] - track.times[first] < 0.8)  # noqa: PLR2004
    kept &= ~has_barred(run.barred, track.times[first], track.times[second])
    return first[kept], second[kept]


def has_barred(barred: Floats, start: Floats, end: Floats) -> NDArray[np.bool_]:
    """Whether a barred sample lies in each closed interval."""
    inside: NDArray[np.bool_] = np.searchsorted(barred, end + 1e-9) > np.searchsorted(barred, start - 1e-9)
    return inside


def _is_barred(run: MotionRun, times: Floats) -> NDArray[np.bool_]:
    return has_barred(run.barred, times - 0.05, times + 0.05)


def _fit_robustly(gyro: Floats, span: Floats, turned: Floats) -> tuple[float, float, float]:
    """Scale, bias and robust spread of turned = scale * gyro + bias * span."""
    keep = np.ones(gyro.size, dtype=bool)
    scale = bias = spread = 0.0
    for _ in range(4):
        design = np.column_stack((gyro[keep], span[keep]))
        (scale, bias), *_ = np.linalg.lstsq(design, turned[keep], rcond=None)
        rest = np.abs(turned - scale * gyro - bias * span)
        spread = 1.4826 * float(np.median(rest))
        keep = rest <= max(3.0 * spread, 1e-9)
    return float(scale), float(bias), spread


def _find_pieces(segment: NDArray[np.int64], span: NDArray[np.int64]) -> list[tuple[int, int]]:
    edges = np.flatnonzero((np.diff(segment) != 0) | (np.diff(span) != 0)) + 1
    bounds = [0, *edges.tolist(), segment.size]
    return list(zip(bounds[:-1], bounds[1:], strict=True))


def _smooth(times: Floats, values: Floats, good: NDArray[np.bool_]) -> Floats:
    """Running mean over six seconds of the good values."""
    known = times[good]
    total = np.concatenate(([0.0], np.cumsum(values[good])))
    low = np.searchsorted(known, times - _ALIGN_S)
    high = np.searchsorted(known, times + _ALIGN_S, side="right")
    empty = high <= low
    mean = (total[high] - total[low]) / np.maximum(high - low, 1)
    if empty.any():
        mean[empty] = np.interp(times[empty], known, values[good])
    smooth: Floats = mean
    return smooth
