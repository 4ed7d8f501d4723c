"""Sign, scale, bias and clock of the gyro, from the turns of the poses."""

import numpy as np

from pipeline.core import ROUNDING_S, SILENT_S, Floats, Ints, arrays, robust_spread
from pipeline.run import SPAN_S, GyroFit, Track, fit_turning, has_excluded, mark_excluded

_LARGEST_DELAY = 0.7
"""Largest delay of the poses that is tried [s]: those of the recordings are 0.17 to 0.55."""
_DELAY_STEP = 0.01
"""Step of the derivative with respect to the delay [s]; the search uses steps of five times it."""
_FEWEST = 40
"""Least number of messages, and of windows: four seconds at 10 Hz."""
_REFINEMENTS = 4
"""Gauss-Newton steps from a start with an error of at most 25 ms."""
_REWEIGHTED = 3
"""Iterations of Huber's weights per step."""
_LEAST_TURNING = 0.02
"""Turning in half a second [rad], median plus standard deviation: ten times the pose noise of 2 mrad."""
_GOOD = 0.35
"""Largest residual over turning; half and double change no finding of two recordings."""
_LEAST_COVERED = 0.95
"""Least share of poses with a gyro message nearby."""


def fit_gyro(  # noqa: PLR0911 - each way out is a reason
    track: Track, gyro: tuple[Floats, Floats] | None, excluded: Floats
) -> GyroFit | None:
    """Compare turns over half a second; None without a gyro, with little turning, or without agreement.

    Args:
        track: the poses.
        gyro: times [s] and yaw rates [rad/s], shape (m,) each; None without one.
        excluded: times [s] that are not compared, increasing.
    """
    if gyro is None:
        return None
    times, rate = gyro
    if times.size < _FEWEST or _measure_cover(times, track.times) < _LEAST_COVERED:
        return None
    first, second = _pair_up(track, excluded)
    if first.size < _FEWEST:
        return None
    start, end = track.times[first], track.times[second]
    turned = track.heading[second] - track.heading[first]
    angle = arrays.integrate_rate(times, rate)
    spread = float(np.median(np.abs(turned)) + np.std(turned))
    if spread < _LEAST_TURNING:
        return None
    longest = _LARGEST_DELAY + ROUNDING_S
    inside = (start - longest > times[0]) & (end + longest < times[-1])
    start, end, turned = start[inside], end[inside], turned[inside]
    if start.size < _FEWEST:
        return None

    def judge(delay: float) -> tuple[float, float, float]:
        seen = np.interp(end - delay, times, angle) - np.interp(start - delay, times, angle)
        return fit_turning(seen, end - start, turned)

    coarse = np.arange(-_LARGEST_DELAY, _LARGEST_DELAY + 1e-9, 5 * _DELAY_STEP)
    best = float(coarse[np.argmin([judge(float(d))[2] for d in coarse])])
    scale, bias, loss = judge(best)
    residual = loss / float(np.sqrt(np.mean(np.minimum(np.abs(turned), 3.0 * spread) ** 2)))
    if residual > _GOOD or not 0.5 < abs(scale) < 2.0:  # noqa: PLR2004 - no gyro is that wrong
        return None
    _, _, delay, error = _refine((times, angle), (start, end), turned, (scale, bias, best))
    # Pose errors must not change the scale by a fraction of a percent: it is fitted to longer stretches.
    return GyroFit(*_fit_scale(track, (times, angle), delay, excluded), delay, error, residual)


