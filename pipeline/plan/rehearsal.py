"""Knowledge before a drive, and the rehearsal of commands on candidate models."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from pipeline.core import Complex, Flags, Floats
from pipeline.estimation import EstimationData, Input, ModelState, RunResiduals, fit_model
from pipeline.estimation.decision import list_costs
from pipeline.estimation.fit import PathFit
from pipeline.estimation.largest import average_sustained, measure_largest
from pipeline.estimation.model_fit import Fitted
from pipeline.estimation.model_state import Free
from pipeline.estimation.window_residuals import average_windows, locate_windows
from pipeline.models import Effect, Excitation, Largest, Model, Place, Timing
from pipeline.plan.manoeuvres import Commands, DrivenRange, PlanError, is_steered
from pipeline.run import (
    SPAN_S,
    STILL_MPS,
    Alignment,
    DriveSeries,
    GyroFit,
    MotionRun,
    Track,
    Velocity,
    name_inputs,
)
from pipeline.sources import Vehicle

# Commands rehearsed: a run that has not been driven yet, with the poses that a model predicts.
#
# Such a run is treated like a recorded run: the same estimation data makes its windows, predictions and
# derivatives. The ground is assumed to be level.

_POSE_HZ = 20.0
# Poses and encoders continue for this time after the last command [s].
_AFTER_S = 0.2


@dataclass(frozen=True)
class Senses:
    """Sensors expected in the next log, equal to those of the last one.

    Attributes:
        gyro: fit of the gyro to the poses; None without a good one.
        encoders: whether wheels are measured.
        track_multiplier: multiplier of the controller.
        command_scale: factor on the recorded commands; of commanded sides, on their mean.
        command_turn_scale: factor on the difference of commanded sides.
    """

    gyro: GyroFit | None = None
    encoders: bool = False
    track_multiplier: float = 1.0
    command_scale: float = 1.0
    command_turn_scale: float = 1.0


def read_senses(runs: Sequence[MotionRun]) -> Senses:
    """Sensors that all these runs have, and the parameters of their controller."""
    fits = [run.gyro_fit for run in runs]
    gyro = None if any(fit is None for fit in fits) else fits[0]
    encoders = all(run.wheels is not None for run in runs)
    known = runs[0].alignment
    return Senses(gyro, encoders, known.track_multiplier, known.command_scale, known.command_turn_scale)


class Rehearsal:
    """Commands on level ground.

    Args:
        commands: to rehearse.
        vehicle: geometry.
        senses: sensors of the resulting log.
        begins: start times of the manoeuvres [s], shape (k,).
    """

    def __init__(self, commands: Commands, vehicle: Vehicle, senses: Senses, begins: Floats) -> None:
        self.senses = senses
        self.vehicle = msgspec.structs.replace(vehicle, controller_track_multiplier=senses.track_multiplier)
        self._run = _stand_still(commands, self.vehicle, senses, begins)
        self._run_residuals = RunResiduals(self._run, self.vehicle, Input.COMMAND)

    @property
    def largest(self) -> Largest:
        """Largest commands."""
        return measure_largest((self._run,), self.vehicle)

    def find_excitation(self, edges: Floats) -> dict[Excitation, Flags]:
        """What the commands between each two edges excite, by kind: columns for its parts, shape (k, parts).

        Whether commands are large, small, different or changing enough, the information on a question says.
        """
        asked, size = self.predict(()), edges.size - 1
        group = np.clip(np.searchsorted(edges, self._run_residuals.grid.times, side="right") - 1, 0, size - 1)

        def happens(*parts: Flags) -> Flags:
            counts = [np.bincount(group, one, minlength=size) > 0.0 for one in parts]
            return np.column_stack(counts)

        ahead, back = asked.x > STILL_MPS, asked.x < -STILL_MPS
        left, right = asked.w > STILL_MPS, asked.w < -STILL_MPS
        return {
            Excitation.DRIVING: happens(ahead | back),
            Excitation.TURNING: happens(left, right),
            Excitation.BOTH_SIGNS: happens(ahead, back),
            Excitation.STEERING: happens(left, right),
            Excitation.SIDEWAYS: happens(np.abs(asked.y) > STILL_MPS),
        }

    def predict(self, effects: Sequence[Effect]) -> Velocity:
        """Body velocity of a model on the time grid."""
        return self._run_residuals.predict_velocity(effects, Timing())

    def trace(self, effects: Sequence[Effect]) -> tuple[Complex, Floats]:
        """Path of a model from the origin: positions x + iy [m] and headings [rad] at 20 Hz."""
        return self._trace(self.predict(effects))

    def _trace(self, velocity: Velocity) -> tuple[Complex, Floats]:
        grid, times = self._run_residuals.grid, self._run.track.times
        heading = grid.sum_up(velocity.w)
        along = np.exp(0.5j * (heading[1:] + heading[:-1])) * (velocity.x + 1j * velocity.y)
        path = grid.sum_up(along)
        at, edges = grid.locate_edges(times), np.arange(heading.size)
        position = np.interp(at, edges, path.real) + 1j * np.interp(at, edges, path.imag)
        return position, np.interp(at, edges, heading)

    def prepare(self, effects: Sequence[Effect]) -> EstimationData:
        """Estimation data of these commands, with poses, wheels and gyro as this model predicts them."""
        velocity = self.predict(effects)
        path, heading = self._trace(velocity)
        still = self._run.track
        attitude = np.column_stack((np.zeros((heading.size, 2)), heading))
        track = replace(
            still,
            path=path,
            heading=heading,
            attitude=attitude,
            position=np.column_stack((path.real, path.imag)),
        )
        times = self._run_residuals.grid.times
        run = replace(self._run, track=track)
        if self.senses.gyro is not None:
            known = replace(self.senses.gyro, signed_scale=1.0, bias=0.0, yaw_delay_s=0.0)
            run = replace(run, gyro=(times, velocity.w), alignment=replace(run.alignment, gyro=known))
        if self.senses.encoders:
            driven = self.predict([effect for effect in effects if effect.place <= Place.DRIVE])
            run = replace(run, wheels=_read_wheels(times, driven, self.vehicle))
        return EstimationData([run], self.vehicle, Input.COMMAND)


_REACHED = 0.99
"""Quantile of measured half-second means that counts as reached: jumps of poses are not."""
_MOVED = 0.05
"""Least speed [m/s], yaw rate [rad/s] and acceleration [m/s^2] that count as driving in this way."""


def measure_driven_range(data: EstimationData) -> DrivenRange:
    """What the driving of runs reached: commanded speed and yaw rate, and measured accelerations."""
    parts: dict[str, list[Floats]] = {"speed": [], "turn": [], "acceleration": [], "lateral": []}
    for run_residuals in data.residuals_by_run:
        vehicle, series = run_residuals.context.vehicle, run_residuals.run.commands
        if series is None:
            continue
        asked = vehicle.kinematics.asked(name_inputs(series, vehicle), vehicle)
        ahead, turned = (np.abs(average_sustained(series.times, asked[channel])) for channel in (0, 2))
        live = np.maximum(ahead, turned) > _MOVED
        parts["speed"].append(ahead[live])
        parts["turn"].append(turned[live])
        ideal = run_residuals.predict_velocity((), Timing())
        moved = run_residuals.find_residuals((), Timing())
        moved = moved + average_windows(run_residuals, ideal, locate_windows(run_residuals))
        driven = np.abs(moved[:, [0, 2]]).max(axis=1) > _MOVED
        parts["lateral"].append(np.abs(moved[driven, 0] * moved[driven, 2]))
        times = run_residuals.windows.times[:, 0]
        apart = times[2:] - times[:-2]
        near = (apart > 0.0) & (apart < 2.0 * SPAN_S) & driven[1:-1]
        parts["acceleration"].append(np.abs(moved[2:, 0] - moved[:-2, 0])[near] / apart[near])

    def find(name: str, quantile: float) -> float:
        values = np.concatenate([*parts[name], np.zeros(0)])
        most = float(np.quantile(values, quantile)) if values.size else 0.0
        return float(f"{most:.2g}") if most > _MOVED else math.nan

    commanded = (find(name, 1.0) for name in ("speed", "turn"))
    return DrivenRange(*commanded, *(find(name, _REACHED) for name in ("acceleration", "lateral")))


def start_state(effects: Sequence[Effect]) -> ModelState:
    """Fit state of a model on a rehearsed run, whose clocks are known."""
    return ModelState(tuple(effects), (Timing(),))


def _stand_still(commands: Commands, vehicle: Vehicle, senses: Senses, begins: Floats) -> MotionRun:
    """The commands as a run with placeholder poses."""
    end = commands.duration_s + _AFTER_S
    times = np.arange(round(end * _POSE_HZ)) / _POSE_HZ
    zeros = np.zeros(times.size)
    track = Track(
        times,
        np.zeros(times.size, dtype=np.int64),
        zeros.astype(np.complex128),
        zeros,
        np.zeros((times.size, 3)),
        np.zeros((times.size, 2)),
        np.ones(times.size, dtype=bool),
    )
    return MotionRun(
        name="plan",
        sha256="",
        terrain="unknown",
        commands=drive(commands, vehicle),
        wheels=None,
        gyro=None,
        track=track,
        streams=times,
        step_starts=begins,
        excluded=np.zeros(0),
        duration_s=end,
        alignment=Alignment(track_multiplier=senses.track_multiplier),
    )


def drive(commands: Commands, vehicle: Vehicle) -> DriveSeries:
    """Inputs of the drive that a controller computes from body commands, at the commands' stamps."""
    zeros = np.zeros(commands.speed.size)
    if is_steered(vehicle):
        axle = commands.speed / vehicle.wheel_radius_m
        return DriveSeries(commands.times, axle, axle, commands.turn)
    inputs = vehicle.kinematics.inverse((commands.speed, zeros, commands.turn), vehicle)
    return DriveSeries(commands.times, inputs["left"], inputs["right"], zeros, inputs.get("sideways"))


