"""Verbs on effects and viewers: diagnose, effects, export."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from pipeline import estimation, models, sources, words
from pipeline.analysis import Options
from pipeline.cli.conventions import (
    All,
    Choices,
    Limit,
    MemoryLimit,
    OwnEffects,
    Results,
    build_options,
    exit_code,
    open_shown,
    print_error,
    print_json,
    print_lines,
    print_note,
    print_result,
    show_progress,
    spell_choices,
    spell_flags,
    summarize_error,
)
from pipeline.core import INPUTS, SlipError, resolve_inside

if TYPE_CHECKING:
    from pipeline.results import RunDiagnosis
    from pipeline.store import Manifest


def diagnose(  # noqa: D417 - the shared choices document themselves
    logs: Annotated[list[str], Parameter(help="logs, folders of logs, or runs of the results folder")],
    /,
    *,
    choices: Annotated[Choices, Parameter(name="*")] = Choices(),  # noqa: B008 - frozen
    model: Annotated[
        Path | None, Parameter(help="model that is known: only effects beyond it are estimated")
    ] = None,
    effects: OwnEffects = None,
    vehicle_of: Annotated[
        Literal["model", "run"] | None,
        Parameter(help="geometry to use where the run is of another vehicle than --model"),
    ] = None,
    apply: Annotated[Path | None, Parameter(help="write the proposed model to this file")] = None,
    limit: Limit,
    budget: str | None = None,
    everything: All = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Identify the physical effects that the model of a vehicle lacks.

    From one run, or from several of one vehicle jointly: all that are given, or that a folder holds.

    Args:
        budget: CPU time that a search may take, for example 60s; after it the best answer so far is given. By
            default it takes as long as it needs.
        everything: show all of the summary: where the error is, budget, limits, causes, ranges between runs.
        json: print one JSON object instead of the summary.
        quiet: print no progress and no summary.
    """
    if apply is not None:
        models.check_target(apply)
    models.load_effects(effects or ())
    known = None if model is None else models.read_model(model)
    budget_s = None if budget is None else estimation.parse_budget(budget)
    diagnosed = Diagnosed(limit)

    def conclude(error: SlipError) -> None:
        if json:
            row = summarize_error(error.where, error)
            print_json({**diagnosed.to_json(), "errors": [row]})

    limit.conclude = conclude
    diagnose_logs(diagnosed, logs, build_options(choices), known, vehicle_of, budget_s, quiet=quiet or json)
    if apply is not None:
        diagnosed.errors += _apply(diagnosed.answers, apply, quiet=quiet or json)
    if json:
        print_json(diagnosed.to_json())
    elif not quiet:
        chosen = {"model": model, "vehicle_of": vehicle_of, "memory": limit.given, "budget": budget}
        said = spell_choices(choices) + spell_flags(chosen)
        said += "".join(spell_flags({"effects": path}) for path in effects or ())
        print_lines(diagnosed.list_lines(logs, said, apply, everything=everything))
    return diagnosed.end(quiet=quiet)


