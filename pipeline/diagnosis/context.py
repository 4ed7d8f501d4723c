"""What is diagnosed: the runs made ready, and the candidates that follow from their topics."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.diagnosis.errors import DiagnosisError
from pipeline.diagnosis.plausibility import EXCEEDED_SHARE
from pipeline.identification.comparison import Input
from pipeline.identification.problem import Problem
from pipeline.identification.proposals import Candidate
from pipeline.models.catalogue import list_effects
from pipeline.models.conditions import LEAST_DELAY_S, Conditions, Largest
from pipeline.models.effect import Place
from pipeline.runs.errors import MotionError
from pipeline.runs.recording import MotionRun
from pipeline.runs.signals import find_fastest_wheel, name_inputs
from pipeline.vehicles import Vehicle

_FEWEST_WINDOWS = 60
_DRIVETRAIN = frozenset({Place.COMMAND, Place.DRIVE})
_SURE = 4.0


@dataclass(frozen=True)
class Context:
    """Runs of one vehicle, ready to be asked.

    Attributes:
        problem: the runs on the leading input.
    """

    problem: Problem

    @property
    def runs(self) -> tuple[MotionRun, ...]:
        """The recordings."""
        return self.problem.runs

    @property
    def vehicle(self) -> Vehicle:
        """Geometry."""
        return self.problem.vehicle

    @property
    def largest(self) -> Largest:
        """What relative starts are shares of."""
        return self.problem.largest

    @property
    def has_encoders(self) -> bool:
        """Whether every run has measured wheels."""
        return all(run.wheels is not None for run in self.runs)

    @property
    def has_gyro(self) -> bool:
        """Whether every run has a good gyro as heading and clock."""
        return all(comparison.has_gyro for comparison in self.problem.comparisons)

    def list_shared(self) -> list[object]:
        """Large objects that stay as they are throughout."""
        problems = [self.problem, *([self.problem.behind_wheels] if self.has_encoders else [])]
        return [
            *problems,
            *(one for problem in problems for one in (*vars(problem).values(), *problem.parts)),
        ]

    @cached_property
    def conditions(self) -> Conditions:
        """What the runs can show; every search looks at measured wheels where there are any."""
        sampling = self.sampling_s if self.has_encoders else 0.0
        exceeded = _measure_exceeded(self.runs, self.vehicle)
        return Conditions(self.largest, self.has_encoders, self.has_gyro, sampling, exceeded)

    @property
    def sampling_s(self) -> float:
        """Delay that sampled encoders may feign: a little more than half their period."""
        return 0.6 * max(run.wheel_period_s for run in self.runs)

    def list_candidates(self, source: Input) -> tuple[Candidate, ...]:
        """Effects that can be told on an input of this vehicle."""
        hidden = _DRIVETRAIN if source is Input.MEASURED else frozenset()
        return tuple(
            cast("Candidate", effect)
            for effect in list_effects()
            if self.vehicle.kind in effect.kinds
            and effect.place not in hidden
            and not effect.parts
            and effect().can_show(self.conditions)
        )

    def list_drivetrain(self) -> tuple[Candidate, ...]:
        """Effects between command and wheels."""
        return tuple(
            cast("Candidate", effect)
            for effect in list_effects()
            if self.vehicle.kind in effect.kinds and effect.place in _DRIVETRAIN
        )


def prepare(runs: Sequence[MotionRun], vehicle: Vehicle, source: Input) -> Context:
    """Make runs ready.

    Raises:
        DiagnosisError: ``no_input``; ``too_short``, fewer than a quarter of a minute of driving can be
            compared.
    """
    where = ", ".join(run.name for run in runs)
    try:
        problem = Problem(runs, vehicle, source)
    except MotionError as error:
        if error.code != f"no_{source.value}":
            raise
        other = Input.MEASURED if source is Input.COMMAND else Input.COMMAND
        what = f"there is no {'command' if source is Input.COMMAND else 'measured wheel'} to diagnose from"
        raise DiagnosisError("no_input", what, where=where, hint=f"Try --input {other.value}.") from error
    windows = problem.whole.run.size
    if windows < _FEWEST_WINDOWS:
        what = f"only {windows} stretches of half a second have both a live input and good poses"
        hint = f"{_FEWEST_WINDOWS} are needed: drive longer, or check the poses with `slip inspect`."
        raise DiagnosisError("too_short", what, where=where, hint=hint)
    return Context(problem)


def _measure_exceeded(runs: Sequence[MotionRun], vehicle: Vehicle) -> dict[str, float]:
    """What measured wheels exceed in `EXCEEDED_SHARE` of the time: `speed`, `turn`, `wheel`."""
    found: dict[str, list[Floats]] = {}
    for run in runs:
        if run.wheels is not None:
            inputs = name_inputs(run.wheels, vehicle)
            forward, _, around = vehicle.kinematics.asked(inputs, vehicle)
            series = {"speed": forward, "turn": around, "wheel": find_fastest_wheel(run.wheels)}
            for name, values in series.items():
                found.setdefault(name, []).append(np.abs(values))
    return {
        name: float(np.quantile(np.concatenate(values), 1.0 - EXCEEDED_SHARE))
        for name, values in found.items()
    }


def is_late(run: MotionRun) -> bool:
    """Whether the reported heading is late or early against the gyro beyond doubt."""
    gyro = run.gyro_fit
    delay = abs(run.alignment.heading_delay_s)
    return gyro is not None and delay >= LEAST_DELAY_S and delay > _SURE * gyro.delay_error_s
