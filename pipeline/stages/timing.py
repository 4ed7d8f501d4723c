"""The age of each pose at its stamp."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solveh_banded

from pipeline.core import (
    LONGEST_WAIT_S,
    ROUNDING_S,
    Complex,
    Flags,
    Floats,
    Ints,
    join_parts,
    robust_spread,
)
from pipeline.run import Track, align_heading, mark_excluded
from pipeline.stages.gyro import fit_gyro

# Age of each pose: poses are shifted to the times of measurement, from gyro headings and from the path.
#
# The delay of a localization varies: a slow scan makes one pose a tenth of a second older than the next,
# which at 3 m/s is 0.3 m along the path. In a turn the gyro shows when the vehicle had the reported heading.
# While driving, the path shows by how much the ages of neighbouring poses differ: a vehicle does not leap. A
# pose after a long wait is old. Ages beside these observations follow from their correlation time. Wheels,
# commands and models are not used.
#
# Most likely ages e minimize the squares, in standard deviations, of
#
#     age by the heading - e_i,    e_i+1 - u_i+1 - c (e_i - u_i)    with the usual age u by the waits,
#     p_i+1 - p_i - (v_i + v_i+1) h / 2 + (a_i+1 - a_i) h^2 / 12    with h = wait - (e_i+1 - e_i),
#     v_i+1 - v_i - (a_i + a_i+1) h / 2,    a_i+1 - d a_i,
#
# for positions p [m], velocities v [m/s] and accelerations a [m/s^2] in the map, the wait between two stamps,
# and shares c and d of a deviation that last until the next pose. It is solved repeatedly, linear in the ages
# about the last ones. Accelerations are a first-order process (Singer, IEEE Trans. Aerospace and Electronic
# Systems 6, 1970). Errors of displacements are taken for independent.

_ROUNDS = 3
"""Alternations between the ages and the gyro's fit; estimates of both are then stable."""
_FEWEST = 200
"""Least number of poses in turns for an estimate of ages: twelve for each of 16 parameters. With half of it
the recording on grass of 2024-07-29 gets latencies of its poses."""
_TURNING = 0.3
"""Yaw rate [rad/s] above which a heading determines a time: noise of 2 mrad is 7 ms."""
_BESIDE_S = 0.05
"""Half of the time over which the gyro's yaw rate at a pose is taken [s]."""
_STRAIGHT = 0.05
"""Yaw rate [rad/s] below which the heading shows its noise and not its age: 0.1 s of age are 5 mrad."""
_OLDEST = 0.5
"""Largest age [s]: a larger one is a fault of the heading; those of the recordings vary by 0.04 to 0.15 s."""
_LEAST_SPREAD = 0.015
"""Spread of ages [s] below which stamps are as accurate as the gyro can show."""
_GYRO_CLOCK_S = 0.01
"""Standard deviation of a time by the gyro, beside the heading's noise: its own stamps and their sampling.
With 0.002 the error over 2 s on ice is 0.334 m instead of 0.311 m, on asphalt, gravel and sand within 5 %
(`slip batch --diagnosis`)."""
_NOISE = (0.002, 0.02)  # bounds of a heading's noise [rad]: scan matchers are within
_SHORTEST_STEP = 0.01
"""Least time between two poses after the correction [s], so that stamps stay in order."""
_FASTEST_S = 2.0  # time over which the largest speed is measured [s]: ages are short against it
_LEAST_OF_USUAL = 0.5
"""Least fraction of the usual time between two poses after the correction: those at 100 Hz must not shift
each other."""
_HUBER = 3.0
"""Deviation [standard deviations] above which an age, or a displacement, has less weight."""
_ACCELERATION_MPS2 = 2.0
"""Standard deviation of accelerations: with half or twice of it, ages of withheld turns are up to
5 % nearer or 5 % farther off (against the gyro)."""
_STEADY_S = 0.7
"""Correlation time of accelerations: with 0.3 or 2 s, ages of withheld turns change by up to 5 %."""
_ROUGH = 0.2
"""Change of velocity beyond that of a steady acceleration, relative to the acceleration over the time."""
_POSITION_NOISE = 3.0
"""Noise of a position relative to its spread across a straight path, as scan matching errs while turning:
with 1 instead, ages of withheld turns are 7 % farther off at walking pace, 5 % nearer beyond 2 m/s."""
_LEAST_NOISE_M = 0.003
"""Least noise of a position, of a scan matcher at rest."""
_DRIVING_MPS = 0.3
"""Speed above which a path has a direction."""
_FAST_MPS = 30.0
"""Standard deviation of the velocity of a first pose: nothing is known of it."""
_SMOOTHED = 4
"""Solutions for the ages in each of `_ROUNDS`: with two, ages of withheld turns are up to 4 % farther off."""
_STATES = 5
"""Unknowns of a pose: velocity and acceleration in the map, east and north, and its age."""
_AGE = 4
"""Place of the age among them."""


