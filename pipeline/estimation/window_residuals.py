"""Residuals of a model over windows of half a second, as pages and learned terms look at them.

Models are fitted to increments of about a fifth of a second (`path_residuals`); windows are what people read.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import (
    STRETCH_S,
    Flags,
    Floats,
    Ints,
    arrays,
    fit_robustly,
    guarded_spread,
    robust_spread,
    weigh_bounded,
)
from pipeline.estimation.model_state import ModelState
from pipeline.models import Timing
from pipeline.run import NODE_S, SPAN_S, average_spans

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.estimation.run_residuals import RunResiduals
    from pipeline.run import Velocity

CLIP = 6.0
"""Limit at which residuals are clipped [robust standard deviations]: six do not affect normal noise."""
_RIDGE = 1e-6
"""See `fit_robustly`: some regressors are nearly others."""
_ROUNDS = 3
"""Reweightings of the regression on a residual's past."""
_LEAST_SPREAD = 2e-4
"""Least spread of a displacement [m, rad] over half a second: rounding of stamps."""
_STANDING = 0.02
"""Share of the largest motion of a run below which the robot is at rest in a window."""


class WindowResiduals:
    """Measured less predicted velocities in windows of half a second: x [m/s], y [m/s], w [rad/s].

    Args:
        residuals_by_run: runs with an input.

    Attributes:
        run: number of the run of each window, shape (n,).
        times: start and end of each window [s], shape (n, 2).
        unit: number of the stretch of ten seconds of each window; no stretch spans two runs, shape (n,).
        channels: indices of the informative ones of x, y, w.
        live: whether the input moves the vehicle during a window or just before, shape (n,).
    """

    def __init__(self, residuals_by_run: Sequence[RunResiduals]) -> None:
        self.residuals_by_run = tuple(residuals_by_run)
        is_on_course = any(run_residuals.run.is_on_course for run_residuals in residuals_by_run)
        # A course is the direction of travel: no lateral motion is measured.
        self.channels = (0, 2) if is_on_course else (0, 1, 2)
        windows = [c.windows for c in self.residuals_by_run]
        self.run: Ints = np.repeat(np.arange(len(windows)), [w.start.size for w in windows])
        self.times: Floats = np.concatenate([w.times for w in windows])
        begin = np.array([run_residuals.run.start_s for run_residuals in self.residuals_by_run])
        self._since: Floats = self.times.mean(axis=1) - begin[self.run]
        self.unit = self.number_stretches(STRETCH_S)
        self.live = find_live(self.find_ideal())

    def number_stretches(self, length: float) -> Ints:
        """Stretches of a length [s] since each run's start, numbered through all runs, shape (n,)."""
        return number_stretches(self.run, self._since, length)

    def find_run_residuals(self, state: ModelState, run: int) -> Floats:
        """Residuals of one run, shape (m, 3)."""
        return self.residuals_by_run[run].find_residuals(state.effects_of(run), state.timing[run])

    def find_residuals(self, state: ModelState) -> Floats:
        """Residuals of all runs, shape (n, 3)."""
        return np.concatenate(
            [self.find_run_residuals(state, run) for run in range(len(self.residuals_by_run))]
        )

    def find_ideal(self) -> Floats:
        """Ideal velocity of the input averaged over windows, now and up to 2 s earlier.

        Returns:
            f_x, f_w, and f_y of a vehicle that moves sideways, lags a quarter of a
            second apart, shape (n, lags, 2 or 3).
        """
        return np.concatenate(
            [average_lags(c, c.predict_velocity((), Timing())) for c in self.residuals_by_run]
        )

    def find_attitude(self) -> Floats:
        """Roll and pitch in the middle of every window [rad], shape (n, 2)."""
        middles = [
            (self.times[self.run == run].mean(axis=1), run_residuals.context)
            for run, run_residuals in enumerate(self.residuals_by_run)
        ]
        attitudes = [
            np.column_stack([np.interp(at, context.times, column) for column in context.attitude[:, :2].T])
            for at, context in middles
        ]
        return np.concatenate(attitudes)

    def find_places(self) -> Floats:
        """Where the vehicle was in the middle of every window: x, y in the map [m], shape (n, 2)."""
        middles = [
            (self.times[self.run == run].mean(axis=1), run_residuals.run.track)
            for run, run_residuals in enumerate(self.residuals_by_run)
        ]
        places = [
            np.column_stack([np.interp(at, track.times, column) for column in track.position.T])
            for at, track in middles
        ]
        return np.concatenate(places)

    @cached_property
    def noise(self) -> Floats:
        """Spread that remains after a regression on the input's past, by channel, shape (3,)."""
        residual = self.find_residuals(ModelState((), (Timing(),) * len(self.residuals_by_run)))
        spreads = np.zeros(3)
        for run in range(len(self.residuals_by_run)):
            rows = self.run == run
            columns = make_features(self.find_ideal()[rows])
            for channel in self.channels:
                rest = regress_robustly(columns, residual[rows, channel])
                spread = guarded_spread(np.abs(rest), CLIP, _LEAST_SPREAD)
                spreads[channel] += spread * rows.sum() / rows.size
        return spreads


