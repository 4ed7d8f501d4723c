"""What runs say of a vehicle, and what commands that were not driven yet would: one linearization of both.

Commands are rehearsed as a run whose poses are those that the model predicts on level ground: the code that
fits recorded runs makes its increments, predictions and derivatives.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from msgspec.structs import replace

from pipeline.core import Complex, Floats, SlipError
from pipeline.estimation import (
    DiagnosisInput,
    EstimationData,
    Fitted,
    Free,
    Input,
    ModelState,
    RunResiduals,
    fit_model,
)
from pipeline.estimation.model_state import flatten
from pipeline.estimation.noise import Noise
from pipeline.models import Effect, Largest, Model, Timing, list_effects
from pipeline.plan.manoeuvres import Commands, PlanError, is_steered
from pipeline.results import RunDiagnosis, find_refusal, read_model
from pipeline.run import Alignment, DriveSeries, MotionRun, Track
from pipeline.sources import Vehicle
from pipeline.words import format_finding

_POSE_HZ = 20.0
# Poses and encoders continue for this time after the last command [s].
_AFTER_S = 0.2
# Without a run: standard deviation of an increment of about a fifth of a second [m, m, rad].
_USUAL_NOISE = Noise(0.2, np.zeros(3), np.zeros(3), np.full((1, 3), 0.007))
# Smallest distance of an increment's end from that of a group [s].
_ROUNDING_S = 1e-6
# Information on the amount of an effect without a log, far below that of any drive.
_NOTHING = 1e-6


@dataclass(frozen=True)
class Studied:
    """What is known of a vehicle before a drive.

    Attributes:
        vehicle: geometry.
        diagnosis: joint diagnosis of its runs; None without runs.
        fitted: the identified effects, fitted to the runs; None without runs.
    """

    vehicle: Vehicle
    diagnosis: RunDiagnosis | None = None
    fitted: Fitted | None = None

    @property
    def runs(self) -> tuple[MotionRun, ...]:
        """The runs."""
        return () if self.fitted is None else self.fitted.data.runs

    @property
    def driven_s(self) -> float:
        """Length of the runs [s]."""
        return sum(run.duration_s for run in self.runs)

    @property
    def largest(self) -> Largest | None:
        """Largest commands of the runs."""
        return None if self.fitted is None else self.fitted.data.largest

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The identified effects, on the ground of the first run."""
        return () if self.fitted is None else self.fitted.state.effects_of(0)


def study(
    recordings: Sequence[DiagnosisInput],
    vehicle: Vehicle,
    notify: Callable[[str], None] | None = None,
    known: RunDiagnosis | None = None,
) -> Studied:
    """Fit the effects that the joint diagnosis of runs identified beyond doubt.

    Args:
        recordings: runs of one vehicle.
        vehicle: the vehicle.
        notify: called with what is being done.
        known: their diagnosis, where it was made before.

    Raises:
        SlipError: nothing can be estimated, or a run has no commands.
    """
    from pipeline.estimation import diagnose_runs, load_recording  # noqa: PLC0415 - heavy

    diagnosis = known or diagnose_runs(recordings, vehicle, notify=notify).runs[0]
    proposal, where = read_model(diagnosis), recordings[0].name
    if proposal is None:
        refusal = find_refusal(diagnosis.findings)
        why = "the log cannot be judged" if refusal is None else format_finding(refusal)
        what = f"{why}, so that nothing can be planned from it"
        hint = "See the findings of `slip diagnose`, or plan for the vehicle alone with --vehicle."
        raise SlipError("nothing_judged", what, where=where, hint=hint)
    runs = [load_recording(recording, vehicle) for recording in recordings]
    for run in runs:
        if run.commands is None:
            what = "the log has no commands, which a plan would be made of"
            hint = "Record the command topic, or plan for the vehicle alone with --vehicle."
            raise PlanError("no_command", what, where=run.name, hint=hint)
    # The motion of a car at rest does not show its steering: the fit uses the path from commands to body.
    if is_steered(vehicle) or any(run.wheels is None for run in runs):
        runs = [dataclasses.replace(run, wheels=None) for run in runs]
    data = EstimationData(runs, vehicle, Input.COMMAND)
    usable = {effect.id for effect in list_effects()}
    usable -= {name for group in diagnosis.undecided for name in group.candidates}
    certain = tuple(effect for effect in proposal.model.effects if effect.id in usable)
    return Studied(data.vehicle, diagnosis, fit_model(data, Model(data.vehicle, certain)))


