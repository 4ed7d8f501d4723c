"""Commands that compare runs: check of two drives; fleet fit, show, predict, trend."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

from cyclopts import App, Parameter
from cyclopts.types import NonNegativeFloat

from pipeline import datasets, models, words
from pipeline.cli.conventions import (
    ALERT,
    CLEAN,
    FAILED,
    All,
    Choices,
    Results,
    TrustCode,
    build_options,
    format_value,
    open_shown,
    print_error,
    print_json,
    print_lines,
    print_result,
    show_progress,
    summarize_error,
)
from pipeline.cli.model_runs import open_model
from pipeline.core import (
    TREND_THRESHOLD,
    SlipError,
    format_count,
    format_digits,
    format_interval,
    format_length,
    group_by,
    suffix_unit,
)

if TYPE_CHECKING:
    from pipeline.analysis import Options
    from pipeline.sources import Owner
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
        Literal["model", "run"] | None, Parameter(help="geometry to use where vehicles differ")
    ] = None,
    to: Annotated[Literal["markdown", "junit"] | None, Parameter(help="format of --file")] = None,
    file: Annotated[Path | None, Parameter(help="file to write; standard output without one")] = None,
    trust_code: TrustCode = False,
    results: Results = Path("results"),
    everything: All = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Check what changed between two drives, by cause.

    It tests whether a change exceeds the spread between runs. Exit codes: 0 nothing changed, or all limits
    are kept; 4 something changed, or a limit is broken; 3 undetermined by these runs.

    Args:
        simulated: BEFORE is a simulation: the spread between runs does not count.
        input: input of the model.
        everything: also print the numbers of what did not change, and which changes could be detected.
        json: print one JSON object.
        quiet: print no progress and no summary.
    """
    _require_target(to, file, json=json)
    _require_runs(after)
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    bounds = None if limits is None else datasets.read_limits(limits)
    options = build_options(Choices(results=results))
    known = _open_known(before, trust_code=trust_code)
    silent = quiet or json or (to is not None and file is None)
    with ExitStack() as stack:
        first = _open_runs(before, options, stack, diagnosed=True, quiet=silent) if known is None else known
        second = _open_runs(after, options, stack, diagnosed=known is None, quiet=silent)
        owner: Owner | None = vehicle_of
        checked = datasets.check_runs(
            first,
            second,
            Store(results),
            source=input,
            owner=owner,
            limits=bounds,
            simulated=simulated,
        )
    lines = words.list_lines(checked)
    if to is not None:
        text = _render(checked, to)
        if file is None:
            sys.stdout.write(text)
        else:
            models.write_text(file, text, code="check_unwritable")
    # The check is also printed if the baseline is not replaced.
    unkept: list[SlipError] = []
    try:
        if keep is not None:
            datasets.keep_baseline(checked, keep)
    except SlipError as error:
        unkept = [error]
    if json:
        errors = [summarize_error(after, one) for one in unkept]
        print_json({**datasets.check_as_json(checked, lines), "errors": errors})
    elif not quiet and (to is None or file is not None):
        print_lines(words.format_lines(words.list_lines(checked, everything=everything)))
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
    """Refuse a model or a baseline as AFTER."""
    kind = {".toml": "a model file", ".json": "a baseline"}.get(Path(after).suffix)
    if kind is not None:
        raise SlipError(
            "after_not_driven",
            f"AFTER is {kind}, and not what was driven",
            where=after,
            hint=f"Give {kind} first and the log, folder or run second: slip check {after} LOG.",
        )


def _open_known(name: str, *, trust_code: bool) -> models.ModelFile | datasets.Baseline | None:
    """Open a name as a model file or a baseline; None for a log, a folder or a run."""
    path = Path(name)
    if path.suffix == ".toml":
        return open_model(path, trust_code=trust_code)
    return datasets.read_baseline(path) if path.suffix == ".json" else None


