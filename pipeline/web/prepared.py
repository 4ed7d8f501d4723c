"""A run that is prepared in memory: models are fitted to it, judged and drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
import polars as pl

from pipeline.core import Newest
from pipeline.estimation import Estimates, EstimationData, Input, ModelState, choose_input
from pipeline.estimation.apportion import apportion, find_half
from pipeline.estimation.error_regions import map_errors, pick_regions
from pipeline.estimation.floor import estimate_floor
from pipeline.estimation.held_out import score
from pipeline.estimation.intervals import NOTHING, estimate_intervals
from pipeline.estimation.ladder import LadderStep, ModelAssessment, judge_whole, note_fit
from pipeline.estimation.largest import measure_asked
from pipeline.estimation.prediction import predict_at_from
from pipeline.models import Asked, Model, ModelFile, Timing
from pipeline.report.motion_view import MotionStage, MotionView
from pipeline.results import Errors, RunDiagnosis, SlipBudget, Step, list_excess
from pipeline.run import HORIZON_S, MotionRun, load_motion_run
from pipeline.sources import Vehicle, load_vehicle
from pipeline.store import Manifest
from pipeline.web.figures import Figures, Shown
from pipeline.words import describe_region

_MOST_FITS = 60


@dataclass(frozen=True)
class FittedModel:
    """A fitted model with its held-out errors; its intervals are computed once asked for."""

    step: LadderStep

    @cached_property
    def estimates(self) -> Estimates:
        """Parameters with their 95 % intervals."""
        return estimate_intervals(self.step.fitted) if self.step.effects else NOTHING


@dataclass(frozen=True, eq=False)
class PreparedRun:
    """One run with one input, prepared for fits and figures.

    Attributes:
        manifest: the run's results.
        vehicle: vehicle that it was analyzed with.
        run: the run as arrays.
        data: the estimation data.
        stage: data of the rows to draw.
        figures: its figures.
    """

    manifest: Manifest
    vehicle: Vehicle
    run: MotionRun
    data: EstimationData
    stage: MotionStage
    figures: Figures
    _fits: Newest[FittedModel] = field(default_factory=lambda: Newest(_MOST_FITS))

    @property
    def inputs(self) -> list[str]:
        """Available inputs for models of the run, the default first."""
        there = {Input.COMMAND: self.run.commands, Input.MEASURED: self.run.wheels}
        return [source.value for source, signals in there.items() if signals is not None]

    @cached_property
    def asked(self) -> Asked:
        """The largest motion that the run asks for."""
        return measure_asked([self.run], self.vehicle)

    @cached_property
    def floor(self) -> Errors:
        """The noise floor of the run, by what the ideal model shows."""
        return estimate_floor(self.data)

    def judge(self, model: Model) -> FittedModel:
        """Fit a model and score it on held-out data.

        Effects at neutral values are fitted by a search; the others start from their present values.
        """
        return self._fits.recall(model.effects, lambda: FittedModel(judge_whole(self.data, model)))

    def measure_errors(self, model: Model) -> Errors:
        """Held-out errors of a model, fitted."""
        return self.judge(model).step.errors

    def remember(self, model: Model, judged: FittedModel) -> None:
        """Keep the fit of a model also for the model with the fitted values."""
        self._fits.keep(model.effects, judged)

    def find_fit(self, model: Model) -> FittedModel | None:
        """The known fit that gave a model its present values; None if none did."""
        known = self._fits.find(model.effects)
        return (
            known if known is not None and _list_keys(known.step.fitted.model) == _list_keys(model) else None
        )

    def score(self, model: Model, wheel_delay_s: float) -> Errors:
        """Errors of a model with its present values: held out where a fit gave these, else as they are."""
        known = self.find_fit(model)
        if known is not None:
            return known.step.errors
        return score(self.data, ModelState(model.effects, (Timing(wheel_delay_s),))).pooled

    def note_fit(self, file: ModelFile) -> ModelFile:
        """A model file with the data of its fit to this run, if a fit to it gives these values."""
        noted = note_fit(file, self._assess(file.model))
        return noted if _list_keys(noted.model) == _list_keys(file.model) else file

    def show(self, model: Model, wheel_delay_s: float, ladder: Sequence[Step], floor: Errors) -> Shown:
        """Prepare a model with its present values for the figures."""
        state = ModelState(model.effects, (Timing(wheel_delay_s),))
        whole, run_residuals = self.data.whole, self.data.residuals_by_run[0]
        residual = whole.find_residuals(state)
        regions = map_errors(whole, residual, whole.find_places())
        view = self.stage.view(state, ladder, floor)
        return Shown(
            view=view,
            largest=_find_largest(view),
            where=[describe_region(one) for one in pick_regions(regions, residual, whole.noise)],
            predict=partial(predict_at_from, run_residuals, state.effects_of(0), state.timing[0]),
            apportion=partial(self._apportion, model),
        )

    def _assess(self, model: Model) -> ModelAssessment:
        judged = self.judge(model)
        return ModelAssessment(self.data, judged.step, judged.estimates)

    def _apportion(self, model: Model, length_scale_m: float) -> Sequence[SlipBudget]:
        """Budgets by cause of a model, after fitting it; empty for the ideal model."""
        assessment = self._assess(model)
        return apportion(assessment, length_scale_m=length_scale_m) if assessment.whole.effects else ()


def prepare_run(manifest: Manifest, source: str | None) -> PreparedRun:
    """Prepare a run for models of an input; None takes the default.

    Raises:
        MotionError: the run has too few data to compare.
    """
    vehicle = load_vehicle(manifest)
    run = load_motion_run(manifest, vehicle)
    data = EstimationData([run], vehicle, choose_input([run], source).source)
    velocities = manifest.read("velocities") if "velocities" in manifest.tables else None
    figures = Figures(manifest, data.source.value)
    return PreparedRun(manifest, vehicle, run, data, MotionStage(data, velocities), figures)


def _find_largest(view: MotionView) -> tuple[float, float] | None:
    """The span with the largest part of the squared error that is furthest above its noise floor."""
    excess = list_excess(RunDiagnosis(ladder=(view.ladder[-1],), noise_floor=view.floor))
    is_heading = excess and max(excess, key=excess.__getitem__) == "r_mrmse_rad"
    known = view.horizon_errors.select("t", error="model_yaw" if is_heading else "model")
    known = known.filter(pl.col("error").is_finite())
    if known.is_empty():
        return None
    # Predictions are numbered by the middle of their 2 s.
    number = np.floor((known["t"].to_numpy() + 0.5 * HORIZON_S) / HORIZON_S).astype(np.int64)
    start, end, _ = find_half(number, np.square(known["error"].to_numpy()))[1][0]
    return start, end


def _list_keys(model: Model) -> list[object]:
    return [effect.rounded.key for effect in model.effects]