class Rehearsal:
    """Commands on level ground, as the run that the known model predicts.

    Args:
        commands: to rehearse.
        studied: the model, and the sensors of the runs so far.
        starts: start times of the manoeuvres [s], shape (k,).
    """

    def __init__(self, commands: Commands, studied: Studied, starts: Floats) -> None:
        self.studied, self.vehicle = studied, studied.vehicle
        known = studied.runs[0].alignment if studied.runs else Alignment()
        if studied.runs:
            self.vehicle = replace(self.vehicle, controller_track_multiplier=known.track_multiplier)
        end = commands.duration_s + _AFTER_S
        times = np.arange(round(end * _POSE_HZ)) / _POSE_HZ
        flat, number = np.zeros((times.size, 3)), np.zeros(times.size, np.int64)
        path, seen = flat[:, 0].astype(np.complex128), np.ones(times.size, dtype=bool)
        drive = _drive(commands, self.vehicle)
        has_wheels = bool(studied.runs) and studied.runs[0].wheels is not None
        run = MotionRun(
            name="plan", sha256="", terrain="unknown", commands=drive, wheels=drive if has_wheels else None,
            gyro=None, track=Track(times, number, path, flat[:, 0], flat, flat[:, :2], seen), streams=times,
            step_starts=starts, excluded=np.zeros(0), duration_s=end,
            alignment=Alignment(track_multiplier=self.vehicle.controller_track_multiplier),
        )  # fmt: skip
        self._predictor = RunResiduals(run, self.vehicle, Input.COMMAND)

    def trace(self, effects: Sequence[Effect]) -> tuple[Complex, Floats]:
        """Path of a model from the origin: positions x + iy [m] and headings [rad] at 20 Hz."""
        velocity, grid = self._predictor.predict_velocity(effects, Timing()), self._predictor.grid
        heading = grid.sum_up(velocity.w)
        along = np.exp(0.5j * (heading[1:] + heading[:-1])) * (velocity.x + 1j * velocity.y)
        edges, at = np.arange(heading.size), grid.locate_edges(self._predictor.run.track.times)
        return np.interp(at, edges, grid.sum_up(along)), np.interp(at, edges, heading)

    @cached_property
    def data(self) -> EstimationData:
        """The run with the poses that the known model predicts."""
        path, heading = self.trace(self.studied.effects)
        run, turned = self._predictor.run, np.outer(heading, (0.0, 0.0, 1.0))
        position = np.column_stack((path.real, path.imag))
        track = dataclasses.replace(run.track, path=path, heading=heading, attitude=turned, position=position)
        return EstimationData([dataclasses.replace(run, track=track)], self.vehicle, Input.COMMAND)

    @cached_property
    def numbers(self) -> tuple[Free, ...]:
        """Numbers of the known model of which derivatives exist."""
        free = ModelState(self.studied.effects, (Timing(),)).list_free(())
        return tuple(number for number in free if number.is_smooth)

    def inform(self, others: Sequence[Effect], ends: Floats) -> Floats:
        """Information of the drive on its numbers and on the amounts of other effects, shape (k, q, q).

        Args:
            others: effects that may act, at their sizes: an amount of 1 is that size, one of 0 none of it.
            ends: ends of the groups of increments [s], shape (k,).
        """
        state, size = ModelState(self.studied.effects, (Timing(),)), len(self.numbers) + len(others)
        total = np.zeros((ends.size, size, size))
        fits = (None,) if self.studied.fitted is None else self.studied.fitted.fits
        for path, fit in zip(self.data.paths, fits, strict=True):
            noise, rise = (_USUAL_NOISE, 1.0) if fit is None else (fit.noise, fit.overdispersion)
            residual = path.find_residuals(state)
            columns = np.zeros((*residual.shape, size))
            owned = {effect.id for effect in state.effects if path.owns(effect)}
            mine = [row for row, one in enumerate(self.numbers) if one.effect in owned]
            columns[:, :, mine] = path.differentiate(state, residual, [self.numbers[one] for one in mine])
            for row, effect in enumerate(others, start=len(self.numbers)):
                if path.owns(effect):
                    columns[:, :, row] = residual - path.find_residuals(state.add(effect))
            white = noise.whiten(columns, path.steps)
            group = np.minimum(np.searchsorted(ends, path.times[:, 1] - _ROUNDING_S), ends.size - 1)
            for number in range(ends.size):
                rows = flatten(white[group == number])
                total[number] += rows.T @ rows / rise
        return total

    def recall(self, others: int) -> Floats:
        """Information before the drive on the same, next to none on amounts of others, shape (q, q)."""
        row_of, spread = dict[str, int](), list[float]()
        by_id = {effect.id: effect for effect in self.studied.effects}
        for row, number in enumerate(self.numbers):
            row_of[number.label] = row
            parameter = by_id[number.effect].parameter(number.name)
            neutral = parameter.neutral if np.isfinite(parameter.neutral) else 0.0
            value = by_id[number.effect].values[number.name]
            # The usual size: the distance of the number, or of its typical value, from neutral.
            spread.append(max(abs(value - neutral), abs(parameter.typical - neutral), parameter.step))
        total = np.diag([*(np.array(spread) ** -2.0), *np.full(others, _NOTHING)])
        for fit in () if self.studied.fitted is None else self.studied.fitted.fits:
            mine = [i for i, one in enumerate(fit.free) if one.label in row_of and one.acts_in(0)]
            at = [row_of[fit.free[one].label] for one in mine]
            # Clocks of the runs, and numbers of other grounds, are marginalized.
            total[np.ix_(at, at)] += np.linalg.inv(fit.covariance[np.ix_(mine, mine)])
        return total


def _drive(commands: Commands, vehicle: Vehicle) -> DriveSeries:
    """Inputs of the drive that a controller computes from body commands, at the commands' stamps."""
    zeros = np.zeros(commands.speed.size)
    if is_steered(vehicle):
        axle = commands.speed / vehicle.wheel_radius_m
        return DriveSeries(commands.times, axle, axle, commands.turn)
    inputs = vehicle.kinematics.inverse((commands.speed, zeros, commands.turn), vehicle)
    return DriveSeries(commands.times, inputs["left"], inputs["right"], zeros, inputs.get("sideways"))