def _open_runs(
    names: str, options: Options, stack: ExitStack, *, diagnosed: bool, quiet: bool
) -> list[Manifest]:
    """Runs of a comma-separated list of names, each once; a folder means all logs in it."""
    from pipeline.batch.recordings import list_named  # noqa: PLC0415 - heavy

    manifests: dict[str, Manifest] = {}
    for name in list_named(names):
        asked = replace(options, diagnosis=diagnosed)
        manifest = stack.enter_context(open_shown(name, asked, quiet=quiet)).manifest
        manifests.setdefault(manifest.run, manifest)
    return list(manifests.values())


def _render(checked: datasets.Check, to: Literal["markdown", "junit"]) -> str:
    return {"markdown": words.format_markdown, "junit": words.format_junit}[to](checked)


_LABEL = 26
_LEVEL = 9
_ROWS = 8
"""Parameters of a vehicle on a screen of 24 lines, those of most runs first."""
_SPREADS = (
    ("spread_terrain", "between terrains"),
    ("spread_run", "between runs"),
    ("chi_square", "reduced chi-square"),
)


def build_fleet() -> App:
    """The command and its own commands."""
    from pipeline.cli.verbs_datasets import draw  # noqa: PLC0415 - only for this command

    app = App(name="fleet", help="Fit, predict and follow the runs of a fleet; draw its map.")
    for command in (fit, show, predict, trend):
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
    """Fit every parameter by vehicle, terrain and run.

    The fleet model is fitted to all diagnosed runs.
    Writes fleet.json, fleet.parquet and fleet.html.

    Args:
        everything: also print parameters without an interval, spreads between terrains and runs, and reasons.
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.report.fleet_pages import write_fleet  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    store = Store(results)
    model, keys = datasets.fit_results(store)
    path = write_fleet(store, model, keys)
    content = {**datasets.summarize_fleet(model), "file": str(path)}
    return print_result(
        content, lambda: _format_fleet(content, everything=everything), json=json, quiet=quiet
    )


def show(  # noqa: D417 - the results folder documents itself
    results: Results = Path("results"), *, everything: All = False, json: bool = False, quiet: bool = False
) -> int:
    """Show the fleet model that was fitted last.

    Args:
        everything: as for `slip fleet fit`.
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    content = datasets.read_fleet(Store(results))
    return print_result(
        content, lambda: _format_fleet(content, everything=everything), json=json, quiet=quiet
    )


def _format_fleet(content: Mapping[str, object], *, everything: bool) -> list[str]:
    rows = cast("Sequence[Mapping[str, object]]", content["parameters"])
    runs = cast("Mapping[str, Sequence[str]]", content["runs"])
    lines = [str(content["summary"])]
    width = max([_LABEL, *(len(f"{row['effect']}.{row['parameter']}") + 2 for row in rows)])
    hidden = 0
    for vehicle, names in runs.items():
        own = [row for row in rows if row["vehicle"] == vehicle]
        known = [row for row in own if row["low"] is not None] or own
        shown = own if everything else known[:_ROWS]
        hidden += len(own) - len(shown)
        lines.append(f"{vehicle}: {format_count(len(names), 'run')}")
        lines += [_format_number(row, width, everything=everything) for row in shown] or [
            "  no significant effect in any of them"
        ]
        unsettled = own if everything else ()
        reasons = group_by((row["because"], f"{row['effect']}.{row['parameter']}") for row in unsettled)
        lines += [f"  {', '.join(labels)}: {because}" for because, labels in reasons.items()]
    notes = [f"! {note}" for note in cast("Sequence[str]", content["notes"])]
    if everything:
        return [*lines, *notes]
    others = [format_count(hidden, "more parameter")] if hidden else []
    rest = f"{', '.join([*others, 'spreads, and why each has its level'])}: --all, or the page"
    noted = [f"{format_count(len(notes), 'note')}: --all, or the page"] if notes else []
    return [*lines, rest, *noted]