@dataclass
class Diagnosed:
    """Diagnoses of logs as they come.

    Attributes:
        limit: memory limit; its `at_work` names the current log.
        answers: one for runs that were judged together.
        errors: errors as JSON objects; each affects only one log.
        lossy: logs with losses.
    """

    limit: MemoryLimit = field(default_factory=MemoryLimit)
    answers: list[_Answer] = field(default_factory=list)
    errors: list[dict[str, str]] = field(default_factory=list)
    lossy: list[str] = field(default_factory=list)

    @property
    def runs(self) -> list[RunDiagnosis]:
        """The diagnosis of every run."""
        return [run for answer in self.answers for run in answer.runs]

    def to_json(self) -> dict[str, object]:
        """The object of `slip diagnose --json`."""
        chosen = {one.manifest.run: one.choices for answer in self.answers for one in answer.opened}
        runs = [{**words.diagnosis_as_json(run), **chosen[run.run]} for run in self.runs]
        return {"runs": runs, "errors": self.errors}

    def list_lines(
        self, given: Sequence[str], said: str, applied: Path | None = None, *, everything: bool = False
    ) -> list[str]:
        """Lines for a screen, each answer with the next command, which repeats the flags that were said."""
        lines = []
        for answer in self.answers:
            names = [run.run for run in answer.runs]
            if len(given) < len(names) and len(self.answers) == 1:
                names = list(given)  # a folder is shorter than what it holds
            applying = f"slip diagnose {' '.join(map(shlex.quote, names))}{said} --apply model.toml"
            following = _suggest_next(answer.runs, applying, applied)
            lines += words.describe(answer.runs, following, everything=everything).splitlines()
        return lines

    def end(self, *, quiet: bool) -> int:
        """Return the exit code, and print a note if nothing else explains why it is not 0."""
        from pipeline.results import find_refusal  # noqa: PLC0415 - heavy

        if self.lossy and not quiet:
            listed = f"(slip inspect {self.lossy[0]} lists them)"
            print_note(f"logs with losses: {', '.join(self.lossy)} {listed}")
        is_excluded = any(find_refusal(run.findings) for run in self.runs)
        return exit_code(self.errors, lossy=bool(self.lossy) or is_excluded)


def diagnose_logs(
    diagnosed: Diagnosed,
    logs: Sequence[str],
    options: Options,
    known: models.ModelFile | None = None,
    owner: sources.Owner | None = None,
    budget_s: float | None = None,
    *,
    quiet: bool,
) -> None:
    """Diagnose logs, folders of logs or stored runs, those of one vehicle jointly.

    Args:
        diagnosed: receives the answers, and what could not be answered.
        logs: logs, folders of logs, or names of runs.
        options: of the analyses.
        known: model that is known; only effects beyond it are estimated.
        owner: whose geometry is used where vehicles differ.
        budget_s: CPU time of a search [s]; None for as much as it needs.
        quiet: print no progress.
    """
    diagnosed.limit.at_work = logs[0]
    from pipeline.batch.recordings import list_named  # noqa: PLC0415 - heavy

    opened: dict[str, _Opened] = {}
    # A diagnosis with default options is unique, and is stored for later requests.
    is_plain = known is None and budget_s is None and options.inputs == INPUTS
    named = [name for log in logs for name in list_named(log)]
    for vehicle, recordings in _gather(named, options, diagnosed, opened, quiet=quiet).values():
        diagnosed.limit.at_work = recordings[0].path
        try:
            agreed = _agree(known, vehicle, recordings, owner)
            search = partial(_judge, recordings, agreed, options, known, budget_s, quiet=quiet)
            asked = [opened[recording.name] for recording in recordings]
            keeps = is_plain and len(recordings) == 1
            diagnosed.answers.append(_answer(search, asked, options.out, keeps=keeps, quiet=quiet))
        except SlipError as error:
            print_error(error)
            diagnosed.errors.append(summarize_error(recordings[0].path, error))


def _suggest_next(runs: Sequence[RunDiagnosis], applying: str, applied: Path | None) -> str:
    """The next command: to export an applied model, to add a suggested term, or to apply."""
    if applied is not None:
        kind = next((one.vehicle.kind for one in runs if one.vehicle is not None), "")
        return words.suggest_export(kind, str(applied))
    if suggested := next((one.run for one in runs if one.has_suggestion), None):
        return f"slip serve {shlex.quote(suggested)}    add the suggested term there"
    return applying


