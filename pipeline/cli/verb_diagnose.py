"""`slip diagnose`: which physical effects are missing from the model of a run."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from pipeline.cli.choices import Choices, build_options, spell_choices, spell_flags
from pipeline.cli.memory_limit import limited_memory
from pipeline.cli.model_runs import open_shown
from pipeline.cli.model_trust import TrustCode, open_model
from pipeline.cli.output import (
    describe_error,
    exit_code,
    print_error,
    print_json,
    print_lines,
    show_progress,
)
from pipeline.core.errors import SlipError

if TYPE_CHECKING:
    from pipeline.analysis.geometry import Owner
    from pipeline.analysis.options import Options
    from pipeline.diagnosis import Diagnosis, Recording
    from pipeline.models import ModelFile
    from pipeline.vehicles import Vehicle


def diagnose(  # noqa: D417 - the shared choices document themselves
    logs: Annotated[list[str], Parameter(help="logs, or runs of the results folder", negative=())],
    /,
    *,
    choices: Annotated[Choices, Parameter(name="*")] = Choices(),  # noqa: B008 - frozen
    model: Annotated[
        Path | None, Parameter(help="what is known already: say what is missing beyond it")
    ] = None,
    trust_code: TrustCode = False,
    vehicle_of: Annotated[
        Literal["model", "run"] | None,
        Parameter(help="whose geometry counts where the run is of another vehicle than --model"),
    ] = None,
    apply: Annotated[Path | None, Parameter(help="write the proposed model to this file")] = None,
    memory: str | None = None,
    budget: str | None = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Name what is missing from the model, from one run or from several of one vehicle jointly.

    Args:
        trust_code: trust the Python that the model file names, now and later.
        memory: most memory, for example 2GB (default: 80 % of the machine's).
        budget: CPU time that a search may take, for example 60s (default: that for 10 minutes of driving);
            after it the best answer so far is given.
        json: print one JSON object instead of the summary.
        quiet: print no progress and no summary.
    """
    options = build_options(choices)
    from pipeline.diagnosis.budget import parse_budget  # noqa: PLC0415 - heavy
    from pipeline.models.model_text import check_place  # noqa: PLC0415 - heavy

    if apply is not None:
        check_place(apply)
    known = None if model is None else open_model(model, trust_code=trust_code)
    budget_s = None if budget is None else parse_budget(budget)
    diagnoses: list[Diagnosis] = []
    at_work = [logs[0]]
    chosen: dict[str, dict[str, object]] = {}

    def conclude(error: SlipError) -> None:
        if json:
            told = describe_error(at_work[0], error)
            print_json({"runs": _to_json(diagnoses, chosen), "errors": [told]})

    with limited_memory(memory, lambda: at_work[0], conclude):
        gathered, errors, lossy = _gather(logs, options, at_work, chosen, quiet=quiet or json)
        for vehicle, recordings in gathered.values():
            at_work[0] = recordings[0].path
            try:
                agreed = vehicle if known is None else _agree(known, vehicle, recordings, vehicle_of)
                diagnoses.append(_judge(recordings, agreed, options, known, budget_s, quiet=quiet or json))
            except SlipError as error:
                print_error(error)
                errors.append(describe_error(recordings[0].path, error))
    runs = [run for diagnosis in diagnoses for run in diagnosis.runs]
    if apply is not None:
        _apply([run.proposal for run in runs], apply, quiet=quiet or json)
    if json:
        left_out = {"warnings": list(known.warnings)} if known is not None and known.warnings else {}
        print_json({"runs": _to_json(diagnoses, chosen), "errors": errors, **left_out})
    elif not quiet:
        from pipeline.diagnosis.words import describe  # noqa: PLC0415 - only for people

        more = {"model": model, "vehicle_of": vehicle_of, "memory": memory, "budget": budget}
        said = spell_choices(choices) + spell_flags(more) + " --trust-code" * trust_code
        for diagnosis in diagnoses:
            names = " ".join(shlex.quote(run.run) for run in diagnosis.runs)
            following = (
                f"slip diagnose {names}{said} --apply model.toml"
                if apply is None
                else f"slip model export {shlex.quote(str(apply))} --to ros2_control"
            )
            print_lines(describe(diagnosis, following).splitlines())
    return exit_code(errors, lossy=lossy)


def _gather(
    logs: list[str],
    options: Options,
    at_work: list[str],
    chosen: dict[str, dict[str, object]],
    *,
    quiet: bool,
) -> tuple[dict[str, tuple[Vehicle, list[Recording]]], list[dict[str, str]], bool]:
    """Recordings by vehicle; an error costs one log.

    ``at_work`` is told which log it is, ``chosen`` what was chosen in each run.
    """
    from pipeline.analysis.diagnosis import read_choices, read_recording  # noqa: PLC0415 - heavy

    gathered: dict[str, tuple[Vehicle, list[Recording]]] = {}
    errors: list[dict[str, str]] = []
    lossy = False
    for log in logs:
        at_work[0] = log
        try:
            with open_shown(log, options, quiet=quiet) as opened:
                vehicle, recording = read_recording(opened.manifest)
                chosen[recording.name] = read_choices(opened.manifest)
        except SlipError as error:
            print_error(error)
            errors.append(describe_error(log, error))
            continue
        lossy |= opened.lossy
        gathered.setdefault(repr(vehicle), (vehicle, []))[1].append(recording)
    return gathered, errors, lossy


def _to_json(diagnoses: list[Diagnosis], chosen: dict[str, dict[str, object]]) -> list[dict[str, object]]:
    """The runs as JSON objects, with the topics and the vehicle that were chosen."""
    runs = [run.to_json() for diagnosis in diagnoses for run in diagnosis.runs]
    return [{**run, **chosen.get(str(run["run"]), {})} for run in runs]


def _agree(known: ModelFile, vehicle: Vehicle, recordings: list[Recording], owner: Owner | None) -> Vehicle:
    from pipeline.analysis.geometry import agree_on_vehicle  # noqa: PLC0415 - heavy

    return agree_on_vehicle(known.model.vehicle, {one.name: vehicle for one in recordings}, owner)


def _judge(
    recordings: list[Recording],
    vehicle: Vehicle,
    options: Options,
    known: ModelFile | None,
    budget_s: float | None,
    *,
    quiet: bool,
) -> Diagnosis:
    from pipeline.diagnosis import diagnose_runs  # noqa: PLC0415 - heavy

    name = recordings[0].name if len(recordings) == 1 else f"{len(recordings)} runs"
    with show_progress(name, quiet=quiet) as progress:
        progress("diagnosis")
        return diagnose_runs(
            recordings,
            vehicle,
            inputs=options.inputs,
            model=None if known is None else known.model,
            budget_s=budget_s,
            tell=progress,
        )


def _apply(proposals: list[ModelFile | None], path: Path, *, quiet: bool) -> None:
    from pipeline.models import write_model  # noqa: PLC0415 - heavy

    proposal = next((found for found in proposals if found is not None), None)
    if proposal is None:
        what = "no model can be proposed: nothing could be judged"
        raise SlipError("nothing_to_apply", what, where=str(path), hint="See the findings.")
    write_model(proposal, path)
    if not quiet:
        print_lines([f"{path}: {', '.join(proposal.model.ids) or 'the ideal model'}"])
