"""Commands that compare runs: check of two drives; fleet fit, show, trend."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from pipeline import api, models, words
from pipeline.cli.conventions import (
    All,
    Force,
    OwnEffects,
    Results,
    open_shown,
    print_json,
    print_lines,
    print_result,
    require_new,
)
from pipeline.core import SlipError


def check(  # noqa: D417 - the arguments document themselves
    before: Annotated[str, Parameter(help="logs, folders of logs, runs (several: with commas), or a model")],
    after: Annotated[str, Parameter(help="logs, folders of logs, or runs (several: with commas)")],
    /,
    *,
    limits: Annotated[Path | None, Parameter(help="file of limits (check.toml)")] = None,
    simulated: bool = False,
    input: Literal["command", "measured"] | None = None,  # noqa: A002 - the word of the other verbs
    vehicle_of: Annotated[
        Literal["model", "run"] | None, Parameter(help="geometry to use where vehicles differ")
    ] = None,
    to: Annotated[Literal["markdown", "junit", "html"] | None, Parameter(help="format of --file")] = None,
    file: Annotated[Path | None, Parameter(help="file to write; standard output without one")] = None,
    force: Force = False,
    effects: OwnEffects = None,
    results: Results = Path("results"),
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Check what changed between two drives, by cause.

    One table: each number before and after, the difference, and by how much runs differ without a change.
    Exit codes: 0 nothing changed, or all limits are kept; 4 something changed, or a limit is broken; 3
    undetermined by these runs.

    Args:
        simulated: BEFORE is a simulation, whose runs do not differ.
        input: input of the model.
        json: print one JSON object.
        quiet: print no progress and no summary.
    """
    if to is None and file is not None:
        what, hint = "--file says where, and not in which format", "Add --to markdown, junit or html."
        raise SlipError("wrong_options", what, hint=hint)
    if to is not None and file is None and json:
        what, hint = f"--json and --to {to} would both be printed", "Add --file FILE, or leave one out."
        raise SlipError("wrong_options", what, hint=hint)
    if file is not None:
        require_new(file, force=force)
    if Path(after).suffix == ".toml":
        what = "AFTER is a model file, and not what was driven"
        hint = f"Give it first and the log, folder or run second: slip check {after} LOG."
        raise SlipError("after_not_driven", what, where=after, hint=hint)
    api.load_effects(*(effects or ()))
    silent = quiet or json or (to is not None and file is None)
    checked = api.check(
        before,
        after,
        results=results,
        limits=limits,
        simulated=simulated,
        input=input,
        vehicle_of=vehicle_of,
        opened=partial(open_shown, quiet=silent),
    )
    if to is not None:
        formats = {"markdown": checked.to_markdown, "junit": checked.to_junit, "html": checked.to_html}
        text = formats[to]()
        if file is None:
            sys.stdout.write(text)
        else:
            models.write_text(file, text, code="check_unwritable")
    if json:
        print_json({**checked.to_json(), "errors": []})
    elif not quiet and (to is None or file is not None):
        print_lines(str(checked).splitlines())
    return checked.code


def build_fleet() -> App:
    """The command and its own commands."""
    from pipeline.cli.verbs_datasets import draw  # noqa: PLC0415 - only for this command

    app = App(
        name="fleet", help="Numbers of all runs by level; their course over dates; the map of deployments."
    )
    for command in (fit, show, trend):
        app.command(command)
    app.command(draw, name="map")
    return app


def fit(  # noqa: D417 - the results folder documents itself
    results: Results = Path("results"),
    *,
    everything: All = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Write every parameter by vehicle, terrain and run, with the bands of another run.

    Writes fleet.parquet and fleet.html; what it prints is that of `slip fleet show`.

    Args:
        everything: as for `slip fleet show`.
        json: print one JSON object.
        quiet: print nothing.
    """
    written = api.write_fleet(results)
    fleet, file = written.result, str(written.files["fleet.parquet"])
    lines = words.format_fleet(fleet, everything=everything)
    return print_result({**fleet.to_json(), "file": file}, lambda: lines, json=json, quiet=quiet)


def show(  # noqa: D417 - the results folder documents itself
    results: Results = Path("results"), *, everything: All = False, json: bool = False, quiet: bool = False
) -> int:
    """Show every parameter by vehicle, terrain and run, with the bands of another run.

    What another run on a terrain is expected to show lies in its band with 95 %.

    Args:
        everything: also print all terrains, spreads, and why each number has its level.
        json: print one JSON object.
        quiet: print nothing.
    """
    fleet = api.read_fleet(results)
    return print_result(
        fleet.to_json(), lambda: words.format_fleet(fleet, everything=everything), json=json, quiet=quiet
    )


def trend(  # noqa: D417 - arguments document themselves
    results: Results = Path("results"),
    *,
    by: Annotated[
        str, Parameter(help="groups for slip: dataset, vehicle, terrain, or several of them")
    ] = "dataset",
    everything: All = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Follow slip and fitted parameters over dates, each with a test of its largest step.

    Writes trend.html. Parameters are followed by vehicle, beside what its terrains differ by.

    Args:
        everything: also print the series that cannot be tested.
        json: print one JSON object.
        quiet: print nothing.
    """
    followed = api.follow_trend(results, by)
    page = followed.page
    content = {**followed.result.to_json(), "page": None if page is None else str(page)}
    lines = words.format_trend(followed.result, everything=everything) + ([f"page    {page}"] if page else [])
    return print_result(content, lambda: lines, json=json, quiet=quiet)
