"""How old each pose is: put poses at the moments they belong to, with the gyro as clock.

A localization reports late, and not always by the same time: a slow scan makes one pose a tenth of a second
older than the next, which at 3 m/s is 0.3 m. In a turn the gyro knows when the vehicle had the reported
heading. What it says there is carried over to straight stretches by how long the ages last and by the pattern
of the stamps: a pose that came after a long wait is old. Positions and models have no part in it.
"""

from dataclasses import dataclass, replace

import numpy as np

from pipeline.core.arrays import Flags, Floats
from pipeline.runs.heading import align_heading, fit_gyro, mark_barred
from pipeline.runs.recording import GyroFit, MotionRun, Track

_ROUNDS = 3
_FEWEST = 200
_TURNING = 0.3
_STRAIGHT = 0.05
_ROUNDING_S = 1e-6
_OLDEST = 0.5
_LEAST_SPREAD = 0.015
_NOISE = (0.002, 0.02)
_LONGEST_WAIT = 1.0
_SHORTEST_STEP = 0.01
_LEAST_OF_USUAL = 0.5
_HUBER = 3.0


@dataclass(frozen=True)
class _Seen:
    """What the gyro says of the poses' ages.

    Attributes:
        age: age of each pose beyond the usual one [s], as its heading alone shows it, shape (n,).
        rate: yaw rate of the gyro [rad/s], shape (n,).
        noise: spread of the reported heading [rad].
        good: poses in no bad stretch whose heading may count, shape (n,).
        telling: those of them in turns, shape (n,).
    """

    age: Floats
    rate: Floats
    noise: float
    good: Flags
    telling: Flags


def estimate_latency(run: MotionRun) -> tuple[Floats, float]:
    """Latency of every pose of a run's track beside the one that all share, and how much it varies.

    It is zero without a gyro that agrees with the poses, with little turning, or where the ages of the
    poses vary by less than 15 ms: then the stamps are as good as the gyro can tell.

    Returns:
        Latencies [s] in the order of the poses, shape (n,), and their standard deviation in turns [s].
    """
    track, ages = run.track, np.zeros(run.track.times.size)
    nothing, spread = (np.zeros(ages.size), 0.0), 0.0
    for _ in range(_ROUNDS):
        moved = replace(run, track=replace(track, times=_take_off(track, ages)))
        gyro = fit_gyro(moved)
        if gyro is None:
            return nothing
        seen = _look(run, moved.track, gyro, ages)
        if seen.telling.sum() < _FEWEST:
            return nothing
        ages, spread = _estimate(track, seen)
        if spread < _LEAST_SPREAD:
            return nothing
    return track.times - _take_off(track, ages), spread


def _look(run: MotionRun, track: Track, gyro: GyroFit, ages: Floats) -> _Seen:
    """Compare reported headings with the gyro's at the moments that the ages found so far give."""
    times, rate = run.gyro if run.gyro is not None else (np.zeros(0), np.zeros(0))
    angle = gyro.turn(times, rate)
    at = track.times - gyro.yaw_delay_s
    turning = (np.interp(at + 0.05, times, angle) - np.interp(at - 0.05, times, angle)) / 0.1
    difference = track.heading - np.interp(at, times, angle)
    good = ~mark_barred(run, run.track.times) & track.active
    rest = difference - align_heading(run.track, difference, good)
    straight = good & (np.abs(turning) < _STRAIGHT)
    noise = 1.4826 * float(np.median(np.abs(rest[straight]))) if straight.any() else _NOISE[1]
    safe = np.where(np.abs(turning) > 1e-3, turning, np.inf)  # noqa: PLR2004 - no turning tells no time
    age = ages - rest / safe
    good &= np.abs(age) < _OLDEST
    return _Seen(
        age, turning, float(np.clip(noise, *_NOISE)), good, np.asarray(good & (np.abs(turning) > _TURNING))
    )