def regress_robustly(columns: Floats, values: Floats) -> Floats:
    """Residuals (n,) of a regression on columns (n, p), outliers weighted down, widened for its freedom."""
    columns = np.column_stack((columns[:, columns.std(axis=0) > 0.0], np.ones(columns.shape[0])))
    rest = fit_robustly(
        columns, values, measure=robust_spread, weigh=weigh_bounded, ridge=_RIDGE, rounds=_ROUNDS
    ).rest
    freedom = max(values.size - columns.shape[1], 0.25 * values.size)
    widened: Floats = rest * np.sqrt(values.size / freedom)
    return widened


def make_features(lags: Floats) -> Floats:
    """Regressors of a residual on the input's past, see `WindowResiduals.find_ideal`, shape (n, p)."""
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
        across, first = sideways * turning, sideways[:, 0]
        columns += [sideways, across[:, [0, 1, 2, 4, 6]], first * np.abs(first)]
        columns += [first * np.abs(turning[:, 0]), first * np.abs(forward[:, 0])]
        columns += [np.abs(first) * forward[:, 0], np.sign(first), np.abs(first)]
    return np.column_stack(columns)


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


def count_seconds(windows: WindowResiduals) -> Floats:
    """Seconds that each window adds to the preceding ones, so that overlaps count once, shape (n,)."""
    starts = windows.times[:, 0]
    further = np.append(np.diff(starts), np.inf)
    further[np.flatnonzero(np.diff(windows.run))] = np.inf
    return np.asarray(np.minimum(further, SPAN_S), dtype=np.float64)


def find_live(ideal: Floats) -> Flags:
    """Whether any of the ideal velocities of `WindowResiduals.find_ideal` is more than 2 % of the largest."""
    size = np.abs(ideal)
    live: Flags = (size > _STANDING * size.max(axis=(0, 1))).any(axis=(1, 2))
    return live


@dataclass(frozen=True)
class WindowSpans:
    """Starts and ends of windows relative to cell edges: edge before, share of the cell and width [s]."""

    first: Ints
    into_first: Floats
    last: Ints
    into_last: Floats
    width: Floats

    def average(self, run_residuals: RunResiduals, signal: Floats) -> Floats:
        """Mean of a signal on cells over every window, shape (n,)."""
        return average_spans(
            np.ascontiguousarray(signal),
            run_residuals.grid.step_s,
            self.first,
            self.into_first,
            self.last,
            self.into_last,
            self.width,
        )


def locate_windows(run_residuals: RunResiduals, late: float = 0.0) -> WindowSpans:
    """The windows of a comparison, moved ``late`` seconds back, relative to its cell edges."""
    grid, times = run_residuals.grid, run_residuals.windows.times
    start, end = grid.locate_edges(times[:, 0] - late), grid.locate_edges(times[:, 1] - late)
    top = grid.times.size - 1
    first, last = np.minimum(start.astype(np.int64), top), np.minimum(end.astype(np.int64), top)
    width = np.maximum((end - start) * grid.step_s, grid.step_s)
    return WindowSpans(first, start - first, last, end - last, width)


def average_windows(run_residuals: RunResiduals, velocity: Velocity, spans: WindowSpans) -> Floats:
    """Mean of (x, y, w) over every window, shape (n, 3)."""
    means, y = np.zeros((spans.first.size, 3)), velocity.y
    means[:, 0] = spans.average(run_residuals, velocity.x)
    means[:, 2] = spans.average(run_residuals, velocity.w)
    if y.any():
        means[:, 1] = spans.average(run_residuals, y)
    return means


def average_lags(run_residuals: RunResiduals, velocity: Velocity, lags: int = 9) -> Floats:
    """Means of (x, w), or (x, w, y) for a vehicle that moves sideways, over current and earlier windows."""
    signals = [velocity.x, velocity.w]
    if run_residuals.context.vehicle.kinematics.has_inputs("sideways"):
        signals.append(velocity.y)
    spans = [locate_windows(run_residuals, NODE_S * lag) for lag in range(lags)]
    means = [[one.average(run_residuals, signal) for signal in signals] for one in spans]
    return np.moveaxis(np.asarray(means), (0, 1, 2), (1, 2, 0))
