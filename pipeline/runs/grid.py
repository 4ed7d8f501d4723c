"""The fine grid of a run: spans without holes, cut into cells, and the inputs on them."""

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.core.arrays import Floats, Ints
from pipeline.runs.recording import MotionRun
from pipeline.runs.signals import Commands, DriveSeries, Signal, Wheels

Number = TypeVar("Number", np.float64, np.int64)

_SHORTEST_HOLE = 0.3
_SHORTEST_SPAN = 0.5
_BEFORE = 1.0
# Stamps on a raster meet bounds exactly: rounding must not decide.
_ROUNDING_S = 1e-6


@dataclass(frozen=True)
class Grid:
    """Cells of all spans, one after the other.

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
        """Number of the span that holds each time, -1 in a hole."""
        span = np.searchsorted(self.starts, at, side="right") - 1
        inside = (span >= 0) & (at <= self.ends[np.maximum(span, 0)])
        return np.where(inside, span, -1)

    def sum_up(self, rate: Signal) -> Signal:
        """Integral of a rate at every cell edge: index 0 is the first edge of all, holes count nothing."""
        summed: Signal = np.empty(rate.size + 1, dtype=rate.dtype)
        summed[0] = 0.0
        np.cumsum(rate, out=summed[1:])
        summed *= self.step_s
        return summed

    def locate_edges(self, at: Floats) -> Floats:
        """Place of times among the cell edges as a fractional index into `sum_up`'s result."""
        span = np.clip(np.searchsorted(self.starts, at, side="right") - 1, 0, self.starts.size - 1)
        inside = np.clip(at, self.starts[span], self.ends[span]) - self.starts[span]
        return self.first[span] + inside / self.step_s


def lay_grid(run: MotionRun, rate_hz: float) -> Grid:
    """Cut a run at the holes of its recording and lay cells over what remains.

    Args:
        run: the run.
        rate_hz: cells per second.
    """
    stamps = run.streams
    period = np.diff(stamps)
    hole = max(_SHORTEST_HOLE, 3.0 * float(np.median(period)))
    edges = np.flatnonzero(period > hole + _ROUNDING_S)
    starts = np.concatenate((stamps[:1], stamps[edges + 1]))
    ends = np.concatenate((stamps[edges], stamps[-1:]))
    long = ends - starts >= _SHORTEST_SPAN - _ROUNDING_S
    starts, ends = starts[long], ends[long]
    step = 1.0 / rate_hz
    counts = np.ceil((ends - starts) / step - 1e-6).astype(np.int64)
    first = np.concatenate(([0], np.cumsum(counts)[:-1]))
    span = np.repeat(np.arange(starts.size), counts)
    times = starts[span] + (np.arange(span.size) - first[span] + 0.5) * step
    return Grid(step, times, span, first, starts, starts + counts * step)


class MeasuredDrive:
    """Measured wheels as a function of time, held towards the middle of holes.

    Args:
        series: wheel speeds [rad/s] and steering [rad] at their stamps.
    """

    def __init__(self, series: DriveSeries) -> None:
        times = series.times
        period = np.diff(times)
        hole = np.flatnonzero(period > max(_SHORTEST_HOLE, 3.0 * float(np.median(period))) + _ROUNDING_S)
        middle = 0.5 * (times[hole] + times[hole + 1])
        places = np.concatenate((hole + 1, hole + 1))
        self._knots = np.insert(times, places, np.concatenate((middle - 1e-6, middle + 1e-6)))

        def fill(values: Floats) -> Floats:
            return np.insert(values, places, np.concatenate((values[hole], values[hole + 1])))

        self._left, self._right = fill(series.left), fill(series.right)
        self._steering = fill(series.steering) if series.steering.any() else None
        self._sideways = None if series.sideways is None else fill(series.sideways)

    def interpolate(self, at: Floats, delay_s: float) -> Wheels:
        """Wheels at times [s] of shape (n,), their stamps being late by ``delay_s``."""
        late = at + delay_s
        return Wheels(
            np.interp(late, self._knots, self._left),
            np.interp(late, self._knots, self._right),
            np.zeros(late.size) if self._steering is None else np.interp(late, self._knots, self._steering),
            None if self._sideways is None else np.interp(late, self._knots, self._sideways),
        )


