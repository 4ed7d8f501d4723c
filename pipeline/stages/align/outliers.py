"""Faults of the localization: half seconds in which it goes where its own wheels say no vehicle went.

A localization that was lost jumps back, waits and catches up, or reports a way that is turned against the
heading. Every displacement over half a second, its direction and its length, is compared with a robust model
of the whole run: a regression on the wheels, late and multiplied, wide enough to hold every effect of the
catalogue. What is eight times as far off as is usual at that speed, and a quarter of a metre, is an outlier,
up to a twentieth of the run.
"""

import numpy as np

from pipeline.core import timegrid
from pipeline.core.arrays import Floats, Ints
from pipeline.runs.heading import align_heading, has_barred, mark_barred
from pipeline.runs.recording import MotionRun
from pipeline.runs.signals import DriveSeries, name_inputs
from pipeline.vehicles import Vehicle

_WINDOW_S = 0.5
_LONGEST_S = 1.2
_FEWEST = 200
_FAR = 8.0
_LEAST_M = 0.25
_LARGEST_SHARE = 0.05
_LAGS_S = (-0.3, -0.1, 0.0, 0.1, 0.3, 0.6, 1.0, 1.6)
_ROUNDS = 10
_BINS = 6
SAMPLE_S = 0.05
_ROUNDING = 1e-6


def find_outliers(run: MotionRun, vehicle: Vehicle) -> Floats:
    """Times at which the localization is at fault [s], twenty a second.

    Without measured wheels nothing says where the vehicle cannot have gone: there are none.
    """
    none = np.zeros(0)
    if run.wheels is None:
        return none
    first, last = _pair_up(run)
    if first.size < _FEWEST:
        return none
    off = _measure_misfit(run, run.wheels, vehicle, first, last)
    begin, end = run.track.times[first], run.track.times[last]
    live = np.diff(run.track.times)[run.track.active[1:]]
    most = _LARGEST_SHARE * float(live[live < _LONGEST_S].sum())
    faulty = off > 1.0
    grid = _fill(begin[faulty], end[faulty], run.start_s)
    # More than a twentieth is no exception: then only the worst of it counts as fault.
    while grid.size * SAMPLE_S > most:
        faulty &= off > np.quantile(off[faulty], 0.1)
        grid = _fill(begin[faulty], end[faulty], run.start_s)
    return grid


def _fill(begin: Floats, end: Floats, origin: float) -> Floats:
    """Times all through some intervals, twenty a second since ``origin``."""
    first = np.floor((begin - origin) / SAMPLE_S + _ROUNDING)
    last = np.ceil((end - origin) / SAMPLE_S - _ROUNDING)
    ticks = [np.arange(a, b + 1) for a, b in zip(first.tolist(), last.tolist(), strict=True)]
    return origin + np.unique(np.concatenate(ticks)) * SAMPLE_S if ticks else np.zeros(0)


def _pair_up(run: MotionRun) -> tuple[Ints, Ints]:
    """Poses of one segment half a second apart, and those on both sides of a longer wait."""
    times = run.track.times
    first = np.arange(times.size)
    last = np.searchsorted(times, times + _WINDOW_S - 1e-3)
    kept = last < times.size
    first, last = first[kept], last[kept].astype(np.int64)
    kept = (run.track.segment[first] == run.track.segment[last]) & (times[last] - times[first] < _LONGEST_S)
    kept &= run.track.active[first] & run.track.active[last]
    kept &= ~has_barred(run.barred, times[first], times[last])
    return first[kept], last[kept]


def _measure_misfit(run: MotionRun, wheels: DriveSeries, vehicle: Vehicle, first: Ints, last: Ints) -> Floats:
    """How far each displacement is from the robust model; one is as far as is just believed, shape (n,)."""
    track = run.track
    heading, delay = _choose_heading(run)
    moved = (track.path[last] - track.path[first]) * np.exp(-0.5j * (heading[first] + heading[last]))
    span = track.times[last] - track.times[first]
    forward, sideways, turning = vehicle.kinematics.forward(name_inputs(wheels, vehicle), vehicle)

    def drive(rate: Floats, late: float) -> Floats:
        way = timegrid.integrate_rate(wheels.times, rate)
        at = track.times - delay - late
        return np.interp(at[last], wheels.times, way) - np.interp(at[first], wheels.times, way)

    own = (heading[last] - heading[first]) / span
    along = [drive(forward, late) for late in _LAGS_S]
    across = [drive(forward * turning, late) for late in _LAGS_S]
    beside = [own * way for way in along]
    rest = [span, drive(forward * np.abs(turning), 0.1), drive(forward * np.abs(forward), 0.1)]
    rest += [drive(np.abs(forward), 0.1), drive(np.abs(turning), 0.1), drive(turning, 0.1), own * span]
    speed = np.abs(along[_LAGS_S.index(0.1)])
    if wheels.sideways is not None:
        aside = [drive(sideways, late) for late in _LAGS_S]
        rest += [*aside, *(own * way for way in aside), drive(sideways * np.abs(sideways), 0.1)]
        rest += [drive(sideways * turning, 0.1), drive(np.abs(sideways), 0.1)]
        speed = np.hypot(speed, aside[_LAGS_S.index(0.1)])
    columns = np.column_stack((*along, *across, *beside, *rest))
    gap = np.column_stack([_fit_robustly(columns, part) for part in (moved.real, moved.imag)])
    size = np.hypot(gap[:, 0], gap[:, 1])
    usual = _spread_by_speed(size, speed / span)
    return size / np.maximum(_FAR * usual, _LEAST_M)


def _choose_heading(run: MotionRun) -> tuple[Floats, float]:
    """Heading at the poses: the gyro's where there is a good one; and how late the poses are [s]."""
    gyro = run.gyro_fit
    if gyro is None or run.gyro is None:
        return run.track.heading, 0.0
    times, rate = run.gyro
    angle = gyro.turn(times, rate)
    seen = np.interp(run.track.times - gyro.yaw_delay_s, times, angle)
    good = ~mark_barred(run, run.track.times)
    return seen + align_heading(run.track, run.track.heading - seen, good), gyro.yaw_delay_s


def _fit_robustly(columns: Floats, values: Floats) -> Floats:
    """What a regression with Cauchy weights leaves, shape (n,)."""
    scale = np.sqrt(np.mean(columns**2, axis=0)) + 1e-9
    design = columns / scale
    weight, left = np.ones(values.size), values
    ridge = 1e-4 * values.size * np.eye(design.shape[1])
    for _ in range(_ROUNDS):
        rows = design * weight[:, None]
        found = np.linalg.solve(rows.T @ design + ridge, rows.T @ values)
        left = values - design @ found
        spread = max(1.4826 * float(np.median(np.abs(left))), 1e-3)
        weight = 1.0 / (1.0 + (left / (2.0 * spread)) ** 2)
    return left


def _spread_by_speed(size: Floats, speed: Floats) -> Floats:
    """Usual size of a misfit at each speed: faster is less certain, for stamps are what is wrong."""
    edges = np.quantile(speed, np.linspace(0.0, 1.0, _BINS + 1))
    place = np.clip(np.searchsorted(edges, speed, side="right") - 1, 0, _BINS - 1)
    middle = np.array([np.median(speed[place == k]) if (place == k).any() else np.nan for k in range(_BINS)])
    usual = np.array([np.median(size[place == k]) if (place == k).any() else np.nan for k in range(_BINS)])
    known = np.isfinite(middle)
    # The median of the length of two normal parts is 1.18 times the spread of either.
    return np.interp(speed, middle[known], np.maximum.accumulate(usual[known])) / 1.18