def _read_wheels(times: Floats, driven: Velocity, vehicle: Vehicle) -> DriveSeries:
    """Encoder speeds of a drive with known ideal velocity."""
    nominal = msgspec.structs.replace(vehicle, controller_track_multiplier=1.0)
    inputs = nominal.kinematics.inverse((driven.x, driven.y, driven.w), nominal)
    return DriveSeries(times, inputs["left"], inputs["right"], np.zeros(times.size), inputs.get("sideways"))


# Knowledge before a drive: candidate models, the precision of their parameters, and the noise.
#
# A hypothesis is a model with values. The information matrix of the logs so far is that of the fit, divided
# by the variance of its weighted residuals times the number of neighbours that repeat each residual. The
# prior of the fleet, or the usual size of a parameter, adds to it.

_USUAL_NOISE = (0.007, 0.007, 0.007)
"""Without a log: spread of the residual of a step [m, m, rad]."""
# Standard deviation of the clock offset of a future log [s].
CLOCK_S = 0.05


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A candidate model; instances compare by identity.

    Attributes:
        effects: with their values.
        free: its parameters, one per row of `information`.
        information: information of the logs so far and of the usual sizes, shape (p, p).
    """

    effects: tuple[Effect, ...]
    free: tuple[Free, ...]
    information: Floats

    @property
    def names(self) -> frozenset[str]:
        """Ids of its effects."""
        return frozenset(effect.id for effect in self.effects)

    @property
    def values(self) -> Floats:
        """Values of its parameters, shape (p,)."""
        state = start_state(self.effects)
        return np.array([state.get(number) for number in self.free])

    def extend(self, effect: Effect) -> Hypothesis:
        """The model with one more effect, on which the logs have no information."""
        both = _assume(start_state(self.effects).add(effect).effects, {})
        old = {number.label: index for index, number in enumerate(self.free)}
        rows = [index for index, number in enumerate(both.free) if number.label in old]
        mine = [old[both.free[index].label] for index in rows]
        information = both.information.copy()
        information[np.ix_(rows, rows)] = self.information[np.ix_(mine, mine)]
        return replace(both, information=information)

    def draw(self, generator: np.random.Generator) -> tuple[Effect, ...]:
        """Effects with parameters drawn from their distribution, clipped to their bounds."""
        if not self.free:
            return self.effects
        root = np.linalg.cholesky(self.information)
        spread = np.linalg.solve(root.T, generator.standard_normal(len(self.free)))
        return start_state(self.effects).move(self.free, spread.tolist()).effects


@dataclass(frozen=True)
class Knowledge:
    """What is known before a drive.

    Attributes:
        vehicle: geometry.
        senses: sensors of the next log.
        base: model that explains the logs so far; the ideal one without logs.
        noise: standard deviation of a step's residual by part and channel, as if independent; infinite
            in channels without information, shape (parts, 3).
        fitted: fit of the base to the logs so far; None without logs on this ground.
        data: estimation data of the logs so far; None without logs.
    """

    vehicle: Vehicle
    senses: Senses
    base: Hypothesis
    noise: Floats
    data: EstimationData | None = None
    fitted: Fitted | None = field(default=None, repr=False)

    @property
    def driven_s(self) -> float:
        """Length of the logs so far [s]."""
        return 0.0 if self.data is None else sum(run.duration_s for run in self.data.runs)

    def suppose(self, effects: Sequence[Effect]) -> Hypothesis:
        """Hypothesis of these effects, fitted to any logs so far; neutral effects start from a search."""
        if self.data is None:
            return _assume(tuple(effects), {})
        return _inform(fit_model(self.data, Model(self.data.vehicle, tuple(effects))))

    def rival(self, effects: Sequence[Effect]) -> tuple[Hypothesis, float]:
        """Hypothesis of these effects fitted to the logs so far, and the block t in favour of the base.

        Raises:
            ValueError: there are no logs on this ground.
        """
        if self.fitted is None:
            raise ValueError("nothing was driven")
        data, power = self.fitted.data, 0.0
        other = fit_model(data, Model(data.vehicle, tuple(effects)))
        for path, own, fit in zip(data.paths, self.fitted.fits, other.fits, strict=True):
            # The noise is the same for both models.
            costs = [list_costs(path, own.noise, one.residual) for one in (fit, own)]
            power += float((costs[0] - costs[1]).sum()) / own.overdispersion
        return _inform(other), 0.5 * math.sqrt(max(power, 0.0))


def learn(
    runs: Sequence[MotionRun],
    vehicle: Vehicle,
    effects: Sequence[Effect] = (),
    prior: Mapping[str, tuple[float, float]] | None = None,
) -> Knowledge:
    """Knowledge from the runs of one vehicle.

    Args:
        runs: the logs so far.
        vehicle: geometry.
        effects: effects identified in them, which are refitted to all logs jointly.
        prior: prior of their parameters: mean and standard deviation by label.

    Raises:
        PlanError: ``no_command``, a run has no commands.
        MotionError: a run is too short.
    """
    for run in runs:
        if run.commands is None:
            what = "the log has no commands, which a plan would be made of"
            hint = "Record the command topic, or plan for the vehicle alone with --vehicle."
            raise PlanError("no_command", what, where=run.name, hint=hint)
    # The motion of a car at rest does not show its steering: the fit uses the path from commands to body.
    used = [replace(run, wheels=None) for run in runs]
    if not is_steered(vehicle) and all(run.wheels is not None for run in runs):
        used = list(runs)
    data = EstimationData(used, vehicle, Input.COMMAND)
    model = Model(data.vehicle, tuple(effects))
    if prior:
        data = data.with_prior(prior)
    fitted = fit_model(data, model)
    noise = [_measure_noise(fit) for fit in fitted.fits]
    return Knowledge(data.vehicle, read_senses(used), _inform(fitted), np.array(noise), data, fitted)


def assume(
    vehicle: Vehicle, effects: Sequence[Effect] = (), prior: Mapping[str, tuple[float, float]] | None = None
) -> Knowledge:
    """Knowledge of a vehicle without a log: poses alone, with usual noise.

    Args:
        vehicle: geometry.
        effects: expected effects at their expected values; none for the ideal model.
        prior: prior of their parameters: mean and standard deviation by label.
    """
    noise = np.array([_USUAL_NOISE])
    senses = Senses(track_multiplier=vehicle.controller_track_multiplier)
    return Knowledge(vehicle, senses, _assume(tuple(effects), prior or {}), noise)


def _assume(effects: tuple[Effect, ...], prior: Mapping[str, tuple[float, float]]) -> Hypothesis:
    free = tuple(number for number in start_state(effects).list_free(()) if number.is_smooth)
    return Hypothesis(effects, free, np.diag(_expect(effects, free, prior)))


def _inform(fitted: Fitted) -> Hypothesis:
    """Hypothesis of a fitted model on the ground of the first run; what others have is marginalized."""
    effects = fitted.state.effects_of(0)
    free = tuple(number for number in start_state(effects).list_free(()) if number.is_smooth)
    index_of = {number.label: index for index, number in enumerate(free)}
    total = np.diag(_expect(effects, free, fitted.data.paths[0].prior.numbers))
    for fit in fitted.fits:
        columns = fit.white.columns[:, fit.smooth]
        normal = columns.T @ columns / fit.overdispersion
        numbers = [fit.free[index] for index in fit.smooth]
        is_clock = [not number.effect or number.effect in fit.path.clocks for number in numbers]
        mine = [index for index, number in enumerate(numbers) if not is_clock[index] and number.acts_in(0)]
        others = [index for index in range(len(numbers)) if index not in mine]
        known = normal[np.ix_(mine, mine)]
        if others:
            cross, own = normal[np.ix_(mine, others)], normal[np.ix_(others, others)]
            spread = [CLOCK_S if is_clock[index] else numbers[index].step for index in others]
            known = known - cross @ np.linalg.solve(own + np.diag(np.array(spread) ** -2.0), cross.T)
        at = [index_of[numbers[index].label] for index in mine]
        total[np.ix_(at, at)] += known
    return Hypothesis(effects, free, total)


def _expect(
    effects: Sequence[Effect], free: Sequence[Free], prior: Mapping[str, tuple[float, float]]
) -> Floats:
    """Information before any log, shape (p,): of the prior, else of the usual size.

    The usual size is the distance of the parameter, or of its typical value, from neutral.
    """
    by_id = {effect.id: effect for effect in effects}
    spread = []
    for number in free:
        parameter = by_id[number.effect].parameter(number.name)
        neutral = parameter.neutral if math.isfinite(parameter.neutral) else 0.0
        value = by_id[number.effect].values[number.name]
        usual = max(abs(value - neutral), abs(parameter.typical - neutral))
        spread.append(max(prior.get(number.label, (0.0, usual))[1], parameter.step))
    return np.array(spread, dtype=np.float64) ** -2.0


def _measure_noise(fit: PathFit) -> Floats:
    """Standard deviation of a step by channel, as if steps were independent, shape (3,).

    A slow disturbance adds up over many steps, and counts by its sum; the noise of poses cancels.
    """
    noise = fit.noise
    lasting = noise.share * (1.0 + noise.correlation) / (1.0 - noise.correlation)
    spread = noise.spread * np.sqrt((lasting + 1.0 - noise.share) * fit.overdispersion)
    return np.where(spread > 0.0, spread, np.inf)
