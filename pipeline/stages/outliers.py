"""Faults of the localization: half seconds of motion that contradict the vehicle's wheels.

A localization that was lost jumps back, stops and catches up, or reports a path that is rotated against the
heading. Every displacement over half a second, its direction and its length, is compared with a robust
model of the whole run: a regression on the wheels with delays and gains, general enough to contain every
effect of the catalogue. A deviation of eight times the usual one at that speed, and of a quarter of a
metre, is an outlier, up to a twentieth of the run. What lasts longer, and blocks of the grid show, is found
by `spans`.
"""

import numpy as np

from pipeline.core import Floats, Ints, arrays, fit_robustly, robust_spread
from pipeline.run import DriveSeries, Track, name_inputs
from pipeline.sources import Vehicle
from pipeline.stages.gyro import pair_poses
from pipeline.stages.spans import Span

_EARLY_S = 1e-3
"""See `pair_poses`: rounding."""
_LONGEST_S = 1.2
"""Longest span of a tested displacement [s]: over a longer one the wheels' motion is too uncertain."""
_FEWEST = 200
"""Least number of displacements for a fit of some thirty parameters: six per parameter."""
_FAR = 8.0
"""Usual misfits at a speed above which a displacement is a fault; half and double change no finding of two
recordings, where `_LEAST_M` decides."""
_LEAST_M = 0.25
"""Least misfit of a fault [m]. With half of it the recording on grass of 2024-07-29 has outliers, and 0.6 %
less median slip."""
_LARGEST_SHARE = 0.05
"""Largest fraction of a run that is an outlier; a larger one is a property of the localization. Bad poses are
0 to 10 % of the windows of the recordings."""
_LAGS_S = (-0.3, -0.1, 0.0, 0.1, 0.3, 0.6, 1.0, 1.6)
"""Delays [s] at which wheels enter the model: their mixture approximates any lag and inertia up to 1.6 s."""
_LEAST_NOISE_M = 1e-3
"""Least noise of a displacement: a localization that errs less is a simulation."""
_RIDGE = 1e-4
"""See `fit_robustly`: at one speed its columns do not determine their coefficients."""
_BINS = 6
"""Classes of speed of equal size, at least 33 displacements in each."""
_BESIDE_S = 0.05
"""Time before and after a displacement that is at fault with it [s]: the step of the grid."""


def find_outliers(
    track: Track, heading: Floats, at: Floats, wheels: DriveSeries, vehicle: Vehicle, excluded: Floats
) -> list[Span]:
    """Spans in which the localization is at fault, in order.

    Args:
        track: the poses, shape (n,).
        heading: of the gyro if there is a good one, else of the poses [rad], shape (n,).
        at: times of the poses on the clock of the wheels [s], shape (n,).
        wheels: measured; without them the vehicle's motion is unknown.
        vehicle: geometry.
        excluded: times [s] that are not compared, increasing.
    """
    first, last = pair_poses(track, excluded, early_s=_EARLY_S, longest_s=_LONGEST_S)
    active = track.active[first] & track.active[last]
    first, last = first[active], last[active]
    if first.size < _FEWEST:
        return []
    off = _measure_misfit(track, heading, at, wheels, vehicle, first, last)
    begin, end = track.times[first] - _BESIDE_S, track.times[last] + _BESIDE_S
    live = np.diff(track.times)[track.active[1:]]
    most = _LARGEST_SHARE * float(live[live < _LONGEST_S].sum())
    faulty = off > 1.0
    spans = _join(begin[faulty], end[faulty], off[faulty])
    # More than a twentieth is not an exception: then only the worst part counts as a fault.
    while sum(one.end - one.start for one in spans) > most:
        faulty &= off > np.quantile(off[faulty], 0.1)
        spans = _join(begin[faulty], end[faulty], off[faulty])
    return spans


def _join(begin: Floats, end: Floats, off: Floats) -> list[Span]:
    """Union of some intervals, in the order of their starts."""
    until = np.maximum.accumulate(end)
    first = np.flatnonzero(np.append(True, begin[1:] > until[:-1])[: begin.size])
    last = np.append(first[1:], begin.size)[: first.size] - 1
    return [
        Span("outlier", float(begin[a]), float(until[b]), float(off[a : b + 1].max()))
        for a, b in zip(first.tolist(), last.tolist(), strict=True)
    ]


def _measure_misfit(
    track: Track, heading: Floats, at: Floats, wheels: DriveSeries, vehicle: Vehicle, first: Ints, last: Ints
) -> Floats:
    """Distance of each displacement from the robust model, one at the threshold of a fault, shape (n,)."""
    moved = (track.path[last] - track.path[first]) * np.exp(-0.5j * (heading[first] + heading[last]))
    span = track.times[last] - track.times[first]
    forward, sideways, turning = vehicle.kinematics.forward(name_inputs(wheels, vehicle), vehicle)

    def drive(rate: Floats, late: float) -> Floats:
        driven = arrays.integrate_rate(wheels.times, rate)
        until = np.interp(at - late, wheels.times, driven)
        return until[last] - until[first]

    own = (heading[last] - heading[first]) / span
    along = [drive(forward, late) for late in _LAGS_S]
    across = [drive(forward * turning, late) for late in _LAGS_S]
    beside = [own * column for column in along]
    rest = [span, drive(forward * np.abs(turning), 0.1), drive(forward * np.abs(forward), 0.1)]
    rest += [drive(np.abs(forward), 0.1), drive(np.abs(turning), 0.1), drive(turning, 0.1), own * span]
    speed = np.abs(along[_LAGS_S.index(0.1)])
    if wheels.sideways is not None:
        aside = [drive(sideways, late) for late in _LAGS_S]
        rest += [*aside, *(own * column for column in aside), drive(sideways * np.abs(sideways), 0.1)]
        rest += [drive(sideways * turning, 0.1), drive(np.abs(sideways), 0.1)]
        speed = np.hypot(speed, aside[_LAGS_S.index(0.1)])
    columns = np.column_stack((*along, *across, *beside, *rest))
    gap_x, gap_y = (
        fit_robustly(columns, part, measure=robust_spread, least=_LEAST_NOISE_M, ridge=_RIDGE).rest
        for part in (moved.real, moved.imag)
    )
    size = np.hypot(gap_x, gap_y)
    usual = _spread_by_speed(size, speed / span)
    return size / np.maximum(_FAR * usual, _LEAST_M)


def _spread_by_speed(size: Floats, speed: Floats) -> Floats:
    """Usual misfit at each speed: it increases with the speed, since stamps are the source of error."""
    edges = np.quantile(speed, np.linspace(0.0, 1.0, _BINS + 1))
    bins = np.clip(np.searchsorted(edges, speed, side="right") - 1, 0, _BINS - 1)
    middle = np.array([np.median(speed[bins == k]) if (bins == k).any() else np.nan for k in range(_BINS)])
    usual = np.array([np.median(size[bins == k]) if (bins == k).any() else np.nan for k in range(_BINS)])
    known = np.isfinite(middle)
    # The median of the length of two normal parts is 1.18 times the spread of either.
    return np.interp(speed, middle[known], np.maximum.accumulate(usual[known])) / 1.18
