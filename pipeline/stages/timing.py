"""Mapping between the recorder's clock and that of the stamps, and the age of each pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.core.arrays import ROUNDING_S, Flags, Floats, Ints, robust_spread, solve_tridiagonal
from pipeline.core.rigid import LONGEST_WAIT_S
from pipeline.models.parameter import LEAST_DELAY_S
from pipeline.run import GyroFit, MotionRun, Track
from pipeline.run.heading import align_heading, fit_gyro, mark_excluded
from pipeline.stages import SURE

# Rates of the recorder's clock and of the stamps' clock: a map between them from topics that have both.
#
# A message is recorded some time after its stamp, never before: the least delay between the two, not the
# usual one, shows the clocks. Busy networks and bridges only add to it.

Stamps = Ints

JUMP_NS = 500_000_000
"""Leap of a clock [ns] above which it was set: networks and busy recorders delay messages by less."""
_FASTEST_SIMULATION = 50.0
"""Largest real-time factor of simulations."""
_FLOOR_SHARE = 0.02
"""Quantile of delays used as the least delay: a single stamp may be wrong."""
_PIECES = 20
"""Pieces of a run for the median rate of a clock, and for a line through the least delays: a leap of the
clock spoils one piece."""
_FEWEST_IN_PIECE = 50
"""Least number of messages per piece: of 50, one is at `_FLOOR_SHARE`."""
_FEWEST_PIECES = 5
"""Least number of pieces, or of steps of a clock, for a median and a spread."""
_LEAST_DRIFT_NS = round(1e9 * LEAST_DELAY_S)
"""Least drift over a whole run: without drift stamps deviate by as much (`LEAST_DELAY_S`)."""
_FASTEST_DRIFT = 5e-4
"""Largest drift: quartz clocks differ by less than 200e-6, NTP adjusts a clock by up to 500e-6 (slew)."""
_AT_ONCE = 0.1
"""Fraction of the period below which two messages were simultaneous."""
_BUNCHED = 0.25
"""Fraction of simultaneous messages above which a bridge delays them: with bunches of two it is a half."""
_PACE_NS = 5e9
"""Time [ns] over which a sender's rate is measured: 25 times a delay of 0.2 s."""
_FEWEST_OF_PACE = 100
"""Least number of messages for the rate: independent ones vary by 10 %, twice `_STEADY`."""
_STEADY = 0.05
"""Relative variation of a steady rate: bridge delays of .2 s change 5 s by 2 %, random 10 Hz ones by 14 %."""
_USUAL_SHARE = 0.99
"""Quantile of gaps between messages that are not holes."""
_HELD_UP_SHARE = 0.95
"""Quantile of delays that is reported: a few are a hole of the network."""
_LEAST_HELD_UP_S = 0.03
"""Least delay of a bunch [s], below a command period: two simultaneous messages are not a bunch."""
_HOLE_PERIODS = 8.0
"""Usual periods that a hole of a slow topic exceeds: bunches of eight cause gaps of as many."""
_HOLE_NS = 1_000_000_000
"""Gap [ns] above which a line is interrupted: bridges delay messages by less."""
_REACH = 25
"""Messages on each side for a line: fifty include several bunches of ten."""


@dataclass(frozen=True)
class ClockMap:
    """Piecewise linear map from the recorder's clock to the stamps' clock.

    Attributes:
        log: times of the recorder's clock [ns], increasing, shape (n,).
        stamp: of the stamps' clock [ns], increasing, shape (n,).
    """

    log: Floats
    stamp: Floats

    @property
    def rate(self) -> float:
        """Rate of the stamps' clock relative to the recorder's, over the whole run."""
        return float((self.stamp[-1] - self.stamp[0]) / (self.log[-1] - self.log[0]))

    def follow(self, times: Stamps) -> Stamps:
        """Map the recorder's times to the stamps' clock [ns]; beyond the ends the mean rate is used."""
        inside = np.interp(times, self.log, self.stamp)
        before = np.minimum(times - self.log[0], 0.0) * self.rate
        after = np.maximum(times - self.log[-1], 0.0) * self.rate
        mapped: Stamps = np.rint(inside + before + after).astype(np.int64)
        return mapped

    @property
    def usual_rate(self) -> float:
        """Median of the same rate over pieces of the run, which a leap of the clock does not change."""
        at = np.linspace(self.log[0], self.log[-1], _PIECES + 1)
        return float(np.median(np.diff(np.interp(at, self.log, self.stamp)))) / float(at[1] - at[0])

    @property
    def bend_s(self) -> float:
        """Largest deviation of the map from a straight line [s of the stamps' clock]."""
        away = self.stamp - self.stamp[0] - self.rate * (self.log - self.log[0])
        return float(np.ptp(away)) / 1e9

    @property
    def leaps(self) -> bool:
        """Whether the clock was set forward, by more than any simulation advances."""
        most = _FASTEST_SIMULATION * np.diff(self.log) + JUMP_NS
        return bool((np.diff(self.stamp) > most).any())


