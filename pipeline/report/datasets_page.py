"""Pages of what sets runs side by side: comparison, causes, fleet, trend, map, check."""

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import polars as pl

from pipeline.core import INPUT_WORDS, FigureFormat, Floats, format_count, format_csv
from pipeline.datasets import (
    ABOUT_UNIT,
    AS_PUBLISHED,
    EQUAL_DRIVING,
    OTHERS_SPREAD,
    OVER_RUNS,
    QUANTITIES,
    THIS_RUN,
    Answer,
    Budget,
    Causes,
    DeploymentMap,
    Fleet,
    RunsCheck,
    Series,
    Trend,
)
from pipeline.report import Picture, bracket_unit, format_number, label_names, theme, write_page
from pipeline.report.page import write_pictures
from pipeline.report.pages import Page, Section
from pipeline.report.theme import Chart, Drawing, encode_column, layer, make_axis
from pipeline.results import BUDGET_SLIP
from pipeline.store import Store
from pipeline.words import (
    Table,
    list_check_sentences,
    list_shown_notes,
    list_sides,
    name_series,
    tabulate_answer,
    tabulate_causes,
    tabulate_check,
    tabulate_datasets,
    tabulate_fleet,
    tabulate_limits,
    tabulate_map,
    tabulate_pairs,
    tabulate_trend,
)

_ROW = 34
_LEAST = 1e-3
"""Slip [m/s] below which a level is drawn at the end of its axis: no pose is so exact."""
_TICKS = [float(f"{digit}e{power}") for power in range(-3, 3) for digit in (1, 2, 5)]
_INTERVALS = {OVER_RUNS: theme.ON_COMMAND, OTHERS_SPREAD: theme.ON_MEASURED, THIS_RUN: theme.CROSS}
"""Colours of intervals by what they are of."""
_MAP, _COMPLEXITY = (720, 520), (0.0, 10.0)
"""Width and height of the map [px], and the ends of the scale of terrains."""
_RADIUS, _LETTER = {True: 7.5, False: 5.0}, {True: 7.0, False: 6.0}
"""Of own marks and of others: radius, and width of a letter beside them [px]."""
_SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))
"""Where a name may stand beside its mark, the best first."""
_MOST_FIGURES = 40
"""Series of a page: those with a step come first."""


def _build_page(
    title: str,
    facts: Sequence[str],
    *,
    lines: Sequence[str] = (),
    pictures: Sequence[Picture] = (),
    answer: Table | None = None,
    tables: Sequence[Table] = (),
    notes: Sequence[str] = (),
    runs: Sequence[str] = (),
) -> Page:
    """A result in sentences and figures, its numbers, and behind a line notes and the runs that count."""
    counted = f"{format_count(len(notes), 'note')}, and the {format_count(len(runs), 'run')} counted"
    return Page(
        title,
        facts,
        [
            Section(
                "answer", "Result", lines=lines, pictures=pictures, tables=() if answer is None else [answer]
            ),
            Section("numbers", "Numbers", tables=tables),
            Section("notes", "Notes", lines=notes, items=runs, brief=counted),
        ],
    )


def _write(store: Store, name: str, page: Page, figures: FigureFormat | None = None) -> dict[str, Path]:
    """Write a page where figures can be drawn, and its figures if a format is given; the files by name."""
    written: dict[str, Path] = {}
    if theme.can_draw() or not page.pictures:
        written[name] = write_page(store, name, page.render())
    if figures is not None:
        made = write_pictures(page.pictures, store.root / "figures", figures)
        written |= {path.name: path for path in made}
    return written


