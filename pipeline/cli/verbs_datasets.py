"""Commands that set datasets side by side: compare, fleet map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from pipeline import datasets, store, words
from pipeline.cli.conventions import All, Results, format_value, open_results, print_result
from pipeline.core import (
    INPUT_WORDS,
    PACKAGE,
    FigureFormat,
    align_rows,
    format_count,
    format_share,
    format_two,
    split_interval,
    suffix_unit,
)


def compare(  # noqa: D417 - arguments document themselves
    *datasets: Annotated[
        str,
        Parameter(
            help="datasets to compare with each other (default: all of each vehicle); the results folder may "
            "stand before them"
        ),
    ],
    results: Results = Path("results"),
    vehicle: Annotated[str, Parameter(help="compare only runs of this vehicle, for example warthog")] = "",
    by: Annotated[
        str,
        Parameter(
            help="columns that define a dataset: dataset, vehicle, terrain, run, day, month, year, or several"
        ),
    ] = "dataset",
    fed: Annotated[
        Literal["command", "measured"] | None,
        Parameter(
            name="--input",
            help="input of the ideal model (default: both)",
        ),
    ] = None,
    as_published: bool = False,
    causes: bool = False,
    figures: FigureFormat | None = None,
    everything: All = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Compare datasets: which is harder, as driven and at equal driving.

    The unit of the tests is the run.
    Writes datasets.parquet, comparisons.parquet, both also as CSV, features.parquet and comparison.html.

    Args:
        as_published: compare 2 s window norms, as published, in place of median slip moduli.
        causes: compare budgets: which effects contribute to the slip, and which to the differences. Writes
            causes.html, causes.csv and cause_differences.csv.
        figures: also write the figures in this format, for papers.
        everything: also print the tables of datasets and pairs, and all notes.
        json: print one JSON object in place of the lines.
        quiet: print nothing.
    """
    from pipeline.datasets import Question, compare_results, find_causes  # noqa: PLC0415 - heavy
    from pipeline.report.datasets_page import write_answer, write_causes  # noqa: PLC0415 - heavy

    # Alone or before datasets, a folder is that of the results.
    is_folder = len(datasets) == 1 or (datasets and Path(datasets[0]).is_dir())
    if is_folder and results == Path("results"):
        results, datasets = Path(datasets[0]), datasets[1:]
    names = tuple(name.strip() for name in by.split(",") if name.strip())
    question = Question(names, fed, as_published=as_published, datasets=datasets, vehicle=vehicle)
    folder = store.Store(results)
    if causes:
        compared = find_causes(folder, question)
        written = write_causes(folder, compared, figures)
        content, lines = compared.to_json(), _format_causes(compared, everything=everything)
    else:
        answer = compare_results(folder, question)
        written = write_answer(folder, answer, figures)
        content, lines = words.summarize_answer(answer), _format_answer(answer, everything=everything)
    page = next((str(path) for name, path in written.items() if name.endswith(".html")), None)
    lines.append(f"page    {page or _NO_PAGE}")
    return print_result({**content, "page": page}, lambda: lines, json=json, quiet=quiet)


_NO_PAGE = f"none: pip install '{PACKAGE}[report]' draws it"
_MOST = 3
"""Differences and notes on the screen without `--all`."""
_MOST_PAIRS = 10
"""Pairs on the screen, as many as five datasets have; the page has all."""
_LEAST_SHARE = 0.01
"""Share of a budget from which on its cause is named on a screen; the page has all."""


def _format_causes(causes: datasets.Causes, *, everything: bool) -> list[str]:
    lines = [f"slip {INPUT_WORDS[causes.input]} by cause, shares of its mean square"]
    for budget in causes.budgets:
        shown = [one for one in budget.parts if everything or abs(one.value) >= _LEAST_SHARE]
        parts = [f"{causes.names.get(one.name, one.name)} {format_share(one.value, 0)}" for one in shown]
        rms, runs = format_two(budget.total**0.5), format_count(budget.runs, "run")
        lines += ["", f"{budget.dataset}: root mean square {rms} m/s, {runs}", f"  {', '.join(parts)}"]
    sentences = [one.describe(causes.names) for one in causes.differences]
    return [
        *lines,
        "",
        *_shorten(sentences, "difference", everything=everything),
        *_list_notes(causes.notes, everything),
    ]


def _shorten(lines: Sequence[str], what: str, *, everything: bool) -> list[str]:
    """The lines, or the first ones and how many more there are."""
    if everything or len(lines) <= _MOST:
        return list(lines)
    return [*lines[:_MOST], f"  {format_count(len(lines) - _MOST, f'more {what}')} (--all, page)"]


