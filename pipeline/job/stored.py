"""Stored runs, models fitted to them, and the comparison with models of the literature."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import msgspec

from pipeline.core.program import SlipError
from pipeline.estimation.additions import explain_refusals
from pipeline.estimation.comparison import InputChoice, choose_input
from pipeline.estimation.describe import (
    correlations_as_json,
    ladder_as_json,
    parameters_as_json,
    step_as_json,
)
from pipeline.estimation.folds import Errors, errors_as_json, measure_by_terrain
from pipeline.estimation.ladder import Judgement, judge_model, note_fit
from pipeline.estimation.learned import judge_learned, list_learners
from pipeline.estimation.learned_step import judge_learned_term, judge_with_term
from pipeline.estimation.problem import Problem
from pipeline.estimation.rivals import (
    Contest,
    contest_as_json,
    format_contest,
    hold_contest,
    judge_fit,
    judge_rival,
    time_fit,
)
from pipeline.job import INPUTS, JobError, Options
from pipeline.job.analyze import SUMMARY, analyze_log, update_datasets
from pipeline.job.keys import Owner, agree_on_vehicle, find_recorded_log, find_run
from pipeline.job.log_setup import name_run, set_up_log
from pipeline.job.work import Progress, stored_contexts
from pipeline.logs import hash_log, list_files
from pipeline.models.learned_term import drop_learned, find_learned
from pipeline.models.literature import list_models
from pipeline.models.model_file import ModelFile
from pipeline.report.motion_view import load_motion_run, load_vehicle
from pipeline.run import MotionRun
from pipeline.sources import Vehicle
from pipeline.store import LogIdentities, Manifest, Store


@dataclass(frozen=True)
class OpenedRun:
    """An opened run.

    Attributes:
        manifest: its results.
        lossy: whether the run was opened by its log and the log had losses.
        note: warning that the log's current configuration would give other results; else empty.
    """

    manifest: Manifest
    lossy: bool = False
    note: str = ""


@contextmanager
def open_run(text: str, options: Options, progress: Progress) -> Iterator[OpenedRun]:
    """Open the results of a log or of a stored run; stored results are never changed.

    If complete results exist for the content of a log, they are used as they are. With other options
    (`--vehicle`, `--config`, ...), the log is analyzed again in a temporary folder. A log without results is
    analyzed and stored.

    Args:
        text: name of a run, or path of a log.
        options: options of the user; results always have both inputs.
        progress: callback, called with the name of each stage that is computed.

    Raises:
        SlipError: the log cannot be read, or there is no such run.
    """
    store = Store(options.out)
    path = Path(text)
    chosen = bool(options.overrides) or options.config is not None
    if path.exists():
        stored = _find_stored(path, store)
    else:
        stored = _find_named(text, path, store)
        if stored is not None and not chosen:
            yield OpenedRun(stored)
            return
        hint = f"Other choices than the run's need it: give its path, or ask about {text} without them."
        path = path if stored is None else find_recorded_log(stored, hint=hint)
    if stored is None and options.inputs != INPUTS:
        # Raises the error of a missing input before anything is computed.
        set_up_log(path, options)
    options = replace(options, inputs=INPUTS)
    if stored is None:
        outcome = analyze_log(path, options, progress)
        if outcome.computed:
            update_datasets(store)
        yield OpenedRun(outcome.manifest, outcome.lossy)
        return
    changed = _is_changed(path, stored, options, asked=chosen)
    if changed and chosen:
        with tempfile.TemporaryDirectory(prefix="slip-") as folder:
            aside = replace(options, out=Path(folder), run=stored.run, report=False, diagnosis=False)
            outcome = analyze_log(path, aside, progress)
            yield OpenedRun(outcome.manifest, outcome.lossy)
        return
    note = (
        f"{stored.run} is read as it was analyzed, with other options or another configuration than now; "
        f"slip analyze {text} recomputes it"
    )
    lossy = bool(stored_contexts(stored).get("extract", {}).get("losses"))
    yield OpenedRun(stored, lossy, note if changed else "")


def _find_stored(path: Path, store: Store) -> Manifest | None:
    """The complete results of a log's content; None if there are none."""
    sha256 = LogIdentities(store).lookup(path)
    if sha256 is None:
        size = sum(part.stat().st_size for part in (list_files(path) if path.is_dir() else [path]))
        # Hashing reads the whole log: only if a stored log has the same size.
        if all(manifest.part("log").get("bytes") != size for manifest in store.survey().manifests):
            return None
        sha256 = hash_log(path)
    manifest = store.manifest(name_run(path, sha256, store))
    if manifest is None or manifest.part("log").get("sha256") != sha256 or SUMMARY not in manifest.files:
        return None
    return manifest


def _find_named(text: str, path: Path, store: Store) -> Manifest | None:
    """The results of that name; None if it is the path of a log that does not exist."""
    known = {manifest.run: manifest for manifest in store.survey().manifests}
    if text in known:
        return known[text]
    return None if path.suffix else find_run(text, store)