def write_answer(store: Store, answer: Answer, figures: FigureFormat | None = None) -> dict[str, Path]:
    """Write `datasets`, `comparisons` and `features`, the first two also as CSV, and `comparison.html`.

    Args:
        store: the results.
        answer: result of `compare_results`.
        figures: also write the figures to `figures/` in this format.

    Returns:
        The files by name.

    Raises:
        SlipError: figures were asked for, and what draws them is not installed.
    """
    written: dict[str, Path] = {}
    for name, frame in (("datasets", answer.datasets), ("comparisons", answer.comparisons)):
        store.write_results_table(name, frame)
        written[f"{name}.csv"] = store.write_results_text(f"{name}.csv", format_csv(frame, digits=6))
    store.write_results_table("features", answer.features)
    main = answer.datasets.filter(pl.col("input").cast(pl.String) == answer.input)
    published = answer.views[0][1] == AS_PUBLISHED
    page = _build_page(
        "Deployments compared",
        [format_count(main.height, "dataset"), f"{main['runs'].sum()} runs", answer.measure],
        answer=tabulate_answer(answer),
        pictures=[picture for view in answer.views if (picture := _draw_levels(answer, view))],
        tables=[
            *(tabulate_datasets(answer, source) for source in dict.fromkeys(one for one, _ in answer.views)),
            *(tabulate_pairs(answer, view) for view in answer.views),
        ],
        notes=[*list_shown_notes(answer), *([ABOUT_UNIT] if published else [])],
        runs=[key for keys in main["keys"] for key in keys.split()],
    )
    return written | _write(store, "comparison.html", page, figures)


def _draw_levels(answer: Answer, view: tuple[str, str]) -> Picture | None:
    """Value of every run as a point, and of its dataset with its interval."""
    source, quantity = view
    levels = answer.take(answer.levels, view).sort("value", "dataset")
    if levels.is_empty():
        return None
    labels = label_names(levels["dataset"].to_list())
    runs = answer.runs.filter(pl.col("input").cast(pl.String) == source, pl.col(quantity).is_not_null())
    points = runs.filter(pl.col("group").is_in(list(labels))).select(
        pl.col("group").replace_strict(labels, return_dtype=pl.String).alias("label"),
        "run",
        pl.col(quantity).alias("value"),
    )
    spans = levels.select(
        pl.col("dataset").replace_strict(labels, return_dtype=pl.String).alias("label"),
        "value",
        "low",
        "high",
        pl.col("interval").alias("kind"),
    )
    # Intervals are ratios, and those of few runs are wide: on a logarithmic axis all of them are whole.
    ends = [points["value"], *(spans[name] for name in ("value", "low", "high"))]
    numbers = pl.concat(ends).drop_nulls().to_numpy()
    least, most = max(float(numbers.min()), _LEAST), max(float(numbers.max()), 2.0 * _LEAST)
    domain = [0.9 * least, 1.1 * most]
    spans, points = (
        frame.with_columns(pl.col(pl.Float64).clip(lower_bound=domain[0])) for frame in (spans, points)
    )
    name, words = f"{quantity}_{source}", INPUT_WORDS[source]
    title = f"{'slip modulus' if quantity == EQUAL_DRIVING else answer.measure} {words} [m/s]"
    order = list(labels.values())
    axis = {"title": None, "labelLimit": 280, "minExtent": 190, "grid": False, "labelColor": theme.INK}
    rows = encode_column("label:N", sort=order, axis=axis, scale={"domain": order})
    kinds = [kind for kind in _INTERVALS if kind in set(spans["kind"])]
    colours = {"domain": kinds, "range": [_INTERVALS[kind] for kind in kinds]}
    legend = {"title": "95 % interval", "symbolType": "stroke"}
    ticks = [tick for tick in _TICKS if domain[0] <= tick <= domain[1]]
    bars = (
        Chart.of_rows(f"{name}_spans")
        .mark("rule", strokeWidth=5, opacity=0.75)
        .encode(
            y=rows,
            x=make_axis("low", title, scale={"type": "log", "domain": domain, "nice": False}, values=ticks),
            x2="high:Q",
            color=encode_column("kind:N", scale=colours, legend=legend),
        )
    )
    middles = (
        Chart.of_rows(f"{name}_spans")
        .mark("tick", size=18, thickness=2.5, color=theme.MEASURED)
        .encode(y=rows, x="value:Q")
    )
    dots = (
        Chart.of_rows(f"{name}_runs")
        .mark("point", size=70, filled=True, fill=theme.SLIP, stroke=theme.PAPER, strokeWidth=1, opacity=1)
        .encode(y=rows, x="value:Q", tooltip=["run:N", encode_column("value:Q", format=".3")])
    )
    chart = layer(bars, dots, middles).properties(
        width=640, height=_ROW * len(order), usermeta={"gutter": 210}
    )
    text = ", ".join(
        f"{dataset} {value:.3g}" for dataset, value in levels.select("dataset", "value").iter_rows()
    )
    note = "Compare within a vehicle only: the vehicles drove differently." * (len(answer.families) > 1)
    drawing = Drawing(chart, {f"{name}_spans": spans, f"{name}_runs": points}, note, f"In m/s: {text}.")
    return Picture(name, f"Slip {QUANTITIES[quantity]}, {words}", drawing, width="half")


