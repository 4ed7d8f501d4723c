"""Objective of a fit: weighted residuals over windows of half a second, as a function of a state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from pipeline.core import arrays
from pipeline.core.arrays import STRETCH_S, Flags, Floats, Ints, guarded_spread, robust_spread
from pipeline.estimation.comparison import Comparison, Input
from pipeline.estimation.state import NO_PRIOR, DelayName, Free, Prior, State, Weights, make_columns
from pipeline.models.catalogue import find_late_effect
from pipeline.models.effect import Effect, Late, Place
from pipeline.models.model import Timing
from pipeline.models.parameter import OVERSHOOT, Largest
from pipeline.run.signals import Velocity
from pipeline.run.windows import NODE_S, WINDOW_S, average_spans

CLIP = 6.0
"""Limit at which residuals are clipped or above which their cost is linear [robust standard deviations]:
six do not affect normal noise, and windows with a rotated pose do not dominate a fit."""
RIDGE = 1e-6
"""Regularization of normal equations for columns of unit size: smaller than any relevant gain."""


Measure = Callable[[Floats, float, float], float]


def measure_spread(residual: Floats, part: Part, measure: Measure = guarded_spread) -> Floats:
    """Spread of each run and channel while driving, in the layout of the residuals, shape (n, 3).

    Args:
        residual: shape (n, 3).
        part: part with these residuals.
        measure: function of the sizes, shape (k,), the clipping limit in spreads, and the least spread.
    """
    spread = np.full(residual.shape, np.inf)
    for number in np.unique(part.run).tolist():
        rows = part.run == number
        live = rows & part.live
        for channel in part.channels:
            size = np.abs(residual[live if live.any() else rows, channel])
            # A channel without any motion, as the turning of a straight drive, says nothing.
            spread[rows, channel] = measure(size, CLIP, float(part.least[channel])) or np.inf
    return spread


def make_weights(residual: Floats, part: Part) -> Weights:
    """Weights of a model: its spreads, at most those of a saturated fit, clipped at six of its own spreads.

    Args:
        residual: residuals of the model, shape (n, 3).
        part: part with these residuals.
    """
    own = measure_spread(residual, part)
    scale = np.minimum(own, part.noise)
    with np.errstate(invalid="ignore"):
        clip = np.where(np.isfinite(scale), CLIP * own / scale, 1.0)
    return Weights(scale, clip)


def measure_noise(part: Part, residual: Floats) -> Floats:
    """Spread of the residuals of a saturated fit: a regression on the input's past, shape (n, 3).

    Args:
        part: part to explain.
        residual: residuals of the ideal model, or of the model to start from.
    """
    design = _make_features(part)
    rest = np.array(residual)
    for number in np.unique(part.run).tolist():
        rows = part.run == number
        columns = design[rows]
        columns = columns[:, columns.std(axis=0) > 0.0]
        size = np.sqrt((columns**2).mean(axis=0))
        columns = np.column_stack((columns / size, np.ones(columns.shape[0])))
        for channel in part.channels:
            rest[rows, channel] = _fit_robustly(columns, residual[rows, channel])
    return measure_spread(rest, part)


def _fit_robustly(columns: Floats, values: Floats) -> Floats:
    weight = np.ones(values.size)
    rest = values
    ridge = RIDGE * values.size * np.eye(columns.shape[1])
    for _ in range(3):
        weighted = columns * weight[:, None]
        rest = values - columns @ np.linalg.solve(weighted.T @ columns + ridge, weighted.T @ values)
        spread = robust_spread(rest) + 1e-12
        weight = np.minimum(1.0, 3.0 * spread / np.maximum(np.abs(rest), 1e-12))
    freedom = max(values.size - columns.shape[1], 0.25 * values.size)
    widened: Floats = rest * np.sqrt(values.size / freedom)
    return widened


def _make_features(part: Part) -> Floats:
    lags = part.find_ideal()
    forward, turning = lags[:, :, 0], lags[:, :, 1]
    products = forward * turning
    now = [
        forward[:, 0] * np.abs(forward[:, 0]),
        forward[:, 0] * np.abs(turning[:, 0]),
        turning[:, 0] * np.abs(turning[:, 0]),
        np.sign(forward[:, 0]),
        np.sign(turning[:, 0]),
        np.abs(forward[:, 0]),
        np.abs(turning[:, 0]),
    ]
    columns = [forward, turning, products[:, [0, 1, 2, 4, 6]], *now]
    for sideways in np.moveaxis(lags[:, :, 2:], 2, 0):
        across = sideways * turning
        first = sideways[:, 0]
        columns += [
            sideways,
            across[:, [0, 1, 2, 4, 6]],
            first * np.abs(first),
            first * np.abs(turning[:, 0]),
        ]
        columns += [
            first * np.abs(forward[:, 0]),
            np.abs(first) * forward[:, 0],
            np.sign(first),
            np.abs(first),
        ]
    return np.column_stack(columns)


_NO_DELAY = Timing()
_LEAST_SPREAD = 2e-4
"""Least spread of a displacement [m, rad] over half a second: weights remain finite for a model without
noise."""
_STANDING = 0.02  # share of the largest motion of a run below which the robot is at rest in a window
# Encoders are read between commands: half a period of one is half a percent of half a second of the other.
_LEAST_SHARE = 0.005
# Ratio of width and standard deviation of a uniform distribution.
_SPREAD_OF_EVEN = 12.0**0.5


class Part(ABC):
    """Residuals over windows of half a second: x [m/s], y [m/s], w [rad/s].

    Args:
        comparisons: runs with the input and the windows to compare.
        delays: delays of a run that are free in addition to the effects.

    Attributes:
        run: number of the run of each window, shape (n,).
        times: start and end of each window [s], shape (n, 2).
        unit: number of the stretch of ten seconds of each window; no stretch spans two runs, shape (n,).
        block: number of the command step of each window, through all runs, shape (n,).
        channels: indices of the informative ones of x, y, w.
        live: whether the input moves the vehicle during a window or just before, shape (n,).
        least: spread below which a residual is rounding of stamps [m/s, m/s, rad/s], shape (3,).
        title: displayed name of the part.
        prior: prior of the parameters.
        is_restarted: see `restarted`.
        dates_poses: whether its fixed clocks are those of the poses.
        is_delayed: whether the wheels that it predicts start from encoders with their delay.
        clocks: ids of effects that are a clock of each single run: of several runs if not all have a gyro
            that determines the delay of the poses.
    """

    prior: Prior = NO_PRIOR
    is_restarted: bool = False
    dates_poses: bool = True
    is_delayed: bool = True
    channels: tuple[int, ...] = (0, 1, 2)
    title: str

    def __init__(self, comparisons: Sequence[Comparison], delays: tuple[DelayName, ...] = ()) -> None:
        self.comparisons = tuple(comparisons)
        self.delays = delays
        is_dated = len(self.comparisons) == 1 or all(c.has_gyro for c in self.comparisons)
        self.clocks = () if is_dated else (find_late_effect(Late.POSES).id,)
        self.least: Floats = np.full(3, _LEAST_SPREAD)
        windows = [c.windows for c in self.comparisons]
        self.run = np.repeat(np.arange(len(windows)), [w.start.size for w in windows]).astype(np.int64)
        self.times: Floats = np.concatenate([w.times for w in windows])
        begin = np.array([comparison.run.start_s for comparison in self.comparisons])
        self._since: Floats = self.times.mean(axis=1) - begin[self.run]
        self._stretches: dict[float, Ints] = {}
        self.unit = self.number_stretches(STRETCH_S)
        shift = np.concatenate(([0], np.cumsum([int(w.block.max(initial=-1)) + 1 for w in windows])))
        self.block: Ints = np.concatenate([w.block + shift[i] for i, w in enumerate(windows)])
        self.live = find_live(self.find_ideal())

    def number_stretches(self, length: float) -> Ints:
        """Stretches of a length [s] since each run's start, numbered through all runs, shape (n,)."""
        if length not in self._stretches:
            self._stretches[length] = number_stretches(self.run, self._since, length)
        return self._stretches[length]

    def list_free(self, state: State, per_run: Sequence[str] = ()) -> tuple[Free, ...]:
        """Free parameters of a state on this part: clocks and parameters in `per_run` have a value per run.

        In a run without a gyro, the delay between poses and wheels is its clock.
        """
        return tuple(
            number
            for number in state.list_free(self.delays, (*self.clocks, *per_run))
            if number.effect or self.comparisons[number.run or 0].has_gyro
        )

    @abstractmethod
    def owns(self, effect: Effect) -> bool:
        """Whether an effect acts on this part of the path."""

    @abstractmethod
    def find_run_residuals(self, state: State, run: int) -> Floats:
        """Measured less predicted velocities in the windows of one run, shape (m, 3)."""

    def find_residuals(self, state: State) -> Floats:
        """Measured less predicted velocities of all runs, shape (n, 3)."""
        residuals = [self.find_run_residuals(state, run) for run in range(len(self.comparisons))]
        return residuals[0] if len(residuals) == 1 else np.concatenate(residuals)

    @property
    def restarted(self) -> Self:
        """The same with states reset to measured ones at the start of each prediction over 2 s.

        It is a new copy each time, as the prior of a part may be replaced.
        """
        part = copy(self)
        part.is_restarted = True
        return part

    def find_ideal(self) -> Floats:
        """Ideal velocity of the input averaged over windows, now and up to 2 s earlier.

        Returns:
            f_x, f_w, and f_y of a vehicle that moves sideways, lags a quarter of a
            second apart, shape (n, lags, 2 or 3).
        """
        return np.concatenate([average_lags(c, c.predict_velocity((), _NO_DELAY)) for c in self.comparisons])

    @abstractmethod
    def list_clock_errors(self) -> Floats:
        """Standard error of each run's clock that is fixed in this part [s], shape (runs,)."""

    @abstractmethod
    def shift_clock(self, state: State, run: int, late_s: float) -> Floats:
        """Residuals of one run's windows with that clock delayed by ``late_s`` [s], shape (m, 3)."""

    @cached_property
    def noise(self) -> Floats:
        """Spread of the residuals of a saturated fit, see `measure_noise`, shape (n, 3)."""
        ideal = State((), (_NO_DELAY,) * len(self.comparisons))
        return measure_noise(self, self.find_residuals(ideal))

    def differentiate(
        self, state: State, residual: Floats, free: Sequence[Free], *, both_sides: bool = False
    ) -> Floats:
        """Derivative of the prediction by each free parameter, see `linearize`."""
        return self.linearize(state, free, residual, both_sides=both_sides)[1]

    def linearize(
        self, state: State, free: Sequence[Free], residual: Floats | None = None, *, both_sides: bool = False
    ) -> tuple[Floats, Floats]:
        """Residuals of a state, shape (n, 3), and derivatives of its prediction, shape (n, 3, p).

        Args:
            state: state at which to differentiate.
            free: the parameters.
            residual: residuals at this state, if they are known.
            both_sides: use central differences of a tenth of the step within the bounds: the fit then ends
                alike from all starts.
        """
        ends = [number.step_aside(state.get(number), both_sides=both_sides) for number in free]
        moved = [[state.set(number, at) for at in steps] for number, steps in zip(free, ends, strict=True)]
        self.look_ahead(
            [*([state] if residual is None else []), *(one for states in moved for one in states)]
        )
        residual = self.find_residuals(state) if residual is None else residual
        columns = make_columns(residual.shape[0], len(free))
        for index, (number, steps, states) in enumerate(zip(free, ends, moved, strict=True)):
            run = number.run
            looks = [
                self.find_residuals(one) if run is None else self.find_run_residuals(one, run)
                for one in states
            ]
            rows = slice(None) if run is None else self.run == run
            if len(steps) > 1:
                columns[rows, :, index] = (looks[0] - looks[1]) / (steps[1] - steps[0])
            else:
                columns[rows, :, index] = (residual[rows] - looks[0]) / (steps[0] - state.get(number))
        return residual, columns

    def look_ahead(self, states: Sequence[State]) -> None:
        """Compute what is faster at once for states that are looked at next, see `Forward.look_ahead`.

        Args:
            states: all with the same effects.
        """
        if self.is_restarted or not states:
            return
        for run, comparison in enumerate(self.comparisons):
            measured = comparison.source is Input.MEASURED
            models = list[tuple[tuple[Effect, ...], Timing]]()
            for state in states:
                effects = tuple(effect for effect in state.effects_of(run) if self.owns(effect))
                timing = state.timing[run] if self.is_delayed else _NO_DELAY
                models.append((effects, timing if measured else comparison.complete_timing(effects, timing)))
            comparison.forward.look_ahead(models, measured=measured)


