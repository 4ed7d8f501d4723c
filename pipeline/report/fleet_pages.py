"""Pages over runs: `slip fleet fit` and `slip compare --causes`."""

import contextlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import polars as pl

from pipeline.core import (
    INPUT_WORDS,
    FigureFormat,
    format_count,
    group_by,
    mapping_in,
    number_in,
    objects_in,
    split_interval,
    suffix_unit,
)
from pipeline.datasets import (
    FLEET,
    Budget,
    Causes,
    Difference,
    FleetModel,
    fit_results,
    list_differences,
    name_causes,
    summarize_fleet,
    tabulate_budgets,
    tabulate_differences,
    tabulate_fleet,
)
from pipeline.models import name_parameter
from pipeline.report import (
    MISSING,
    Cell,
    Column,
    Picture,
    Table,
    begin_large,
    format_known_share,
    format_number,
    label_names,
    set_squares,
    theme,
    write_page,
)
from pipeline.report.comparison_page import write_tables
from pipeline.report.page import add_figures, render_figures
from pipeline.report.theme import (
    Chart,
    Drawing,
    encode_column,
)
from pipeline.store import NoRunsError, Store

_LEVELS = (
    Column("parameter"), Column("level"), Column("value", number=True), Column("95 %", number=True),
    Column("between terrains", number=True), Column("between runs", number=True),
    Column("reduced chi-square", number=True), Column("found in", "runs", number=True),
)  # fmt: skip
_TERRAINS = (
    Column("parameter"), Column("terrain"), Column("mean", number=True), Column("95 %", number=True),
    Column("runs", number=True),
)  # fmt: skip


def render_fleet(content: Mapping[str, object]) -> str:
    """Render the complete page as HTML.

    Args:
        content: the JSON object of `slip fleet fit`, with its `keys`.
    """
    rows = objects_in(content, "parameters")
    runs = mapping_in(content, "runs")
    reasons = group_by(
        (f"{row['because']} ({row['vehicle']})", _label(row)) for row in rows if row["level"] is None
    )
    vehicles = []
    for number, name in enumerate(runs):
        own = [row for row in rows if row["vehicle"] == name]
        known = [row for row in own if row["low"] is not None]
        few = [row for row in own if row["low"] is None]
        levels = _tabulate_levels(f"Parameters of {name} by level", known or few)
        single = f"{format_count(len(few), 'parameter')} of {name} from too few runs for an interval"
        means = [row_means for row in own for row_means in _list_terrains(row)]
        folded = [
            _tabulate_levels(single, few if known else []),
            Table(f"Means of {name} by terrain", _TERRAINS, means),
        ]
        vehicles.append((f"vehicle-{number}", name, levels, [table for table in folded if table.rows]))
    keys = cast("Sequence[str]", content["keys"])
    return render_figures(
        "report/templates/fleet.html",
        [],
        title="Parameters by level: vehicle, terrain, run",
        facts=[
            f"{len(counted)} {word}{'s' * (len(counted) != 1)}"
            for word, counted in (("vehicle", runs), ("run", keys), ("number", rows))
        ],
        summary=str(content.get("summary") or ""),
        vehicles=vehicles,
        open=[
            *(f"{why}: {', '.join(labels)}" for why, labels in reasons.items()),
            *cast("Sequence[str]", content["notes"]),
        ],
        runs=keys,
    )


def _tabulate_levels(caption: str, parameters: Sequence[Mapping[str, object]]) -> Table:
    return Table(caption, _LEVELS, [_list(row) for row in parameters]).drop_empty()


def _label(row: Mapping[str, object]) -> str:
    return f"{row['effect']}.{row['parameter']}"


def _name(row: Mapping[str, object]) -> str:
    """Name of a parameter in words: at its level, where that has its own."""
    if row["name"] == row["effect"]:
        return name_parameter(str(row["effect"]), str(row["parameter"]))
    return begin_large(str(row["name"]).replace("_", " "))


