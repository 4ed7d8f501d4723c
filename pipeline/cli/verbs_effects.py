"""Verbs on effects and viewers: diagnose, effects, export."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from pipeline import api, models, results, store, words
from pipeline.cli.conventions import (
    All,
    Asked,
    Choices,
    Force,
    OwnEffects,
    Results,
    build_options,
    exit_code,
    open_shown,
    print_json,
    print_lines,
    print_note,
    print_result,
    require_new,
    show_progress,
    spell_choices,
    spell_flags,
)
from pipeline.core import SlipError, pick, resolve_inside


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
    force: Force = False,
    asked: Asked,
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
        require_new(apply, force=force)
    models.load_effects(effects or ())
    known = None if model is None else models.read_model(model)
    budget_s = None if budget is None else api.parse_budget(budget)
    from pipeline.batch.recordings import list_named  # noqa: PLC0415 - heavy

    options, silent = build_options(choices), quiet or json
    answers: list[Sequence[results.RunDiagnosis]] = []
    chosen: dict[str, dict[str, object]] = {}
    asked.list_runs = lambda: [
        {**words.diagnosis_as_json(run), **chosen[run.run]} for runs in answers for run in runs
    ]
    asked.at_work = logs[0]
    read: dict[str, list[api.ReadRun]] = {}

    def warn(text: str) -> None:
        print_note(f"slip: {text}")

    lossy: list[str] = []
    for log in [name for given in logs for name in list_named(given)]:
        with asked.attempt(log), open_shown(log, options, quiet=silent) as opened:
            one = api.read_run(opened.manifest)
            chosen[one.recording.name] = store.read_choices(opened.manifest)
            lossy += [log] * opened.lossy
            read.setdefault(repr(one.vehicle), []).append(one)
    for group in read.values():
        with asked.attempt(group[0].recording.path):
            name = group[0].recording.name if len(group) == 1 else f"{len(group)} runs"
            with show_progress(name, quiet=silent) as progress:
                answer = api.diagnose_together(
                    group,
                    options.out,
                    inputs=options.inputs,
                    known=known,
                    owner=vehicle_of,
                    budget_s=budget_s,
                    notify=progress,
                    warn=None if silent else warn,
                )
            answers.append(answer)
    runs = [run for answer in answers for run in answer]
    if apply is not None and runs:
        with asked.attempt(str(apply)):
            _apply(runs, apply, quiet=silent)
    if json:
        print_json(asked.to_json())
    elif not quiet:
        flags = {"model": model, "vehicle_of": vehicle_of, "memory": asked.memory, "budget": budget}
        said = spell_choices(choices) + spell_flags(flags)
        said += "".join(spell_flags({"effects": path}) for path in effects or ())
        for answer in answers:
            simulated = [run.run for run in answer if chosen[run.run].get("simulated")]
            names = [run.run for run in answer]
            # A folder is shorter than what it holds.
            names = logs if len(logs) < len(names) and len(answers) == 1 else names
            applying = f"slip diagnose {' '.join(map(shlex.quote, names))}{said} --apply model.toml"
            following = _suggest_next(answer, applying, apply)
            text = words.describe(answer, following, simulated=simulated, everything=everything)
            print_lines(text.splitlines())
    if lossy and not quiet:
        print_note(f"logs with losses: {', '.join(lossy)} (slip inspect {lossy[0]} lists them)")
    return exit_code(
        asked.errors, lossy=bool(lossy) or any(results.find_refusal(run.findings) for run in runs)
    )


def _suggest_next(runs: Sequence[results.RunDiagnosis], applying: str, applied: Path | None) -> str:
    """The next command: to export an applied model, to add a suggested term, or to apply."""
    if applied is not None:
        file = next(filter(None, map(results.read_model, runs)), None)
        return "" if file is None else words.suggest_export(file, str(applied))
    if suggested := next((one.run for one in runs if one.has_suggestion), None):
        return f"slip serve {shlex.quote(suggested)}    add the suggested term there"
    return applying


def _apply(runs: Sequence[results.RunDiagnosis], path: Path, *, quiet: bool) -> None:
    """Write the proposed model; an error where there is none."""
    proposal = next(filter(None, map(results.read_model, runs)), None)
    if proposal is None:
        refusals = (results.find_refusal(run.findings) for run in runs)
        refusal = next(filter(None, refusals), None)
        why = "nothing could be judged" if refusal is None else words.format_finding(refusal)
        what = f"no model can be proposed: {why}"
        raise SlipError("nothing_to_apply", what, where=str(path), hint="See the findings.")
    models.write_model(proposal, path)
    if not quiet:
        print_lines([f"{path}: {', '.join(proposal.model.ids) or 'the ideal model'}"])


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
    from pipeline.models.catalogue import format_page  # noqa: PLC0415 - heavy

    models.load_effects(own or ())
    every = (*models.list_effects(), *models.list_own_effects().values())
    chosen = every if effect is None else (models.find_effect(effect),)
    pages = models.list_pages(chosen) if effect is None else [format_page(chosen[0])]
    rows = [
        {
            "id": one.id,
            "place": one.place.name.lower(),
            "kinds": list(one.kinds),
            "parameters": [pick(number, "name", "unit", "about", "typical") for number in one.parameters],
            "needs": [need.value for need in one.needs],
            "confused_with": list(one.confused_with),
            "equivalent_to": list(one.equivalent_to),
            "page": format_page(one),
        }
        for one in chosen
    ]
    return print_result({"effects": rows}, lambda: "\n".join(pages).split("\n"), json=json, quiet=quiet)


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
    force: Force = False,
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
    from pipeline.report.viewer_files import (  # noqa: PLC0415 - heavy
        write_layout,
        write_slip_log,
        write_tables,
    )

    manifest = store.find_run(run, store.Store(results))
    path = file or resolve_inside(Path(), manifest.run.replace("/", "_") + _SUFFIXES[to])
    is_folder = to in {"csv", "parquet"} and path.is_dir()
    require_new(
        *([path / f"{table}.{to}" for table in manifest.tables] if is_folder else [path]), force=force
    )
    models.load_effects(effects or ())
    known = None if model is None else models.read_model(model)
    if to in {"csv", "parquet"}:
        written = write_tables(manifest, to, path)
    elif to == "mcap":
        written = [write_slip_log(manifest, api.read_slip(manifest, known), path, frame)]
    else:
        written = [write_layout(to, path)]
    files = [str(each) for each in written]
    content = {"run": manifest.run, "to": to, "files": files}
    return print_result(content, lambda: files, json=json, quiet=quiet)
