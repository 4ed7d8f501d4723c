"""Commands that compare runs: check of two drives; fleet fit, show, trend."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from pipeline import datasets, models, store, words
from pipeline.cli.conventions import (
    All,
    Choices,
    OwnEffects,
    Results,
    build_options,
    open_shown,
    print_json,
    print_lines,
    print_result,
)
from pipeline.cli.model_runs import open_model
from pipeline.core import SlipError, align_rows, format_count, suffix_unit


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
    to: Annotated[Literal["markdown", "junit"] | None, Parameter(help="format of --file")] = None,
    file: Annotated[Path | None, Parameter(help="file to write; standard output without one")] = None,
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
        what, hint = "--file says where, and not in which format", "Add --to markdown or --to junit."
        raise SlipError("wrong_options", what, hint=hint)
    if to is not None and file is None and json:
        what, hint = f"--json and --to {to} would both be printed", "Add --file FILE, or leave one out."
        raise SlipError("wrong_options", what, hint=hint)
    if Path(after).suffix == ".toml":
        what = "AFTER is a model file, and not what was driven"
        hint = f"Give it first and the log, folder or run second: slip check {after} LOG."
        raise SlipError("after_not_driven", what, where=after, hint=hint)
    bounds = None if limits is None else datasets.read_limits(limits)
    known = open_model(Path(before), effects) if Path(before).suffix == ".toml" else None
    silent = quiet or json or (to is not None and file is None)
    from pipeline.batch.recordings import list_named  # noqa: PLC0415 - heavy

    with ExitStack() as stack:

        def open_runs(names: str) -> list[store.Manifest]:
            asked = replace(build_options(Choices(results=results)), diagnosis=known is None)
            shown = (open_shown(name, asked, quiet=silent) for name in list_named(names))
            manifests = [stack.enter_context(one).manifest for one in shown]
            return list({one.run: one for one in manifests}.values())

        checked = datasets.check_runs(
            open_runs(before) if known is None else known,
            open_runs(after),
            store.Store(results),
            source=input,
            owner=vehicle_of,
            limits=bounds,
            simulated=simulated,
        )
    if to is not None:
        text = {"markdown": words.format_markdown, "junit": words.format_junit}[to](checked)
        if file is None:
            sys.stdout.write(text)
        else:
            models.write_text(file, text, code="check_unwritable")
    if json:
        print_json({**words.check_as_json(checked), "errors": []})
    elif not quiet and (to is None or file is not None):
        print_lines(words.format_lines(words.list_check_lines(checked)))
    return checked.code


_MOST = 8
"""Parameters of a vehicle on a screen of 24 lines, those of most runs first."""


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
    from pipeline.report.datasets_page import write_fleet  # noqa: PLC0415 - heavy

    folder = store.Store(results)
    fleet = datasets.fit_results(folder)
    file = str(write_fleet(folder, fleet)["fleet.parquet"])
    lines = _format_fleet(fleet, everything=everything)
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
    fleet = datasets.fit_results(store.Store(results))
    return print_result(
        fleet.to_json(), lambda: _format_fleet(fleet, everything=everything), json=json, quiet=quiet
    )


def _format_fleet(fleet: datasets.Fleet, *, everything: bool) -> list[str]:
    lines = [fleet.summary]
    for vehicle, runs in fleet.runs.items():
        own = [one for one in fleet.numbers if one.vehicle == vehicle]
        shown = own if everything else own[:_MOST]
        rows = [("level", "parameter", "value", "95 %", "another run", "unit")]
        for one in shown:
            rows.append(
                (one.level or "open", one.label, *_format_band(one.whole), suffix_unit(one.unit).strip())
            )
            is_split = everything or one.level == "terrain"
            rows += [
                ("", f"  on {name}", *_format_band(band), "")
                for name, band in one.terrains.items()
                if is_split
            ]
        lines += ["", f"{vehicle}: {format_count(len(runs), 'run')}", *align_rows(rows)] if own else []
        hidden = len(own) - len(shown)
        lines += [f"{format_count(hidden, 'more parameter')}: --all, or the page"] if hidden else []
        lines += [f"{one.label}: {one.name}, {one.because}" for one in shown if everything]
    return [*lines, *(f"! {note}" for note in fleet.notes)]


def _format_band(band: datasets.Band) -> tuple[str, str, str]:
    ends = [(band.low, band.high), (band.another_low, band.another_high)]
    texts = ["-" if low is None or high is None else f"{low:.3g} to {high:.3g}" for low, high in ends]
    return f"{band.value:.3g}", texts[0], texts[1]


def trend(  # noqa: D417 - arguments document themselves
    results: Results = Path("results"),
    *,
    by: Annotated[
        str, Parameter(help="groups for slip: dataset, vehicle, terrain, or several of them")
    ] = "dataset",
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Follow slip and fitted parameters over dates, each with a test of its largest step.

    Writes trend.html. Parameters are followed by vehicle, beside what its terrains differ by.

    Args:
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.report.datasets_page import write_trend  # noqa: PLC0415 - heavy

    folder = store.Store(results)
    names = tuple(name.strip() for name in by.split(",") if name.strip())
    followed = datasets.follow_trend(folder, names)
    page = write_trend(folder, followed).get("trend.html")
    content = {**followed.to_json(), "page": None if page is None else str(page)}
    lines = align_rows([(one.group, one.quantity, one.describe()) for one in followed.series])
    lines += [f"! {note}" for note in followed.notes] + ([f"page    {page}"] if page else [])
    return print_result(content, lambda: lines, json=json, quiet=quiet)
