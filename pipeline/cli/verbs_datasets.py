"""Commands that set datasets side by side: compare, fleet map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from pipeline import datasets, words
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

if TYPE_CHECKING:
    from pipeline.store import Store


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
    Writes datasets.parquet, comparisons.parquet, both as CSV and LaTeX, features.parquet and comparison.html.

    Args:
        as_published: compare 2 s window norms, as published, in place of median slip moduli.
        causes: compare budgets: which effects contribute to the slip, and which to the differences. Writes
            causes.html, causes.csv, causes.tex, cause_differences.csv and cause_differences.tex.
        figures: also write the figures in this format, for papers.
        everything: also print the tables of datasets and pairs, and all notes.
        json: print one JSON object in place of the lines.
        quiet: print nothing.
    """
    from pipeline.datasets import Question, compare_results  # noqa: PLC0415 - heavy
    from pipeline.report.comparison_page import write_answer  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    # Alone or before datasets, a folder is that of the results.
    is_folder = len(datasets) == 1 or (datasets and Path(datasets[0]).is_dir())
    if is_folder and results == Path("results"):
        results, datasets = Path(datasets[0]), datasets[1:]
    names = tuple(name.strip() for name in by.split(",") if name.strip())
    question = Question(names, fed, as_published=as_published, datasets=datasets, vehicle=vehicle)
    store = Store(results)
    if causes:
        return _compare_causes(store, question, figures, everything=everything, json=json, quiet=quiet)
    answer = compare_results(store, question)
    written = write_answer(store, answer, figures)
    content = {**words.summarize_answer(answer), "page": _find_page(written, "comparison.html")}
    return print_result(
        content, lambda: _format_answer(answer, written, everything=everything), json=json, quiet=quiet
    )


_LEAST_SHARE = 0.01
"""Share of a budget from which on its cause is named on a screen; the page has all."""


def _compare_causes(
    store: Store,
    question: datasets.Question,
    figures: FigureFormat | None,
    *,
    everything: bool,
    json: bool,
    quiet: bool,
) -> int:
    from pipeline.report.fleet_pages import write_causes  # noqa: PLC0415 - heavy

    causes = datasets.find_causes(store, question)
    written = write_causes(store, causes, figures)
    content, names = datasets.summarize_causes(causes), datasets.name_causes(causes.names)
    lines = [f"slip {INPUT_WORDS[causes.input]} by cause, shares of its mean square"]
    for budget in causes.budgets:
        shown = [one for one in budget.parts if everything or abs(one.share) >= _LEAST_SHARE]
        parts = [f"{names.get(one.name, one.name)} {format_share(one.share, 0)}" for one in shown]
        others = 1.0 - sum(one.share for one in shown)
        parts += [f"others {format_share(others, 0)}"] if abs(others) >= _LEAST_SHARE else []
        rms, runs = format_two(budget.total**0.5), format_count(budget.runs, "run")
        lines += ["", f"{budget.dataset}: root mean square {rms} m/s, {runs}", f"  {', '.join(parts)}"]
    lines += [""] * bool(causes.differences)
    lines += datasets.list_differences(causes.differences if everything else causes.differences[:_FEW], names)
    if not everything and len(causes.differences) > _FEW:
        lines.append(f"{len(causes.differences) - _FEW} more differences (--all, page)")
    page = _find_page(written, "causes.html")
    lines += ["", *_list_notes(causes.notes, everything=everything), f"page    {page or _NO_PAGE}"]
    return print_result({**content, "page": page}, lambda: lines, json=json, quiet=quiet)


_MOST_PAIRS = 10
"""Pairs on the screen, as many as five datasets have; the page has all."""


_FEW = 3
"""Differences on the screen without `--all`."""
_NOTES = 2
"""Notes on the screen without `--all`."""


def _list_notes(notes: Sequence[str], *, everything: bool) -> list[str]:
    shown = notes if everything else notes[:_NOTES]
    lines = [f"! {note}" for note in shown]
    rest = format_count(len(notes) - len(shown), "more note")
    return [*lines, f"  {rest} (--all, page)"] if len(notes) > len(shown) else lines