@dataclass(frozen=True)
class _Seen:
    """Ages of the poses by the gyro.

    Attributes:
        age: age of each pose beyond the usual one [s], from its heading alone, shape (n,).
        rate: yaw rate of the gyro [rad/s], shape (n,).
        noise: spread of the reported heading [rad].
        good: poses outside bad stretches with a usable heading, shape (n,).
        telling: those of them in turns, shape (n,).
    """

    age: Floats
    rate: Floats
    noise: float
    good: Flags
    telling: Flags


def estimate_latency(
    track: Track, gyro: tuple[Floats, Floats] | None, excluded: Floats
) -> tuple[Floats, float]:
    """Latency of every pose of a track relative to their common latency, and its variation.

    It is zero without a gyro that agrees with the poses, with little turning, or if the ages of the poses
    vary by less than 15 ms: then the stamps are as accurate as the gyro can show.

    Args:
        track: the poses at their stamps, shape (n,).
        gyro: times [s] and yaw rates [rad/s]; None without one.
        excluded: times [s] that are not compared, increasing.

    Returns:
        Latencies [s] in the order of the poses, shape (n,), and their standard deviation in turns [s].
    """
    ages, spread = np.zeros(track.times.size), 0.0
    nothing = np.zeros(ages.size), 0.0
    good = ~mark_excluded(excluded, track.times) & track.active
    for _ in range(_ROUNDS):
        moved = replace(track, times=_take_off(track, ages))
        fit = fit_gyro(moved, gyro, excluded)
        if fit is None or gyro is None:
            return nothing
        before, angle, after = (fit.turn_until(moved.times + by, gyro) for by in (-_BESIDE_S, 0.0, _BESIDE_S))
        seen = _look(track, angle, (after - before) / (2.0 * _BESIDE_S), ages, good)
        if seen.telling.sum() < _FEWEST:
            return nothing
        ages, spread = _estimate(track, seen, ages)
        if not spread >= _LEAST_SPREAD:  # nor where it is not a number
            return nothing
    return track.times - _take_off(track, ages), spread


def _look(track: Track, angle: Floats, turning: Floats, ages: Floats, good: Flags) -> _Seen:
    """Compare reported headings with the gyro's at the times given by the current ages.

    Args:
        track: the poses at their stamps, shape (n,).
        angle: of the gyro at these times [rad], shape (n,).
        turning: its yaw rate [rad/s], shape (n,).
        ages: of the poses [s], shape (n,).
        good: poses to use, shape (n,).
    """
    difference = track.heading - angle
    rest = difference - align_heading(track, difference, good)
    straight = good & (np.abs(turning) < _STRAIGHT)
    noise = robust_spread(rest[straight]) if straight.any() else _NOISE[1]
    safe = np.where(np.abs(turning) > 1e-3, turning, np.inf)  # noqa: PLR2004 - no age without turning
    age = ages - rest / safe
    good = good & (np.abs(age) < _OLDEST)
    return _Seen(
        age, turning, float(np.clip(noise, *_NOISE)), good, np.asarray(good & (np.abs(turning) > _TURNING))
    )


def _estimate(track: Track, seen: _Seen, ages: Floats) -> tuple[Floats, float]:
    """Ages of all poses [s], shape (n,), and their variation [s], from estimates to start from."""
    pattern = _list_terms(track)
    weight = 1.0 / ((seen.noise / np.maximum(np.abs(seen.rate), _TURNING)) ** 2 + 0.05**2)
    rows = pattern[seen.telling] * weight[seen.telling, None]
    normal = rows.T @ pattern[seen.telling]
    limited = np.clip(seen.age[seen.telling], -0.35, 0.35)
    ridge = 1e-6 * np.trace(normal) * np.eye(normal.shape[0])
    usual = pattern @ np.linalg.solve(normal + ridge, rows.T @ limited)
    beside = seen.age - usual
    spread = max(robust_spread(beside[seen.telling]), 1e-3)
    # A part of the spread is the heading's own noise.
    heard = seen.noise**2 * float(np.median(1.0 / seen.rate[seen.telling] ** 2))
    own = np.sqrt(max(spread**2 - heard, 0.0))
    if own < 1e-3:  # noqa: PLR2004 - nothing but noise
        return np.zeros(usual.size), 0.0
    ages = _smooth(track, seen, ages, usual, float(own))
    ages -= float(np.mean(ages[seen.good])) if seen.good.any() else 0.0
    return ages, float(np.std(ages[seen.telling]))


