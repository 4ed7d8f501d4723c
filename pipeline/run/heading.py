"""Fine time grid of a run, and the heading against which models are compared."""

import enum
import itertools
from dataclasses import dataclass, replace

import numpy as np

from pipeline.core import PERIODS, ROUNDING_S, SILENT_S, Flags, Floats, Ints, compiled
from pipeline.run.motion_run import GyroFit, MotionRun, Track
from pipeline.run.signals import SPAN_S, STILL, Commands, DriveSeries, Signal, Wheels

_SHORTEST_HOLE = 0.3  # [s]: six messages at 20 Hz; shorter gaps, which last less than a window, are bridged
_LONGEST_HOLE = 3.0  # [s]: no prediction (2 s) bridges it, however rare messages are; it bounds the cells
_BEFORE = 1.0  # [s] before a span, from which its first command is held; lags start at the wheel speeds


@dataclass(frozen=True)
class Grid:
    """Consecutive cells of all spans.

    Attributes:
        step_s: width of a cell.
        times: middles [s], shape (n,).
        span: number of the span, shape (n,).
        first: first cell of each span, shape (k,).
        starts: start of each span [s], shape (k,).
        ends: end of each span's last cell [s], shape (k,).
    """

    step_s: float
    times: Floats
    span: Ints
    first: Ints
    starts: Floats
    ends: Floats

    def find_span(self, at: Floats) -> Ints:
        """Number of the span that contains each time, -1 in a gap."""
        span = np.searchsorted(self.starts, at, side="right") - 1
        inside = (span >= 0) & (at <= self.ends[np.maximum(span, 0)])
        return np.where(inside, span, -1)

    def sum_up(self, rate: Signal) -> Signal:
        """Integral of a rate at every cell edge: index 0 is the first edge, gaps add nothing."""
        summed: Signal = np.empty(rate.size + 1, dtype=rate.dtype)
        summed[0] = 0.0
        np.cumsum(rate, out=summed[1:])
        summed *= self.step_s
        return summed

    def locate_edges(self, at: Floats) -> Floats:
        """Fractional index of times into the result of `sum_up`."""
        places = np.empty(at.size)
        _locate_edges(np.ascontiguousarray(at), self.starts, self.ends, self.first, self.step_s, places)
        return places


@compiled("void(float64[::1], float64[::1], float64[::1], int64[::1], float64, float64[::1])")
def _locate_edges(
    at: Floats, starts: Floats, ends: Floats, first: Ints, step_s: float, places: Floats
) -> None:
    """See `Grid.locate_edges`; fastest for sorted times."""
    span = 0
    for row in range(at.size):
        time = at[row]
        while span + 1 < starts.size and starts[span + 1] <= time:
            span += 1
        while span > 0 and starts[span] > time:
            span -= 1
        inside = min(max(time, starts[span]), ends[span]) - starts[span]
        places[row] = first[span] + inside / step_s


def lay_grid(run: MotionRun, rate_hz: float) -> Grid:
    """Cut a run at the gaps of its recording and cover the rest with cells.

    Args:
        run: the run.
        rate_hz: cells per second.
    """
    stamps = run.streams
    period = np.diff(stamps)
    hole = min(max(_SHORTEST_HOLE, 3.0 * float(np.median(period))), _LONGEST_HOLE)
    edges = np.flatnonzero(period > hole + ROUNDING_S)
    starts = np.concatenate((stamps[:1], stamps[edges + 1]))
    ends = np.concatenate((stamps[edges], stamps[-1:]))
    long = ends - starts >= SPAN_S - ROUNDING_S
    starts, ends = starts[long], ends[long]
    step = 1.0 / rate_hz
    counts = np.ceil((ends - starts) / step - 1e-6).astype(np.int64)
    first = np.concatenate(([0], np.cumsum(counts)[:-1]))
    span = np.repeat(np.arange(starts.size), counts)
    times = starts[span] + (np.arange(span.size) - first[span] + 0.5) * step
    return Grid(step, times, span, first, starts, starts + counts * step)


def find_silences(series: DriveSeries, at: Floats) -> Floats:
    """Times of poses [s] within the gaps of a drive's readings, where its motion is unknown, and their ends.

    Before its first and after its last reading it is unknown as well.

    Args:
        series: readings.
        at: times of poses [s], increasing, shape (n,).
    """
    times = series.times
    steps = np.diff(times)
    # Two topics, one per side, come in pairs of nearly equal stamps: their median period is almost zero.
    longest = max(SILENT_S, PERIODS * float(np.quantile(steps, 0.75))) if steps.size else np.inf
    if at.size:
        times = np.concatenate((np.minimum(at[:1], times[0]), times, np.maximum(at[-1:], times[-1])))
    gaps = np.flatnonzero(np.diff(times) > longest + ROUNDING_S)
    begins, ends = times[gaps] + 0.05, times[gaps + 1] - 0.05
    first = np.searchsorted(begins, at, side="right") - 1
    inside = at[(first >= 0) & (at <= ends[np.maximum(first, 0)])] if gaps.size else at[:0]
    return np.unique(np.concatenate((begins, inside, ends)))


