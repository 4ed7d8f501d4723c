"""Pages of `slip fleet fit` and `slip fleet trend`."""

import itertools
from collections.abc import Mapping, Sequence
from typing import cast

import polars as pl

from pipeline.core.json_objects import mapping_in, number_in, objects_in
from pipeline.fleet.trend import (
    ParameterTrend,
    Series,
    Trend,
    format_change,
    format_power,
    format_quiet,
    format_step,
)
from pipeline.report import theme
from pipeline.report.figures import Drawing
from pipeline.report.page import render_figures
from pipeline.report.scene import format_ends
from pipeline.report.templating import Cell, Column, Picture, Table, begin_large, format_number
from pipeline.report.theme import Channel, Chart, encode_column, layer

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
    reasons: dict[str, list[str]] = {}
    for row in rows:
        if row["level"] is None:
            reasons.setdefault(f"{row['because']} ({row['vehicle']})", []).append(_label(row))
    vehicles = []
    for number, name in enumerate(runs):
        own = [row for row in rows if row["vehicle"] == name]
        levels = Table(
            f"Parameters of {name} by level",
            _LEVELS,
            [_list(row) for row in own],
        )
        means = [row_means for row in own for row_means in _list_terrains(row)]
        vehicles.append(
            (f"vehicle-{number}", name, levels, Table(f"Means of {name} by terrain", _TERRAINS, means))
        )
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


def _label(row: Mapping[str, object]) -> str:
    return f"{row['effect']}.{row['parameter']}"


def _list(row: Mapping[str, object]) -> list[str | Cell]:
    spreads = [format_number(number_in(row, f"spread_{kind}")) for kind in ("terrain", "run")]
    return [
        Cell(str(row["name"]), small=_label(row), notes=[str(row["because"])] if row["level"] else ()),
        str(row["level"] or "open"),
        _format_value(row, row),
        format_ends(row),
        *spreads,
        format_number(number_in(row, "chi_square")),
        f"{row['named']} of {row['runs']}",
    ]


def _list_terrains(row: Mapping[str, object]) -> list[list[str | Cell]]:
    terrains = mapping_in(row, "terrains")
    means = {name: mapping_in(terrains, name) for name in terrains}
    return [
        [
            Cell(small=_label(row)),
            name,
            _format_value(mean, row),
            format_ends(mean),
            str(mean["runs"]),
        ]
        for name, mean in means.items()
    ]


def _format_value(of: Mapping[str, object], row: Mapping[str, object]) -> Cell:
    return Cell(format_number(number_in(of, "value")), small="" if row["unit"] == "1" else str(row["unit"]))


_FEWEST_POINTS = 3
_LATER = ("finding ", "suspect share", "warnings")


def render_trend(trend: Trend) -> str:
    """Render the complete page as HTML; series and parameters with fewer than three runs are omitted."""
    series, parameters, keys, alerts = trend.series, trend.parameters, trend.keys, trend.alerts
    vehicles = list(dict.fromkeys(one.vehicle for one in parameters))
    names = list(dict.fromkeys(one.group for one in series))
    groups = [
        (f"vehicle-{number}", f"Parameters of {name}", _draw_vehicle(parameters, name, number))
        for number, name in enumerate(vehicles)
    ] + [
        (
            f"group-{number}",
            f"Slip and data of {name}",
            _draw_group([one for one in series if one.group == name], number),
        )
        for number, name in enumerate(names)
    ]
    return render_figures(
        "report/templates/trend.html",
        [picture for _, _, pictures in groups for picture in pictures],
        title="Trends",
        facts=[
            f"{len(parameters)} parameters of {len(vehicles)} vehicle{'s' * (len(vehicles) != 1)}",
            f"{len(series)} series of {len(names)} group{'s' * (len(names) != 1)}",
            f"{len(keys)} runs",
            f"{len(alerts)} alert{'s' * (len(alerts) != 1)}",
        ],
        alerts=[alert.text for alert in alerts],
        quiet=begin_large(format_quiet(series, parameters)),
        notes=trend.notes,
        groups=[group for group in groups if group[2]],
        runs=keys,
    )


def _draw_vehicle(parameters: Sequence[ParameterTrend], vehicle: str, number: int) -> list[Picture]:
    own = [one for one in parameters if one.vehicle == vehicle and one.points.height >= _FEWEST_POINTS]
    own.sort(key=lambda one: (not one.changes, -one.named, one.label))
    pictures = []
    for index, one in enumerate(own):
        name = f"parameter_{number}_{index}"
        text = "; ".join(format_change(one, change) for change in one.changes) or "no change"
        odd = f". Left out, apart from the others: {', '.join(one.odd)}" if one.odd else ""
        words = (
            f"{one.points.height} runs, last {one.latest:.3g}. {begin_large(text)}; {format_power(one)}{odd}."
        )
        pictures.append(Picture(name, f"{one.label}{_format_unit(one)}", _draw_parameter(one, name, words)))
    return pictures