def _smooth(track: Track, seen: _Seen, ages: Floats, usual: Floats, spread: float) -> Floats:
    """Most likely ages by headings, path and usual ages, see above [s], shape (n,).

    Args:
        track: the poses.
        seen: their ages by the heading.
        ages: ages to start from [s], shape (n,).
        usual: usual ages by the waits [s], shape (n,).
        spread: standard deviation of ages about these [s].
    """
    wait = np.diff(track.times)
    is_next = (np.diff(track.segment) == 0) & (wait < LONGEST_WAIT_S - ROUNDING_S)
    both = seen.telling[1:] & seen.telling[:-1] & is_next
    limited = np.clip(seen.age - usual, -3.0 * spread, 3.0 * spread)
    alike = 0.5
    if both.sum() >= _FEWEST // 2:
        alike = float(np.clip(np.corrcoef(limited[1:][both], limited[:-1][both])[0, 1], 0.05, 0.95))
    lasts = -float(np.median(wait[both] if both.any() else wait)) / np.log(alike)
    linked = np.flatnonzero(is_next)
    first = np.flatnonzero(np.concatenate(([True], ~is_next)))
    decay = np.exp(-wait[linked] / lasts)
    by_wait = [
        _Equations(
            linked,
            {_AGE: -decay, _AGE + _STATES: 1.0},
            usual[linked + 1] - decay * usual[linked],
            spread**2 * (1.0 - decay**2),
        ),
        _Equations(first, {_AGE: 1.0}, usual[first], spread**2),
    ]
    known, noise = np.flatnonzero(seen.good & (seen.rate != 0.0)), _measure_position_noise(track)
    by_heading = (seen.noise / seen.rate[known]) ** 2 + _GYRO_CLOCK_S**2
    moved, least = np.diff(track.path)[linked], _find_least_waits(track)
    step = np.maximum(wait - np.diff(ages), least)[linked]
    pace: Complex = moved / step
    rough = np.ones(linked.size)
    for _ in range(_SMOOTHED):
        off = np.abs(seen.age - ages)[known] / np.sqrt(by_heading)
        heard = _Equations(known, {_AGE: 1.0}, seen.age[known], by_heading * np.maximum(off / _HUBER, 1.0))
        motion = _list_motion(moved, pace, wait[linked] - step, step, linked, first, noise**2 * rough)
        states = _solve_equations([*by_wait, heard, *motion], track.times.size)
        ages = np.clip(states[:, _AGE], -_OLDEST, _OLDEST)
        step = np.maximum(wait - np.diff(ages), least)[linked]
        velocity = join_parts(states[:, 0], states[:, 1])
        pace = 0.5 * (velocity[linked] + velocity[linked + 1])
        curve = np.diff(join_parts(states[:, 2], states[:, 3]))[linked] * step**2 / 12.0
        rest = np.abs(moved - pace * step + curve) / (_HUBER * noise * np.sqrt(2.0))
        # A position far off has no weight: even a bounded force of it would move the ages about it.
        rough = np.maximum(rest, 1.0) * np.maximum(rest / _HUBER, 1.0) ** 2
    return ages


@dataclass(frozen=True)
class _Equations:
    """Linear equations of the states of a pose and of the next one.

    Attributes:
        pose: index of the pose of each, shape (k,), each at most once.
        factors: by unknown: those of the pose from 0, those of the next one from `_STATES`.
        target: sum of the unknowns times their factors, shape (k,).
        variance: its variance, shape (k,) or one for all.
    """

    pose: Ints
    factors: Mapping[int, Floats | float]
    target: Floats
    variance: Floats | float


def _list_motion(
    moved: Complex, pace: Complex, older: Floats, step: Floats, linked: Ints, first: Ints, variance: Floats
) -> Iterator[_Equations]:
    """Equations of velocity and acceleration along both axes of the map, see above.

    Args:
        moved: displacement to the next pose [m], shape (k,).
        pace: mean velocity until then, as last estimated [m/s], shape (k,).
        older: age of the next pose less that of the pose, as last estimated [s], shape (k,).
        step: time between both after these ages [s], shape (k,).
        linked: poses that have a next one, shape (k,).
        first: poses that follow no other one.
        variance: of a position at both ends of each displacement [m^2], shape (k,).
    """
    keeps = np.exp(-step / _STEADY_S)
    spread, zero = _ACCELERATION_MPS2**2, np.zeros(linked.size)
    bend = step**2 / 12.0
    for axis, (distance, speed) in enumerate(((moved.real, pace.real), (moved.imag, pace.imag))):
        v, a = axis, 2 + axis
        w, b = v + _STATES, a + _STATES
        factors: dict[int, Floats | float] = {
            v: 0.5 * step,
            w: 0.5 * step,
            a: bend,
            b: -bend,
            _AGE: speed,
            _AGE + _STATES: -speed,
        }
        # To first order in the ages, about the present ones.
        target = distance - speed * older
        yield _Equations(linked, factors, target, 2.0 * variance)
        factors = {v: -1.0, w: 1.0, a: -0.5 * step, b: -0.5 * step}
        yield _Equations(linked, factors, zero, spread * (_ROUGH * step) ** 2)
        yield _Equations(linked, {a: -keeps, b: np.ones(linked.size)}, zero, spread * (1.0 - keeps**2))
        yield _Equations(first, {a: 1.0}, np.zeros(first.size), spread)
        yield _Equations(first, {v: 1.0}, np.zeros(first.size), _FAST_MPS**2)