class BodyPart(Part):
    """From an input to the body's motion."""

    def __init__(
        self, comparisons: Sequence[Comparison], delays: tuple[DelayName, ...] = (), *, whole: bool = True
    ) -> None:
        super().__init__(comparisons, delays)
        self.whole = whole
        if any(comparison.run.is_on_course for comparison in comparisons):
            # A course is the direction of travel: no lateral motion is measured.
            self.channels = (0, 2)
        self.title = "Drivetrain and ground effects" if whole else "Ground effects"
        if any(comparison.run.is_drive_alone for comparison in comparisons):
            self.title, self.dates_poses = "Drivetrain effects", False

    def owns(self, effect: Effect) -> bool:
        """All effects if the input is the command; those after the wheels if it is the wheels."""
        return self.whole or effect.place > Place.DRIVE

    def find_run_residuals(self, state: State, run: int) -> Floats:
        """See `Part`."""
        effects, timing = state.effects_of(run), state.timing[run]
        return self.comparisons[run].find_residuals(effects, timing, restarted=self.is_restarted)

    def list_clock_errors(self) -> Floats:
        """See `Part`: the poses relative to the gyro, or to encoders that are read periodically."""
        return np.array([self._find_clock_error(comparison) for comparison in self.comparisons])

    def _find_clock_error(self, comparison: Comparison) -> float:
        if comparison.heading.gyro is not None:
            return comparison.heading.gyro.delay_error_s
        is_exact = self.whole and not comparison.run.is_drive_alone
        return 0.0 if is_exact else comparison.run.wheel_period_s / _SPREAD_OF_EVEN

    def shift_clock(self, state: State, run: int, late_s: float) -> Floats:
        """See `Part`: the poses are later by ``late_s`` than assumed."""
        effects, timing = state.effects_of(run), state.timing[run]
        return self.comparisons[run].find_residuals(effects, timing, late_s, restarted=self.is_restarted)