def map_clock(log_time: Stamps, stamp: Stamps) -> ClockMap | None:
    """Latest stamp recorded up to each time.

    Args:
        log_time: when messages were recorded [ns], increasing, shape (n,).
        stamp: stamps of the headers [ns], shape (n,).

    Returns:
        The map; None if the stamps go back, or are too few.
    """
    latest = np.maximum.accumulate(stamp)
    if (latest - stamp > JUMP_NS).any():
        return None
    # Of simultaneous messages the last is used, and only an advance of the clock is a knot.
    last = np.append(np.diff(log_time) > 0, [True])
    log, shown = log_time[last], latest[last]
    new = np.append([True], np.diff(shown) > 0)
    log, shown = log[new].astype(np.float64), shown[new].astype(np.float64)
    return ClockMap(log, shown) if log.size >= _FEWEST_PIECES else None


@dataclass(frozen=True)
class Drift:
    """Drift of a topic's stamps against the recorder's clock.

    Attributes:
        rate: [s/s], positive if the stamps' clock is faster.
        scatter: of the least delays about the straight line [ns].
        first, last: stamps between which it was measured [ns].
        least_ns: the least delay of the topic's messages at the first stamp, on the straight line.
    """

    rate: float = 0.0
    scatter: float = 0.0
    first: int = 0
    last: int = 0
    least_ns: float = 0.0

    @property
    def is_certain(self) -> bool:
        """Whether it is the drift of a clock, and exceeds the variation of the delays."""
        return self._is_apart(0.0) and abs(self.rate) < _FASTEST_DRIFT

    def is_same(self, other: Drift) -> bool:
        """Whether it is compatible with another, more accurate drift, and closer to it than to zero."""
        return not self._is_apart(other.rate) and abs(self.rate - other.rate) < abs(self.rate)

    def find_agreement(self) -> int:
        """The stamp at which both clocks agree, or the end of the run that is closer to it [ns].

        No message is recorded before its stamp, and the fastest one hardly later.
        """
        return round(min(max(self.first + self.least_ns / self.rate, self.first), self.last))

    def _is_apart(self, rate: float) -> bool:
        return abs(self.rate - rate) * (self.last - self.first) > max(_LEAST_DRIFT_NS, SURE * self.scatter)


