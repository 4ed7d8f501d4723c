"""`slip analyze`: all stages and the report for each log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from pipeline.analysis.options import FigureFormat, Options
from pipeline.cli.choices import Choices, build_options, spell_choices
from pipeline.cli.memory_limit import limited_memory
from pipeline.cli.model_trust import TrustCode, trust_named
from pipeline.cli.output import describe_error, exit_code, print_error, print_json, print_lines, show_progress
from pipeline.core.errors import SlipError

if TYPE_CHECKING:
    from pipeline.analysis.analyze import Outcome


def analyze(  # noqa: D417 - the shared choices document themselves
    logs: Annotated[
        list[Path],
        Parameter(help="MCAP files or folders of split recordings; after -- if a name begins with a dash"),
    ],
    /,
    *,
    choices: Annotated[Choices, Parameter(name="*")] = Choices(),  # noqa: B008 - frozen
    diagnosis: Annotated[bool, Parameter(negative="--no-diagnosis")] = True,
    report: Annotated[bool, Parameter(negative="--no-report")] = True,
    figures: FigureFormat | None = None,
    model: Path | None = None,
    trust_code: TrustCode = False,
    force: bool = False,
    memory: str | None = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Analyze logs: slip per time step into tables, a one-screen summary and a report.

    Args:
        diagnosis: name what is missing from the model.
        report: write report.html.
        model: a model file to compute slip relative to as well.
        trust_code: trust the Python that the model file names, now and later.
        figures: also write the figures in this format, for papers.
        force: compute again what is already there.
        memory: most memory, for example 2GB (default: 80 % of the machine's).
        json: print one JSON object instead of the summary.
        quiet: print no progress and no summary.
    """
    trust_named(model, wanted=trust_code)
    options = build_options(choices)
    options = replace(options, report=report, diagnosis=diagnosis, figures=figures, force=force, model=model)
    outcomes: list[Outcome] = []
    errors: list[dict[str, str]] = []

    def name_log() -> str:
        return str(logs[min(len(outcomes) + len(errors), len(logs) - 1)])

    def conclude(error: SlipError) -> None:
        if json:
            _print_json(outcomes, [*errors, describe_error(name_log(), error)])

    with limited_memory(memory, name_log, conclude):
        _analyze_all(logs, options, outcomes, errors, quiet=quiet or json)
    if json:
        _print_json(outcomes, errors)
    elif not quiet:
        _print_outcomes(outcomes, spell_choices(choices))
    return exit_code(errors, lossy=any(outcome.lossy for outcome in outcomes))


def _print_json(outcomes: list[Outcome], errors: list[dict[str, str]]) -> None:
    print_json({"runs": [_as_json(outcome) for outcome in outcomes], "errors": errors})


def _as_json(outcome: Outcome) -> dict[str, object]:
    return {**outcome.summary, "same_content_as": outcome.twin or None}


def _analyze_all(
    logs: list[Path],
    options: Options,
    outcomes: list[Outcome],
    errors: list[dict[str, str]],
    *,
    quiet: bool,
) -> None:
    """Analyze one log after the other into outcomes and errors; an error costs one log."""
    if options.report:
        _warm_report()
    from pipeline.analysis.analyze import analyze_log, update_datasets  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    for log in logs:
        try:
            with show_progress(log.name, quiet=quiet) as progress:
                outcomes.append(analyze_log(log, options, progress))
        except SlipError as error:
            print_error(error)
            errors.append(describe_error(str(log), error))
    if any(outcome.computed for outcome in outcomes):
        update_datasets(Store(options.out))


def _warm_report() -> None:
    """Fetch the report's drawing code in the background while the log is read."""
    from pipeline.report.bundle import warm_bundle  # noqa: PLC0415 - only for reports

    warm_bundle()


def _print_outcomes(outcomes: list[Outcome], said: str) -> None:
    from pipeline.cli.screen import describe_run  # noqa: PLC0415 - only for people

    for outcome in outcomes:
        text = describe_run(outcome.summary, unchanged=not outcome.computed, twin=outcome.twin, said=said)
        print_lines(text.splitlines())