def write_causes(store: Store, causes: Causes, figures: FigureFormat | None = None) -> dict[str, Path]:
    """Write `causes.csv`, `cause_differences.csv` and `causes.html`; the files by name."""
    budgets, differences = (causes.tabulate(differences=one) for one in (False, True))
    written = {
        name: store.write_results_text(name, format_csv(frame, digits=6))
        for name, frame in (("causes.csv", budgets), ("cause_differences.csv", differences))
    }
    page = _build_page(
        "Deployments compared by cause",
        [format_count(len(causes.budgets), "dataset"), f"slip {INPUT_WORDS[causes.input]}"],
        lines=[one.describe(causes.names) for one in causes.differences],
        pictures=[_draw_causes(causes.budgets, causes.names)],
        tables=tabulate_causes(causes),
        notes=causes.notes,
        runs=causes.keys,
    )
    return written | _write(store, "causes.html", page, figures)


def _draw_causes(budgets: Sequence[Budget], names: Mapping[str, str]) -> Picture:
    """A bar per dataset with the length of its RMS slip, split into causes."""
    labels = label_names([budget.dataset for budget in budgets])
    parts = [
        (labels[one.dataset], names.get(part.name, part.name), math.sqrt(one.total) * part.value)
        for one in budgets
        for part in one.parts
    ]
    kinds = {"dataset": pl.String, "cause": pl.String, "slip": pl.Float64}
    rows = pl.DataFrame(parts, schema=kinds, orient="row")
    chart = (
        Chart.of_rows("causes")
        .mark("bar")
        .encode(
            y=encode_column("dataset:N", sort=list(labels.values()), axis={"title": None, "grid": False}),
            x=encode_column("sum(slip):Q", axis={"title": f"{BUDGET_SLIP} [m/s]", "format": ",~r"}),
            color=encode_column(
                "cause:N", legend={"title": None, "columns": 3}, scale={"scheme": "tableau20"}
            ),
            tooltip=["dataset:N", "cause:N", encode_column("slip:Q", format=".3")],
        )
        .properties(width=640, height={"step": 30}, usermeta={"gutter": 150})
    )
    text = "; ".join(f"{one.dataset} {format_number(math.sqrt(one.total))} m/s" for one in budgets)
    note = "A negative part increases the held-out slip of the model."
    drawing = Drawing(chart, {"causes": rows}, note, f"{BUDGET_SLIP}: {text}.")
    return Picture("causes", f"{BUDGET_SLIP} of each dataset by cause", drawing)


def write_fleet(store: Store, fleet: Fleet) -> dict[str, Path]:
    """Write the table `fleet` and `fleet.html`; the files by name."""
    store.write_results_table("fleet", fleet.tabulate())
    page = _build_page(
        "Parameters by level: vehicle, terrain, run",
        [format_count(len(fleet.runs), "vehicle"), format_count(len(fleet.keys), "run")],
        lines=[fleet.summary.rstrip(".")],
        tables=tabulate_fleet(fleet),
        notes=fleet.notes,
        runs=fleet.keys,
    )
    return {"fleet.parquet": store.root / "fleet.parquet"} | _write(store, "fleet.html", page)