def _is_changed(path: Path, stored: Manifest, options: Options, *, asked: bool) -> bool:
    """Whether an analysis would now use another vehicle or configuration."""
    try:
        setup = set_up_log(path, options)
    except SlipError:
        if asked:
            raise
        # Without the options of its analysis, the log alone may be insufficient.
        return False
    now = {
        "configuration": msgspec.to_builtins(setup.configuration),
        "vehicle": msgspec.to_builtins(setup.vehicle),
        "terrain": setup.terrain,
        "dataset": setup.dataset,
        "inputs": options.inputs,
    }
    return any(stored.details.get(key) != value for key, value in json.loads(json.dumps(now)).items())


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
    before: Judgement
    after: Judgement
    chosen: InputChoice

    @property
    def floor(self) -> Errors:
        """Noise floor of the runs, the same for both ladders."""
        return self.after.floor

    def explain_refusals(self) -> dict[str, str]:
        """Reasons why added effects do not reduce the held-out error, by id; empty if they do."""
        before, after = self.before.whole, self.after.whole
        return explain_refusals(self.after.problem, before, after, lambda: self.file.intervals)

    def to_json(self) -> dict[str, object]:
        """The keys of `slip model fit --json` that the fit provides."""
        problem, whole = self.after.problem, self.after.whole
        return {
            "input": self.chosen.source.value,
            "input_reason": self.chosen.reason,
            "runs": list(problem.names),
            "ladder_before": ladder_as_json(self.before.ladder, self.floor),
            "ladder": ladder_as_json(self.after.ladder, self.floor),
            "step": step_as_json(self.before.whole, whole),
            "refused": self.explain_refusals(),
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
    """Load stored runs with the geometry of one vehicle.

    Args:
        manifests: manifests of the runs, at least one.
        vehicle: vehicle of the model; None for that of the first run.
        owner: whose geometry to use if that of a run differs.

    Returns:
        The vehicle that is used, and the runs.

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
    """Fit a model, and evaluate it before and after a change.

    Args:
        before: the model before the change.
        after: the model to fit, with the vehicle whose geometry is used.
        runs: runs to fit it to.
        source: `command` or `measured`; None chooses.
        tie: function that adds prior knowledge of the parameters to the problem.

    Raises:
        MotionError: the runs lack the input, or are too short.
    """
    chosen = choose_input(runs, source, after.model, last=before.last_input)
    problem = Problem(runs, after.model.vehicle, chosen.source)
    if tie is not None:
        problem = tie(problem)
    known, physics = (drop_learned(model) for model in (before.model, after.model))
    old = new = judge_model(problem, replace(known, vehicle=physics.vehicle), per_run=before.per_run)
    if physics.effects != known.effects:
        new = judge_model(problem, physics, per_run=after.per_run)
    if find_learned(after.model) is not None:
        # The residual of the physical model has changed: train the learned term again.
        new = judge_learned_term(new)
    return ModelFit(note_fit(after, new), old, new, chosen)


Against = Literal["literature", "learned"]


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

    def format_lines(self) -> list[str]:
        """The table for the screen."""
        return format_contest(self.contest)


def contest_models(
    files: Mapping[str, ModelFile],
    runs: Sequence[MotionRun],
    vehicle: Vehicle,
    against: Sequence[Against],
    source: str | None = None,
) -> ModelContest:
    """Fit all models to runs, and score each on held-out stretches of ten seconds.

    Args:
        files: the user's models by name; their values are the start of the fit.
        runs: runs of one vehicle.
        vehicle: vehicle whose geometry is used.
        against: `literature`, `learned`, or both; the ideal model is always included.
        source: `command` or `measured`; None chooses.

    Raises:
        SlipError: a run lacks the input or is too short, or scikit-learn is not installed.
        JobError: ``name_taken``: a model of the user has the name of another model of the comparison.
    """
    learners = list_learners() if "learned" in against else ()
    known = {model.name: model.make(vehicle) for model in list_models(vehicle)}
    if taken := files.keys() & {*known, *(learner.name for learner in learners)}:
        what = f"{', '.join(sorted(taken))} is the name of a model that yours is compared with"
        raise JobError("name_taken", what, hint="Give yours another name.")
    last = {file.last_input for file in files.values()}
    effects = [effect for file in files.values() for effect in file.model]
    chosen = choose_input(runs, source, effects, last=last.pop() if len(last) == 1 else None)
    problem = Problem(runs, vehicle, chosen.source)
    rivals = [
        judge_with_term(problem, name, replace(file.model, vehicle=vehicle), file.per_run)
        for name, file in files.items()
    ]
    ideal, fit_s = time_fit(problem, known.pop("ideal"))
    rivals.append(judge_fit(problem, "ideal", ideal, fit_s))
    if "literature" in against:
        rivals += [judge_rival(problem, name, model) for name, model in known.items()]
    rivals += [judge_learned(problem, ideal, learner) for learner in learners]
    return ModelContest(hold_contest(problem, rivals), chosen, problem.names)
