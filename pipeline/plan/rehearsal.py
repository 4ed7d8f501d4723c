"""What runs say of a vehicle, and what commands that were not driven yet would: one linearization of both.

Commands are rehearsed as a run whose poses, wheels and gyro are those that the model predicts on level
ground: the code that fits recorded runs makes its increments, predictions and derivatives.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import msgspec
import numpy as np

from pipeline.core import Complex, Floats, SlipError
from pipeline.estimation import (
    EstimationData,
    Fitted,
    Free,
    Input,
    ModelState,
    Recording,
    RunResiduals,
    fit_model,
)
from pipeline.estimation.fit import whiten_columns
from pipeline.estimation.model_state import flatten
from pipeline.estimation.noise import Noise
from pipeline.estimation.path_residuals import PathResiduals
from pipeline.models import Effect, Largest, Model, Place, Timing, list_effects
from pipeline.plan.manoeuvres import Commands, PlanError, is_steered
from pipeline.results import RunDiagnosis, find_refusal
from pipeline.run import Alignment, DriveSeries, MotionRun, Track, Velocity
from pipeline.sources import Vehicle

_POSE_HZ = 20.0
# Poses and encoders continue for this time after the last command [s].
_AFTER_S = 0.2
# Without a run: standard deviation of an increment of about a fifth of a second [m, m, rad].
_USUAL_NOISE = Noise(0.2, np.zeros(3), np.zeros(3), np.full((1, 3), 0.007))
# Standard deviation of the clock offset of a future log [s].
_CLOCK_S = 0.05
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
    recordings: Sequence[Recording], vehicle: Vehicle, notify: Callable[[str], None] | None = None
) -> Studied:
    """Diagnose runs jointly, and fit the effects that the diagnosis identified beyond doubt.

    Args:
        recordings: runs of one vehicle.
        vehicle: the vehicle.
        notify: called with what is being done.

    Raises:
        SlipError: nothing can be estimated, or a run has no commands.
    """
    from pipeline.estimation import diagnose_runs, load_recording  # noqa: PLC0415 - heavy

    joint = diagnose_runs(recordings, vehicle, notify=notify)
    diagnosis, where = joint.runs[0], recordings[0].name
    if joint.proposal is None:
        why = find_refusal(diagnosis.findings) or "the log cannot be judged"
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
        runs = [replace(run, wheels=None) for run in runs]
    data = EstimationData(runs, vehicle, Input.COMMAND)
    usable = {effect.id for effect in list_effects()}
    usable -= {name for group in diagnosis.undecided for name in group.candidates}
    known = tuple(effect for effect in joint.proposal.model.effects if effect.id in usable)
    return Studied(data.vehicle, diagnosis, fit_model(data, Model(data.vehicle, known)))


class Rehearsal:
    """Commands on level ground, as the run that the known model predicts.

    Args:
        commands: to rehearse.
        studied: the model, and the sensors of the runs so far.
        starts: start times of the manoeuvres [s], shape (k,).
    """

    def __init__(self, commands: Commands, studied: Studied, starts: Floats) -> None:
        self.studied = studied
        known = studied.runs[0].alignment if studied.runs else Alignment()
        multiplier = known.track_multiplier if studied.runs else studied.vehicle.controller_track_multiplier
        vehicle = msgspec.structs.replace(studied.vehicle, controller_track_multiplier=multiplier)
        self.vehicle = vehicle
        end = commands.duration_s + _AFTER_S
        times = np.arange(round(end * _POSE_HZ)) / _POSE_HZ
        none, all_ = np.zeros(times.size), np.ones(times.size, dtype=bool)
        flat = np.zeros((times.size, 3))
        still = Track(
            times, np.zeros(times.size, np.int64), none.astype(np.complex128), none, flat, flat[:, :2], all_
        )
        run = MotionRun(
            name="plan", sha256="", terrain="unknown", commands=drive(commands, vehicle), wheels=None,
            gyro=None, track=still, streams=times, step_starts=starts, excluded=np.zeros(0), duration_s=end,
            alignment=Alignment(track_multiplier=multiplier),
        )  # fmt: skip
        self._predictor = RunResiduals(run, vehicle, Input.COMMAND)

    @cached_property
    def data(self) -> EstimationData:
        """The run with what its sensors would report if nothing else acted."""
        studied, run, grid = self.studied, self._predictor.run, self._predictor.grid
        path, heading = self.trace(studied.effects)
        attitude = np.column_stack((np.zeros((heading.size, 2)), heading))
        position = np.column_stack((path.real, path.imag))
        track = replace(run.track, path=path, heading=heading, attitude=attitude, position=position)
        run = replace(run, track=track)
        if studied.runs and (gyro := studied.runs[0].gyro_fit) is not None:
            exact = replace(gyro, signed_scale=1.0, bias=0.0, yaw_delay_s=0.0)
            turned = (grid.times, self._predict(studied.effects).w)
            run = replace(run, gyro=turned, alignment=replace(run.alignment, gyro=exact))
        if studied.runs and studied.runs[0].wheels is not None:
            driven = self._predict([effect for effect in studied.effects if effect.place <= Place.DRIVE])
            plain = msgspec.structs.replace(self.vehicle, controller_track_multiplier=1.0)
            inputs = plain.kinematics.inverse((driven.x, driven.y, driven.w), plain)
            sides = (inputs["left"], inputs["right"], np.zeros(grid.times.size), inputs.get("sideways"))
            run = replace(run, wheels=DriveSeries(grid.times, *sides))
        return EstimationData([run], self.vehicle, Input.COMMAND)

    def _predict(self, effects: Sequence[Effect]) -> Velocity:
        return self._predictor.predict_velocity(effects, Timing())

    def trace(self, effects: Sequence[Effect]) -> tuple[Complex, Floats]:
        """Path of a model from the origin: positions x + iy [m] and headings [rad] at 20 Hz."""
        velocity, grid = self._predict(effects), self._predictor.grid
        heading = grid.sum_up(velocity.w)
        along = np.exp(0.5j * (heading[1:] + heading[:-1])) * (velocity.x + 1j * velocity.y)
        edges, at = np.arange(heading.size), grid.locate_edges(self._predictor.run.track.times)
        return np.interp(at, edges, grid.sum_up(along)), np.interp(at, edges, heading)

    def list_numbers(self) -> tuple[Free, ...]:
        """Numbers of the known model and clocks of the drive, of which derivatives exist."""
        delays = dict.fromkeys(name for path in self.data.paths for name in path.delays)
        free = ModelState(self.studied.effects, (Timing(),)).list_free(tuple(delays))
        return tuple(number for number in free if number.is_smooth)

    def inform(self, others: Sequence[Effect], ends: Floats) -> Floats:
        """Information of the drive on `list_numbers` and then the amounts of other effects, shape (k, q, q).

        Args:
            others: effects that may act, at their sizes: an amount of 1 is that size, one of 0 none of it.
            ends: ends of the groups of increments [s], shape (k,).
        """
        numbers = self.list_numbers()
        total = np.zeros((ends.size, len(numbers) + len(others), len(numbers) + len(others)))
        fits = self.studied.fitted.fits if self.studied.fitted is not None else (None,)
        state = ModelState(self.studied.effects, (Timing(),))
        for path, fit in zip(self.data.paths, fits, strict=True):
            noise, rise = (_USUAL_NOISE, 1.0) if fit is None else (fit.noise, fit.overdispersion)
            columns = noise.whiten(differentiate(path, state, numbers, others), path.steps)
            group = np.minimum(np.searchsorted(ends, path.times[:, 1] - 1e-6), ends.size - 1)
            for number in range(ends.size):
                rows = flatten(columns[group == number])
                total[number] += rows.T @ rows / rise
        return total

    def recall(self, others: Sequence[Effect]) -> Floats:
        """Information of the runs so far on the same, and that before any run, shape (q, q).

        Clocks of the runs, and numbers of other grounds, are marginalized.
        """
        numbers = self.list_numbers()
        place_of = {number.label: place for place, number in enumerate(numbers) if number.effect}
        by_id = {effect.id: effect for effect in self.studied.effects}
        usual = [_find_usual(by_id, number) for number in numbers]
        total = np.diag([*(np.array(usual) ** -2.0), *np.full(len(others), _NOTHING)])
        for fit in self.studied.fitted.fits if self.studied.fitted is not None else ():
            free = [number for number in fit.free if number.is_smooth]
            columns = whiten_columns(fit, differentiate(fit.path, fit.state, free, others))
            normal = columns.T @ columns / fit.overdispersion
            is_shared = [number.label in place_of and number.acts_in(0) for number in free]
            is_shared = [
                shared and number.effect not in fit.path.clocks
                for shared, number in zip(is_shared, free, strict=True)
            ]
            mine = np.flatnonzero([*is_shared, *[True] * len(others)])
            rest = np.flatnonzero([not shared for shared in is_shared])
            spread = [free[i].step if free[i].effect in by_id else _CLOCK_S for i in rest]
            own = normal[np.ix_(rest, rest)] + np.diag(np.array(spread, dtype=np.float64) ** -2.0)
            cross = normal[np.ix_(mine, rest)]
            at = [place_of[one.label] for one, shared in zip(free, is_shared, strict=True) if shared]
            at += range(len(numbers), len(total))
            total[np.ix_(at, at)] += normal[np.ix_(mine, mine)] - cross @ np.linalg.solve(own, cross.T)
        return total


def differentiate(
    path: PathResiduals, state: ModelState, numbers: Sequence[Free], others: Sequence[Effect]
) -> Floats:
    """Derivative of a path's prediction by numbers, and by the amounts of other effects, shape (n, 3, q)."""
    residual = path.find_residuals(state)
    columns = np.zeros((*residual.shape, len(numbers) + len(others)))
    owned = {effect.id for effect in state.effects if path.owns(effect)}
    mine = [place for place, one in enumerate(numbers) if one.effect in owned or (one.name in path.delays)]
    columns[:, :, mine] = path.differentiate(state, residual, [numbers[place] for place in mine])
    for place, effect in enumerate(others, start=len(numbers)):
        if path.owns(effect):
            columns[:, :, place] = residual - path.find_residuals(state.add(effect))
    return columns


def _find_usual(by_id: dict[str, Effect], number: Free) -> float:
    """Distance of a number, or of its typical value, from neutral; that of a clock."""
    if not number.effect:
        return _CLOCK_S
    parameter = by_id[number.effect].parameter(number.name)
    neutral = parameter.neutral if np.isfinite(parameter.neutral) else 0.0
    value = by_id[number.effect].values[number.name]
    return max(abs(value - neutral), abs(parameter.typical - neutral), parameter.step)


def drive(commands: Commands, vehicle: Vehicle) -> DriveSeries:
    """Inputs of the drive that a controller computes from body commands, at the commands' stamps."""
    zeros = np.zeros(commands.speed.size)
    if is_steered(vehicle):
        axle = commands.speed / vehicle.wheel_radius_m
        return DriveSeries(commands.times, axle, axle, commands.turn)
    inputs = vehicle.kinematics.inverse((commands.speed, zeros, commands.turn), vehicle)
    return DriveSeries(commands.times, inputs["left"], inputs["right"], zeros, inputs.get("sideways"))
