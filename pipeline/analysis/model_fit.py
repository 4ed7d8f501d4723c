"""A model fitted to runs, before and after a change: behind `slip model` and behind Python's `fit`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from pipeline.analysis.geometry import Owner, agree_on_vehicle
from pipeline.identification.describe import (
    correlations_as_json,
    errors_as_json,
    ladder_as_json,
    parameters_as_json,
    step_as_json,
)
from pipeline.identification.inputs import InputChoice, choose_input
from pipeline.identification.judgement import Judgement, judge_model, note_fit
from pipeline.identification.problem import Problem
from pipeline.identification.scoring import Errors, measure_by_terrain
from pipeline.models.model_file import ModelFile
from pipeline.report.motion_run import load_motion_run, load_vehicle
from pipeline.runs.recording import MotionRun
from pipeline.store import Manifest
from pipeline.vehicles import Vehicle


@dataclass(frozen=True)
class ModelFit:
    """A model on runs.

    Attributes:
        file: the model with the values found, their intervals, and what they were fitted on.
        before: how good the model was before the change; the same object as `after` where its effects stayed.
        after: how good it is.
        chosen: what it is fed with, and why.
    """

    file: ModelFile
    before: Judgement
    after: Judgement
    chosen: InputChoice

    @property
    def floor(self) -> Errors:
        """One floor for both ladders: it is the runs'."""
        return self.after.floor

    def to_json(self) -> dict[str, object]:
        """The keys of `slip model fit --json` that are the fit's own."""
        problem, whole = self.after.problem, self.after.whole
        return {
            "input": self.chosen.source.value,
            "input_reason": self.chosen.reason,
            "runs": list(problem.names),
            "ladder_before": ladder_as_json(self.before.ladder, self.floor),
            "ladder": ladder_as_json(self.after.ladder, self.floor),
            "step": step_as_json(self.before.whole, whole),
            "idle": list(self.after.ladder.idle),
            "not_fitted": list(self.chosen.idle),
            "by_run": {
                name: errors_as_json(errors)
                for name, errors in zip(problem.names, whole.held_out.by_run, strict=True)
            },
            "by_terrain": {
                terrain: errors_as_json(errors)
                for terrain, errors in measure_by_terrain(problem, whole.held_out).items()
            },
            "noise_floor": errors_as_json(self.floor),
            "parameters": parameters_as_json(self.after.fitted.model, self.after.estimates),
            "correlated": correlations_as_json(self.after.estimates),
            "timing": [
                {
                    "run": comparison.run.name,
                    "pose_delay_s": comparison.run.alignment.heading_delay_s,
                    "wheel_delay_s": timing.wheel_delay_s,
                    "latency_spread_s": comparison.run.alignment.latency_spread_s,
                    "outlier_s": comparison.run.alignment.outlier_s,
                }
                for comparison, timing in zip(
                    problem.comparisons, self.after.fitted.state.timing, strict=True
                )
            ],
        }


def read_runs(
    manifests: Sequence[Manifest], vehicle: Vehicle | None, owner: Owner | None
) -> tuple[Vehicle, list[MotionRun]]:
    """Stored runs, read with one vehicle's geometry.

    Args:
        manifests: of the runs, at least one.
        vehicle: of the model; None for that of the first run.
        owner: whose geometry counts where the run's is another one.

    Returns:
        The vehicle that counts, and the runs.

    Raises:
        SlipError: a run has no poses, or its vehicle contradicts the model's.
    """
    known = {manifest.run: load_vehicle(manifest) for manifest in manifests}
    chosen = agree_on_vehicle(vehicle or next(iter(known.values())), known, owner)
    return chosen, [load_motion_run(manifest, chosen) for manifest in manifests]


def fit_to_runs(
    before: ModelFile,
    after: ModelFile,
    runs: Sequence[MotionRun],
    source: str | None,
    tie: Callable[[Problem], Problem] | None = None,
) -> ModelFit:
    """Judge a model before and after a change, and fit it.

    Args:
        before: as it was.
        after: as it is to be fitted, with the vehicle whose geometry counts.
        runs: what it is fitted to.
        source: `command` or `measured`; None chooses.
        tie: adds to the problem what is known of the numbers beforehand.

    Raises:
        MotionError: the runs lack the input, or are too short.
    """
    chosen = choose_input(runs, source, after.model, last=before.last_input)
    problem = Problem(runs, after.model.vehicle, chosen.source)
    if tie is not None:
        problem = tie(problem)
    same_vehicle = replace(before.model, vehicle=after.model.vehicle)
    old = new = judge_model(problem, same_vehicle, per_run=before.per_run)
    if after.model.effects != before.model.effects:
        new = judge_model(problem, after.model, per_run=after.per_run)
    return ModelFit(note_fit(after, new), old, new, chosen)
