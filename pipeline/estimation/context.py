"""Runs of one vehicle made ready for a search: what they can show, and which effects may be named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, cast

from pipeline.core import SlipError
from pipeline.estimation.comparison import Input
from pipeline.estimation.problem import Problem
from pipeline.models import Conditions, Effect, Excitation, Largest, Place, is_of_one_run, list_effects
from pipeline.run import GROUND_UNOBSERVABLE, MotionError, MotionRun

if TYPE_CHECKING:
    from pipeline.estimation.candidates import Candidate
    from pipeline.sources import Vehicle


class DiagnosisError(SlipError):
    """A diagnosis that cannot be made, in one line."""


_FEWEST_WINDOWS = 40
"""Half seconds of driving with poses that a diagnosis needs, over all of its runs: ten seconds, windows
overlapping."""
_LONG_S = 60.0
"""Shortest run that can show a change with time [s]: in a shorter one its start is what changes."""
_DRIVETRAIN = frozenset({Place.COMMAND, Place.DRIVE})


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
    def is_drive_alone(self) -> bool:
        """Whether the poses are the motion of the wheels, so that only the drivetrain is observable."""
        return any(run.is_drive_alone for run in self.runs)

    @property
    def has_gyro(self) -> bool:
        """Whether every run has a good gyro as heading and clock."""
        return all(comparison.has_gyro for comparison in self.problem.comparisons)

    @cached_property
    def conditions(self) -> Conditions:
        """What the runs can show; every search looks at measured wheels where there are any."""
        encoders = self.has_encoders or self.is_drive_alone
        sampling = self.sampling_s if encoders else 0.0
        exceeded = self.problem.exceeded
        slope = max(comparison.context.slope_rad for comparison in self.problem.comparisons)
        course = any(run.is_on_course for run in self.runs)
        return Conditions(self.largest, encoders, self.has_gyro, sampling, exceeded, slope, course)

    @property
    def sampling_s(self) -> float:
        """Delay that sampled encoders may feign: a little more than half their period."""
        return 0.6 * max(run.wheel_period_s for run in self.runs)

    def list_candidates(self, source: Input) -> tuple[Candidate, ...]:
        """Effects that can be identified from an input of this vehicle."""
        if self.is_drive_alone:
            return self.list_drivetrain()
        hidden = _DRIVETRAIN if source is Input.MEASURED else frozenset()
        return tuple(
            cast("Candidate", effect)
            for effect in list_effects()
            if self.vehicle.kind in effect.kinds
            and effect.place not in hidden
            and not effect.parts
            and self._can_show(effect())
        )

    def _can_show(self, effect: Effect) -> bool:
        if len(self.runs) > 1 and is_of_one_run(effect.parameters):
            return False
        is_long = max(run.duration_s for run in self.runs) >= _LONG_S
        return effect.can_show(self.conditions) and (is_long or Excitation.LONG not in effect.needs)

    def list_drivetrain(self) -> tuple[Candidate, ...]:
        """Effects between command and wheels."""
        return tuple(
            cast("Candidate", effect)
            for effect in list_effects()
            if self.vehicle.kind in effect.kinds and effect.place in _DRIVETRAIN and self._can_show(effect())
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
    _require_alike(runs)
    windows = problem.whole.run.size
    if windows < _FEWEST_WINDOWS:
        what = f"only {windows} stretches of half a second have both a live input and valid poses"
        hint = f"{_FEWEST_WINDOWS} are needed: drive longer, or check the poses with `slip inspect`."
        raise DiagnosisError("too_short", what, where=where, hint=hint)
    return Context(problem)


def _require_alike(runs: Sequence[MotionRun]) -> None:
    """Refuse to judge runs with poses and runs without together.

    Raises:
        DiagnosisError: ``ground_unobservable``.
    """
    alone = [run.name for run in runs if run.is_drive_alone]
    if alone and len(alone) < len(runs):
        what = (
            "the log holds no pose, so that only its drivetrain is observable; others of these logs hold one"
        )
        hint = "Diagnose it without the others."
        raise DiagnosisError(GROUND_UNOBSERVABLE, what, where=", ".join(alone), hint=hint)
