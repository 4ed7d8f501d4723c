"""Commands rehearsed: a run that was not driven yet, with the poses that a model predicts.

Such a run is a run like any other: the one residual problem makes its windows, predictions and derivatives.
The ground is taken to be level.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from pipeline.core.arrays import Complex, Floats
from pipeline.identification import Comparison, Input, Problem, State
from pipeline.identification.problem import measure_largest
from pipeline.models import Effect, Place, Timing
from pipeline.models.conditions import Largest
from pipeline.plan.limits import is_steered
from pipeline.plan.manoeuvres import Commands
from pipeline.runs.recording import Alignment, GyroFit, MotionRun, Track
from pipeline.runs.signals import DriveSeries, Velocity
from pipeline.vehicles import Vehicle

_POSE_HZ = 20.0
# Poses and encoders go on after the last command.
_AFTER_S = 0.2


@dataclass(frozen=True)
class Senses:
    """Which sensors the next log will have, as the last one had.

    Attributes:
        gyro: how the gyro fits the poses; None without a good one.
        encoders: whether wheels are measured.
        track_multiplier: of the controller.
        command_scale: by which recorded commands are multiplied.
    """

    gyro: GyroFit | None = None
    encoders: bool = False
    track_multiplier: float = 1.0
    command_scale: float = 1.0


def read_senses(runs: Sequence[MotionRun]) -> Senses:
    """Sensors that all these runs have, and their controller."""
    fits = [run.gyro_fit for run in runs]
    gyro = None if any(fit is None for fit in fits) else fits[0]
    encoders = all(run.wheels is not None for run in runs)
    known = runs[0].alignment
    return Senses(gyro, encoders, known.track_multiplier, known.command_scale)


class Rehearsal:
    """Commands on level ground.

    Args:
        commands: to rehearse.
        vehicle: geometry.
        senses: sensors of the log that will come of it.
        begins: when manoeuvres begin [s], shape (k,).
    """

    def __init__(self, commands: Commands, vehicle: Vehicle, senses: Senses, begins: Floats) -> None:
        self.senses = senses
        self.vehicle = msgspec.structs.replace(vehicle, controller_track_multiplier=senses.track_multiplier)
        self._run = _stand_still(commands, self.vehicle, senses, begins)
        self._comparison = Comparison(self._run, self.vehicle, Input.COMMAND)

    @property
    def largest(self) -> Largest:
        """What the commands ask for at most."""
        return measure_largest((self._run,), self.vehicle)

    def predict(self, effects: Sequence[Effect]) -> Velocity:
        """Body velocity of a model on the cells."""
        return self._comparison.predict_velocity(effects, Timing())

    def trace(self, effects: Sequence[Effect]) -> tuple[Complex, Floats]:
        """Way of a model from the origin: positions x + iy [m] and headings [rad], 20 a second."""
        return self._trace(self.predict(effects))

    def _trace(self, velocity: Velocity) -> tuple[Complex, Floats]:
        cells, times = self._comparison.cells, self._run.track.times
        heading = cells.sum_up(velocity.w)
        along = np.exp(0.5j * (heading[1:] + heading[:-1])) * (velocity.x + 1j * velocity.y)
        path = cells.sum_up(along)
        at, edges = cells.locate_edges(times), np.arange(heading.size)
        place = np.interp(at, edges, path.real) + 1j * np.interp(at, edges, path.imag)
        return place, np.interp(at, edges, heading)

    def prepare(self, effects: Sequence[Effect]) -> Problem:
        """The residual problem of these commands, with poses, wheels and gyro as this model predicts them."""
        velocity = self.predict(effects)
        path, heading = self._trace(velocity)
        still = self._run.track
        attitude = np.column_stack((np.zeros((heading.size, 2)), heading))
        track = replace(
            still,
            path=path,
            heading=heading,
            attitude=attitude,
            place=np.column_stack((path.real, path.imag)),
        )
        times = self._comparison.cells.times
        run = replace(self._run, track=track)
        if self.senses.gyro is not None:
            known = replace(self.senses.gyro, signed_scale=1.0, bias=0.0, yaw_delay_s=0.0)
            run = replace(run, gyro=(times, velocity.w), alignment=replace(run.alignment, gyro=known))
        if self.senses.encoders:
            driven = self.predict([effect for effect in effects if effect.place <= Place.DRIVE])
            run = replace(run, wheels=_read_wheels(times, driven, self.vehicle))
        return Problem([run], self.vehicle, Input.COMMAND)


def start_state(effects: Sequence[Effect]) -> State:
    """A model as it acts on a rehearsed run, whose clocks are known."""
    return State(tuple(effects), (Timing(),))


def _stand_still(commands: Commands, vehicle: Vehicle, senses: Senses, begins: Floats) -> MotionRun:
    """The commands as a run whose poses say nothing yet."""
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
        barred=np.zeros(0),
        duration_s=end,
        alignment=Alignment(track_multiplier=senses.track_multiplier),
    )


def drive(commands: Commands, vehicle: Vehicle) -> DriveSeries:
    """What a controller makes of body commands: the drive's inputs, at the commands' stamps."""
    zeros = np.zeros(commands.speed.size)
    if is_steered(vehicle):
        axle = commands.speed / vehicle.wheel_radius_m
        return DriveSeries(commands.times, axle, axle, commands.turn)
    inputs = vehicle.kinematics.inverse((commands.speed, zeros, commands.turn), vehicle)
    return DriveSeries(commands.times, inputs["left"], inputs["right"], zeros, inputs.get("sideways"))


def _read_wheels(times: Floats, driven: Velocity, vehicle: Vehicle) -> DriveSeries:
    """Encoders of a drive whose ideal velocity is known."""
    nominal = msgspec.structs.replace(vehicle, controller_track_multiplier=1.0)
    inputs = nominal.kinematics.inverse((driven.x, driven.y, driven.w), nominal)
    return DriveSeries(times, inputs["left"], inputs["right"], np.zeros(times.size), inputs.get("sideways"))