def _draw_parameter(trend: ParameterTrend, name: str, words: str) -> Drawing:
    """Draw runs with the intervals of their estimates and the simultaneous limits, by terrain."""
    rows = _number(trend.points)
    base = Chart.of_rows(f"{name}_points").encode(x=_along(rows))
    axis = {"title": None, "format": ",.3~r", "tickCount": 4, "minExtent": 44}
    value = encode_column("value:Q", axis=axis, scale={"zero": False})
    limits = base.mark("rule", strokeWidth=9, color=theme.CROSS, opacity=0.3).encode(
        y="limit_low:Q", y2="limit_high:Q"
    )
    levels = base.mark("tick", thickness=2.5, width=14, color=theme.ON_COMMAND, orient="horizontal").encode(
        y="level:Q"
    )
    errors = base.mark("rule", color=theme.SLIP).encode(y="low:Q", y2="high:Q")
    grounds = sorted(set(rows["terrain"]))
    legend = {"title": "ground"} if len(grounds) > 1 else None
    dots = base.mark("point", size=46, filled=True, color=theme.SLIP, opacity=1).encode(
        y=value,
        shape=encode_column("terrain:N", legend=legend, scale={"domain": grounds}),
        tooltip=[
            *(f"{column}:N" for column in ("run", "day", "terrain")),
            *(encode_column(f"{column}:Q", format=".4") for column in ("value", "level")),
        ],
    )
    chart = layer(limits, levels, errors, dots).properties(width=640, height=140, usermeta={"gutter": 60})
    power = begin_large(format_power(trend))
    note = f"{power}. Bars: where all runs lie at 95 %; strokes: level on that ground."
    return Drawing(chart, {f"{name}_points": rows}, note, words)


def _format_unit(of: Series | ParameterTrend) -> str:
    return f" [{of.unit}]" if of.unit not in ("", "1") else ""


def _number(points: pl.DataFrame) -> pl.DataFrame:
    return points.drop("order").with_row_index("order").with_columns(pl.col("order").cast(pl.Float64))


def _along(points: pl.DataFrame) -> Channel:
    about = f"runs in the order of their dates, {points['day'][0]} to {points['day'][-1]}"
    return encode_column(
        "order:Q",
        axis={"title": about, "labels": False, "grid": False},
        scale={"domain": [-0.5, points.height - 0.5], "nice": False, "zero": False},
    )


def _draw_group(series: Sequence[Series], number: int) -> list[Picture]:
    own = [one for one in series if one.points.height >= _FEWEST_POINTS]
    own.sort(key=lambda one: (not one.steps, one.quantity.startswith(_LATER), one.quantity))
    return [_picture(one, f"trend_{number}_{index}") for index, one in enumerate(own)]


def _picture(series: Series, name: str) -> Picture:
    steps = "; ".join(format_step(series, step) for step in series.steps)
    words = f"{series.points.height} runs, last {series.latest:.3g}. {begin_large(steps) or 'No step'}."
    return Picture(
        name, f"{series.quantity}{_format_unit(series)}", _draw_series(series, name, words), "half"
    )


def _draw_series(series: Series, name: str, words: str) -> Drawing:
    points = _number(series.points)
    levels = _tabulate_levels(series)
    axis = {"title": None, "format": ",~r", "tickCount": 4, "minExtent": 44}
    dots = (
        Chart.of_rows(f"{name}_points")
        .mark("point", size=46, filled=True, color=theme.SLIP, opacity=0.9)
        .encode(
            x=_along(points),
            y=encode_column("value:Q", axis=axis, scale={"zero": False}),
            tooltip=["run:N", "day:N", encode_column("value:Q", format=".4")],
        )
    )
    lines = (
        Chart.of_rows(f"{name}_levels")
        .mark("rule", strokeWidth=2.5, color=theme.ON_COMMAND)
        .encode(x="start:Q", x2="end:Q", y="value:Q")
    )
    chart = layer(lines, dots).properties(width=640, height=120, usermeta={"gutter": 60})
    rows = {f"{name}_points": points, f"{name}_levels": levels}
    note = "; ".join(begin_large(format_step(series, step)) for step in series.steps)
    return Drawing(chart, rows, note, words)


def _tabulate_levels(series: Series) -> pl.DataFrame:
    runs = series.points["run"].to_list()
    edges = [0, *(runs.index(step.run) for step in series.steps), len(runs)]
    return pl.DataFrame(
        {
            "start": [edge - 0.5 for edge in edges[:-1]],
            "end": [edge - 0.5 for edge in edges[1:]],
            "value": [
                float(series.points["value"][start:end].to_numpy().mean())
                for start, end in itertools.pairwise(edges)
            ],
        }
    )