def _list(row: Mapping[str, object]) -> list[str | Cell]:
    # What one run cannot tell is left empty, not dashed: on a phone each cell is words.
    known = [number_in(row, key) for key in ("spread_terrain", "spread_run", "chi_square")]
    spreads = ["" if value is None else format_number(value) for value in known]
    return [
        Cell(_name(row), small=_label(row), notes=[str(row["because"])] if row["level"] else ()),
        str(row["level"] or "open"),
        *_format_value(row, row),
        *spreads,
        f"{row['named']} of {row['runs']}",
    ]


def _list_terrains(row: Mapping[str, object]) -> list[list[str | Cell]]:
    terrains = mapping_in(row, "terrains")
    means = {name: mapping_in(terrains, name) for name in terrains}
    return [
        [
            Cell(_name(row), small=_label(row)),
            name,
            *_format_value(mean, row),
            str(mean["runs"]),
        ]
        for name, mean in means.items()
    ]


def _format_value(of: Mapping[str, object], row: Mapping[str, object]) -> tuple[Cell, str]:
    """A value with its unit, and its interval; both with the digits that the interval supports."""
    unit = set_squares(suffix_unit(row["unit"]).strip())
    value, low, high = (number_in(of, key) for key in ("value", "low", "high"))
    if value is None or low is None or high is None:
        return Cell(format_number(value), small=unit), ""
    texts = [text.replace("-", "\u2212") for text in split_interval(value, low, high)]
    return Cell(texts[0], small=unit), f"{texts[1]}\u00a0to\u00a0{texts[2]}"


# Datasets side by side as budgets by cause, and what they differ by.

_COLOURS = (theme.MODEL, theme.ON_COMMAND, theme.ON_MEASURED, theme.SLIP, theme.DRIVETRAIN, theme.MARK)
_LEFT = {"disturbance": theme.GROUND, "localization_noise": theme.CROSS}
_OTHERS = "other effects"
_FEW = 3
"""Differences that a page shows where these runs show none to be more than chance; the others are folded."""


def render_causes(causes: Causes) -> str:
    """Render the complete page as HTML; differences that these runs cannot show are folded away."""
    budgets, names, keys = causes.budgets, causes.names, causes.keys
    shown = [one for one in causes.differences if not one.note] or causes.differences[:_FEW]
    others = [one for one in causes.differences if one not in shown]
    return render_figures(
        "report/templates/causes.html",
        [draw_causes(budgets, names)],
        title="Deployments compared by cause",
        facts=[
            format_count(len(budgets), "dataset"),
            format_count(len(keys), "run"),
            f"slip {INPUT_WORDS[causes.input]}",
        ],
        sentence_list=list_differences(shown, names),
        doubtful=list_differences(others, names),
        folded=len(others),
        budgets=_tabulate_budgets(budgets, names),
        differences=_tabulate_differences(causes.differences, names),
        notes=causes.notes,
        runs=keys,
    )


def draw_causes(budgets: Sequence[Budget], names: Mapping[str, str]) -> Picture:
    """Draw a bar per dataset with the length of its RMS slip, split into causes; the largest are coloured."""
    size: dict[str, float] = {}
    for budget in budgets:
        for part in budget.parts:
            if part.kind == "effect":
                size[part.name] = size.get(part.name, 0.0) + abs(part.share) * budget.total
    shown = sorted(size, key=lambda name: -size[name])[: len(_COLOURS)]
    rows = []
    labels = label_names([budget.dataset for budget in budgets])
    for budget in budgets:
        rms = math.sqrt(budget.total)
        for part in budget.parts:
            known = part.kind != "effect" or part.name in shown
            cause = names.get(part.name, part.name) if known else _OTHERS
            rows.append(
                (
                    labels[budget.dataset],
                    cause.replace("_noise", " noise"),
                    rms * part.share,
                    format_known_share(part.share),
                )
            )
    kinds = {"dataset": pl.String, "cause": pl.String, "slip": pl.Float64, "told": pl.String}
    order = [*(names.get(name, name) for name in shown), _OTHERS, "disturbance", "localization noise"]
    colours = [*_COLOURS[: len(shown)], theme.INK, *_LEFT.values()]
    chart = (
        Chart.of_rows("causes")
        .mark("bar")
        .encode(
            y=encode_column(
                "dataset:N",
                sort=list(labels.values()),
                axis={"title": None, "grid": False},
            ),
            x=encode_column(
                "sum(slip):Q", axis={"title": "RMS slip over half a second [m/s]", "format": ",~r"}
            ),
            color=encode_column(
                "cause:N",
                scale={"domain": order, "range": colours},
                legend={"title": None, "columns": 3},
            ),
            tooltip=["dataset:N", "cause:N", encode_column("told:N", title="share")],
        )
        .properties(width=640, height={"step": 30}, usermeta={"gutter": 150})
    )
    frame = pl.DataFrame(rows, schema=kinds, orient="row")
    sentence = "; ".join(f"{one.dataset} {format_number(math.sqrt(one.total))} m/s" for one in budgets)
    note = (
        "The RMS slip of a dataset, divided in proportion to the shares of its mean square. A negative part "
        "increases the held-out slip of the model."
    )
    return Picture(
        "causes",
        "RMS slip of each dataset by cause",
        Drawing(chart, {"causes": frame}, note, f"RMS slip: {sentence}."),
    )


