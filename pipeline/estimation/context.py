"""The runs made ready for a search, the candidates that they allow, and the time that it may take."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import cast

from pipeline.core import SlipError
from pipeline.core.compute import measure_cpu
from pipeline.estimation.comparison import Input
from pipeline.estimation.problem import Problem
from pipeline.estimation.proposals import Candidate
from pipeline.models.catalogue import list_effects
from pipeline.models.effect import Place
from pipeline.models.parameter import LEAST_DELAY_S, Conditions, Largest
from pipeline.run.recording import MotionError, MotionRun
from pipeline.sources import Vehicle


class DiagnosisError(SlipError):
    """A diagnosis that cannot be made, in one line."""


_USUAL_S = 60.0
"""CPU time of a search [s] for `_FOR_S` of driving, and the least."""
_FOR_S = 600.0
"""Driving [s] that `_USUAL_S` is for."""
_UNITS = {"": 1.0, "s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}
"""Seconds in a unit of `--budget`."""
_DURATION = re.compile(r"(\d+(?:\.\d+)?)\s*(s|min|m|h|)")


@dataclass
class Budget:
    """CPU time that a search may take; after it the best answer so far stands.

    Attributes:
        seconds: of CPU time of this process and of what works beside it.
        notify: told what was found so far.
        was_cut: whether a search was ended by it.
    """

    seconds: float = math.inf
    notify: Callable[[str], None] | None = None
    was_cut: bool = False
    _started: float = field(default_factory=measure_cpu)

    @property
    def spent_s(self) -> float:
        """CPU time since it began [s]."""
        return measure_cpu() - self._started

    def is_spent(self) -> bool:
        """Whether it is used up: whoever asks ends then."""
        self.was_cut |= self.spent_s > self.seconds
        return self.was_cut

    def report(self, title: str, effects: Iterable[str]) -> None:
        """Report the effects found on a part of the way."""
        if self.notify is not None:
            self.notify(f"{title}: {', '.join(effects) or 'none yet'} ({self.spent_s:.0f} s)")


def usual_budget(driven_s: float) -> float:
    """CPU time [s] for a run of so much driving [s]: a minute for ten minutes, and never less."""
    return max(_USUAL_S, _USUAL_S * driven_s / _FOR_S)


def parse_budget(text: str) -> float:
    """CPU time [s] of ``60s``, ``2min`` or a number of seconds.

    Raises:
        DiagnosisError: ``bad_budget``.
    """
    match = _DURATION.fullmatch(text.strip())
    if match is None or float(match[1]) == 0.0:
        what, hint = f"{text!r} is not a duration above zero", "Write it like 60s or 5min."
        raise DiagnosisError("bad_budget", what, where="--budget", hint=hint)
    return float(match[1]) * _UNITS[match[2]]


_FEWEST_WINDOWS = 60
"""Half seconds of driving with poses that a diagnosis needs: a quarter of a minute, windows overlapping."""
_DRIVETRAIN = frozenset({Place.COMMAND, Place.DRIVE})
_SURE = 4.0
"""Standard errors from which on a delay of the heading is beyond doubt."""


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
        exceeded = self.problem.exceeded
        slope = max(comparison.context.slope_rad for comparison in self.problem.comparisons)
        return Conditions(self.largest, self.has_encoders, self.has_gyro, sampling, exceeded, slope)

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
            if self.vehicle.kind in effect.kinds
            and effect.place in _DRIVETRAIN
            and effect().can_show(self.conditions)
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
        what = f"only {windows} stretches of half a second have both a live input and valid poses"
        hint = f"{_FEWEST_WINDOWS} are needed: drive longer, or check the poses with `slip inspect`."
        raise DiagnosisError("too_short", what, where=where, hint=hint)
    return Context(problem)


def is_late(run: MotionRun) -> bool:
    """Whether the reported heading is late or early against the gyro beyond doubt."""
    gyro = run.gyro_fit
    delay = abs(run.alignment.heading_delay_s)
    return gyro is not None and delay >= LEAST_DELAY_S and delay > _SURE * gyro.delay_error_s