def write_trend(store: Store, trend: Trend) -> dict[str, Path]:
    """Write `trend.html`; the files by name."""
    series = trend.series
    drawn = [one for one in series if one.points.height > 1][:_MOST_FIGURES]
    page = _build_page(
        "Trends",
        [f"{len(series)} series", format_count(len(trend.keys), "run")],
        lines=[
            trend.summary,
            *(f"{name_series(one)} of {one.group}: {one.describe()}" for one in series if one.is_changed),
        ],
        pictures=[_draw_series(one, f"trend_{number}") for number, one in enumerate(drawn)],
        tables=[tabulate_trend(trend)],
        notes=trend.notes,
        runs=trend.keys,
    )
    return _write(store, "trend.html", page)


def _draw_series(series: Series, name: str) -> Picture:
    # In UTC on both sides: a browser elsewhere must not show the day before.
    dates = {"scale": {"type": "utc"}, "axis": {"title": "date", "format": "%Y-%m-%d", "tickCount": 5}}
    rows = series.points.with_columns(pl.col("day").str.to_date().cast(pl.Datetime("ms")).dt.epoch("ms"))
    dots = (
        Chart.of_rows(name)
        .mark("point", size=46, filled=True, color=theme.SLIP, opacity=0.9)
        .encode(
            x=encode_column("day:T", **dates),
            y=encode_column("value:Q", axis={"title": None, "format": ",.3~r"}, scale={"zero": False}),
            shape=encode_column("terrain:N", legend={"title": None}),
            tooltip=[
                "run:N",
                encode_column("day:T", timeUnit="utcyearmonthdate", format="%Y-%m-%d"),
                "terrain:N",
                encode_column("value:Q", format=".4"),
            ],
        )
    )
    charts = [dots]
    if series.is_changed and series.step is not None:
        first = rows["run"].to_list().index(series.step.run)
        between = (rows["day"][first - 1] + rows["day"][first]) // 2
        rows = rows.with_columns(pl.lit(between).alias("step"))
        charts.append(
            Chart.of_rows(name)
            .mark("rule", color=theme.ON_COMMAND)
            .encode(x=encode_column("step:T", **dates))
        )
    chart = layer(*charts).properties(width=640, height=130, usermeta={"gutter": 60})
    text = series.describe()
    title = f"{name_series(series)} of {series.group}{bracket_unit(series.unit)}"
    return Picture(name, title, Drawing(chart, {name: rows}, text[:1].upper() + text[1:], text), width="half")


def write_map(store: Store, drawn: DeploymentMap, figures: FigureFormat | None = None) -> dict[str, Path]:
    """Write `map.html`, and its figure if a format is given; the files by name."""
    about = f"{drawn.measure.name} {INPUT_WORDS[drawn.input]}{bracket_unit(drawn.measure.unit)}"
    missing = f"not on the map, as mass, speed or terrain is not published: {', '.join(drawn.missing)}"
    page = _build_page(
        "Deployment map",
        [f"{drawn.points.height} deployments", f"{drawn.own.height} own datasets"],
        pictures=[_draw_map(drawn, about)],
        tables=tabulate_map(drawn),
        notes=[*drawn.notes, *([missing] if drawn.missing else [])],
        runs=drawn.keys,
    )
    return _write(store, "map.html", page, figures)