def _tabulate_budgets(budgets: Sequence[Budget], names: Mapping[str, str]) -> Table:
    columns = (
        Column("dataset"), Column("runs", number=True), Column("cause"), Column("share", number=True),
        Column("95 % interval", number=True),
    )  # fmt: skip
    rows = [
        (
            one.dataset,
            str(one.runs),
            names.get(part.name, part.name),
            format_known_share(part.share),
            _format_cause_ends(part.low, part.high),
        )
        for one in budgets
        for part in one.parts
    ]
    return Table("Budgets: shares of the mean square slip, means over runs", columns, rows)


def _tabulate_differences(differences: Sequence[Difference], names: Mapping[str, str]) -> Table:
    columns = (
        Column("difference"), Column("cause"), Column("more slip", "m/s", number=True),
        Column("95 % interval", number=True), Column("p corrected", number=True), Column("method"),
    )  # fmt: skip
    rows = [
        (f"{one.b} \u2212 {one.a}", names.get(part.name, part.name), format_number(part.difference),
         _format_cause_ends(part.low, part.high, format_number), format_number(part.p_adjusted),
         part.method or MISSING)
        for one in differences
        for part in one.parts
    ]  # fmt: skip
    return Table("Differences of RMS slip by cause; p after Holm over the causes of a pair", columns, rows)


def _format_cause_ends(
    low: float, high: float, format_end: Callable[[float], str] = format_known_share
) -> str:
    if not (math.isfinite(low) and math.isfinite(high)):
        return MISSING
    return f"{format_end(low)} to {format_end(high)}"


def write_causes(store: Store, causes: Causes, figures: FigureFormat | None = None) -> dict[str, Path]:
    """Write `causes` and `cause_differences` as CSV and LaTeX, and `causes.html`; the files by name.

    Where figures cannot be drawn, the page is left out.

    Args:
        store: the results.
        causes: result of `find_causes`.
        figures: also write the figure to `figures/` in this format.
    """
    written: dict[str, Path] = {}
    for name, frame in (
        ("causes", tabulate_budgets(causes)),
        ("cause_differences", tabulate_differences(causes)),
    ):
        written |= write_tables(store, name, frame, frame)
    names = name_causes(causes.names)
    if theme.can_draw():
        page = render_causes(replace(causes, names=names))
        written["causes.html"] = write_page(store, "causes.html", page)
    return written | add_figures(store, lambda: [draw_causes(causes.budgets, names)], figures)


def write_fleet(store: Store, model: FleetModel, keys: tuple[str, ...]) -> Path:
    """Write `fleet.json`, the table `fleet` and the page; return the path of the first."""
    store.write_results_table("fleet", tabulate_fleet(model, keys))
    content = {**summarize_fleet(model), "keys": list(keys)}
    write_page(store, "fleet.html", render_fleet(content))
    return store.write_results_text(FLEET, json.dumps(content, indent=1, allow_nan=False) + "\n")


def update_fleet(store: Store) -> None:
    """Refit an existing fleet model; do nothing if there is none.

    The model stays unchanged if no run has estimates.
    """
    if (store.root / FLEET).is_file():
        with contextlib.suppress(NoRunsError):
            write_fleet(store, *fit_results(store))