def _gather(
    logs: Sequence[str], options: Options, diagnosed: Diagnosed, opened: dict[str, _Opened], *, quiet: bool
) -> dict[str, tuple[sources.Vehicle, list[estimation.Recording]]]:
    """Recordings by vehicle; ``opened`` receives the data read of each run."""
    from pipeline.estimation.stored_diagnosis import read_recording  # noqa: PLC0415 - heavy
    from pipeline.store import read_choices  # noqa: PLC0415 - heavy

    gathered: dict[str, tuple[sources.Vehicle, list[estimation.Recording]]] = {}
    for log in logs:
        diagnosed.limit.at_work = log
        try:
            with open_shown(log, options, quiet=quiet) as run:
                vehicle, recording = read_recording(run.manifest)
                opened[recording.name] = _Opened(run.manifest, read_choices(run.manifest))
        except SlipError as error:
            print_error(error)
            diagnosed.errors.append(summarize_error(log, error))
            continue
        diagnosed.lossy += [log] if run.lossy else []
        gathered.setdefault(repr(vehicle), (vehicle, []))[1].append(recording)
    return gathered


@dataclass(frozen=True)
class _Opened:
    """Results of a run, and the topics and the vehicle that were chosen for it."""

    manifest: Manifest
    choices: dict[str, object]


@dataclass(frozen=True)
class _Answer:
    """The diagnosis of runs that were judged together, made now or read from the results.

    Attributes:
        runs: what was found in each.
        opened: where each comes from.
        proposal: the model to write; None where nothing could be judged.
    """

    runs: Sequence[RunDiagnosis]
    opened: Sequence[_Opened]
    proposal: models.ModelFile | None


def _answer(
    search: Callable[[], estimation.Diagnosis],
    opened: Sequence[_Opened],
    results: Path,
    *,
    keeps: bool,
    quiet: bool,
) -> _Answer:
    """The result of a search, or with ``keeps`` the stored result of an earlier one."""
    from pipeline.estimation.stored_diagnosis import find_diagnosis  # noqa: PLC0415 - heavy
    from pipeline.results import read_model  # noqa: PLC0415 - heavy

    if keeps and (stored := find_diagnosis(results, opened[0].manifest)) is not None:
        return _Answer([stored], opened, read_model(stored))
    diagnosis = search()
    if keeps:
        _keep(results, opened[0].manifest, diagnosis, quiet=quiet)
    return _Answer(diagnosis.runs, opened, diagnosis.proposal)


def _keep(results: Path, manifest: Manifest, diagnosis: estimation.Diagnosis, *, quiet: bool) -> None:
    """Store an answer with the results; if they cannot be written, only print a note."""
    from pipeline.estimation.stored_diagnosis import keep_diagnosis  # noqa: PLC0415 - heavy

    (run,) = diagnosis.runs
    try:
        keep_diagnosis(results, manifest, run)
    except (OSError, SlipError) as error:
        if not quiet:
            print_note(f"slip: the diagnosis was not saved: {error}")


def _agree(
    known: models.ModelFile | None,
    vehicle: sources.Vehicle,
    recordings: list[estimation.Recording],
    owner: sources.Owner | None,
) -> sources.Vehicle:

    if known is None:
        return vehicle
    return sources.agree_on_vehicle(known.model.vehicle, {one.name: vehicle for one in recordings}, owner)


def _judge(
    recordings: list[estimation.Recording],
    vehicle: sources.Vehicle,
    options: Options,
    known: models.ModelFile | None,
    budget_s: float | None,
    *,
    quiet: bool,
) -> estimation.Diagnosis:

    name = recordings[0].name if len(recordings) == 1 else f"{len(recordings)} runs"
    with show_progress(name, quiet=quiet) as progress:
        progress("diagnosis")
        return estimation.diagnose_runs(
            recordings,
            vehicle,
            inputs=options.inputs,
            model=None if known is None else known.model,
            budget_s=budget_s,
            notify=progress,
        )


