"""The page of `slip trend`."""

import itertools
from collections.abc import Sequence

import polars as pl

from pipeline.fleet.parameter_trend import ParameterTrend, describe_change, say_power
from pipeline.fleet.trend import Series, Trend, describe_quiet, describe_step
from pipeline.report import theme
from pipeline.report.elements import Picture
from pipeline.report.figures import Drawing
from pipeline.report.page import render_figures
from pipeline.report.vega import Channel, Chart, encode_column, layer
from pipeline.report.words import begin_large

_FEWEST_POINTS = 3
_LATER = ("finding ", "suspect share", "warnings")


def render_trend(trend: Trend) -> str:
    """The whole page as HTML; series and parameters with fewer than three runs are left out."""
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
        quiet=begin_large(describe_quiet(series, parameters)),
        notes=trend.notes,
        groups=[group for group in groups if group[2]],
        runs=keys,
    )


def _draw_vehicle(parameters: Sequence[ParameterTrend], vehicle: str, number: int) -> list[Picture]:
    own = [one for one in parameters if one.vehicle == vehicle and one.points.height >= _FEWEST_POINTS]
    own.sort(key=lambda one: (not one.changes, -one.named, one.label))
    pictures = []
    for place, one in enumerate(own):
        name = f"parameter_{number}_{place}"
        told = "; ".join(describe_change(one, change) for change in one.changes) or "no change"
        odd = f". Left out, apart from the others: {', '.join(one.odd)}" if one.odd else ""
        words = (
            f"{one.points.height} runs, last {one.latest:.3g}. {begin_large(told)}; {say_power(one)}{odd}."
        )
        pictures.append(Picture(name, f"{one.label}{_say_unit(one)}", _draw_parameter(one, name, words)))
    return pictures


def _draw_parameter(trend: ParameterTrend, name: str, words: str) -> Drawing:
    """Runs with the intervals of their estimates, on the limits that all lie within, by ground."""
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
    note = (
        f"{begin_large(say_power(trend))}. Bars: where all runs lie at 95 %; strokes: level on that ground."
    )
    return Drawing(chart, {f"{name}_points": rows}, note, words)


def _say_unit(of: Series | ParameterTrend) -> str:
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
    return [_picture(one, f"trend_{number}_{place}") for place, one in enumerate(own)]


def _picture(series: Series, name: str) -> Picture:
    steps = "; ".join(describe_step(series, step) for step in series.steps)
    words = f"{series.points.height} runs, last {series.latest:.3g}. {begin_large(steps) or 'No step'}."
    return Picture(name, f"{series.quantity}{_say_unit(series)}", _draw_series(series, name, words), "half")


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
    note = "; ".join(begin_large(describe_step(series, step)) for step in series.steps)
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