def _estimate(track: Track, seen: _Seen) -> tuple[Floats, float]:
    """Ages of all poses [s], shape (n,), and how much they vary [s]."""
    pattern = _describe_stamps(track)
    weight = 1.0 / ((seen.noise / np.maximum(np.abs(seen.rate), _TURNING)) ** 2 + 0.05**2)
    rows = pattern[seen.telling] * weight[seen.telling, None]
    normal = rows.T @ pattern[seen.telling]
    limited = np.clip(seen.age[seen.telling], -0.35, 0.35)
    usual = pattern @ np.linalg.solve(
        normal + 1e-6 * np.trace(normal) * np.eye(normal.shape[0]), rows.T @ limited
    )
    beside = seen.age - usual
    spread = max(1.4826 * float(np.median(np.abs(beside[seen.telling]))), 1e-3)
    # Part of what is seen is the heading's own noise.
    heard = seen.noise**2 * float(np.median(1.0 / seen.rate[seen.telling] ** 2))
    own = np.sqrt(max(spread**2 - heard, 0.0))
    if own < 1e-3:  # noqa: PLR2004 - nothing but noise
        return np.zeros(usual.size), 0.0
    ages = usual + _smooth(track, seen, beside, float(own))
    ages -= float(np.mean(ages[seen.good])) if seen.good.any() else 0.0
    return ages, float(np.std(ages[seen.telling]))


def _smooth(track: Track, seen: _Seen, beside: Floats, spread: float) -> Floats:
    """Most likely ages beside the usual ones: a first-order process in time, seen where the vehicle turns."""
    from scipy.linalg import solveh_banded  # noqa: PLC0415 - heavy

    wait = np.where(np.diff(track.segment) != 0, np.inf, np.diff(track.times))
    both = seen.telling[1:] & seen.telling[:-1] & (wait < _LONGEST_WAIT - _ROUNDING_S)
    limited = np.clip(beside, -3.0 * spread, 3.0 * spread)
    alike = 0.5
    if both.sum() >= _FEWEST // 2:
        alike = float(np.clip(np.corrcoef(limited[1:][both], limited[:-1][both])[0, 1], 0.05, 0.95))
    lasts = -float(np.median(wait[both] if both.any() else wait)) / np.log(alike)
    kept = np.exp(-wait / lasts)
    stiff = 1.0 / (spread**2 * (1.0 - kept**2))
    diagonal = np.concatenate(([1.0 / spread**2], stiff))
    diagonal[:-1] += stiff * kept**2
    beneath = np.concatenate(([0.0], -stiff * kept))
    known = np.where(seen.good, (seen.rate / seen.noise) ** 2, 0.0)
    found = np.zeros(beside.size)
    for _ in range(3):
        off = np.abs(beside - found) * np.abs(seen.rate) / seen.noise
        trusted = known * np.where(off > _HUBER, _HUBER / np.maximum(off, _HUBER), 1.0)
        found = solveh_banded(
            np.vstack((beneath, diagonal + trusted)), trusted * np.where(known > 0, beside, 0)
        )
    return np.asarray(found, dtype=np.float64)


def _describe_stamps(track: Track) -> Floats:
    """Waits before and after each pose as shares of the usual one, with kinks; shape (n, 16)."""
    wait = np.diff(track.times, prepend=track.times[0])
    usual = float(np.median(wait))
    first = np.concatenate(([True], np.diff(track.segment) != 0))
    wait = np.where(first | (wait > _LONGEST_WAIT + _ROUNDING_S), usual, wait)
    columns = [np.ones(wait.size)]
    for ahead in (-2, -1, 0, 1, 2):
        share = np.clip(np.roll(wait, -ahead) / usual, 0.0, 4.0)
        columns += [share, np.minimum(share, 0.6), np.maximum(share - 1.6, 0.0)]
    return np.column_stack(columns)


def _take_off(track: Track, ages: Floats) -> Floats:
    """Stamps without the ages, still in order."""
    usual = float(np.median(np.diff(track.times))) if track.times.size > 1 else 0.0
    # Below the usual step: poses at 100 Hz must not push each other on.
    count = min(_SHORTEST_STEP, _LEAST_OF_USUAL * usual) * np.arange(ages.size)
    ordered: Floats = np.maximum.accumulate(track.times - ages - count) + count
    return ordered