class MeasuredDrive:
    """Measured wheels as a function of time, held up to the middle of gaps.

    Args:
        series: wheel speeds [rad/s] and steering [rad] at their stamps.
    """

    def __init__(self, series: DriveSeries) -> None:
        times = series.times
        period = np.diff(times)
        hole = np.flatnonzero(period > max(_SHORTEST_HOLE, 3.0 * float(np.median(period))) + ROUNDING_S)
        middle = 0.5 * (times[hole] + times[hole + 1])
        places = np.concatenate((hole + 1, hole + 1))
        self._knots = np.insert(times, places, np.concatenate((middle - 1e-6, middle + 1e-6)))

        def fill(values: Floats) -> Floats:
            return np.insert(values, places, np.concatenate((values[hole], values[hole + 1])))

        self._steers, self._drifts = bool(series.steering.any()), series.sideways is not None
        signals = [series.left, series.right]
        # A car turns by speed times angle: where both jump, their means would turn less than it did.
        if self._steers:
            signals += [series.speed, series.speed * series.steering]
        signals += [] if series.sideways is None else [series.sideways]
        self._values = np.array([fill(signal) for signal in signals])

    def interpolate(self, at: Floats, delay_s: float) -> Wheels:
        """Wheels at times [s], shape (n,), with stamps late by ``delay_s``."""
        signals = np.empty((len(self._values), at.size))
        _interpolate(at + delay_s, self._knots, self._values, signals)
        left, right, *rest = signals
        steering = rest[1] / rest[0] if self._steers else np.zeros(left.size)
        return Wheels(left, right, steering, rest[-1] if self._drifts else None)


@compiled("void(float64[::1], float64[::1], float64[:, ::1], float64[:, ::1])")
def _interpolate(at: Floats, knots: Floats, values: Floats, signals: Floats) -> None:
    """Signals at times, linear between knots and constant outside.

    Args:
        at: times [s], fastest if sorted, shape (n,).
        knots: increasing [s], shape (m,).
        values: of each signal at the knots, shape (k, m).
        signals: the result, shape (k, n).
    """
    last, before = knots.size - 1, 0
    for row in range(at.size):
        time = min(max(at[row], knots[0]), knots[last])
        while before + 1 < last and knots[before + 1] <= time:
            before += 1
        while before > 0 and knots[before] > time:
            before -= 1
        share = (time - knots[before]) / (knots[before + 1] - knots[before])
        for signal in range(values.shape[0]):
            value = values[signal, before]
            signals[signal, row] = value + share * (values[signal, before + 1] - value)


class HeldDrive:
    """Held commands on cells; everything that depends only on their stamps is computed once.

    Args:
        series: held commands.
        grid: the grid.
    """

    def __init__(self, series: DriveSeries, grid: Grid) -> None:
        self._grid = grid
        following = np.minimum(np.searchsorted(series.times, grid.starts - 1e-6), series.times.size - 1)
        # Commands in a gap are unknown; before the recording there are none.
        ends_before = np.concatenate(([-np.inf], grid.ends[:-1]))
        stamp = np.maximum(ends_before + 1e-3, grid.starts - _BEFORE)
        inside = np.flatnonzero(grid.find_span(series.times) >= 0)
        times = np.concatenate((stamp, series.times[inside]))
        order = np.argsort(times, kind="stable")
        self._begins = np.argsort(order)[: stamp.size]
        source = np.concatenate((following, inside))[order]
        sideways = None if series.sideways is None else series.sideways[source]
        sides = (series.left[source], series.right[source], series.steering[source])
        self._held = Commands(times[order], *sides, sideways)

    def begin_spans(self, measured: Floats) -> Commands:
        """Commands with a first value for every span: what is measured there, or its first command.

        Args:
            measured: at each span's start, as `Wheels.stack`; NaN where unknown, shape (k, 4).
        """
        held = self._held
        left, right = self._begin(held.left, measured[:, 0]), self._begin(held.right, measured[:, 1])
        sideways = None if held.sideways is None else self._begin(held.sideways, measured[:, 2])
        steering = self._begin(held.steering, measured[:, 3])
        return replace(held, left=left, right=right, sideways=sideways, steering=steering)

    def _begin(self, values: Floats, seen: Floats) -> Floats:
        started = values.copy()
        started[self._begins] = np.where(np.isfinite(seen), seen, values[self._begins])
        return started

    def average_on_grid(self, commands: Commands) -> Wheels:
        """Cell means of held commands, at the stamps of `begin_spans` or at others."""

        def average(values: Floats) -> Floats:
            return average_held(commands.times, values, self._grid)

        steers = commands.steering.any()
        return Wheels(
            average(commands.left),
            average(commands.right),
            average(commands.steering) if steers else np.zeros(self._grid.times.size),
            None if commands.sideways is None else average(commands.sideways),
            average((np.maximum(np.abs(commands.left), np.abs(commands.right)) < STILL).astype(np.float64)),
        )


