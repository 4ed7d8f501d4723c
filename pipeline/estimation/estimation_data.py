"""Estimation data: runs prepared for one input, to fit models and to score them on these or other runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING, cast

import numpy as np

from pipeline.core import Flags, Floats, Newest, SlipError, require_compiler
from pipeline.estimation.fit import PathFit
from pipeline.estimation.folds import Fold, find_near, make_folds
from pipeline.estimation.largest import measure_exceeded, measure_largest
from pipeline.estimation.model_state import DelayName, ModelState, Prior
from pipeline.estimation.path_residuals import BodyResiduals, PathResiduals, WheelResiduals, tie_prior
from pipeline.estimation.run_residuals import Input, RunResiduals, choose_rate
from pipeline.estimation.window_residuals import WindowResiduals
from pipeline.models import (
    Conditions,
    Effect,
    Excitation,
    Model,
    Place,
    Timing,
    is_of_one_run,
    list_effects,
)
from pipeline.recording import SLOW_HZ
from pipeline.run import (
    GROUND_UNOBSERVABLE,
    HeadingSource,
    MotionError,
    MotionRun,
)
from pipeline.sources import Vehicle

if TYPE_CHECKING:
    from pipeline.estimation.candidates import Candidate

FEWEST_WINDOWS = 20
"""Minimum number of windows of a fit: a model of several effects has about as many parameters."""
_MOST_FITS = 24
"""Number of cached fits of paths: more than the steps of a ladder of ten effects."""
_FEWEST_DIAGNOSED = 40
"""Half seconds of driving with poses that a diagnosis needs, over all of its runs: ten seconds, windows
overlapping."""
_LONG_S = 60.0
"""Shortest run that can show a change with time [s]: in a shorter one its start is what changes."""
_DRIVETRAIN = frozenset({Place.COMMAND, Place.DRIVE})


class DiagnosisError(SlipError):
    """A diagnosis that cannot be made, in one line."""


def _refuse_few(run: MotionRun, count: int) -> MotionError:
    """Error for a run with too few windows, with the reason."""
    periods = np.diff(run.track.times)
    rate = 1.0 / float(np.median(periods)) if periods.size else 0.0
    if 0.0 < rate < SLOW_HZ:
        return MotionError(
            "slow_poses",
            f"its poses come at {rate:.2g} Hz: at least {SLOW_HZ:g} Hz are needed",
            where=run.name,
            hint="Record a faster localization, or the transforms (/tf): the odometry in them fills the time "
            "between its poses.",
        )
    return MotionError(
        "too_short",
        f"the run has {count} stretches of half a second with live commands and good poses; "
        f"{FEWEST_WINDOWS} are needed",
        where=run.name,
        hint="Drive longer, or check the intervals and the pose topic with `slip inspect`.",
    )


class EstimationData:
    """Runs of one vehicle prepared for one input: what models are fitted to, and scored on.

    Building one is expensive; fitting and scoring models with it is cheap.

    Args:
        runs: one or several recordings of one vehicle.
        vehicle: geometry.
        source: input of the models.
        heading: source of the heading.

    Attributes:
        residuals_by_run: measured less predicted motion of each run.
        paths: paths on which parameters are fitted: the whole path, or if wheels are measured as well as
            commanded, the path from the wheels to the body and that from the command to the wheels.
        largest: the largest commands.
        exceeded: speeds that measured wheels exceed, see `measure_exceeded`.
        fits: cached fits of a path by their starts: models with commands and with measured wheels as input
            share the path after the wheels.

    Raises:
        MotionError: a run lacks the input, or has too little comparable data.
    """

    def __init__(
        self,
        runs: Sequence[MotionRun],
        vehicle: Vehicle,
        source: Input,
        *,
        heading: HeadingSource = HeadingSource.AUTO,
    ) -> None:
        require_compiler()
        self.runs = tuple(run.anchored for run in runs)
        self.vehicle = runs[0].correct_vehicle(vehicle)
        self.source = source
        self.heading = heading
        self.residuals_by_run = self._find_motion_residuals(source)
        counts = [run_residuals.windows.start.size for run_residuals in self.residuals_by_run]
        if sum(counts) < FEWEST_WINDOWS or 0 in counts:
            fewest = counts.index(min(counts))
            raise _refuse_few(self.runs[fewest], counts[fewest])
        self.largest = measure_largest(self.runs, self.vehicle)
        self.exceeded = measure_exceeded(self.runs, self.vehicle)
        self.fits = Newest[PathFit](_MOST_FITS)
        # A gyro determines the delay of the poses, one in any run for all; the remaining delay between poses
        # and wheels is that of the encoders.
        gyro = any(run_residuals.has_gyro for run_residuals in self.residuals_by_run)
        delays: tuple[DelayName, ...] = ("wheel_delay_s",) if gyro else ()
        self.paths: tuple[PathResiduals, ...]
        if source is Input.MEASURED:
            self.paths = (BodyResiduals(self.residuals_by_run, delays, whole=False),)
        elif any(run.wheels is None for run in self.runs):
            self.paths = (BodyResiduals(self.residuals_by_run),)
        else:
            self._measured = self._find_motion_residuals(Input.MEASURED)
            sideways = self.largest.sideways > 0.0
            self.paths = (
                BodyResiduals(self._measured, delays, whole=False),
                WheelResiduals(
                    self.residuals_by_run, self._measured, sideways=sideways, exceeded=self.exceeded
                ),
            )

    def _find_motion_residuals(self, source: Input) -> tuple[RunResiduals, ...]:
        rate = choose_rate(self.runs)
        return tuple(
            RunResiduals(run, self.vehicle, source, heading=self.heading, rate_hz=rate) for run in self.runs
        )

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
        return all(run_residuals.has_gyro for run_residuals in self.residuals_by_run)

    @cached_property
    def conditions(self) -> Conditions:
        """What the runs can show; every search looks at measured wheels where there are any."""
        encoders = self.has_encoders or self.is_drive_alone
        sampling = self.sampling_s if encoders else 0.0
        exceeded = self.exceeded
        slope = max(run_residuals.context.slope_rad for run_residuals in self.residuals_by_run)
        course = any(run.is_on_course for run in self.runs)
        bursts = any(run.in_bursts for run in self.runs)
        return Conditions(self.largest, encoders, self.has_gyro, sampling, exceeded, slope, course, bursts)

    @property
    def sampling_s(self) -> float:
        """Delay that sampled encoders may feign: a little more than half their period."""
        return 0.6 * max(run.wheel_period_s for run in self.runs)

    def list_candidates(self, source: Input) -> tuple[Candidate, ...]:
        """Effects that can be identified from an input of this vehicle."""
        if self.is_drive_alone:
            return self.list_drivetrain()
        hidden = _DRIVETRAIN if source is Input.MEASURED else frozenset()
        able = self._list_able()
        return tuple(cast("Candidate", one) for one in able if one.place not in hidden and not one.parts)

    def list_drivetrain(self) -> tuple[Candidate, ...]:
        """Effects between command and wheels."""
        return tuple(cast("Candidate", one) for one in self._list_able() if one.place in _DRIVETRAIN)

    def _list_able(self) -> list[type[Effect]]:
        """Effects of this kind of vehicle that its sensors and its driving may show."""
        of_kind = (effect for effect in list_effects() if self.vehicle.kind in effect.kinds)
        return [effect for effect in of_kind if self._can_show(effect())]

    def _can_show(self, effect: Effect) -> bool:
        if len(self.runs) > 1 and is_of_one_run(effect.parameters):
            return False
        is_long = max(run.duration_s for run in self.runs) >= _LONG_S
        return effect.can_show(self.conditions) and (is_long or Excitation.LONG not in effect.needs)

    @cached_property
    def behind_wheels(self) -> EstimationData:
        """The same runs with their measured wheels as input; prepared data are shared."""
        if self.source is Input.MEASURED:
            return self
        if len(self.paths) == 1:
            raise MotionError(
                "no_measured",
                "the run has no measured wheels to feed a model with",
                where=", ".join(self.names),
                hint="Choose the other input.",
            )
        data = self.with_paths(self.paths[:1])
        data.source, data.residuals_by_run = Input.MEASURED, self._measured
        return data

    def with_prior(self, numbers: Mapping[str, tuple[float, float]]) -> EstimationData:
        """The same runs with a prior on the parameters of a model.

        Args:
            numbers: mean and standard deviation by label ``effect.name``.
        """
        return self.with_paths(tuple(tie_prior(path, Prior(numbers)) for path in self.paths))

    def with_paths(self, paths: tuple[PathResiduals, ...]) -> EstimationData:
        """The same runs with other paths, without cached results of the former ones."""
        data = copy(self)
        for name in ("behind_wheels", "whole", "folds", "training", "conditions"):
            data.__dict__.pop(name, None)
        data.paths = paths
        return data

    @cached_property
    def whole(self) -> WindowResiduals:
        """Residuals of the whole path, from the input to the body, in windows: errors are measured there."""
        return WindowResiduals(self.residuals_by_run)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the runs."""
        return tuple(run.name for run in self.runs)

    @cached_property
    def folds(self) -> tuple[Fold, ...]:
        """Windows of the whole path that are held out in turn."""
        return make_folds(self.whole)

    @cached_property
    def training(self) -> tuple[tuple[Flags, ...], ...]:
        """Masks of the training steps, by fold and path."""
        return tuple(
            tuple(~find_near(path, self.whole, fold.test) for path in self.paths) for fold in self.folds
        )

    def start_state(self, known: ModelState | Sequence[Effect] = ()) -> ModelState:
        """A state to start from: that of a fit, or one without delays."""
        if isinstance(known, ModelState):
            return known
        return ModelState(tuple(known), (Timing(),) * len(self.runs))

    def active_effects(self, model: Model) -> tuple[Effect, ...]:
        """Effects that can act on one of the runs, see `RunResiduals.list_active`."""
        active = {
            one.id for run_residuals in self.residuals_by_run for one in run_residuals.list_active(model)
        }
        return tuple(effect for effect in model if effect.id in active)

    def find_residuals(self, state: ModelState) -> Floats:
        """Residuals of the whole path, all windows of all runs, shape (n, 3): x, y [m/s], w [rad/s]."""
        return self.whole.find_residuals(state)

    def find_run_residuals(self, state: ModelState, run: int) -> Floats:
        """Residuals of one run's windows."""
        return self.whole.find_run_residuals(state, run)


def prepare_data(runs: Sequence[MotionRun], vehicle: Vehicle, source: Input) -> EstimationData:
    """Prepare runs for a diagnosis.

    Raises:
        DiagnosisError: ``no_input``; ``too_short``, fewer than a quarter of a minute of driving can be
            compared.
    """
    where = ", ".join(run.name for run in runs)
    try:
        data = EstimationData(runs, vehicle, source)
    except MotionError as error:
        if error.code != f"no_{source.value}":
            raise
        other = Input.MEASURED if source is Input.COMMAND else Input.COMMAND
        what = f"there is no {'command' if source is Input.COMMAND else 'measured wheel'} to diagnose from"
        raise DiagnosisError("no_input", what, where=where, hint=f"Try --input {other.value}.") from error
    _require_alike(runs)
    windows = data.whole.run.size
    if windows < _FEWEST_DIAGNOSED:
        what = f"only {windows} stretches of half a second have both a live input and valid poses"
        hint = f"{_FEWEST_DIAGNOSED} are needed: drive longer, or check the poses with `slip inspect`."
        raise DiagnosisError("too_short", what, where=where, hint=hint)
    return data


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