def _format_number(row: Mapping[str, object], width: int, *, everything: bool) -> str:
    label = f"{row['effect']}.{row['parameter']}"
    unit = suffix_unit(row["unit"])
    spreads = [
        f"{words} {format_value(row[key])}"
        for key, words in (_SPREADS if everything else ())
        if row[key] is not None
    ]
    value = f"{format_value(row['value'])}{unit}"
    terrains = cast("Mapping[str, Mapping[str, float]]", row["terrains"] or {})
    if row["level"] == "terrain" and len(terrains) > 1 and not everything:
        means = (f"{name} {format_digits(of['value'])}" for name, of in sorted(terrains.items()))
        value = f"{', '.join(means)}{unit}"
    elif row["low"] is not None:
        middle, low, high = (float(str(row[key])) for key in ("value", "low", "high"))
        value = format_interval(middle, low, high, row["unit"])
    numbers = ", ".join([value, *spreads])
    name = "" if row["name"] == row["effect"] else f": {row['name']}"
    return f"  {row['level'] or 'open':<{_LEVEL}}{label:<{width}}{numbers}{name}"


_NOTES = 4
"""Notes of a trend on the screen; the page has all."""
_WORDS = (
    ("median_modulus", "median slip modulus", "m/s"),
    ("t_mrmse_m", "position error over 2 s", "m"),
    ("ideal_t_mrmse_m", "that of the ideal model", "m"),
)


