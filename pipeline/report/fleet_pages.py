"""Pages over runs: `slip fleet fit`, `slip fleet map --terrain`, and `slip compare --causes`."""

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
    format_share,
    group_by,
    mapping_in,
    number_in,
    objects_in,
    split_interval,
    suffix_unit,
)
from pipeline.datasets import (
    FLEET,
    GEOJSON,
    PAGE,
    SHARE_DIGITS,
    Budget,
    Causes,
    Difference,
    FleetModel,
    PassEffect,
    TerrainMap,
    fit_results,
    list_differences,
    list_features,
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
from pipeline.report.scene import CAP_QUANTILE
from pipeline.report.theme import (
    Chart,
    Drawing,
    encode_column,
    find_extent,
    fit_equal_aspect,
    layer,
    make_axis,
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


MOST_MAPS = 12
"""Largest number of maps on a page: those with most runs and cells; the table of cells has all."""
_SIDE = 420
_DEGREES = 180.0 / math.pi
_SHOWN = (
    ("slip", "Slip", "share of the motion lost", "%"),
    ("passes", "Passes", "crossings of the cell", ""),
    ("spread", "Spread of slip", "between quartiles of crossings", "%"),
    ("energy", "Energy of slip", "kinetic energy of the slip velocity", "J"),
    ("power", "Power", "drawn from the battery", "W"),
    ("lean", "Inclination", "of the vehicle", "deg"),
)
"""Column, title, description, and its unit for people."""


def render_terrain(drawn: TerrainMap) -> str:
    """Render the complete page as HTML."""
    groups = _group_maps(drawn)
    repeated = draw_passes(drawn.passes, drawn.effects)
    notes = list(drawn.notes)
    omitted = drawn.cell_table.select("frame", "vehicle").n_unique() - len(groups)
    if omitted > 0:
        notes.append(f"{omitted} more maps of fewer cells are in cells.parquet alone")
    count = len(drawn.keys)
    return render_figures(
        "report/templates/terrain.html",
        [picture for _, _, pictures in groups for picture in pictures] + repeated,
        title="What to expect by place",
        facts=[
            format_count(count, "run"),
            f"{drawn.cell_table.height} cells of {drawn.cell_m:g} m",
            f"{drawn.crossings} crossings",
            f"slip {INPUT_WORDS[drawn.input]}",
        ],
        groups=groups,
        sentences_of_effects=[effect.describe() for effect in drawn.effects],
        repeated=repeated,
        effects=_tabulate_effects(drawn.effects),
        notes=notes,
        runs=list(drawn.keys),
    )


def _group_maps(drawn: TerrainMap) -> list[tuple[str, str, list[Picture]]]:
    """Chapters of the page: number, name, maps."""
    cell_table = drawn.cell_table.with_columns((pl.col("slip_high") - pl.col("slip_low")).alias("spread"))
    sizes = cell_table.group_by("frame", "vehicle").agg(pl.col("runs").max(), pl.len().alias("count"))
    order = sizes.sort("runs", "count", "frame", "vehicle", descending=[True, True, False, False])
    groups = []
    for number, row in enumerate(order.head(MOST_MAPS).iter_rows(named=True)):
        mine = cell_table.filter(pl.col("frame") == row["frame"], pl.col("vehicle") == row["vehicle"])
        members = len(drawn.frames[row["frame"]])
        # A run without a shared frame has one of its own, called after it.
        is_own = row["frame"] == f"run {next(iter(drawn.frames[row['frame']]))}"
        name = f"{row['vehicle']}, {row['frame']}"
        name += "" if is_own else f", {format_count(members, 'run')}"
        pictures = [
            Picture(f"map-{number}-{column}", title, _draw_cells(mine, drawn.cell_m, number, shown), "half")
            for shown in _SHOWN
            for column, title in [shown[:2]]
            if _varies(mine, column)
        ]
        groups.append((f"frame-{number}", name, pictures))
    return groups


def _varies(cell_table: pl.DataFrame, column: str) -> bool:
    known = cell_table[column].drop_nulls()
    return not known.is_empty() and (column in {"slip", "passes"} or known.n_unique() > 1)


def _draw_cells(
    cell_table: pl.DataFrame, cell_m: float, number: int, shown: tuple[str, str, str, str]
) -> Drawing:
    """Draw a map of one quantity: one square per cell, equal scales in x and y."""
    column, title, about, unit = shown
    rows = cell_table.select(
        low_x=pl.col("x") - 0.5 * cell_m,
        high_x=pl.col("x") + 0.5 * cell_m,
        low_y=pl.col("y") - 0.5 * cell_m,
        high_y=pl.col("y") + 0.5 * cell_m,
        slip=100.0 * pl.col("slip"),
        spread=100.0 * pl.col("spread"),
        energy=pl.col("energy"),
        power=pl.col("power"),
        lean=_DEGREES * pl.col("lean"),
        passes=pl.col("passes").cast(pl.Float64),
        runs=pl.col("runs").cast(pl.Float64),
        terrain=pl.col("terrain"),
    )
    extent = [find_extent(pl.concat([rows[f"low_{axis}"], rows[f"high_{axis}"]])) for axis in "xy"]
    height, x_domain, y_domain = fit_equal_aspect(extent[0], extent[1], width=_SIDE)
    known = rows[column].drop_nulls()
    top = float(known.quantile(CAP_QUANTILE, "linear") or 0.0) or 1.0
    top = math.ceil(top) if column in {"passes", "runs"} else float(f"{top:.3g}")
    in_unit = f" [{unit}]" if unit else ""
    name = f"cells_{number}"
    drawn = rows.with_columns(pl.col(column).clip(upper_bound=top).alias(f"{column}_shown"))
    words = [("slip", "slip [%]", ".0f"), ("passes", "passes", ".0f"), ("runs", "runs", ".0f")]
    words += [
        ("energy", "energy [J]", ".2f"),
        ("power", "power [W]", ".0f"),
        ("lean", "inclination [deg]", ".1f"),
    ]
    chart = (
        Chart.of_rows(f"{name}_{column}")
        .mark("rect", stroke=theme.PAPER, strokeWidth=0.3)
        .encode(
            x=make_axis(
                "low_x", "x [m]", scale={"domain": x_domain, "nice": False, "zero": False}, tickCount=5
            ),
            x2="high_x:Q",
            y=make_axis(
                "low_y", "y [m]", scale={"domain": y_domain, "nice": False, "zero": False}, tickCount=5
            ),
            y2="high_y:Q",
            color=encode_column(
                f"{column}_shown:Q",
                scale={"range": list(theme.SLIP_RAMP), "interpolate": "rgb", "domainMin": 0.0},
                legend={"title": f"{title.lower()}{in_unit}", "gradientLength": 120, "gradientThickness": 8},
            ),
            tooltip=[
                "terrain:N",
                *(
                    encode_column(f"{one}:Q", title=said, format=form)
                    for one, said, form in words
                    if not rows[one].drop_nulls().is_empty()
                ),
            ],
        )
        .filter(f"datum.{column} !== null")
        .properties(width=_SIDE, height=height)
    )
    middle = float(known.median() or 0.0)  # type: ignore[arg-type]
    note = f"{about[:1].upper()}{about[1:]}; colours end at {top:,g}{f' {unit}' if unit else ''}."
    summary = f"{title} in {known.len()} cells: median {middle:.3g}{f' {unit}' if unit else ''}."
    return Drawing(chart, {f"{name}_{column}": drawn}, note, summary)


def draw_passes(passes: pl.DataFrame, effects: tuple[PassEffect, ...]) -> list[Picture]:
    """Draw the slip of further passes relative to the first one, one figure per dataset with an estimate."""
    pictures = []
    for number, effect in enumerate(effects):
        mine = passes.filter(pl.col("dataset") == effect.dataset)
        if effect.reason or mine.is_empty():
            continue
        rows = mine.select(
            passes=(pl.col("passes") + 1).cast(pl.Float64),
            ratio="ratio",
            low="low",
            high="high",
            line=(pl.col("passes").cast(pl.Float64) * math.log1p(effect.change)).exp(),
            crossings=pl.col("crossings").cast(pl.Float64),
        )
        name = f"passes_{number}"
        base = Chart.of_rows(name)
        scale = {"domainMin": 1, "nice": False, "zero": False}
        across = make_axis("passes", "number of the pass over a place", scale=scale, tickMinStep=1)
        bars = (
            base.mark("rule", color=theme.QUIET, strokeWidth=2)
            .encode(x=across, y="low:Q", y2="high:Q")
            .filter("datum.low !== null")
        )
        dots = base.mark("point", size=60, filled=True, color=theme.SLIP, opacity=1).encode(
            x=across,
            y=make_axis("ratio", "slip over that of the first pass", scale={"type": "log"}, tickCount=5),
            tooltip=[
                encode_column("ratio:Q", title="slip over the first pass", format=".2f"),
                encode_column("crossings:Q", title="crossings", format=".0f"),
            ],
        )
        line = base.mark("line", color=theme.MODEL, strokeWidth=1.6).encode(x=across, y="line:Q")
        chart = layer(bars, line, dots).properties(width=_SIDE, height=240)
        note = "Bars: 95 % intervals by stretches of 10 s. Line: the change per pass of the table."
        pictures.append(
            Picture(
                f"passes-{number}",
                effect.dataset,
                Drawing(chart, {name: rows}, note, effect.describe()),
                "half",
            )
        )
    return pictures


_UNDETERMINED = 10.0
"""Change per pass above which the end of an interval says nothing: slip grows elevenfold."""


def _tabulate_effects(effects: tuple[PassEffect, ...]) -> Table:
    head = (
        Column("dataset"),
        Column("change of slip per pass", number=True),
        Column("interval"),
        Column("beside a drift with time"),
        Column("places", number=True),
        Column("repeated crossings", number=True),
    )
    rows = [
        [
            effect.dataset,
            MISSING if effect.reason else _format_change(effect.change),
            MISSING if effect.reason else _format_ends(effect.low, effect.high),
            MISSING if math.isnan(effect.beside_time[0]) else _format_ends(*effect.beside_time),
            str(effect.places),
            str(effect.repeated),
        ]
        for effect in effects
    ]
    return Table(
        "Slip by number of passes within a run, beside place, direction, speed and turning", head, rows
    )


def _format_ends(low: float, high: float) -> str:
    if high > _UNDETERMINED:
        return "undetermined"
    return f"{_format_change(low)} to {_format_change(high)}"


def _format_change(share: float) -> str:
    """Format a change per pass as a percentage."""
    return format_share(share, SHARE_DIGITS).replace("-", "\u2212").replace(" ", "\u202f")


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


def write_terrain(store: Store, drawn: TerrainMap) -> dict[str, Path]:
    """Write `cells.parquet`, `terrain.html` and, if georeferenced, `terrain.geojson`; the files by name."""
    keys = " ".join(drawn.keys)
    names = drawn.cell_table.with_columns(pl.lit("*").alias("run"), pl.lit(keys).alias("keys"))
    store.write_results_table("cells", names.drop("i", "j"))
    written = {"cells.parquet": store.root / "cells.parquet"}
    features = list_features(drawn)
    if features:
        text = json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False) + "\n"
        written[GEOJSON] = store.write_results_text(GEOJSON, text)
    written[PAGE] = write_page(store, PAGE, render_terrain(drawn))
    return written