class WheelPart(Part):
    """From the command to the wheels: the drivetrain, independent of the ground.

    Args:
        commanded: runs with commands as input.
        measured: the same runs with measured wheels as input.
        largest: the largest commands.
        exceeded: speeds that the measured wheels exceed, see `Conditions`: no limit is below them.
    """

    title = "Drivetrain effects"
    dates_poses = False
    is_delayed = False

    def __init__(
        self,
        commanded: Sequence[Comparison],
        measured: Sequence[Comparison],
        largest: Largest,
        exceeded: Mapping[str, float],
    ) -> None:
        super().__init__(commanded)
        self._exceeded = exceeded
        self.channels = (0, 1, 2) if largest.sideways > 0.0 else (0, 2)
        self.least = np.array([largest.speed, largest.sideways or 1.0, largest.turn]) * _LEAST_SHARE
        self.measured = tuple(measured)
        self._seen: dict[tuple[int, float], Floats] = {}
        self._spans = [locate_windows(comparison) for comparison in self.comparisons]

    def owns(self, effect: Effect) -> bool:
        """Effects on commands and in the drivetrain."""
        return effect.place <= Place.DRIVE

    def list_free(self, state: State, per_run: Sequence[str] = ()) -> tuple[Free, ...]:
        """See `Part`; limits are at least what the measured wheels exceed."""
        return tuple(self._bound(state, number) for number in super().list_free(state, per_run))

    def _bound(self, state: State, number: Free) -> Free:
        effect = state.find(number.effect)
        of = "" if effect is None else effect.parameter(number.name).relative_to
        low, high = number.bounds
        least = max(low, self._exceeded.get(of, low) / OVERSHOOT)
        return replace(number, bounds=(least, high)) if least < high else number

    def find_run_residuals(self, state: State, run: int) -> Floats:
        """See `Part`; in terms of the ideal velocity of the wheels."""
        return self._compare(state, run, state.timing[run].wheel_delay_s)

    def _compare(self, state: State, run: int, late: float) -> Floats:
        """Residuals with the encoders delayed by ``late`` [s]."""
        comparison = self.comparisons[run]
        if (run, late) not in self._seen:
            wheels = self.measured[run].predict_velocity((), Timing(late))
            self._seen = {key: seen for key, seen in self._seen.items() if key[0] != run}
            self._seen[run, late] = average_windows(comparison, wheels, self._spans[run])
        drive = tuple(effect for effect in state.effects_of(run) if self.owns(effect))
        timing = Timing(late) if self.is_restarted else _NO_DELAY
        driven = comparison.predict_wheels(drive, timing, restarted=self.is_restarted)
        return self._seen[run, late] - average_windows(comparison, driven, self._spans[run])

    def list_clock_errors(self) -> Floats:
        """See `Part`: wheels that are read periodically change at an unknown time between two readings."""
        return np.array([comparison.run.wheel_period_s for comparison in self.comparisons]) / _SPREAD_OF_EVEN

    def shift_clock(self, state: State, run: int, late_s: float) -> Floats:
        """See `Part`: the encoders are later by ``late_s`` than assumed."""
        return self._compare(state, run, state.timing[run].wheel_delay_s + late_s)