def predict(
    *,
    vehicle: Annotated[str, Parameter(help="vehicle preset, for example warthog")],
    terrain: Annotated[str, Parameter(help="terrain to drive on, for example ice")],
    results: Results = Path("results"),
    input: Literal["command", "measured"] = "command",  # noqa: A002 - the word of the other verbs
    file: Path | None = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Predict the motion of a vehicle on a terrain.

    Its model, slip, and error over 2 s, with intervals.
    Intervals are 95 % prediction intervals of a further run. A terrain without runs is predicted from the
    vehicle's other terrains.

    Args:
        vehicle: vehicle preset, for example warthog.
        terrain: terrain to drive on, for example ice.
        results: results folder with diagnosed runs of the vehicle.
        input: input of the model.
        file: model file to write.
        json: print one JSON object.
        quiet: print no progress and no summary.
    """
    from pipeline.plan import forecast_deployment  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415

    store = Store(results)
    with show_progress(f"{vehicle} on {terrain}", quiet=quiet or json) as progress:
        forecast = forecast_deployment(store, vehicle, terrain, input, notify=progress)
        progress("driving their commands with drawn parameters")
        prediction = datasets.predict_deployment(store, forecast)
    if file is not None:
        models.write_model(datasets.make_model_file(prediction), file)
    summary = datasets.summarize_prediction(prediction)
    content = {**summary, "model": None if file is None else str(file)}
    return print_result(content, lambda: _format_forecast(content), json=json, quiet=quiet)


def _format_forecast(content: Mapping[str, object]) -> list[str]:
    here, elsewhere = content["runs_on_terrain"], content["runs_elsewhere"]
    there = f"{format_count(cast('int', here), 'run')} there, {elsewhere} elsewhere"
    lines = [f"{content['vehicle']} on {content['terrain']}: {there}"]
    lines += [f"! {note}" for note in cast("Sequence[str]", content["notes"])]
    numbers: dict[str, str] = {}
    for effect in cast("Sequence[Mapping[str, object]]", content["effects"]):
        parameters = cast("Mapping[str, Mapping[str, object]]", effect["parameters"])
        kind = models.find_effect(str(effect["id"]))()
        numbers |= {
            f"  {kind.id}.{name}": _format_expected(number, kind.parameter(name))
            for name, number in parameters.items()
        }
    width = max([_LABEL, *map(len, numbers)]) + 2
    lines += [f"{label:<{width}}{text}" for label, text in numbers.items()]
    if not content["effects"]:
        lines.append("  the ideal model: most runs have no significant effect")
    lines += [
        f"{words:<{width}}{_format_interval(cast('Mapping[str, object]', content[key]), unit)}"
        for key, words, unit in _WORDS
    ]
    if any(cast("Mapping[str, object]", content[key])["low"] is None for key, *_ in _WORDS):
        lines.append("no intervals: they need three runs")
    return lines if content["model"] is None else [*lines, f"written: {content['model']}"]


def _format_expected(number: Mapping[str, object], parameter: models.Parameter) -> str:
    """An expected parameter; a limit at the largest value of its search is none."""
    low, most, unit = number["low"], parameter.bounds[1], suffix_unit(parameter.unit)
    if parameter.neutral == math.inf and number["value"] == most:
        return "no limit" + (f", or one of at least {low:.3g}{unit}" if low is not None else "")
    cut = " (the interval ends at a limit of the search)" if number["at_bound"] and low is not None else ""
    return f"{_format_interval(number, parameter.unit)}{cut}"


def _format_interval(number: Mapping[str, object], unit: str) -> str:
    value, low, high = (cast("float", number[key]) for key in ("value", "low", "high"))
    if number["low"] is None:
        return format_length(value) if unit == "m" else f"{value:.3g}{suffix_unit(unit)}"
    if unit == "m" and value < 1.0:
        return format_interval(100.0 * value, 100.0 * low, 100.0 * high, "cm")
    return format_interval(value, low, high, unit)


def trend(  # noqa: D417 - arguments document themselves
    results: Results = Path("results"),
    *,
    by: Annotated[
        str, Parameter(help="groups for slip and health: dataset, vehicle, terrain, or several of them")
    ] = "dataset",
    threshold: Annotated[
        NonNegativeFloat, Parameter(help="relative change of slip that raises an alert")
    ] = TREND_THRESHOLD,
    limit: Annotated[
        tuple[str, ...], Parameter(help="QUANTITY=VALUE, an alert where the last run is above")
    ] = (),
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Follow slip, fitted parameters and data health over dates.

    The exit code is 4 where something changed.
    Writes trend.html and trend.json, which a batch keeps up to date. Parameters are followed by vehicle
    over all terrains, from four runs on; a change is reported where it is significant and larger than the
    detection threshold. Slip and health need nine runs and a change above --threshold. What changed with a
    parameter is listed beside it.

    Args:
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.report.trend_page import write_trend  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    if not math.isfinite(threshold):
        raise SlipError(
            "bad_limit", f"{threshold} is not a threshold", hint="Write --threshold 0.1 for a tenth"
        )
    limits = dict(map(_read_limit, limit))
    datasets.check_limits(limits)
    store = Store(results)
    names = tuple(name.strip() for name in by.split(",") if name.strip())
    followed = datasets.follow_trend(store, names, threshold=threshold, limits=limits)
    page = write_trend(store, followed)
    print_result(
        {**datasets.summarize_trend(followed), "page": str(page)},
        lambda: _format_trend(followed, page),
        json=json,
        quiet=quiet,
    )
    return ALERT if followed.alerts else CLEAN


def _read_limit(text: str) -> tuple[str, float]:
    name, _, value = text.rpartition("=")
    try:
        limit = float(value)
    except ValueError:
        limit = math.nan
    if not math.isfinite(limit):
        raise SlipError(
            "bad_limit",
            f"{text!r} is not a limit",
            hint="Write --limit QUANTITY=VALUE, as median_modulus=1.2",
        )
    return name.strip() or text, limit


def _format_trend(followed: datasets.Trend, page: Path) -> list[str]:
    quiet = datasets.format_quiet(followed.series, followed.parameters)
    lines = [f"!! {alert.text}" for alert in followed.alerts] or [quiet]
    # The notes list the parameters that could not be judged.
    rows = [
        (
            f"{one.vehicle} {one.label}",
            one.points.height,
            f"latest {one.shown_latest}, {datasets.format_power(one)}",
        )
        for one in followed.parameters
        if not one.need
    ]
    for group in dict.fromkeys(one.group for one in followed.series):
        own = [one for one in followed.series if one.group == group]
        slip = next((one for one in own if one.quantity.startswith("median_modulus")), None)
        if slip is None:
            rows.append((group, own[0].points.height, "no slip"))
        else:
            latest = f"latest {slip.latest:.3g}{suffix_unit(slip.unit)}"
            rows.append((group, slip.points.height, f"{datasets.name_quantity(slip.quantity)} {latest}"))
    width = max((len(label) for label, _, _ in rows), default=0)
    lines += [f"{label:<{width}}{runs:>5} run{'s' * (runs != 1):<2} {text}" for label, runs, text in rows]
    lines += [f"! {note}" for note in followed.notes[:_NOTES]]
    others = len(followed.notes) - _NOTES
    lines += [f"  {format_count(others, 'more note')} on the page"] if others > 0 else []
    return [*lines, f"page    {page}"]
