"""Residuals of one path, drivetrain or ground: measured less predicted increments of a model."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import compiled
from pipeline.estimation.model_state import (
    NO_PRIOR,
    DelayName,
    Free,
    FreeKey,
    ModelState,
    Prior,
    make_columns,
)
from pipeline.estimation.noise import Steps, learn_noise
from pipeline.estimation.run_residuals import Input, RunResiduals
from pipeline.estimation.window_residuals import average_windows, locate_windows, number_stretches
from pipeline.models import OVERSHOOT, Effect, Late, Place, Timing, find_late, find_late_effect

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.core import Complex, Flags, Floats, Ints
    from pipeline.estimation.noise import Noise
    from pipeline.estimation.window_residuals import WindowSpans
    from pipeline.run import Velocity

BLOCK_S = 20.0
"""Length of blocks that are held out, and that count as independent [s]: ten times as long as any noise."""
HORIZONS_S = (0.5, 2.0, 10.0, math.inf)
"""Times [s] after which errors of predictions are compared; infinite for whole stretches without a gap."""
CLOCK_STEP_S = 5e-3
"""Step of a derivative by the delay of a clock [s]: a quarter of a cell."""
_WITHIN_CELL = 0.05
"""Standard error of a time constant in cells: drawn lags are found within a tenth of a cell."""
_MOST_PERIODS = 2.0
"""Largest delay of encoders against the commands, in their periods."""
_MOST_LEFT = 0.5
"""Share of the mean square motion of wheels that a model of the drivetrain may leave: in drawn logs, drives
that follow leave less than a hundredth, those that do not more than six tenths."""
_CREEPING = 0.01
"""Speed below which a path has no curvature [m/s]."""
_NO_DELAY = Timing()
_UNIFORM = 12.0**0.5
"""Ratio of width and standard deviation of a uniform distribution."""


@dataclass(frozen=True)
class HorizonError:
    """Squared errors of predictions that begin at measured states.

    Attributes:
        block: block in which each prediction begins, shape (k,).
        position: mean square over its steps [m^2], shape (k,).
        heading: the same [rad^2], shape (k,).
    """

    block: Ints
    position: Floats
    heading: Floats


class PathResiduals(ABC):
    """Increments over about a fifth of a second: x [m], y [m], turn [rad].

    Args:
        residuals_by_run: runs with an input, compared by steps (`RunResiduals.stepped`).
        delays: delays of a run that are free in addition to the effects.

    Attributes:
        run: number of the run of each step, shape (n,).
        times: start and end of each [s], shape (n, 2).
        spans: length of each [s], shape (n,).
        fresh: whether it does not continue the one before, shape (n,).
        steps: both and the run, as the noise needs them.
        block: number of its block of `BLOCK_S`; no block spans two runs, shape (n,).
        unit: of its stretch of ten seconds, shape (n,).
        channels: indices of the informative ones of x, y, turn.
        prior: of the parameters.
        weight: of each step in a fit, shape (n, 1); one number where all runs count alike.
        dates_poses: whether its fixed clocks are those of the poses.
        is_delayed: whether its delays are those of its input; else of the encoders against the commands.
        clocks: ids of effects that are a clock of each single run.
        grounds: numbers of the runs on each ground; one empty group where all are on one.
        title: name of the path.
        target: what its predictions are compared with.
    """

    prior: Prior = NO_PRIOR
    weight: Floats | float = 1.0
    dates_poses: bool = True
    is_delayed: bool = True
    channels: tuple[int, ...] = (0, 1, 2)
    title: str
    target: str = "the poses"

    def __init__(self, residuals_by_run: Sequence[RunResiduals], delays: tuple[DelayName, ...] = ()) -> None:
        self.residuals_by_run = tuple(residuals_by_run)
        self.delays = delays
        is_dated = len(self.residuals_by_run) == 1 or all(c.has_gyro for c in self.residuals_by_run)
        self.clocks = () if is_dated else (find_late_effect(Late.POSES).id,)
        self.grounds = _group_by_ground(self.residuals_by_run)
        windows = [run_residuals.windows for run_residuals in self.residuals_by_run]
        self.run: Ints = np.repeat(np.arange(len(windows)), [w.start.size for w in windows])
        self.times: Floats = np.concatenate([w.times for w in windows])
        self.spans: Floats = np.ascontiguousarray(self.times[:, 1] - self.times[:, 0])
        joined = [np.append(True, w.start[1:] != w.end[:-1])[: w.start.size] for w in windows]
        self.fresh: Flags = np.ascontiguousarray(np.concatenate(joined))
        since = self.times.mean(axis=1) - np.array([c.run.start_s for c in self.residuals_by_run])[self.run]
        self.steps = Steps(self.spans, self.fresh, self.run)
        self.block = number_stretches(self.run, since, BLOCK_S)
        self.unit = number_stretches(self.run, since)

    def list_free(self, state: ModelState, per_run: Sequence[str] = ()) -> tuple[Free, ...]:
        """Free numbers of a state: clocks and those of `per_run` have a value in each run."""
        return state.list_free(self.delays, (*self.clocks, *per_run), self.grounds)

    def _bound_delay(self, number: Free, most: float = math.inf) -> Free:
        """A delay of encoders with its bounds, the largest in their periods.

        A jump right after a reading seems to begin with it: up to half a period too early.
        """
        period = self.residuals_by_run[number.runs[0]].run.wheel_period_s
        low, high = number.bounds
        return replace(number, bounds=(low - 0.5 * period, max(min(high, most * period), CLOCK_STEP_S)))

    @abstractmethod
    def owns(self, effect: Effect) -> bool:
        """Whether an effect acts on this path."""

    @abstractmethod
    def find_velocities(self, state: ModelState, run: int) -> Floats:
        """Measured less predicted mean velocities over the steps of a run, shape (m, 3)."""

    def find_run_residuals(self, state: ModelState, run: int) -> Floats:
        """Measured less predicted increments of one run, shape (m, 3)."""
        return self._multiply(self.find_velocities(state, run), run)

    def _multiply(self, velocities: Floats, run: int) -> Floats:
        """Increments by mean velocities over the steps of a run."""
        increments: Floats = velocities * self._spans_by_run[run]
        return increments

    @cached_property
    def _spans_by_run(self) -> list[Floats]:
        ends = np.cumsum(np.bincount(self.run, minlength=len(self.residuals_by_run)))
        return np.split(self.spans[:, None], ends[:-1])

    def find_residuals(self, state: ModelState, runs: Sequence[int] = ()) -> Floats:
        """Measured less predicted increments of some runs, in order, by default of all, shape (n, 3)."""
        residuals = [self.find_run_residuals(state, run) for run in runs or range(len(self.residuals_by_run))]
        return residuals[0] if len(residuals) == 1 else np.concatenate(residuals)

    def is_followed(self, residual: Floats) -> bool:  # noqa: ARG002 - the body follows its wheels, or slips
        """Whether what residuals leave of the motion, shape (n, 3), allows to speak of a model of it."""
        return True

    @abstractmethod
    def list_clock_errors(self, state: ModelState) -> Floats:
        """Standard error of each run's clock beside what a fit finds of it [s], shape (runs,)."""

    @abstractmethod
    def shift_clock(self, state: ModelState, run: int, late_s: float) -> Floats:
        """Increments of one run with that clock delayed by ``late_s`` [s], shape (m, 3)."""

    @abstractmethod
    def list_rolled(self, state: ModelState) -> tuple[Floats, float]:
        """Increments that are computed from speeds of wheels by the vehicle's dimensions, shape (n, 3).

        Returns:
            The increments, and the sign with which they stand in the residuals; zero if dimensions cancel.
        """

    def list_shifts(self, state: ModelState) -> list[Floats]:
        """Changes of the residuals by one standard error of each estimated dimension, shape (n, 3) each.

        Speeds of wheels times a radius, over a track or a wheelbase, are the body's motion.
        """
        vehicle = self.residuals_by_run[0].context.vehicle
        if not vehicle.errors:
            return []
        rolled, sign = self.list_rolled(state)
        shifts = []
        for name, error in vehicle.errors.items() if sign else ():
            share = sign * error / float(getattr(vehicle, name))
            is_radius = name == "wheel_radius_m"
            shifts.append(share * rolled if is_radius else -share * rolled * np.array([0.0, 0.0, 1.0]))
        return shifts

    def _average(self, velocities: Sequence[Velocity]) -> Floats:
        """Increments of each run by its velocities, shape (n, 3)."""
        means = [
            average_windows(one, velocity, locate_windows(one))
            for one, velocity in zip(self.residuals_by_run, velocities, strict=True)
        ]
        return np.asarray(np.concatenate(means) * self.spans[:, None], dtype=np.float64)

    def learn(self, residual: Floats, start: Noise | None = None, *, exact: bool = False) -> Noise:
        """Noise of residuals of shape (n, 3)."""
        return learn_noise(residual, self.steps, self.channels, start, exact=exact)

    def differentiate(
        self,
        state: ModelState,
        residual: Floats,
        free: Sequence[Free],
        widths: Mapping[FreeKey, float] | None = None,
    ) -> Floats:
        """Derivative of the prediction by each number, shape (n, 3, p).

        Args:
            state: where.
            residual: its residuals, shape (n, 3).
            free: the numbers.
            widths: over what each is taken, see `Free.list_ends`.
        """
        known = widths or {}
        ends = [number.list_ends(state.get(number), known.get(number.key, math.nan)) for number in free]
        moved = [[state.set(number, at) for at in steps] for number, steps in zip(free, ends, strict=True)]
        self.look_ahead([one for states in moved for one in states])
        columns = make_columns(residual.shape[0], len(free))
        for index, (number, steps, states) in enumerate(zip(free, ends, moved, strict=True)):
            rows = np.isin(self.run, number.runs) if number.runs else slice(None)
            looks = [self.find_residuals(one, number.runs) for one in states]
            if len(steps) > 1:
                columns[rows, :, index] = (looks[0] - looks[1]) / (steps[1] - steps[0])
            else:
                columns[rows, :, index] = (residual[rows] - looks[0]) / (steps[0] - state.get(number))
        return columns

    def look_ahead(self, states: Sequence[ModelState]) -> None:
        """Compute what is faster at once for the states looked at next, see `ForwardModel.look_ahead`."""
        for run, run_residuals in enumerate(self.residuals_by_run) if states else ():
            measured = run_residuals.source is Input.MEASURED
            models = list[tuple[tuple[Effect, ...], Timing]]()
            for state in states:
                effects = tuple(effect for effect in state.effects_of(run) if self.owns(effect))
                timing = state.timing[run] if self.is_delayed else _NO_DELAY
                models.append(
                    (effects, timing if measured else run_residuals.complete_timing(effects, timing))
                )
            run_residuals.forward.look_ahead(models, measured=measured)

    @cached_property
    def speed(self) -> float:
        """Root mean square of the speed that the input asks for in the steps, forward and sideways [m/s]."""
        ideal = self._average([one.predict_velocity((), _NO_DELAY) for one in self.residuals_by_run])
        return math.sqrt(float(np.mean((ideal[:, 0] ** 2 + ideal[:, 1] ** 2) / self.spans**2)))

    def list_horizon_errors(self, residual: Floats) -> tuple[HorizonError, ...]:
        """Errors of the predictions that these residuals add up to, over `HORIZONS_S`."""
        frame, moved = self._measured
        headings = np.ascontiguousarray(np.angle(np.conj(frame)))
        travelled = np.ascontiguousarray(np.column_stack((moved.real, moved.imag)))
        residual = np.ascontiguousarray(residual)
        typical = float(np.median(self.spans))
        errors = []
        for horizon in HORIZONS_S:
            most = self.run.size if math.isinf(horizon) else max(round(horizon / typical), 1)
            squares = np.full((self.run.size, 2), np.nan)
            _sum_errors(residual, headings, travelled, self.fresh, most, math.isinf(horizon), squares)
            rows = np.flatnonzero(np.isfinite(squares[:, 0]))
            errors.append(HorizonError(self.block[rows], squares[rows, 0], squares[rows, 1]))
        return tuple(errors)

    @cached_property
    def _measured(self) -> tuple[Complex, Complex]:
        """Rotation from the map to the frame of each step, and the displacement in it [m], shape (n,)."""
        return np.ones(self.run.size, dtype=np.complex128), np.zeros(self.run.size, dtype=np.complex128)