def measure_drift(log_time: Stamps, stamp: Stamps) -> Drift:
    """Drift of a topic's stamps: a straight line through the least delays of pieces of the run."""
    pieces = min(_PIECES, stamp.size // _FEWEST_IN_PIECE)
    if pieces < _FEWEST_PIECES:
        return Drift()
    delay = (log_time - stamp).astype(np.float64)
    spans = np.array_split(np.arange(stamp.size), pieces)
    at = np.array([float(np.median(stamp[span])) for span in spans]) - float(stamp[0])
    floor = np.array([float(np.quantile(delay[span], _FLOOR_SHARE)) for span in spans])
    one, two = np.triu_indices(pieces, 1)
    apart = at[two] - at[one]
    if not (apart > 0.0).all():
        return Drift()
    slope = float(np.median((floor[two] - floor[one]) / apart))
    rest = floor - slope * at
    scatter = robust_spread(rest - np.median(rest))
    return Drift(-slope, scatter, int(stamp.min()), int(stamp.max()), float(np.median(rest)))


def spread_bunches(log_time: Stamps) -> Stamps:
    """Arrival times of bunched messages at the rate of their sender.

    The messages of a steady sender lie on a line over their number, and a bridge only delays them: the line
    is below all of them. It is estimated for every message from its neighbours, so that it follows the
    sender's rate; holes interrupt it.

    Args:
        log_time: log times of a topic [ns], increasing, shape (n,).

    Returns:
        Times [ns], shape (n,); unchanged if messages did not arrive in bunches.
    """
    gaps = np.diff(log_time).astype(np.float64)
    if gaps.size < _REACH:
        return log_time
    period = float(gaps[gaps <= np.quantile(gaps, _USUAL_SHARE)].mean())
    if float(np.mean(gaps < _AT_ONCE * period)) < _BUNCHED or not _is_steady(log_time, period):
        return log_time
    even = (log_time - log_time[0]).astype(np.float64)
    holes = np.flatnonzero(gaps > max(_HOLE_NS, _HOLE_PERIODS * period)) + 1
    for part in np.split(np.arange(even.size), holes):
        if part.size > 2 * _REACH:
            even[part] = np.minimum(_draw_below(even[part]), even[part])
    spread: Stamps = log_time[0] + np.rint(np.maximum.accumulate(even)).astype(np.int64)
    return spread if find_held_up_s(log_time, spread) > _LEAST_HELD_UP_S else log_time


def _is_steady(log_time: Stamps, period: float) -> bool:
    """Whether equal numbers of messages take equal times, unlike those of a hand on a joystick."""
    many = max(round(_PACE_NS / period), _FEWEST_OF_PACE) if period > 0.0 else log_time.size
    took = np.diff(log_time[::many]).astype(np.float64)
    if took.size < _FEWEST_PIECES:
        return False
    usual = float(np.median(took))
    return robust_spread(took - usual) < _STEADY * usual


def find_held_up_s(log_time: Stamps, spread: Stamps) -> float:
    """Delay of the bunches [s], a high quantile."""
    return float(np.quantile(log_time - spread, _HELD_UP_SHARE)) / 1e9


def _draw_below(times: Floats) -> Floats:
    number = np.arange(times.size)
    period = float(times[-1] - times[0]) / (times.size - 1)
    above = times - period * number
    windows = np.lib.stride_tricks.sliding_window_view
    least = windows(np.pad(above, _REACH, mode="edge"), 2 * _REACH + 1).min(axis=1)
    # Minimum over the neighbours, then its mean: a smooth line below the messages.
    smooth = windows(np.pad(least, _REACH, mode="edge"), 2 * _REACH + 1).mean(axis=1)
    drawn: Floats = smooth + period * number
    return drawn


# Age of each pose: poses are shifted to the times of measurement, with the gyro as clock.
#
# The delay of a localization varies: a slow scan makes one pose a tenth of a second older than the next,
# which at 3 m/s is 0.3 m. In a turn the gyro shows when the vehicle had the reported heading. These ages are
# extended to straight stretches by their correlation time and by the pattern of the stamps: a pose after a
# long wait is old. Positions and models are not used.

_ROUNDS = 3
"""Alternations between the ages and the gyro's fit; estimates of both are then stable."""
_FEWEST = 200
"""Least number of poses in turns for an estimate of ages: twelve for each of 16 parameters. With half of it
the recording on grass of 2024-07-29 gets latencies of its poses."""
_TURNING = 0.3
"""Yaw rate [rad/s] above which a heading determines a time: noise of 2 mrad is 7 ms."""
_STRAIGHT = 0.05
"""Yaw rate [rad/s] below which the heading shows its noise and not its age: 0.1 s of age are 5 mrad."""
_OLDEST = 0.5
"""Largest age [s]: a larger one is a fault of the heading; those of the recordings vary by 0.04 to 0.15 s."""
_LEAST_SPREAD = 0.015
"""Spread of ages [s] below which stamps are as accurate as the gyro can show."""
_NOISE = (0.002, 0.02)  # bounds of a heading's noise [rad]: scan matchers are within
_SHORTEST_STEP = 0.01
"""Least time between two poses after the correction [s], so that stamps stay in order."""
_LEAST_OF_USUAL = 0.5
"""Least fraction of the usual time between two poses after the correction: those at 100 Hz must not shift
each other."""
_HUBER = 3.0
"""Deviation [standard deviations] above which an age has less weight."""


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


def estimate_latency(run: MotionRun) -> tuple[Floats, float]:
    """Latency of every pose of a run's track relative to their common latency, and its variation.

    It is zero without a gyro that agrees with the poses, with little turning, or if the ages of the poses
    vary by less than 15 ms: then the stamps are as accurate as the gyro can show.

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
    """Compare reported headings with the gyro's at the times given by the current ages."""
    times, rate = run.gyro if run.gyro is not None else (np.zeros(0), np.zeros(0))
    angle = gyro.turn(times, rate)
    at = track.times - gyro.yaw_delay_s
    turning = (np.interp(at + 0.05, times, angle) - np.interp(at - 0.05, times, angle)) / 0.1
    difference = track.heading - np.interp(at, times, angle)
    good = ~mark_excluded(run, run.track.times) & track.active
    rest = difference - align_heading(run.track, difference, good)
    straight = good & (np.abs(turning) < _STRAIGHT)
    noise = robust_spread(rest[straight]) if straight.any() else _NOISE[1]
    safe = np.where(np.abs(turning) > 1e-3, turning, np.inf)  # noqa: PLR2004 - no age without turning
    age = ages - rest / safe
    good &= np.abs(age) < _OLDEST
    return _Seen(
        age, turning, float(np.clip(noise, *_NOISE)), good, np.asarray(good & (np.abs(turning) > _TURNING))
    )


def _estimate(track: Track, seen: _Seen) -> tuple[Floats, float]:
    """Ages of all poses [s], shape (n,), and their variation [s]."""
    pattern = _list_terms(track)
    weight = 1.0 / ((seen.noise / np.maximum(np.abs(seen.rate), _TURNING)) ** 2 + 0.05**2)
    rows = pattern[seen.telling] * weight[seen.telling, None]
    normal = rows.T @ pattern[seen.telling]
    limited = np.clip(seen.age[seen.telling], -0.35, 0.35)
    usual = pattern @ np.linalg.solve(
        normal + 1e-6 * np.trace(normal) * np.eye(normal.shape[0]), rows.T @ limited
    )
    beside = seen.age - usual
    spread = max(robust_spread(beside[seen.telling]), 1e-3)
    # A part of the spread is the heading's own noise.
    heard = seen.noise**2 * float(np.median(1.0 / seen.rate[seen.telling] ** 2))
    own = np.sqrt(max(spread**2 - heard, 0.0))
    if own < 1e-3:  # noqa: PLR2004 - nothing but noise
        return np.zeros(usual.size), 0.0
    ages = usual + _smooth(track, seen, beside, float(own))
    ages -= float(np.mean(ages[seen.good])) if seen.good.any() else 0.0
    return ages, float(np.std(ages[seen.telling]))


def _smooth(track: Track, seen: _Seen, beside: Floats, spread: float) -> Floats:
    """Most likely ages relative to the usual ones: a first-order process in time, observed in turns."""
    wait = np.where(np.diff(track.segment) != 0, np.inf, np.diff(track.times))
    both = seen.telling[1:] & seen.telling[:-1] & (wait < LONGEST_WAIT_S - ROUNDING_S)
    limited = np.clip(beside, -3.0 * spread, 3.0 * spread)
    alike = 0.5
    if both.sum() >= _FEWEST // 2:
        alike = float(np.clip(np.corrcoef(limited[1:][both], limited[:-1][both])[0, 1], 0.05, 0.95))
    lasts = -float(np.median(wait[both] if both.any() else wait)) / np.log(alike)
    decay = np.exp(-wait / lasts)
    stiff = 1.0 / (spread**2 * (1.0 - decay**2))
    diagonal = np.concatenate(([1.0 / spread**2], stiff))
    diagonal[:-1] += stiff * decay**2
    known = np.where(seen.good, (seen.rate / seen.noise) ** 2, 0.0)
    smoothed = np.zeros(beside.size)
    for _ in range(3):
        off = np.abs(beside - smoothed) * np.abs(seen.rate) / seen.noise
        trusted = known * np.where(off > _HUBER, _HUBER / np.maximum(off, _HUBER), 1.0)
        smoothed = solve_tridiagonal(
            diagonal + trusted, -stiff * decay, trusted * np.where(known > 0, beside, 0)
        )
    return smoothed


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
    """Stamps minus the ages, in their original order."""
    usual = float(np.median(np.diff(track.times))) if track.times.size > 1 else 0.0
    # Less than the usual step: poses at 100 Hz must not shift each other.
    count = min(_SHORTEST_STEP, _LEAST_OF_USUAL * usual) * np.arange(ages.size)
    ordered: Floats = np.maximum.accumulate(track.times - ages - count) + count
    return ordered