def _draw_map(drawn: DeploymentMap, about: str) -> Picture:
    """Kinetic energy against terrain complexity, own datasets as large points."""
    energies = pl.concat([drawn.points["energy"], drawn.own["energy"]]).to_numpy()
    ends = (0.5 * float(energies.min()), 2.0 * float(energies.max())) if energies.size else (1.0, 10.0)
    axes = {
        "x": make_axis(
            "complexity", "terrain complexity (0 flat asphalt, 10 impassable)", _COMPLEXITY, tickCount=10
        ),
        "y": make_axis(
            "energy",
            "largest kinetic energy [J]",
            scale={"type": "log", "domain": list(ends), "nice": False},
            format="~s",
        ),
    }
    literature = (
        Chart.of_rows("literature")
        .mark("point", size=70, strokeWidth=1.4, opacity=1, stroke=theme.MEASURED)
        .encode(
            **axes,
            fill={"condition": {"test": "datum.sure", "value": theme.CROSS}, "value": theme.PAPER},
            tooltip=["key:N", "vehicle:N", "terrain:N", "energy:Q", "bound:N"],
        )
    )
    marks = (
        Chart.of_rows("own")
        .mark("point", size=170, filled=True, opacity=1)
        .encode(
            **axes,
            color=encode_column(
                "value:Q",
                scale={"range": list(theme.SLIP_RAMP), "interpolate": "rgb"},
                legend={"title": about},
            ),
            tooltip=["dataset:N", "runs:Q", "energy:Q", "value:Q"],
        )
    )
    charts = [literature, *([marks] if drawn.own.height else [])]  # scales of no rows have no ends
    names = _position_names(drawn, ends)
    for is_own, weight in ((False, 400), (True, 600)):
        rows = Chart.of_rows("names").filter(f"datum.own == {str(is_own).lower()}")
        look = rows.mark("text", fontWeight=weight, **({} if is_own else {"color": theme.QUIET}))
        charts.append(look.encode(**axes, text="name:N"))
    chart = layer(*charts).properties(width=_MAP[0], height=_MAP[1])
    note = (
        "Hollow: mass, speed or terrain is not known well. Names that have no room are left out; point at a "
        "mark to read what it is."
    )
    words = f"{drawn.points.height} deployments of the literature and {drawn.own.height} own datasets."
    tables = {"literature": drawn.points, "own": drawn.own, "names": names}
    return Picture("deployment_map", "Energy and terrain", Drawing(chart, tables, note, words))


def _position_names(drawn: DeploymentMap, ends: tuple[float, float]) -> pl.DataFrame:
    """Names of marks where they cover neither a mark nor another name; those of own datasets come first.

    Args:
        drawn: the marks.
        ends: of the axis of the energy [J].

    Returns:
        Rows with ``complexity``, ``energy`` of the middle of a ``name``, and whether it is ``own``. A name of
        the literature for which there is no room is left out.
    """
    width, height = _MAP
    per_unit = np.array([width / (_COMPLEXITY[1] - _COMPLEXITY[0]), height / math.log(ends[1] / ends[0])])
    marks = [
        (str(name), np.array([x, math.log(y / ends[0])]) * per_unit, is_own)
        for frame, column, is_own in ((drawn.own, "dataset", True), (drawn.points, "key", False))
        for name, x, y in frame.select(column, "complexity", "energy").iter_rows()
    ]
    taken = [(middle, np.full(2, _RADIUS[is_own])) for _, middle, is_own in marks]
    rows = []
    for name, middle, is_own in marks:
        half = np.array([0.5 * _LETTER[is_own] * len(name), 7.0])
        free = list[tuple[float, int, Floats]]()
        for step, side in itertools.product((1.0, 2.2), _SIDES):
            spot = middle + np.array(side) * (half + step * _RADIUS[is_own] + 2.0)
            inside = bool((spot - half >= 0.0).all() and (spot + half <= np.array(_MAP)).all())
            over = float(sum(bool((np.abs(spot - at) < half + size).all()) for at, size in taken))
            free.append((over if inside else math.inf, len(free), spot))
        covered, _, spot = min(free, key=lambda one: one[:2])
        if is_own or not covered:
            taken.append((spot, half))
            x, y = (spot / per_unit).tolist()
            rows.append((x, ends[0] * math.exp(y), name, is_own))
    kinds = {"complexity": pl.Float64, "energy": pl.Float64, "name": pl.String, "own": pl.Boolean}
    return pl.DataFrame(rows, schema=kinds, orient="row")


def render_check(check: RunsCheck) -> str:
    """The page of `slip check`."""
    sides, limits = list_sides(check), tabulate_limits(check)
    return _build_page(
        "What changed between two drives",
        [f"{format_count(len(sides.get(side, ())), 'run')} {side}" for side in ("before", "after")],
        lines=list_check_sentences(check),
        answer=limits if limits.rows else None,
        tables=[tabulate_check(check)],
        notes=check.sides.notes,
        runs=[f"{run} ({label})" for label, runs in sides.items() for run in runs],
    ).render()