class BodyResiduals(PathResiduals):
    """From an input to the body's motion."""

    def __init__(
        self,
        residuals_by_run: Sequence[RunResiduals],
        delays: tuple[DelayName, ...] = (),
        *,
        whole: bool = True,
    ) -> None:
        super().__init__([run_residuals.stepped for run_residuals in residuals_by_run], delays)
        self.whole = whole
        if any(run_residuals.run.is_on_course for run_residuals in residuals_by_run):
            # A course is the direction of travel: no lateral motion is measured.
            self.channels = (0, 2)
        self.title = "Drivetrain and ground effects" if whole else "Ground effects"
        if any(run_residuals.run.is_drive_alone for run_residuals in residuals_by_run):
            self.title, self.dates_poses = "Drivetrain effects", False

    def owns(self, effect: Effect) -> bool:
        """All effects if the input is the command; those after the wheels if it is the wheels."""
        return self.whole or effect.place > Place.DRIVE

    def list_free(self, state: ModelState, per_run: Sequence[str] = ()) -> tuple[Free, ...]:
        """See `PathResiduals`; a gyro tells the delay of the encoders."""
        free = super().list_free(state, per_run)
        return tuple(
            one if one.effect else self._bound_delay(one)
            for one in free
            if one.effect or self.residuals_by_run[one.runs[0]].has_gyro
        )

    def find_velocities(self, state: ModelState, run: int) -> Floats:
        """See `PathResiduals`."""
        return self.residuals_by_run[run].find_residuals(state.effects_of(run), state.timing[run])

    def list_clock_errors(self, state: ModelState) -> Floats:  # noqa: ARG002 - poses are late in any state
        """See `PathResiduals`: the poses relative to the gyro, or to encoders that are read periodically."""
        return np.array([self._find_clock_error(run_residuals) for run_residuals in self.residuals_by_run])

    def _find_clock_error(self, run_residuals: RunResiduals) -> float:
        if run_residuals.heading.gyro is not None:
            return run_residuals.heading.gyro.delay_error_s
        is_exact = self.whole and not run_residuals.run.is_drive_alone
        return 0.0 if is_exact else run_residuals.run.wheel_period_s / _UNIFORM

    def list_rolled(self, state: ModelState) -> tuple[Floats, float]:
        """See `PathResiduals`: the whole prediction, unless it is that of body commands."""
        rolls = all(
            one.source is Input.MEASURED or one.run.alignment.body_multiplier is None
            for one in self.residuals_by_run
        )
        predicted = [
            one.predict_velocity(state.effects_of(run), state.timing[run])
            for run, one in enumerate(self.residuals_by_run)
        ]
        return self._average(predicted), -1.0 if rolls else 0.0

    def shift_clock(self, state: ModelState, run: int, late_s: float) -> Floats:
        """See `PathResiduals`: the poses are later by ``late_s`` than assumed."""
        effects, timing = state.effects_of(run), state.timing[run]
        return self._multiply(self.residuals_by_run[run].find_residuals(effects, timing, late_s), run)

    @cached_property
    def _measured(self) -> tuple[Complex, Complex]:
        seen = [run_residuals.measure_steps() for run_residuals in self.residuals_by_run]
        return np.concatenate([one.frame for one in seen]), np.concatenate([one.moved for one in seen])