def average_held(times: Floats, values: Floats, grid: Grid) -> Floats:
    """Cell means of held values, exact for stamps inside a cell, shape (n,).

    Args:
        times: stamps [s], increasing, shape (m,).
        values: value from each stamp to the next, shape (m,).
        grid: the grid.
    """
    held, means = np.ascontiguousarray(values), np.empty(grid.times.size)
    _average_held(np.ascontiguousarray(times), held, grid.times, grid.step_s, means)
    return means


@compiled("void(float64[::1], float64[::1], float64[::1], float64, float64[::1])")
def _average_held(times: Floats, values: Floats, middles: Floats, step_s: float, means: Floats) -> None:
    """See `average_held`."""
    first, last = 0, times.size - 1
    for cell in range(middles.size):
        at = middles[cell] - 0.5 * step_s
        end = at + step_s
        while first < last and times[first + 1] <= at:
            first += 1
        if first == last or times[first + 1] >= end:
            means[cell] = values[first]
            continue
        area, held = 0.0, first
        while held < last and times[held + 1] < end:
            area += values[held] * (times[held + 1] - at)
            held += 1
            at = times[held]
        means[cell] = (area + values[held] * (end - at)) / step_s


# Heading against which models are compared: from the gyro if there is a good one, else from the poses.
#
# A gyro provides a better heading and a better clock than a localization once its sign, scale and bias are
# known and the slow part of its difference from the reported heading aligns it with the map.

_ALIGN_S = 3.0  # [s] to each side: localizations correct a heading over seconds, vehicles turn faster


class HeadingSource(enum.Enum):
    """Source of the heading: the gyro if it agrees with the poses, or always the poses."""

    AUTO = "auto"
    POSE = "pose"


@dataclass(frozen=True)
class Heading:
    """Heading on the cells and at the poses.

    Attributes:
        gyro: fit of the gyro; None if the heading is that of the poses.
        edges: gyro heading at the cell edges [rad], shape (n + 1,); empty without a gyro.
        offset: added to the gyro heading to align it with the map, at every pose [rad]; without a gyro, the
            reported heading, shape (m,).
    """

    gyro: GyroFit | None
    edges: Floats
    offset: Floats


def choose_heading(run: MotionRun, grid: Grid, source: HeadingSource) -> Heading:
    """Heading of the gyro if it agrees with the poses, else of the poses."""
    track = run.track
    fit = run.gyro_fit if source is HeadingSource.AUTO else None
    if fit is None or run.gyro is None:
        return Heading(None, np.zeros(0), track.heading)
    times, rate = run.gyro
    rates = fit.signed_scale * np.interp(grid.times, times, rate) + fit.bias
    edges = grid.sum_up(rates)
    seen = np.interp(grid.locate_edges(track.times), np.arange(edges.size), edges)
    difference = track.heading - seen
    good = ~mark_excluded(run.excluded, track.times)
    offset = align_heading(track, difference, good, grid.find_span(track.times))
    return Heading(fit, edges, offset)


def align_heading(track: Track, difference: Floats, good: Flags, span: Ints | None = None) -> Floats:
    """Slow part of the difference of two headings, within segments and spans [rad], shape (n,).

    Args:
        track: the poses.
        difference: reported heading minus the other one [rad], shape (n,).
        good: poses to use, shape (n,); in a piece without any, all poses are used.
        span: number of the span of each pose; by default gaps in the stamps end a span.
    """
    if span is None:
        span = np.concatenate(([0], np.cumsum(np.diff(track.times) > SPAN_S + ROUNDING_S)))
    offset = np.empty(track.times.size)
    for begin, end in _find_pieces(track.segment, span):
        rows = slice(begin, end)
        counts = good[rows] if good[rows].any() else np.ones(end - begin, dtype=bool)
        offset[rows] = _smooth(track.times[rows], difference[rows], counts)
    return offset


def has_excluded(excluded: Floats, start: Floats, end: Floats) -> Flags:
    """Whether each closed interval contains an excluded sample."""
    return np.searchsorted(excluded, end + 1e-9) > np.searchsorted(excluded, start - 1e-9)


def mark_excluded(excluded: Floats, times: Floats) -> Flags:
    """Whether an excluded sample is next to each time."""
    return has_excluded(excluded, times - 0.05, times + 0.05)


def _find_pieces(segment: Ints, span: Ints) -> list[tuple[int, int]]:
    edges = np.flatnonzero((np.diff(segment) != 0) | (np.diff(span) != 0)) + 1
    bounds = [0, *edges.tolist(), segment.size]
    return list(itertools.pairwise(bounds))


def _smooth(times: Floats, values: Floats, good: Flags) -> Floats:
    """Running mean over six seconds of the good values."""
    known = times[good]
    total = np.concatenate(([0.0], np.cumsum(values[good])))
    low = np.searchsorted(known, times - _ALIGN_S - ROUNDING_S)
    high = np.searchsorted(known, times + _ALIGN_S + ROUNDING_S, side="right")
    empty = high <= low
    mean = (total[high] - total[low]) / np.maximum(high - low, 1)
    if empty.any():
        mean[empty] = np.interp(times[empty], known, values[good])
    smooth: Floats = mean
    return smooth
