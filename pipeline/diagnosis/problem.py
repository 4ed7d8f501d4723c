"""What is explained: residuals of one or several runs as one long table, as a function of a state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.models.forward import Timing

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.diagnosis.state import DelayName, Slot, State
    from pipeline.identification.comparison import Comparison
    from pipeline.runs.signals import Velocity

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

UNIT_S = 10.0
_NO_DELAY = Timing()
_LEAST_SPREAD = 2e-4
_STANDING = 0.02
# Encoders are read between commands: half a period of one is half a percent of half a second of the other.
_LEAST_SHARE = 0.005


class Problem(Protocol):
    """Residuals over windows of half a second: x [m/s], y [m/s], w [rad/s].

    Attributes:
        delays: which delays of a run are free beside the effects.
        run: number of the run of each window, shape (n,).
        times: start and end of each window [s], shape (n, 2).
        unit: number of the stretch of ten seconds of each window; no stretch spans two runs, shape (n,).
        channels: which of x, y, w say anything.
        live: whether the input moves the vehicle during a window or just before, shape (n,).
        least: spread below which a residual is rounding of stamps [m/s, m/s, rad/s], shape (3,).
    """

    delays: tuple[DelayName, ...]
    run: Integers
    times: Floats
    unit: Integers
    channels: tuple[int, ...]
    live: Flags
    least: Floats

    def find_residuals(self, state: State) -> Floats:
        """Measured less predicted, shape (n, 3)."""

    def find_ideal(self) -> Floats:
        """Ideal velocity of the input (f_x, f_w) averaged over windows, now and up to 2 s earlier.

        Returns:
            shape (n, lags, 2), lags a quarter of a second apart.
        """


def number_units(run: Integers, times: Floats, length: float = UNIT_S) -> Integers:
    """Stretches of ten seconds, or of another length, numbered through all runs."""
    label = run * 1_000_000 + (times.mean(axis=1) // length).astype(np.int64)
    return np.unique(label, return_inverse=True)[1].astype(np.int64)


class BodyProblem:
    """From the input to the body's motion."""

    def __init__(self, comparisons: Sequence[Comparison], delays: tuple[DelayName, ...]) -> None:
        self.comparisons = tuple(comparisons)
        self.delays = delays
        self.channels: tuple[int, ...] = (0, 1, 2)
        self.least = np.full(3, _LEAST_SPREAD)
        sizes = [c.windows.start.size for c in self.comparisons]
        self.run = np.repeat(np.arange(len(sizes)), sizes).astype(np.int64)
        self.times = np.concatenate([c.windows.times for c in self.comparisons])
        self.unit = number_units(self.run, self.times)
        self.live = find_live(self.find_ideal())

    def find_residuals(self, state: State) -> Floats:
        """See `Problem`."""
        return np.concatenate(
            [
                c.find_residuals(state.effects, timing)
                for c, timing in zip(self.comparisons, state.timing, strict=True)
            ]
        )

    def find_ideal(self) -> Floats:
        """See `Problem`."""
        parts = []
        for comparison in self.comparisons:
            velocity = comparison.predict_velocity((), _NO_DELAY)
            parts.append(average_lags(comparison, velocity))
        return np.concatenate(parts)


