"""Sign, scale, bias and clock of the gyro, from the turns of the poses."""

import numpy as np

from pipeline.core import (
    ROUNDING_S,
    SILENT_S,
    Floats,
    Ints,
    RobustFit,
    arrays,
    fit_robustly,
    robust_spread,
    weigh_bounded,
)
from pipeline.run import SPAN_S, GyroFit, Track, has_excluded, mark_excluded

_EARLY_S, _LONGEST_S = 0.02, 0.8 - ROUNDING_S
"""See `pair_poses`: stamps vary, and of a span that lasts longer the poses do not tell the turn."""
_LARGEST_DELAY = 0.7
"""Largest delay of the poses that is tried [s]: those of the recordings are 0.17 to 0.55."""
_DELAY_STEP = 0.01
"""Step of the derivative with respect to the delay [s]; the search uses steps of five times it."""
_FEWEST = 40
"""Least number of messages, and of windows: four seconds at 10 Hz."""
_REFINEMENTS = 4
"""Gauss-Newton steps from a start with an error of at most 25 ms."""
_REWEIGHTED = 3
"""Reweightings of a fit."""
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
    first, second = pair_poses(track, excluded, early_s=_EARLY_S, longest_s=_LONGEST_S)
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

    def judge(delay: float) -> RobustFit:
        seen = np.interp(end - delay, times, angle) - np.interp(start - delay, times, angle)
        return fit_robustly(
            np.column_stack((seen, end - start)), turned, measure=robust_spread, rounds=_REWEIGHTED
        )

    coarse = np.arange(-_LARGEST_DELAY, _LARGEST_DELAY + 1e-9, 5 * _DELAY_STEP).tolist()
    best = coarse[int(np.argmin([judge(delay).scale for delay in coarse]))]
    made = judge(best)
    scale, bias = made.gains.tolist()
    residual = made.scale / float(np.sqrt(np.mean(np.minimum(np.abs(turned), 3.0 * spread) ** 2)))
    if residual > _GOOD or not 0.5 < abs(scale) < 2.0:  # noqa: PLR2004 - no gyro is that wrong
        return None
    delay, error = _refine((times, angle), (start, end), turned, (scale, bias, best))
    # Pose errors must not change the scale by a fraction of a percent: it is fitted to longer stretches.
    return GyroFit(*_fit_scale(track, (times, angle), delay, excluded), delay, error, residual)


def _refine(
    gyro: tuple[Floats, Floats],
    span: tuple[Floats, Floats],
    turned: Floats,
    values: tuple[float, float, float],
) -> tuple[float, float]:
    """Delay [s] by robust Gauss-Newton steps, and its standard error.

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
        rest = turned - design[:, :2] @ np.array([scale, bias])
        step = fit_robustly(design, rest, measure=robust_spread, weigh=weigh_bounded, rounds=_REWEIGHTED)
        scale, bias = scale + float(step.gains[0]), bias + float(step.gains[1])
        delay += float(np.clip(step.gains[2], -5 * _DELAY_STEP, 5 * _DELAY_STEP))
        error = float(step.find_errors(design, unit)[2])
    return delay, error


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
    piece = np.unique(np.cumsum(ends)[mask], return_inverse=True)[1]
    design = np.column_stack((np.interp(at, times, angle), at))[mask]
    heading = track.heading[mask]
    made = fit_robustly(
        design, heading, measure=robust_spread, weigh=weigh_bounded, group=piece, rounds=_REWEIGHTED
    )
    scale, bias = made.gains.tolist()
    return scale, bias


def _measure_cover(times: Floats, at: Floats) -> float:
    """Share of times with a gyro message nearby: a gyro that stopped half-way is no source of heading."""
    near = times[arrays.nearest_indices(at, times)]
    return float(np.mean(np.abs(near - at) < SILENT_S))


def pair_poses(track: Track, excluded: Floats, *, early_s: float, longest_s: float) -> tuple[Ints, Ints]:
    """Poses of one segment half a second apart, and those before and after a longer wait.

    Args:
        track: the poses.
        excluded: times [s] that are in none of the spans, increasing.
        early_s: by how much a span may be shorter.
        longest_s: length of a span that is too long.

    Returns:
        The first and the last pose of every span, shape (k,) each.
    """
    times = track.times
    last = np.searchsorted(times, times + SPAN_S - early_s).astype(np.int64)
    first = np.flatnonzero(last < times.size)
    last = last[first]
    begin, end = times[first], times[last]
    mask = (track.segment[first] == track.segment[last]) & (end - begin < longest_s)
    mask &= ~has_excluded(excluded, begin, end)
    return first[mask], last[mask]