def _refine(
    gyro: tuple[Floats, Floats],
    span: tuple[Floats, Floats],
    turned: Floats,
    values: tuple[float, float, float],
) -> tuple[float, float, float, float]:
    """Scale, bias and delay by robust Gauss-Newton steps, with the standard error of the delay.

    Args:
        gyro: times [s] and integrated rate [rad], each of shape (m,).
        span: start and end of every window [s], each of shape (n,).
        turned: change of the reported heading over every window [rad], shape (n,).
        values: scale, bias [rad/s] and delay [s] to start from.
    """
    (times, angle), (start, end) = gyro, span
    scale, bias, delay = values

    def turn(late: float) -> Floats:
        return np.interp(end - late, times, angle) - np.interp(start - late, times, angle)

    error = np.inf
    unit = np.unique(arrays.number_stretches(start - times[0]), return_inverse=True)[1]
    for _ in range(_REFINEMENTS):
        # Derivative of the turned angle with respect to the delay.
        slope = scale * (turn(delay + _DELAY_STEP) - turn(delay - _DELAY_STEP)) / (2.0 * _DELAY_STEP)
        design = np.column_stack((turn(delay), end - start, slope))
        target = turned - design[:, :2] @ np.array([scale, bias])
        weight, step = np.ones(target.size), np.zeros(3)
        for _ in range(_REWEIGHTED):
            rows = design * weight[:, None]
            step = np.linalg.lstsq(rows.T @ design, rows.T @ target, rcond=None)[0]
            rest = np.abs(target - design @ step)
            spread = robust_spread(rest) + 1e-9
            weight = np.minimum(1.0, 3.0 * spread / np.maximum(rest, 1e-12))
        scale, bias = scale + float(step[0]), bias + float(step[1])
        delay += float(np.clip(step[2], -5 * _DELAY_STEP, 5 * _DELAY_STEP))
        bread = np.linalg.pinv((design * weight[:, None]).T @ design)
        pulls = np.zeros((int(unit.max()) + 1, 3))
        np.add.at(pulls, unit, design * ((target - design @ step) * weight)[:, None])
        error = float(np.sqrt(max((bread @ (pulls.T @ pulls) @ bread)[2, 2], 0.0)))
    return scale, bias, delay, error


def _fit_scale(
    track: Track, gyro: tuple[Floats, Floats], delay: float, excluded: Floats
) -> tuple[float, float]:
    """Scale and bias [rad/s] from headings over stretches of ten seconds, each with its own offset.

    Over half a second, poses of growing age show too small a turn; over ten seconds the error is negligible.

    Args:
        track: the poses.
        gyro: times [s] and integrated rate [rad], each of shape (m,).
        delay: of the poses [s].
        excluded: times [s] that are not compared.
    """
    times, angle = gyro
    at, is_out = track.times - delay, mark_excluded(excluded, track.times)
    mask = ~is_out & (at >= times[0]) & (at <= times[-1])
    ends = np.diff(track.segment, prepend=-1) != 0
    ends |= np.diff(arrays.number_stretches(track.times - track.times[0]), prepend=-1) != 0
    ends |= np.diff(is_out, prepend=False)
    piece = np.cumsum(ends)[mask]
    columns = np.column_stack((np.interp(at, times, angle), at, track.heading))[mask]
    weight, fitted = np.ones(piece.size), np.zeros(2)
    for _ in range(_REWEIGHTED):
        total = np.maximum(np.bincount(piece, weight), 1e-12)
        means = np.column_stack([np.bincount(piece, weight * one) for one in columns.T]) / total[:, None]
        rest = columns - means[piece]
        rows = rest[:, :2] * weight[:, None]
        fitted = np.linalg.lstsq(rows.T @ rest[:, :2], rows.T @ rest[:, 2], rcond=None)[0]
        size = np.abs(rest[:, 2] - rest[:, :2] @ fitted)
        spread = robust_spread(size) + 1e-9
        weight = np.minimum(1.0, 3.0 * spread / np.maximum(size, 1e-12))
    return float(fitted[0]), float(fitted[1])


def _measure_cover(times: Floats, at: Floats) -> float:
    """Share of times with a gyro message nearby: a gyro that stopped half-way is no source of heading."""
    next_one = np.minimum(np.searchsorted(times, at), times.size - 1)
    nearest = np.minimum(np.abs(times[next_one] - at), np.abs(times[np.maximum(next_one - 1, 0)] - at))
    return float(np.mean(nearest < SILENT_S))


def _pair_up(track: Track, excluded: Floats) -> tuple[Ints, Ints]:
    """Poses half a second apart in one segment, outside bad stretches."""
    second = np.searchsorted(track.times, track.times + SPAN_S - 0.02)
    first = np.arange(track.times.size)
    mask = second < track.times.size
    first, second = first[mask], second[mask].astype(np.int64)
    mask = (track.segment[first] == track.segment[second]) & (
        track.times[second] - track.times[first] < 0.8 - ROUNDING_S
    )
    mask &= ~has_excluded(excluded, track.times[first], track.times[second])
    return first[mask], second[mask]