class WheelResiduals(PathResiduals):
    """From the command to the wheels: the drivetrain, independent of the ground.

    Args:
        commanded: runs with commands as input.
        measured: the same runs with measured wheels as input.
        sideways: whether the vehicle is commanded to move sideways.
        exceeded: speeds that the measured wheels exceed, see `Conditions`: no limit is below them.
    """

    title = "Drivetrain effects"
    target = "the measured wheels"
    dates_poses = False
    is_delayed = False

    def __init__(
        self,
        commanded: Sequence[RunResiduals],
        measured: Sequence[RunResiduals],
        *,
        sideways: bool,
        exceeded: Mapping[str, float],
    ) -> None:
        super().__init__([one.stepped.where_read for one in commanded], ("encoder_delay_s",))
        self._exceeded = exceeded
        self.channels = (0, 1, 2) if sideways else (0, 2)
        self._spans = [locate_windows(run_residuals) for run_residuals in self.residuals_by_run]
        self._seen = [
            average_windows(one, wheels.predict_velocity((), _NO_DELAY), spans)
            for one, wheels, spans in zip(self.residuals_by_run, measured, self._spans, strict=True)
        ]

    def owns(self, effect: Effect) -> bool:
        """Effects on commands and in the drivetrain."""
        return effect.place <= Place.DRIVE

    def list_free(self, state: ModelState, per_run: Sequence[str] = ()) -> tuple[Free, ...]:
        """See `PathResiduals`; limits are at least what the measured wheels exceed.

        A delay of the commands and one of the encoders are one number here: only one of them is free.
        """
        free = super().list_free(state, per_run)
        return tuple(self._bound(state, one) for one in free if one.effect or not _has_dead_time(state))

    def _bound(self, state: ModelState, number: Free) -> Free:
        if not number.effect:
            # What encoders report is a period old, or two where another one sends it on.
            return self._bound_delay(number, _MOST_PERIODS)
        effect = state.find(number.effect)
        of = "" if effect is None else effect.parameter(number.name).relative_to
        low, high = number.bounds
        least = max(low, self._exceeded.get(of, low) / OVERSHOOT)
        return replace(number, bounds=(least, high)) if least < high else number

    def is_followed(self, residual: Floats) -> bool:
        """See `PathResiduals`: the wheels follow where half of one channel's motion is explained."""
        unexplained = np.square(residual).sum(axis=0)
        seen = np.square(np.concatenate(self._seen) * self.spans[:, None]).sum(axis=0)
        return any(unexplained[channel] <= _MOST_LEFT * seen[channel] for channel in self.channels)

    def find_velocities(self, state: ModelState, run: int) -> Floats:
        """See `PathResiduals`; in terms of the ideal velocity of the wheels.

        The model is delayed, not the measured wheels: the same readings are compared at every delay.
        """
        return self._compare(state, run)

    def _compare(self, state: ModelState, run: int, late_s: float = 0.0) -> Floats:
        """Velocities with the encoders later by ``late_s`` [s]."""
        driven = average_windows(
            self.residuals_by_run[run], self._drive(state, run), self._locate(state, run, late_s)
        )
        apart: Floats = self._seen[run] - driven
        return apart

    def _drive(self, state: ModelState, run: int) -> Velocity:
        """Ideal velocity of the wheels of a model on the cells."""
        drive = tuple(effect for effect in state.effects_of(run) if self.owns(effect))
        return self.residuals_by_run[run].predict_wheels(drive, _NO_DELAY)

    def _locate(self, state: ModelState, run: int, late_s: float = 0.0) -> WindowSpans:
        """Windows of the model that readings are of, with the encoders later by ``late_s`` [s]."""
        timing = state.timing[run]
        # By how much readings are late the ground tells; a dead time beyond it is that of the commands.
        late_s += timing.wheel_delay_s if _has_dead_time(state) else timing.encoder_delay_s
        return self._spans[run] if late_s == 0.0 else locate_windows(self.residuals_by_run[run], late_s)

    def list_clock_errors(self, state: ModelState) -> Floats:
        """See `PathResiduals`: when within a cell, or a period, an encoder was read is not known."""
        if _has_dead_time(state):
            return np.array([one.run.wheel_period_s for one in self.residuals_by_run]) / _UNIFORM
        return np.array([_WITHIN_CELL * one.grid.step_s for one in self.residuals_by_run])

    def shift_clock(self, state: ModelState, run: int, late_s: float) -> Floats:
        """See `PathResiduals`: the encoders are later by ``late_s`` than assumed."""
        return self._multiply(self._compare(state, run, late_s), run)

    def list_shifts(self, state: ModelState) -> list[Floats]:
        """See `PathResiduals`; and by the time within a period at which steering was read.

        Steering has a sensor of its own: the delay that the speeds tell is not that of the angle.
        """
        shifts = super().list_shifts(state)
        if not self.residuals_by_run[0].context.vehicle.kinematics.has_inputs("steering"):
            return shifts
        for run, one in enumerate(self.residuals_by_run):
            velocity, late_s = self._drive(state, run), one.run.wheel_period_s / _UNIFORM
            curvature = np.divide(
                velocity.w, velocity.x, out=np.zeros_like(velocity.w), where=np.abs(velocity.x) > _CREEPING
            )
            times = one.grid.times
            apart = velocity.w - velocity.x * np.interp(times - late_s, times, curvature)
            change, mine = np.zeros((self.run.size, 3)), self.run == run
            turned = replace(velocity, x=np.zeros_like(apart), y=np.zeros_like(apart), w=apart)
            change[mine] = self._multiply(average_windows(one, turned, self._locate(state, run)), run)
            shifts.append(change)
        return shifts

    def list_rolled(self, state: ModelState) -> tuple[Floats, float]:  # noqa: ARG002 - wheels are as they are
        """See `PathResiduals`: the measured wheels, which body commands are compared with."""
        is_body = all(one.run.alignment.body_multiplier is not None for one in self.residuals_by_run)
        return np.concatenate(self._seen) * self.spans[:, None], 1.0 if is_body else 0.0