def _list_notes(notes: Sequence[str], everything: bool) -> list[str]:  # noqa: FBT001 - as the option
    lines = _shorten([f"! {note}" for note in notes], "note", everything=everything)
    return ["", *lines] if lines else []


def _format_answer(answer: datasets.Answer, *, everything: bool) -> list[str]:
    lines: list[str] = []
    title = ""
    for head, about, text in words.list_answer(answer, main_only=not everything):
        lines += ([""] * bool(lines) + [f"slip of {head}"]) * (head != title)
        title = head
        lines.append(f"  {about:<18}{text}")
    for view in answer.views if everything else ():
        about = f"{datasets.QUANTITIES[view[1]]}, {INPUT_WORDS[view[0]]}"
        levels = [
            (row["dataset"], format_value(row["value"]), _format_ends(row), row["interval"])
            for row in answer.take(answer.levels, view).sort("value").iter_rows(named=True)
        ]
        pairs = [
            (f"{row['b']} / {row['a']}", words.format_ratio(row, row["b"]), format_value(row["p_adjusted"]))
            for row in answer.take(answer.comparisons, view)
            .sort("p_adjusted", nulls_last=True)
            .iter_rows(named=True)
        ]
        lines += ["", *align_rows([(f"{answer.measure} {about}", "m/s", "95 % interval", ""), *levels])]
        lines += [
            "",
            *align_rows([("times as much slip", "ratio", "p adjusted"), *pairs[:_MOST_PAIRS]]),
        ] * bool(pairs)
        omitted = len(pairs) - _MOST_PAIRS
        lines += [f"... and {omitted} more pairs on the page"] * (omitted > 0)
    others = [
        INPUT_WORDS[name] for name in dict.fromkeys(one for one, _ in answer.views) if name != answer.input
    ]
    rest = ", ".join([*others, "all datasets and pairs with intervals"])
    lines += [] if everything else ["", f"{rest}: --all, or the page"]
    return [*lines, *_list_notes(words.list_shown_notes(answer), everything)]


def _format_ends(row: Mapping[str, object]) -> str:
    value, low, high = (row.get(key) for key in ("value", "low", "high"))
    if not (isinstance(value, float) and isinstance(low, float) and isinstance(high, float)):
        return "-"
    return " to ".join(split_interval(value, low, high)[1:])


def draw(  # noqa: D417 - arguments document themselves
    results: Results = Path("results"),
    *,
    deployments: Annotated[
        Path | None, Parameter(help="table of deployments (CSV) in place of the project's own")
    ] = None,
    fed: Annotated[
        Literal["command", "measured"] | None,
        Parameter(name="--input", help="input of the ideal model (default: as slip compare)"),
    ] = None,
    show: Annotated[
        Literal["slip", "relative", "energy", "unpredictability", "transitory"],
        Parameter(help="the measure of difficulty that colours own datasets"),
    ] = "slip",
    figures: FigureFormat | None = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Draw deployments of the literature and own datasets by kinetic energy and terrain complexity.

    Writes map.html.

    Args:
        figures: also write the figure in this format, for papers.
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.report.datasets_page import write_map  # noqa: PLC0415 - heavy

    # The default folder may be missing: the map then shows only the literature. Any other must exist.
    folder = store.Store(results) if results == Path("results") else open_results(results)
    drawn = datasets.draw_up_map(folder, deployments, fed=fed, show=show)
    page = str(write_map(folder, drawn, figures).get("map.html", _NO_PAGE))
    content = {
        "deployments": drawn.points.to_dicts(),
        "datasets": drawn.own.to_dicts(),
        "input": drawn.input,
        "measure": vars(drawn.measure),
        "notes": list(drawn.notes),
        "page": page,
    }
    unit = suffix_unit(drawn.measure.unit)
    lines = [
        f"{row['dataset']:<26}{row['energy']:>9.3g} J   complexity {row['complexity']:.1f}   "
        f"{drawn.measure.name} {format_value(row['value'])}{unit}"
        for row in drawn.own.iter_rows(named=True)
    ]
    total = drawn.points.height + len(drawn.missing)
    lines += [f"! {note}" for note in drawn.notes]
    lines.append(
        f"page    {page}    ({drawn.points.height} of {total} deployments placed; "
        f"{drawn.measure.name} {INPUT_WORDS[drawn.input]})"
    )
    return print_result(content, lambda: lines, json=json, quiet=quiet)