def number_stretches(run: Ints, since: Floats, length: float = STRETCH_S) -> Ints:
    """Stretches of ten seconds, or of another length, numbered through all runs.

    Args:
        run: number of the run of each window, shape (n,).
        since: middle of each window since its run's start [s], shape (n,), so that the grouping does not
            depend on the absolute time of the recording.
        length: [s].
    """
    stretch = arrays.number_stretches(since, length)
    label: Ints = run * (int(np.ptp(stretch)) + 1 if stretch.size else 1) + stretch
    return np.unique(label, return_inverse=True)[1].astype(np.int64)


def count_seconds(part: Part) -> Floats:
    """Seconds that each window adds to the preceding ones, so that overlaps count once, shape (n,)."""
    starts = part.times[:, 0]
    further = np.append(np.diff(starts), np.inf)
    further[np.flatnonzero(np.diff(part.run))] = np.inf
    return np.asarray(np.minimum(further, WINDOW_S), dtype=np.float64)


def find_live(ideal: Floats) -> Flags:
    """Whether any of the ideal velocities of `Part.find_ideal` is more than 2 % of the largest."""
    size = np.abs(ideal)
    live: Flags = (size > _STANDING * size.max(axis=(0, 1))).any(axis=(1, 2))
    return live


@dataclass(frozen=True)
class Spans:
    """Starts and ends of windows relative to cell edges: edge before, share of the cell and width [s]."""

    first: Ints
    into_first: Floats
    last: Ints
    into_last: Floats
    width: Floats

    def average(self, comparison: Comparison, signal: Floats) -> Floats:
        """Mean of a signal on cells over every window, shape (n,)."""
        return average_spans(
            np.ascontiguousarray(signal),
            comparison.grid.step_s,
            self.first,
            self.into_first,
            self.last,
            self.into_last,
            self.width,
        )


