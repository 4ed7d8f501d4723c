"""Commands that set datasets side by side: compare, fleet map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from pipeline import api, words
from pipeline.cli.conventions import All, Results, open_results, print_result
from pipeline.core import FigureFormat, name_install


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
    # Alone or before datasets, a folder is that of the results.
    is_folder = len(datasets) == 1 or (datasets and Path(datasets[0]).is_dir())
    if is_folder and results == Path("results"):
        results, datasets = Path(datasets[0]), datasets[1:]
    question = api.Question(
        api.split_names(by), fed, as_published=as_published, datasets=datasets, vehicle=vehicle
    )
    if causes:
        compared = api.compare_causes(results, question, figures)
        content, page = compared.result.to_json(), compared.page
        lines = words.format_causes(compared.result, everything=everything)
    else:
        answered = api.compare_datasets(results, question, figures)
        content, page = words.summarize_answer(answered.result), answered.page
        lines = words.format_answer(answered.result, everything=everything)
    lines.append(f"page    {page or _NO_PAGE}")
    answer = {**content, "page": None if page is None else str(page)}
    return print_result(answer, lambda: lines, json=json, quiet=quiet)


_NO_PAGE = f"none: {name_install()} draws it"


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
    # The default folder may be missing: the map then shows only the literature. Any other must exist.
    if results != Path("results"):
        open_results(results)
    made = api.draw_map(results, deployments, fed=fed, show=show, figures=figures)
    drawn, page = made.result, str(made.page or _NO_PAGE)
    content = {
        "deployments": drawn.points.to_dicts(),
        "datasets": drawn.own.to_dicts(),
        "input": drawn.input,
        "measure": vars(drawn.measure),
        "notes": list(drawn.notes),
        "page": page,
    }
    lines = [*words.format_map(drawn), f"page    {page}    ({words.summarize_map(drawn)})"]
    return print_result(content, lambda: lines, json=json, quiet=quiet)