def _apply(answers: Sequence[_Answer], path: Path, *, quiet: bool) -> list[dict[str, str]]:
    """Write the proposed model; the error of there being none, as a JSON object."""
    from pipeline.results import find_refusal  # noqa: PLC0415 - heavy

    if not answers:  # the errors were said
        return []
    proposal = next((one.proposal for one in answers if one.proposal is not None), None)
    if proposal is None:
        refusals = [find_refusal(run.findings) for answer in answers for run in answer.runs]
        what = f"no model can be proposed: {next(filter(None, refusals), 'nothing could be judged')}"
        error = SlipError("nothing_to_apply", what, where=str(path), hint="See the findings.")
        print_error(error)
        return [summarize_error(str(path), error)]
    models.write_model(proposal, path)
    if not quiet:
        print_lines([f"{path}: {', '.join(proposal.model.ids) or 'the ideal model'}"])
    return []


def effects(  # noqa: D417 - the arguments document themselves
    effect: Annotated[str | None, Parameter(help="id of an effect; without one, all are listed")] = None,
    /,
    *,
    own: OwnEffects = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """List the physical effects, or print one's page.

    The page has formula, parameters, source, similar effects, and the driving that shows it.

    Args:
        json: print one JSON object.
        quiet: print nothing but errors.
    """
    from pipeline.models.catalogue import format_effect  # noqa: PLC0415 - heavy

    models.load_effects(own or ())
    every = (*models.list_effects(), *models.list_own_effects().values())
    chosen = every if effect is None else (models.find_effect(effect),)
    pages = models.list_pages(chosen) if effect is None else [format_effect(chosen[0])]
    content = {"effects": [_as_json(item) for item in chosen]}
    return print_result(content, lambda: "\n".join(pages).split("\n"), json=json, quiet=quiet)


def _as_json(effect: type[models.Effect]) -> dict[str, object]:
    from pipeline.models.catalogue import format_effect  # noqa: PLC0415 - heavy

    return {
        "id": effect.id,
        "place": effect.place.name.lower(),
        "kinds": list(effect.kinds),
        "parameters": [
            {"name": p.name, "unit": p.unit, "about": p.about, "typical": p.typical}
            for p in effect.parameters
        ],
        "needs": [need.value for need in effect.needs],
        "confused_with": list(effect.confused_with),
        "equivalent_to": list(effect.equivalent_to),
        "page": format_effect(effect),
    }


_SUFFIXES = {
    "mcap": "_slip.mcap",
    "csv": "_csv",
    "parquet": "_parquet",
    "foxglove-layout": "_foxglove.json",
    "plotjuggler-layout": "_plotjuggler.xml",
}


def export(  # noqa: D417 - the results folder documents itself
    run: Annotated[str, Parameter(help="name of a run, or its log")],
    /,
    *,
    to: Literal["mcap", "csv", "parquet", "foxglove-layout", "plotjuggler-layout"],
    file: Path | None = None,
    model: Path | None = None,
    frame: str = "map",
    effects: OwnEffects = None,
    results: Results = Path("results"),
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Export a run as a log, as tables, or as layouts for viewers.

    The log can be opened together with the original one.

    Args:
        run: name of a run, or its log.
        to: what to write.
        file: output file (csv, parquet: folder); by default in the current folder, named after the run.
        model: a model file whose velocity is exported too (default: the diagnosed model).
        frame: fixed frame of the log's poses.
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.estimation.stored_diagnosis import read_slip  # noqa: PLC0415 - heavy
    from pipeline.report.viewer_files import (  # noqa: PLC0415 - heavy
        write_layout,
        write_slip_log,
        write_tables,
    )
    from pipeline.store import Store, find_run  # noqa: PLC0415 - heavy

    manifest = find_run(run, Store(results))
    models.load_effects(effects or ())
    known = None if model is None else models.read_model(model)
    path = file or resolve_inside(Path(), manifest.run.replace("/", "_") + _SUFFIXES[to])
    if to in {"csv", "parquet"}:
        written = write_tables(manifest, to, path)
    elif to == "mcap":
        written = [write_slip_log(manifest, read_slip(manifest, known), path, frame)]
    else:
        written = [write_layout(to, path)]
    files = [str(each) for each in written]
    content = {"run": manifest.run, "to": to, "files": files}
    return print_result(content, lambda: files, json=json, quiet=quiet)