def locate_windows(comparison: Comparison, late: float = 0.0) -> Spans:
    """The windows of a comparison, moved ``late`` seconds back, relative to its cell edges."""
    grid, times = comparison.grid, comparison.windows.times
    start, end = grid.locate_edges(times[:, 0] - late), grid.locate_edges(times[:, 1] - late)
    top = grid.times.size - 1
    first, last = np.minimum(start.astype(np.int64), top), np.minimum(end.astype(np.int64), top)
    width = np.maximum((end - start) * grid.step_s, grid.step_s)
    return Spans(first, start - first, last, end - last, width)


def average_windows(comparison: Comparison, velocity: Velocity, spans: Spans) -> Floats:
    """Mean of (x, y, w) over every window, shape (n, 3)."""
    means, y = np.zeros((spans.first.size, 3)), velocity.y
    means[:, 0] = spans.average(comparison, velocity.x)
    means[:, 2] = spans.average(comparison, velocity.w)
    if y.any():
        means[:, 1] = spans.average(comparison, y)
    return means


def average_lags(comparison: Comparison, velocity: Velocity, lags: int = 9) -> Floats:
    """Means of (x, w), or (x, w, y) for a vehicle that moves sideways, over current and earlier windows."""
    signals = [velocity.x, velocity.w]
    if comparison.context.vehicle.kinematics.has_inputs("sideways"):
        signals.append(velocity.y)
    spans = [locate_windows(comparison, NODE_S * lag) for lag in range(lags)]
    means = [[one.average(comparison, signal) for signal in signals] for one in spans]
    return np.moveaxis(np.asarray(means), (0, 1, 2), (1, 2, 0))
