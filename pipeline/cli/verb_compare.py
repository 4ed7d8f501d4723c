"""`slip compare`: datasets side by side, and whether they differ."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

from cyclopts import Parameter

from pipeline.analysis.options import FigureFormat
from pipeline.cli.choices import KeyFile, use_key
from pipeline.cli.output import print_result, say_value

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.fleet.tables import Answer
    from pipeline.store import Store


def compare(  # noqa: D417 - arguments document themselves
    results: Annotated[Path, Parameter(help="results folder")] = Path("results"),
    /,
    *,
    by: Annotated[
        str,
        Parameter(
            help="what makes a dataset: dataset, vehicle, terrain, run, day, month, year, or several of them"
        ),
    ] = "dataset",
    fed: Annotated[
        Literal["command", "measured"] | None,
        Parameter(
            name="--input",
            help="what the ideal model was fed with (default: the command where all runs have one)",
        ),
    ] = None,
    as_published: Annotated[bool, Parameter(negative="")] = False,
    causes: Annotated[bool, Parameter(negative="")] = False,
    figures: FigureFormat | None = None,
    out: Annotated[Path | None, Parameter(help="the same as RESULTS")] = None,
    key: KeyFile = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Compare the datasets of the results: medians with intervals, tests that count runs, effect sizes.

    Writes datasets.parquet, comparisons.parquet, both as CSV and LaTeX, and comparison.html.

    Args:
        as_published: compare window norms of the published chain in place of median moduli.
        causes: compare budgets: which effects carry the slip, and which the differences. Writes causes.html,
            causes.csv, causes.tex, cause_differences.csv and cause_differences.tex.
        figures: also write the figures in this format, for papers.
        json: print one JSON object in place of the tables.
        quiet: print nothing.
    """
    from pipeline.analysis.compare import Question, compare_results  # noqa: PLC0415 - heavy
    from pipeline.analysis.compare_files import describe_answer, write_answer  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    use_key(key)
    store = Store(out or results)
    names = tuple(name.strip() for name in by.split(",") if name.strip())
    if causes:
        return _compare_causes(store, names, fed, figures, json=json, quiet=quiet)
    answer = compare_results(store, Question(by=names, input=fed, as_published=as_published))
    written = write_answer(store, answer, figures)
    content = {**describe_answer(answer), "page": str(written["comparison.html"])}
    return print_result(content, lambda: _describe(answer, written), json=json, quiet=quiet)


def _compare_causes(
    store: Store,
    by: tuple[str, ...],
    fed: str | None,
    figures: FigureFormat | None,
    *,
    json: bool,
    quiet: bool,
) -> int:
    from pipeline.analysis.causes import describe_causes, find_causes, write_causes  # noqa: PLC0415 - heavy

    found = find_causes(store, by, fed)
    written = write_causes(store, found, figures)
    content = describe_causes(found)
    lines = [
        f"slip on {found.input.replace('measured', 'measured wheels')} by cause, parts of its mean square"
    ]
    for budget in found.budgets:
        parts = ", ".join(f"{found.names.get(one.name, one.name)} {one.share:z.0%}" for one in budget.parts)
        lines += [
            "",
            f"{budget.dataset}: {budget.total**0.5:.3g} m/s, {budget.runs} run{'s' * (budget.runs != 1)}",
            f"  {parts}",
        ]
    lines += [""] * bool(content["differences"])
    for one in cast("Sequence[Mapping[str, object]]", content["differences"]):
        lines += [str(one["sentence"]), *([f"  {one['note']}"] if one["note"] else [])]
    page = str(written["causes.html"])
    lines += ["", *(f"! {note}" for note in found.notes), f"page    {page}"]
    return print_result({**content, "page": page}, lambda: lines, json=json, quiet=quiet)


def _describe(answer: Answer, written: Mapping[str, Path]) -> list[str]:
    from pipeline.fleet.measures import MEASURES, compare_orders  # noqa: PLC0415 - heavy

    datasets = answer.datasets.filter(answer.datasets["input"] == answer.input).select(
        "dataset", "runs", "median_window_norm"
    )
    rated = answer.intervals.join(datasets, on="dataset").sort("value")
    label = "as published" if answer.quantity == "published_norm" else "median modulus"
    width = max([len(name) for name in rated["dataset"]] + [7]) + 1
    lines = [
        f"slip on {answer.input.replace('measured', 'measured wheels')}, {label} [m/s]",
        "",
        f"{'dataset':<{width}}{'runs':>5}{'median':>9}   {'95 % interval':<16}{'window norm':>12}",
    ]
    lines += [_describe_dataset(row, width) for row in rated.iter_rows(named=True)]
    lines += ["", *_describe_pairs(list(answer.comparisons.sort("p_adjusted", "p").iter_rows(named=True)))]
    orders = compare_orders(answer.datasets.filter(answer.datasets["input"] == answer.input))
    told = [one.text for one in orders if one.tau is None or MEASURES[one.measure].unit == "1"]
    lines += [*([""] if told else []), *dict.fromkeys(told)]
    return [*lines, "", *(f"! {note}" for note in answer.notes), f"page    {written['comparison.html']}"]


def _describe_dataset(row: Mapping[str, object], width: int) -> str:
    low, high = row["low"], row["high"]
    ends = f"{low:.3g} to {high:.3g}" if isinstance(low, float) and isinstance(high, float) else "-"
    only = " (this run)" if row["interval"] == "this run only" and ends != "-" else ""
    return (
        f"{row['dataset']:<{width}}{row['runs']:>5}{say_value(row['value']):>9}   "
        f"{ends:<16}{say_value(row['median_window_norm']):>12}{only}"
    )


def _describe_pairs(rows: Sequence[Mapping[str, object]]) -> list[str]:
    shown = [row for row in rows if isinstance(row["p_adjusted"], float) and row["p_adjusted"] <= 0.05]  # noqa: PLR2004 - the usual level
    lines = [
        f"{row['a']} and {row['b']} differ: shift {say_value(row['shift'])} m/s, "
        f"Cliff's delta {say_value(row['cliffs_delta'])} ({row['size']}), "
        f"p = {say_value(row['p_adjusted'])} corrected"
        + (", this run against that run, not the terrain" if row["unit_of_analysis"] == "blocks" else "")
        for row in shown
    ]
    rest = len(rows) - len(shown)
    if rest:
        lines.append(f"{rest} pair{'s' * (rest != 1)} not shown to differ")
    return lines