class HeldDrive:
    """Held commands on cells; what depends on their stamps alone is worked out once.

    Args:
        series: held commands.
        cells: the grid.
    """

    def __init__(self, series: DriveSeries, cells: Grid) -> None:
        self._cells = cells
        following = np.minimum(np.searchsorted(series.times, cells.starts - 1e-6), series.times.size - 1)
        # At a hole nobody knows what was asked meanwhile; at the start of the recording nothing was.
        ends_before = np.concatenate(([-np.inf], cells.ends[:-1]))
        stamp = np.maximum(ends_before + 1e-3, cells.starts - _BEFORE)
        inside = np.flatnonzero(cells.find_span(series.times) >= 0)
        times = np.concatenate((stamp, series.times[inside]))
        order = np.argsort(times, kind="stable")
        self._begins = np.argsort(order)[: stamp.size]
        source = np.concatenate((following, inside))[order]
        sideways = None if series.sideways is None else series.sideways[source]
        sides = (series.left[source], series.right[source], series.steering[source])
        self._held = Commands(times[order], *sides, sideways)
        self._raster = Raster(self._held.times, cells)

    def begin_spans(self, measured: Floats) -> Commands:
        """Commands with a first value for every span: what the wheels did there, or its first command.

        Args:
            measured: left, right and sideways speeds at each span's start, NaN where unknown, shape (k, 3).
        """
        held = self._held
        left, right = self._begin(held.left, measured[:, 0]), self._begin(held.right, measured[:, 1])
        sideways = None if held.sideways is None else self._begin(held.sideways, measured[:, 2])
        return replace(held, left=left, right=right, sideways=sideways)

    def _begin(self, values: Floats, seen: Floats) -> Floats:
        begun = values.copy()
        begun[self._begins] = np.where(np.isfinite(seen), seen, values[self._begins])
        return begun

    def hold_on_cells(self, commands: Commands) -> Wheels:
        """Cell means of held commands, at the stamps of `begin_spans` or at others."""
        raster = self._raster if commands.times is self._held.times else Raster(commands.times, self._cells)
        steering = raster.average(commands.steering) if commands.steering.any() else None
        return Wheels(
            raster.average(commands.left),
            raster.average(commands.right),
            np.zeros(self._cells.times.size) if steering is None else steering,
            None if commands.sideways is None else raster.average(commands.sideways),
        )


class Raster:
    """Stamps of held values laid over cells: means are exact wherever a stamp falls inside a cell.

    Args:
        times: stamps [s], increasing, shape (m,).
        cells: the grid.
    """

    def __init__(self, times: Floats, cells: Grid) -> None:
        self._step_s, self._count = cells.step_s, cells.times.size
        self._width = np.diff(times)
        edges = np.concatenate((cells.times - 0.5 * cells.step_s, cells.ends))
        self._last_of_span = np.append(cells.first[1:], self._count) - 1
        self._index = np.clip(np.searchsorted(times, edges, side="right") - 1, 0, times.size - 1)
        self._into = edges - times[self._index]
        self._steady = self._until(self._index) == self._index[: self._count]

    def average(self, values: Floats) -> Floats:
        """Cell means of held values of shape (m,), shape (n,)."""
        area = np.zeros(values.size)
        np.cumsum(values[:-1] * self._width, out=area[1:])
        held = values[self._index]
        at = area[self._index] + held * self._into
        means: Floats = (self._until(at) - at[: self._count]) / self._step_s
        # Differences of a growing integral leave rounding; where nothing changed the value is known exactly.
        return np.where(self._steady, held[: self._count], means)

    def _until(self, at: NDArray[Number]) -> NDArray[Number]:
        """Of values at the edges those at the end of each cell."""
        until = at[1 : self._count + 1].copy()
        until[self._last_of_span] = at[self._count :]
        return until