def _format_answer(answer: datasets.Answer, written: Mapping[str, Path], *, everything: bool) -> list[str]:
    from pipeline.words.comparison import list_lines  # noqa: PLC0415 - heavy

    lines: list[str] = []
    title = ""
    for line in list_lines(answer):
        if line.input != answer.input and not everything:
            continue
        if words.title_line(line) != title:
            title = words.title_line(line)
            lines += [""] * bool(lines) + [f"slip of {title}"]
        lines.append(f"  {line.driving:<18}{line.text}")
    for name in answer.inputs if everything else ():
        lines += ["", *_format_datasets(answer, name), *_format_pairs(answer, name)]
    orders = datasets.compare_orders(answer.datasets.filter(answer.datasets["input"] == answer.input))
    sentences = [one.text for one in orders if one.tau is None or datasets.MEASURES[one.measure].unit == "1"]
    lines += [*([""] if sentences else []), *dict.fromkeys(sentences)]
    others = [INPUT_WORDS[name] for name in answer.inputs if name != answer.input]
    rest = ", ".join([*others, "all datasets and pairs with intervals"])
    lines += [] if everything else ["", f"{rest}: --all, or the page"]
    notes = _list_notes(words.list_shown_notes(answer), everything=everything)
    return [
        *lines,
        *([""] if notes else []),
        *notes,
        f"page    {_find_page(written, 'comparison.html') or _NO_PAGE}",
    ]


_NO_PAGE = f"none: pip install '{PACKAGE}[report]' draws it"


def _find_page(written: Mapping[str, Path], name: str) -> str | None:
    """A page that was written; None where figures cannot be drawn."""
    return str(written[name]) if name in written else None


def _format_datasets(answer: datasets.Answer, name: str) -> list[str]:
    """Medians of the datasets on an input, as driven and at equal driving."""
    driven, equal = (answer.find_view(name, equal=one) for one in (False, True))
    if driven is None:
        return []
    counts = answer.datasets.filter(answer.datasets["input"] == name).select("dataset", "runs")
    shown = driven.levels.join(counts, on="dataset").sort("value", "dataset")
    levels = {row["dataset"]: row for row in equal.levels.iter_rows(named=True)} if equal else {}
    table = [("dataset", "runs", "as driven", "95 % interval", "equal driving", "95 % interval")]
    table += [
        (
            row["dataset"],
            str(row["runs"]),
            format_value(row["value"]),
            _format_ends(row) + " (this run)" * (row["interval"] == "this run only"),
            format_value(levels.get(row["dataset"], {}).get("value")),
            _format_ends(levels.get(row["dataset"], {})),
        )
        for row in shown.iter_rows(named=True)
    ]
    shown_columns = [row if levels else row[:4] for row in table]
    head = f"{answer.measure} [m/s], {INPUT_WORDS[name]}"
    return [head, *align_rows(shown_columns, right=(1, 2, 4), gap=3)]


def _format_ends(row: Mapping[str, object]) -> str:
    value, low, high = (row.get(key) for key in ("value", "low", "high"))
    if not (isinstance(value, float) and isinstance(low, float) and isinstance(high, float)):
        return "-"
    return " to ".join(split_interval(value, low, high)[1:])


def _format_pairs(answer: datasets.Answer, name: str) -> list[str]:
    """One line a pair, the surest first."""
    rows = [
        (
            f"{pair.hard} / {pair.easy}",
            f"{pair.driven}{'*' * pair.is_driven_sure}",
            f"{pair.equal}{'*' * pair.is_equal_sure}",
            pair.common,
            pair.carrier,
        )
        for pair in words.list_pairs(answer, name)
    ]
    if not rows:
        return []
    head = ("times as much slip", "as driven", "equal driving", "in common", "carried by, as driven")
    shown = [head, *rows[:_MOST_PAIRS]]
    columns = [k for k in range(len(head)) if any(row[k] for row in shown[1:])]
    lines = ["", *align_rows([[row[k] for k in columns] for row in shown])]
    omitted = len(rows) - _MOST_PAIRS
    marked = any("*" in text for row in rows[:_MOST_PAIRS] for text in row)
    lines += ["* significant over all pairs of the vehicle"] if marked else []
    return [*lines, f"... and {omitted} more pairs on the page"] if omitted > 0 else lines


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
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    # The default folder may be missing: the map then shows only the literature. Any other must exist.
    store = Store(results) if results == Path("results") else open_results(results).open_store()
    drawn = datasets.draw_up_map(store, deployments, fed=fed, show=show)
    page = write_map(store, drawn, figures)
    content = {
        "deployments": drawn.points.to_dicts(),
        "datasets": drawn.own.to_dicts(),
        "input": drawn.input,
        "measure": vars(drawn.measure),
        "notes": list(drawn.notes),
        "page": str(page),
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