def _has_dead_time(state: ModelState) -> bool:
    return find_late(state.effects, Late.COMMANDS) is not None


def _group_by_ground(residuals_by_run: Sequence[RunResiduals]) -> tuple[tuple[int, ...], ...]:
    terrains = [one.run.terrain for one in residuals_by_run]
    groups = (
        tuple(run for run, one in enumerate(terrains) if one == name) for name in dict.fromkeys(terrains)
    )
    return tuple(groups) if len(set(terrains)) > 1 else ((),)


def weigh_runs(path: PathResiduals, shares: Floats) -> PathResiduals:
    """The same path with runs that count by their shares in its fits, shape (runs,)."""
    weighed = copy(path)
    weighed.weight = shares[path.run][:, None]
    return weighed


def tie_prior(path: PathResiduals, prior: Prior) -> PathResiduals:
    """The same path with a prior of its parameters."""
    tied = copy(path)
    tied.prior = prior
    return tied


@compiled(
    "void(float64[:, ::1], float64[::1], float64[:, ::1], boolean[::1], int64, boolean, float64[:, ::1])"
)
def _sum_errors(
    residual: Floats,
    heading: Floats,
    moved: Floats,
    fresh: Flags,
    most: int,
    whole: bool,  # noqa: FBT001 - a compiled loop takes no keywords
    squares: Floats,
) -> None:
    """Mean squared errors of position and heading of predictions that begin at steps.

    Args:
        residual: measured less predicted increments, shape (n, 3).
        heading: of the frame of each in the map [rad], shape (n,).
        moved: measured displacement in that frame [m], shape (n, 2).
        fresh: steps that do not continue the one before, shape (n,).
        most: steps of a prediction.
        whole: whether predictions begin at fresh steps only, and end with the stretch.
        squares: the result, NaN where none begins, shape (n, 2).
    """
    apart = max(most // 4, 1)
    begin = 0
    for row in range(fresh.size):
        if fresh[row]:
            begin = row
        if (whole and row != begin) or (not whole and (row - begin) % apart != 0):
            continue
        turned, x, y, position, angle, steps = 0.0, 0.0, 0.0, 0.0, 0.0, 0
        while steps < most and row + steps < fresh.size:
            at = row + steps
            if steps > 0 and fresh[at]:
                break
            # The prediction turns by its own heading: what it is wrong by turns what it goes on to travel.
            wrong = turned - 0.5 * residual[at, 2]
            ahead, aside = moved[at, 0] - residual[at, 0], moved[at, 1] - residual[at, 1]
            cos, sin = math.cos(wrong), math.sin(wrong)
            gap_x = moved[at, 0] - cos * ahead + sin * aside
            gap_y = moved[at, 1] - sin * ahead - cos * aside
            cos, sin = math.cos(heading[at]), math.sin(heading[at])
            x += cos * gap_x - sin * gap_y
            y += sin * gap_x + cos * gap_y
            turned -= residual[at, 2]
            position += x * x + y * y
            angle += turned * turned
            steps += 1
        if (whole and steps > 1) or steps == most:
            squares[row, 0], squares[row, 1] = position / steps, angle / steps