class WheelProblem:
    """From the command to the wheels: what the drivetrain does, free of the ground."""

    def __init__(
        self, commanded: Sequence[Comparison], measured: Sequence[Comparison], *, speed: float, turn: float
    ) -> None:
        self.least = np.array([speed, 1.0, turn]) * _LEAST_SHARE
        self.comparisons = tuple(commanded)
        self.measured = tuple(measured)
        self.delays: tuple[DelayName, ...] = ()
        self.channels: tuple[int, ...] = (0, 2)
        sizes = [c.windows.start.size for c in self.comparisons]
        self.run = np.repeat(np.arange(len(sizes)), sizes).astype(np.int64)
        self.times = np.concatenate([c.windows.times for c in self.comparisons])
        self.unit = number_units(self.run, self.times)
        self.live = find_live(self.find_ideal())
        self._seen: dict[tuple[int, float], Floats] = {}
        self._spans = [locate_windows(comparison) for comparison in self.comparisons]

    def find_residuals(self, state: State) -> Floats:
        """See `Problem`; in terms of the ideal velocity of the wheels."""
        parts = []
        for index, (comparison, timing) in enumerate(zip(self.comparisons, state.timing, strict=True)):
            key = (index, timing.wheel_delay_s)
            if key not in self._seen:
                wheels = self.measured[index].predict_velocity((), timing)
                self._seen = {k: v for k, v in self._seen.items() if k[0] != index}
                self._seen[key] = average_windows(comparison, wheels, self._spans[index])
            driven = comparison.predict_velocity(state.effects, _NO_DELAY)
            parts.append(self._seen[key] - average_windows(comparison, driven, self._spans[index]))
        return np.concatenate(parts)

    def find_ideal(self) -> Floats:
        """See `Problem`."""
        return np.concatenate([average_lags(c, c.predict_velocity((), _NO_DELAY)) for c in self.comparisons])


def find_live(ideal: Floats) -> Flags:
    """Whether any of the ideal velocities (n, lags, 2) is more than 2 % of the largest."""
    size = np.abs(ideal)
    live: Flags = (size > _STANDING * size.max(axis=(0, 1))).any(axis=(1, 2))
    return live


@dataclass(frozen=True)
class Spans:
    """Where windows begin and end among the cell edges: edge before, share of the cell, and width [s]."""

    first: Integers
    into_first: Floats
    last: Integers
    into_last: Floats
    width: Floats

    def average(self, comparison: Comparison, signal: Floats) -> Floats:
        """Mean of a signal on cells over every window, shape (n,)."""
        total = comparison.cells.sum_up(signal)
        end = total[self.last] + self.into_last * (total[self.last + 1] - total[self.last])
        start = total[self.first] + self.into_first * (total[self.first + 1] - total[self.first])
        means: Floats = (end - start) / self.width
        return means


def locate_windows(comparison: Comparison, late: float = 0.0) -> Spans:
    """The windows of a comparison, ``late`` seconds earlier, among its cell edges."""
    cells, times = comparison.cells, comparison.windows.times
    start, end = cells.locate_edges(times[:, 0] - late), cells.locate_edges(times[:, 1] - late)
    top = cells.times.size - 1
    first, last = np.minimum(start.astype(np.int64), top), np.minimum(end.astype(np.int64), top)
    width = np.maximum((end - start) * cells.step_s, cells.step_s)
    return Spans(first, start - first, last, end - last, width)


def average_windows(comparison: Comparison, velocity: Velocity, spans: Spans) -> Floats:
    """Mean of (x, y, w) over every window, shape (n, 3)."""
    y = velocity.y
    return np.column_stack(
        (
            spans.average(comparison, velocity.x),
            spans.average(comparison, y) if y.any() else np.zeros(spans.first.size),
            spans.average(comparison, velocity.w),
        )
    )


def average_lags(comparison: Comparison, velocity: Velocity, lags: int = 9) -> Floats:
    """Means of (x, w) over windows now and earlier, shape (n, lags, 2)."""
    spans = [locate_windows(comparison, 0.25 * lag) for lag in range(lags)]
    means = [[one.average(comparison, signal) for signal in (velocity.x, velocity.w)] for one in spans]
    return np.moveaxis(np.asarray(means), (0, 1, 2), (1, 2, 0))


def differentiate(problem: Problem, state: State, residual: Floats, slots: Sequence[Slot]) -> Floats:
    """Change of the prediction with each free number, shape (n, 3, p)."""
    columns = np.empty((*residual.shape, len(slots)))
    for place, slot in enumerate(slots):
        value = state.read(slot)
        step = slot.step if value + slot.step <= slot.bounds[1] else -slot.step
        columns[:, :, place] = (residual - problem.find_residuals(state.write(slot, value + step))) / step
    return columns
