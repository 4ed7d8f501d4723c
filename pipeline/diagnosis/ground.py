"""What is diagnosed: the runs made ready, and the problems and candidates that follow from their topics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np

from pipeline.diagnosis.errors import DiagnosisError
from pipeline.diagnosis.problem import BodyProblem, WheelProblem
from pipeline.diagnosis.timing import YawDelay
from pipeline.identification.comparison import Comparison, Input
from pipeline.models.catalogue import list_effects
from pipeline.models.effect import Place
from pipeline.models.evidence import LEAST_DELAY_S, Evidence, Largest
from pipeline.models.forward import Timing
from pipeline.runs.signals import name_inputs

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.diagnosis.screen import Candidate
    from pipeline.runs.recording import MotionRun
    from pipeline.vehicles import Vehicle

# Cell means of held commands are exact: finer cells change residuals in the sixth digit.
_RATE_HZ = 50.0
_COARSE_HZ = 25.0
_MOST_CELLS = 20_000
_FEWEST_WINDOWS = 60
_DRIVETRAIN = frozenset({Place.COMMAND, Place.DRIVE})


@dataclass(frozen=True)
class Ground:
    """Runs of one vehicle, ready to be asked.

    Attributes:
        runs: the recordings.
        vehicle: geometry.
        commanded: fed with commands, one a run; empty where a run has none.
        measured: fed with measured wheels; empty where a run has none.
        yaw_delays: of each run's heading against its gyro; None without a good gyro.
        largest: what relative starts are shares of.
    """

    runs: tuple[MotionRun, ...]
    vehicle: Vehicle
    commanded: tuple[Comparison, ...]
    measured: tuple[Comparison, ...]
    yaw_delays: tuple[YawDelay | None, ...]
    largest: Largest

    @property
    def has_gyro(self) -> bool:
        """Whether every run has a good gyro as heading and clock."""
        return all(delay is not None for delay in self.yaw_delays)

    def compare(self, source: Input) -> tuple[Comparison, ...]:
        """The comparisons of an input."""
        return self.commanded if source is Input.COMMAND else self.measured

    @property
    def evidence(self) -> Evidence:
        """What the runs can show; every search looks at measured wheels where there are any."""
        sampling = self.sampling_s if self.measured else 0.0
        return Evidence(self.largest, bool(self.measured), self.has_gyro, sampling)

    @property
    def sampling_s(self) -> float:
        """Delay that sampled encoders may feign: a little more than half their period."""
        periods = [float(np.median(np.diff(run.wheels.times))) for run in self.runs if run.wheels is not None]
        return 0.6 * max(periods, default=0.0)

    def start_timing(self) -> tuple[Timing, ...]:
        """Delays to start from: the heading's against the gyro."""
        return tuple(
            Timing() if delay is None or abs(delay.seconds) < 0.5 * LEAST_DELAY_S else Timing(delay.seconds)
            for delay in self.yaw_delays
        )

    def list_candidates(self, source: Input) -> tuple[Candidate, ...]:
        """Effects that can be told on an input of this vehicle."""
        hidden = _DRIVETRAIN if source is Input.MEASURED else frozenset()
        return tuple(
            cast("Candidate", effect)
            for effect in list_effects()
            if self.vehicle.kind in effect.kinds
            and effect.place not in hidden
            and not effect.parts
            and effect().can_show(self.evidence)
        )

    def list_drivetrain(self) -> tuple[Candidate, ...]:
        """Effects between command and wheels."""
        return tuple(
            cast("Candidate", effect)
            for effect in list_effects()
            if self.vehicle.kind in effect.kinds and effect.place in _DRIVETRAIN
        )

    def pose_body(self, source: Input) -> BodyProblem:
        """The problem from an input to the body."""
        late = source is Input.MEASURED and self.has_gyro
        return BodyProblem(self.compare(source), ("wheel_delay_s",) if late else ())

    def pose_wheels(self) -> WheelProblem:
        """The problem from command to wheels."""
        return WheelProblem(self.commanded, self.measured, speed=self.largest.speed, turn=self.largest.turn)


def prepare(runs: Sequence[MotionRun], vehicle: Vehicle) -> Ground:
    """Make runs ready.

    Raises:
        DiagnosisError: ``too_short``, fewer than a quarter of a minute of driving can be compared.
    """
    commanded = _compare_all(runs, vehicle, Input.COMMAND)
    measured = _compare_all(runs, vehicle, Input.MEASURED)
    leading = commanded or measured
    windows = sum(comparison.windows.start.size for comparison in leading)
    if windows < _FEWEST_WINDOWS:
        raise DiagnosisError(
            "too_short",
            f"only {windows} stretches of half a second have both a live input and good poses",
            where=", ".join(run.name for run in runs),
            hint=f"{_FEWEST_WINDOWS} are needed: drive longer, or check the poses with `slip inspect`.",
        )
    delays = []
    for comparison in leading:
        gyro = comparison.heading.gyro
        delays.append(None if gyro is None else YawDelay(gyro.yaw_delay_s, gyro.delay_error_s))
    return Ground(tuple(runs), vehicle, commanded, measured, tuple(delays), _measure_largest(runs, vehicle))


def _compare_all(runs: Sequence[MotionRun], vehicle: Vehicle, source: Input) -> tuple[Comparison, ...]:
    series = [run.commands if source is Input.COMMAND else run.wheels for run in runs]
    if any(one is None for one in series):
        return ()
    long = sum(run.duration_s for run in runs) * _RATE_HZ > _MOST_CELLS
    rate = _COARSE_HZ if long else _RATE_HZ
    return tuple(Comparison(run, vehicle, source, rate_hz=rate) for run in runs)


def _measure_largest(runs: Sequence[MotionRun], vehicle: Vehicle) -> Largest:
    speed = turn = wheel = difference = 0.0
    for run in runs:
        series = run.commands or run.wheels
        if series is None:
            continue
        forward, _, around = vehicle.kinematics.asked(name_inputs(series, vehicle), vehicle)
        speed, turn = max(speed, float(np.abs(forward).max())), max(turn, float(np.abs(around).max()))
        wheel = max(wheel, float(np.abs(series.left).max()), float(np.abs(series.right).max()))
        difference = max(difference, float(np.abs(series.right - series.left).max()))
    places = np.concatenate([run.track.place[run.track.active, 0] for run in runs])
    tenths = np.quantile(places, np.linspace(0.0, 1.0, 11)) if places.size else np.zeros(11)
    return Largest(speed, turn, wheel, max(difference, 1e-6), max(run.duration_s for run in runs), tenths)