def _solve_equations(equations: Iterable[_Equations], poses: int) -> Floats:
    """Unknowns of all poses by least squares, shape (poses, `_STATES`)."""
    matrix, right = np.zeros((2 * _STATES, poses * _STATES)), np.zeros(poses * _STATES)
    for equation in equations:
        start = _STATES * equation.pose
        for unknown, factor in equation.factors.items():
            weighted = factor / equation.variance
            right[start + unknown] += weighted * equation.target
            for other, second in equation.factors.items():
                if other >= unknown:
                    matrix[other - unknown, start + other] += weighted * second
    # Lower diagonals by row are upper diagonals by column.
    return np.asarray(solveh_banded(matrix[: right.size][::-1], right)).reshape(poses, _STATES)


def _measure_position_noise(track: Track) -> float:
    """Noise of a position [m], from its spread across straight stretches of the path."""
    before, times, path = slice(None, -2), track.times, track.path
    here, after = slice(1, -1), slice(2, None)
    wait = times[after] - times[before]
    share = (times[after] - times[here]) / np.maximum(wait, _SHORTEST_STEP)
    velocity = (path[after] - path[before]) / np.maximum(wait, _SHORTEST_STEP)
    speed = np.abs(velocity)
    straight = np.abs(track.heading[after] - track.heading[before]) < _STRAIGHT * wait
    known = straight & (track.segment[after] == track.segment[before]) & (speed > _DRIVING_MPS)
    if known.sum() < _FEWEST // 2:
        return _POSITION_NOISE * _LEAST_NOISE_M
    off = path[here] - share * path[before] - (1.0 - share) * path[after]
    across = (off * np.conj(velocity))[known].imag / speed[known]
    # The spread of a difference to the mean of two others.
    return _POSITION_NOISE * max(robust_spread(across) / math.sqrt(1.5), _LEAST_NOISE_M)


def _list_terms(track: Track) -> Floats:
    """Waits before and after each pose relative to the usual one, with kinks; shape (n, 16)."""
    wait = np.diff(track.times, prepend=track.times[0])
    usual = float(np.median(wait))
    first = np.concatenate(([True], np.diff(track.segment) != 0))
    wait = np.where(first | (wait > LONGEST_WAIT_S + ROUNDING_S), usual, wait)
    columns = [np.ones(wait.size)]
    for ahead in (-2, -1, 0, 1, 2):
        share = np.clip(np.roll(wait, -ahead) / usual, 0.0, 4.0)
        columns += [share, np.minimum(share, 0.6), np.maximum(share - 1.6, 0.0)]
    return np.column_stack(columns)


def _take_off(track: Track, ages: Floats) -> Floats:
    """Stamps minus the ages, changed as little as their order and the way between poses require."""
    least = np.append(0.0, np.cumsum(_find_least_waits(track)))
    ordered, count = track.times - ages - least, np.ones(ages.size, dtype=np.int64)
    # The nearest values in order: those that fall are pooled until none do.
    while (falls := np.diff(ordered) < 0.0).any():
        first = np.flatnonzero(np.append(True, ~falls))
        total, count = (np.add.reduceat(each, first) for each in (ordered * count, count))
        ordered = total / count
    return np.asarray(np.repeat(ordered, count) + least, dtype=np.float64)


def _find_least_waits(track: Track) -> Floats:
    """Least times between poses after the correction [s], shape (n - 1,).

    The way to the next pose takes its time at the run's largest speed. It counts up to the usual wait, for
    the pose may have jumped.
    """
    times, path, segment = track.times, track.path, track.segment
    later = np.minimum(np.searchsorted(times, times + _FASTEST_S), times.size - 1)
    whole = (segment[later] == segment) & (times[later] >= times + _FASTEST_S)
    speed = np.abs(path[later] - path)[whole] / (times[later] - times)[whole]
    usual = float(np.median(np.diff(times))) if times.size > 1 else 0.0
    distance = np.where(np.diff(segment) == 0, np.abs(np.diff(path)), 0.0)
    waits = np.minimum(distance / float(speed.max(initial=_DRIVING_MPS)), usual)
    return np.maximum(waits, min(_SHORTEST_STEP, _LEAST_OF_USUAL * usual))
