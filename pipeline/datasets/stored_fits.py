"""Models fitted to stored runs, and contests of models with those of the literature."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pipeline.core import JSON_DIGITS, NORMAL_95, finite_or_none
from pipeline.datasets.compared_runs import find_run_refusal
from pipeline.datasets.fleet import expect_here
from pipeline.datasets.pooling import ComparisonError
from pipeline.estimation.additions import explain_refusals
from pipeline.estimation.estimation_data import EstimationData
from pipeline.estimation.held_out import measure_by_terrain
from pipeline.estimation.ladder import Ladder, ModelAssessment, assess_model, note_fit
from pipeline.estimation.odometry_noise import measure_alphas
from pipeline.estimation.rivals import (
    Contest,
    contest_as_json,
    hold_contest,
    judge_rival,
)
from pipeline.estimation.run_residuals import Input, InputChoice, choose_input
from pipeline.models import Effect, Model, ModelFile, Number, cut_interval, find_effect, list_models
from pipeline.results import ERRORS_OVER_2S, Errors, as_written, list_rises, to_json
from pipeline.run import MotionError, MotionRun, cut_run, find_driven, load_motion_run
from pipeline.sources import Owner, Vehicle, agree_on_vehicle, load_vehicle
from pipeline.store import Manifest, Store


@dataclass(frozen=True)
class ModelFit:
    """A model fitted to runs.

    Attributes:
        file: the model with the estimates, their intervals, and the runs of the fit.
        before: quality of the model before the change; the same object as `after` if no effect changed.
        after: quality of the fitted model.
        chosen: input of the model, and the reason for it.
    """

    file: ModelFile
    before: ModelAssessment
    after: ModelAssessment
    chosen: InputChoice

    @property
    def floor(self) -> Errors:
        """Noise floor of the runs, the same for both ladders."""
        return self.after.floor

    def explain_refusals(self) -> dict[str, str]:
        """Why added effects would not be accepted, by id; empty where they would."""
        after = self.after.whole
        return explain_refusals(after, set(after.effects).difference(self.before.whole.effects))

    def list_numbers(self) -> dict[str, Number]:
        """The numbers of the effects that were fitted, by label."""
        ids = self.after.fitted.model.ids
        return {
            label: number
            for label, number in self.file.list_numbers().items()
            if label.partition(".")[0] in ids
        }

    def list_prior(self) -> dict[str, Number]:
        """What was known of the numbers before the fit, by label."""
        numbers = {}
        for label, (mean, deviation) in self.after.data.paths[0].prior.numbers.items():
            effect, _, name = label.partition(".")
            half = NORMAL_95 * deviation
            parameter = find_effect(effect)().parameter(name)
            ends = cut_interval(mean - half, mean + half, parameter.bounds)
            numbers[label] = Number(mean, *ends, parameter.unit)
        return numbers

    def to_json(self) -> dict[str, object]:
        """The keys of `slip model fit --json` that the fit provides."""
        data, before, after = self.after.data, self.before.whole, self.after.whole
        return {
            "input": self.chosen.source.value,
            "input_reason": self.chosen.reason,
            "runs": list(data.names),
            "ladder_before": _list_steps(self.before.ladder, self.floor),
            "ladder": _list_steps(self.after.ladder, self.floor),
            "step": {
                "effects": [list(one.effects) for one in (before, after)],
                **{
                    key: [finite_or_none(as_written(one.errors, key)) for one in (before, after)]
                    for key in ERRORS_OVER_2S
                },
                "rises": list(list_rises(before.errors, after.errors)),
            },
            "refused": self.explain_refusals(),
            "idle": list(self.after.ladder.idle),
            "not_fitted": list(self.chosen.idle),
            "by_run": {
                name: to_json(errors) for name, errors in zip(data.names, after.held_out.by_run, strict=True)
            },
            "by_terrain": {
                terrain: to_json(errors)
                for terrain, errors in measure_by_terrain(data, after.held_out).items()
            },
            "noise_floor": to_json(self.floor),
            "parameters": {label: number.to_json() for label, number in self.list_numbers().items()},
            "own": [
                {"run": run, "parameter": label, **number.to_json()}
                for label, by_run in self.file.list_own().items()
                for run, number in by_run.items()
            ],
            "prior": {label: number.to_json() for label, number in self.list_prior().items()},
            "correlated": [
                {"parameters": [one.label, other.label], "correlation": finite_or_none(value, JSON_DIGITS)}
                for one, other, value in self.after.estimates.list_correlated()
            ],
            "timing": [
                {
                    "run": run_residuals.run.name,
                    "pose_delay_s": run_residuals.run.alignment.heading_delay_s,
                    "wheel_delay_s": timing.wheel_delay_s,
                    "latency_spread_s": run_residuals.run.alignment.latency_spread_s,
                    "outlier_s": run_residuals.run.alignment.outlier_s,
                }
                for run_residuals, timing in zip(
                    data.residuals_by_run, self.after.fitted.state.timing, strict=True
                )
            ],
        }


def _list_steps(ladder: Ladder, floor: Errors) -> list[dict[str, object]]:
    """Steps of a ladder as JSON: the effects first, `rises` where an error rises."""
    return [
        {"effects": list(step.effects), **{key: value for key, value in to_json(step).items() if value != []}}
        for step in ladder.as_result(floor)
    ]


def read_runs(
    manifests: Sequence[Manifest], vehicle: Vehicle | None, owner: Owner | None
) -> tuple[Vehicle, list[MotionRun]]:
    """Load stored runs with the geometry of one vehicle.

    Args:
        manifests: manifests of the runs, at least one.
        vehicle: vehicle of the model; None for that of the first run.
        owner: whose geometry to use if that of a run differs.

    Returns:
        The vehicle that is used, and the runs.

    Raises:
        SlipError: a run has no poses, its vehicle contradicts the model's, or no fit to it has a meaning.
    """
    for manifest in manifests:
        if refusal := find_run_refusal(manifest):
            hint = "No fit to it has a meaning: give other runs."
            raise ComparisonError("no_fit", refusal, where=manifest.run, hint=hint)
    known = {manifest.run: load_vehicle(manifest) for manifest in manifests}
    chosen = agree_on_vehicle(vehicle, known, owner)
    return chosen, [load_motion_run(manifest, chosen) for manifest in manifests]


def put_on_runs(
    file: ModelFile, manifests: Sequence[Manifest], owner: Owner | None
) -> tuple[ModelFile, list[MotionRun]]:
    """A model with the vehicle whose geometry is used, and the runs, as `read_runs` loads them."""
    vehicle, runs = read_runs(manifests, file.model.vehicle, owner)
    return replace(file, model=replace(file.model, vehicle=vehicle)), runs


def fit_to_runs(
    before: ModelFile,
    after: ModelFile,
    runs: Sequence[MotionRun],
    source: str | None,
    *,
    first_s: float | None = None,
    fleet: Store | None = None,
) -> ModelFit:
    """Fit a model, and evaluate it before and after a change.

    Args:
        before: the model before the change.
        after: the model to fit, with the vehicle whose geometry is used.
        runs: runs to fit it to.
        source: `command` or `measured`; None chooses.
        first_s: fit to the first seconds of driving of each run; None for all of them.
        fleet: results whose other runs of the vehicle are a prior of its numbers; None for none.

    Raises:
        MotionError: the runs lack the input, or are too short; ``not_fitted``, an added effect cannot act.
        SlipError: there is no fleet, or ``several_terrains``.
    """
    if first_s is not None:
        runs = [cut_run(run, end_s=find_driven(run, first_s)) for run in runs]
    chosen = choose_input(runs, source, after.model, last=before.last_input)
    _require_fitted([effect for effect in after.model if effect.id not in before.model.ids], runs, chosen)
    data = EstimationData(runs, after.model.vehicle, chosen.source)
    if fleet is not None:
        data = data.with_prior(expect_here(runs, after.model.vehicle.id, chosen.source.value, fleet).prior)
    known = replace(before.model, vehicle=after.model.vehicle)
    old = new = assess_model(data, known, per_run=before.per_run)
    if after.model.effects != known.effects:
        new = assess_model(data, after.model, per_run=after.per_run)
    if not {*known.ids} <= {*after.model.ids}:
        # Beside an effect that is gone, values may have come to be where those of the rest alone never lead.
        bare = after.model.swap(*(effect.unfitted for effect in after.model))
        again = assess_model(data, bare, per_run=after.per_run)
        new = min(new, again, key=lambda one: one.fitted.score)
    noted = note_fit(after, new)
    said = {"first_s": first_s, "prior": None if fleet is None else "fleet"}
    fit = {**noted.fit, **{key: value for key, value in said.items() if value is not None}}
    return ModelFit(replace(noted, fit=fit), old, new, chosen)


def expect_model(
    manifests: Sequence[Manifest], source: str | None, fleet: Store, owner: Owner | None = None
) -> ModelFile:
    """The model that the other runs of a fleet expect for the vehicle and the ground of runs.

    Raises:
        SlipError: runs are of several vehicles or terrains, or there is no fleet.
    """
    vehicle, runs = read_runs(manifests, None, owner)
    chosen = choose_input(runs, source)
    return ModelFile(Model(vehicle, expect_here(runs, vehicle.id, chosen.source.value, fleet).effects))


def judge_measured(file: ModelFile, manifests: Sequence[Manifest]) -> ModelFile:
    """A model fitted to runs with their measured wheels as input, and AMCL's alphas of each step.

    Args:
        file: the model, as `slip model fit --input measured` would write it.
        manifests: the runs.

    Raises:
        SlipError: a run has no measured wheels, or its vehicle contradicts the model's.
    """
    file, runs = put_on_runs(file, manifests, None)
    data = EstimationData(runs, file.model.vehicle, Input.MEASURED)
    assessment = assess_model(data, file.model, per_run=file.per_run)
    noted = note_fit(file, assessment)
    steps = zip(noted.list_fitted("ladder"), assessment.ladder.steps, strict=True)
    ladder = [{**row, "odometry_alphas": measure_alphas(data, step.fitted)} for row, step in steps]
    return replace(noted, fit={**noted.fit, "ladder": ladder})


def _require_fitted(added: Sequence[Effect], runs: Sequence[MotionRun], chosen: InputChoice) -> None:
    """Refuse to add effects that the runs cannot give a value, which would be written neutral."""
    unfit = choose_input(runs, chosen.source.value, added)
    if unfit.idle:
        what = f"{unfit.warning}; the model is unchanged"
        hint = "Fit it to a log and an input on which it acts, or choose another effect."
        raise MotionError("not_fitted", what, where=", ".join(unfit.idle), hint=hint)


@dataclass(frozen=True)
class ModelContest:
    """Comparison of models on runs.

    Attributes:
        contest: the models with their held-out errors.
        chosen: input of the models, and the reason for it.
        runs: names of the runs.
    """

    contest: Contest
    chosen: InputChoice
    runs: tuple[str, ...]

    def to_json(self) -> dict[str, object]:
        """The keys of `slip model compare --against --json` that the comparison provides."""
        return {
            "input": self.chosen.source.value,
            "input_reason": self.chosen.reason,
            "runs": list(self.runs),
            **contest_as_json(self.contest),
        }


def contest_models(
    files: Mapping[str, ModelFile],
    runs: Sequence[MotionRun],
    vehicle: Vehicle,
    source: str | None = None,
) -> ModelContest:
    """Fit models and those of the literature to runs, and score each on held-out stretches of ten seconds.

    Args:
        files: the user's models by name; their values are the start of the fit.
        runs: runs of one vehicle.
        vehicle: vehicle whose geometry is used.
        source: `command` or `measured`; None chooses.

    Raises:
        SlipError: a run lacks the input or is too short.
        ComparisonError: ``name_taken``: a model of the user has the name of another model of the comparison.
    """
    known = {model.name: model.make(vehicle) for model in list_models(vehicle)}
    if taken := files.keys() & known.keys():
        what = f"{', '.join(sorted(taken))} is the name of a model that yours is compared with"
        raise ComparisonError("name_taken", what, hint="Give yours another name.")
    last = {file.last_input for file in files.values()}
    effects = [effect for file in files.values() for effect in file.model]
    chosen = choose_input(runs, source, effects, last=last.pop() if len(last) == 1 else None)
    data = EstimationData(runs, vehicle, chosen.source)
    rivals = [
        judge_rival(data, name, replace(file.model, vehicle=vehicle), file.per_run)
        for name, file in files.items()
    ]
    rivals += [judge_rival(data, name, model) for name, model in known.items()]
    return ModelContest(hold_contest(data, rivals), chosen, data.names)
