"""`slip check`: what changed between two drives, and whether it is more than runs differ anyway."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from pipeline.cli.conventions import (
    FAILED,
    Choices,
    KeyFile,
    Results,
    build_options,
    print_error,
    print_json,
    print_lines,
    summarize_error,
)
from pipeline.cli.model_runs import TrustCode, open_model, open_shown
from pipeline.core.program import SlipError

if TYPE_CHECKING:
    from pipeline.job.check import Check
    from pipeline.job.check_sides import Baseline
    from pipeline.job.keys import Owner
    from pipeline.job.options import Options
    from pipeline.models.model_file import ModelFile
    from pipeline.store import Manifest


def check(  # noqa: D417 - the arguments document themselves
    before: Annotated[
        str, Parameter(help="logs, folders of logs, runs (several: with commas), a model, or a baseline")
    ],
    after: Annotated[str, Parameter(help="logs, folders of logs, or runs (several: with commas)")],
    /,
    *,
    limits: Annotated[Path | None, Parameter(help="file of limits (check.toml)")] = None,
    keep: Annotated[Path | None, Parameter(help="write AFTER as a baseline to check later runs with")] = None,
    simulated: bool = False,
    input: Literal["command", "measured"] | None = None,  # noqa: A002 - the word of the other verbs
    vehicle_of: Annotated[
        Literal["model", "run"] | None, Parameter(help="whose geometry counts where vehicles differ")
    ] = None,
    to: Annotated[Literal["markdown", "junit"] | None, Parameter(help="format of --file")] = None,
    file: Annotated[Path | None, Parameter(help="file to write; standard output without one")] = None,
    trust_code: TrustCode = False,
    results: Results = Path("results"),
    key: KeyFile = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Check what changed between two drives, by cause.

    It says whether that is more than runs differ anyway. Exit codes: 0 nothing changed, or all limits are
    kept; 4 something changed, or a limit is broken; 3 these runs cannot tell.

    Args:
        simulated: BEFORE is a simulation: what runs differ by anyway does not count.
        input: what the model is fed with.
        json: print one JSON object.
        quiet: print no progress and no summary.
    """
    try:
        _require_target(to, file, json=json)
        _require_runs(after)
        from pipeline.estimation.diagnosis_lines import format_lines  # noqa: PLC0415 - heavy
        from pipeline.job.check import check_as_json, check_runs, keep_baseline  # noqa: PLC0415 - heavy
        from pipeline.job.check_limits import read_limits  # noqa: PLC0415 - heavy
        from pipeline.job.check_text import list_lines  # noqa: PLC0415 - heavy
        from pipeline.models.model_text import write_text  # noqa: PLC0415 - heavy
        from pipeline.store import Store  # noqa: PLC0415 - heavy

        bounds = None if limits is None else read_limits(limits)
        options = build_options(Choices(results=results, key=key))
        known = _open_known(before, trust_code=trust_code)
        silent = quiet or json or (to is not None and file is None)
        with ExitStack() as stack:
            first = (
                _open_runs(before, options, stack, diagnosed=True, quiet=silent) if known is None else known
            )
            second = _open_runs(after, options, stack, diagnosed=known is None, quiet=silent)
            owner: Owner | None = vehicle_of
            checked = check_runs(
                first,
                second,
                Store(results),
                source=input,
                owner=owner,
                limits=bounds,
                simulated=simulated,
            )
        lines = list_lines(checked)
        if to is not None:
            text = _render(checked, to)
            if file is None:
                sys.stdout.write(text)
            else:
                write_text(file, text, code="check_unwritable")
    except SlipError as error:
        print_error(error)
        if json:
            print_json({"errors": [summarize_error(after, error)]})
        return FAILED
    # What broke is said, too, where the baseline stays as it is.
    unkept: list[SlipError] = []
    try:
        if keep is not None:
            keep_baseline(checked, keep)
    except SlipError as error:
        unkept = [error]
    if json:
        errors = [summarize_error(after, one) for one in unkept]
        print_json({**check_as_json(checked, lines), "errors": errors})
    elif not quiet and (to is None or file is not None):
        print_lines(format_lines(lines))
    for one in unkept:
        print_error(one)
    return FAILED if unkept else checked.code


def _require_target(to: str | None, file: Path | None, *, json: bool) -> None:
    """Refuse a file without a format, and two formats on standard output."""
    if to is None and file is not None:
        what, hint = "--file says where, and not in which format", "Add --to markdown or --to junit."
    elif to is not None and file is None and json:
        what, hint = (
            f"--json and --to {to} would both be printed",
            "Add --file FILE, or leave one out.",
        )
    else:
        return
    raise SlipError("wrong_options", what, hint=hint)


def _require_runs(after: str) -> None:
    """Refuse a model or a baseline as what was driven afterwards."""
    kind = {".toml": "a model file", ".json": "a baseline"}.get(Path(after).suffix)
    if kind is not None:
        raise SlipError(
            "after_not_driven",
            f"AFTER is {kind}, and not what was driven",
            where=after,
            hint=f"Give {kind} first and the log, folder or run second: slip check {after} LOG.",
        )


def _open_known(name: str, *, trust_code: bool) -> ModelFile | Baseline | None:
    """The model file or the baseline that a name stands for; None of a log, a folder or a run."""
    from pipeline.job.check_sides import read_baseline  # noqa: PLC0415 - heavy

    path = Path(name)
    if path.suffix == ".toml":
        return open_model(path, trust_code=trust_code)
    return read_baseline(path) if path.suffix == ".json" else None


def _open_runs(
    names: str, options: Options, stack: ExitStack, *, diagnosed: bool, quiet: bool
) -> list[Manifest]:
    """Runs of names with commas between them, each once; folders stand for the logs in them."""
    from dataclasses import replace  # noqa: PLC0415

    from pipeline.batch.recordings import list_named  # noqa: PLC0415 - heavy

    manifests: dict[str, Manifest] = {}
    for name in list_named(names):
        asked = replace(options, diagnosis=diagnosed)
        manifest = stack.enter_context(open_shown(name, asked, quiet=quiet)).manifest
        manifests.setdefault(manifest.run, manifest)
    return list(manifests.values())


def _render(checked: Check, to: Literal["markdown", "junit"]) -> str:
    from pipeline.job.check_text import format_junit, format_markdown  # noqa: PLC0415 - heavy

    return {"markdown": format_markdown, "junit": format_junit}[to](checked)
