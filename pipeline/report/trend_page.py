"""Page of `slip fleet trend`: parameters of vehicles, slip and health of groups, over the dates of runs."""

import contextlib
import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
import polars as pl

from pipeline.core import TREND_THRESHOLD, Floats, format_count
from pipeline.datasets import (
    TREND,
    WHISKER_REACH,
    ComparisonError,
    ParameterTrend,
    Series,
    Trend,
    follow_trend,
    format_change,
    format_power,
    format_quiet,
    name_quantity,
    summarize_trend,
)
from pipeline.models import name_parameter
from pipeline.report import Picture, begin_large, bracket_unit, set_squares, theme, write_page
from pipeline.report.page import render_figures
from pipeline.report.theme import Channel, Chart, Drawing, encode_column, layer
from pipeline.store import NoRunsError, Store, StoreError, read_stored

_FEWEST_POINTS = 3
_LIMITS = ("limit_low", "limit_high")
_KEY = (
    "Points: the value of each run, with its 95 % interval as a thin line. Short strokes: the value expected "
    "on the terrain of the run. Grey bars: the range in which all values of the figure lie, with a "
    "probability of 95 %, if nothing else changes."
)
_KEY_OF_SERIES = "Points: the value of each run. Lines: the mean between two changes."
_LATER = ("finding ", "suspect share", "warnings")


def render_trend(trend: Trend) -> str:
    """Render the complete page as HTML; series and parameters with fewer than three runs are omitted."""
    series, parameters, keys, alerts = trend.series, trend.parameters, trend.keys, trend.alerts
    vehicles = list(dict.fromkeys(one.vehicle for one in parameters))
    names = list(dict.fromkeys(one.group for one in series))
    # One mark for each ground on the whole page.
    grounds = sorted({str(ground) for one in parameters for ground in one.points["terrain"].unique()})
    groups = [
        (
            f"vehicle-{number}",
            f"Parameters of {name}",
            _KEY,
            *_draw_vehicle(parameters, name, grounds, number),
        )
        for number, name in enumerate(vehicles)
    ] + [
        (
            f"group-{number}",
            f"Slip and data of {name}",
            _KEY_OF_SERIES,
            *_draw_group([one for one in series if one.group == name], number),
        )
        for number, name in enumerate(names)
    ]
    return render_figures(
        "report/templates/trend.html",
        [picture for *_, changed, others in groups for picture in (*changed, *others)],
        title="Trends",
        facts=[
            f"{format_count(len(parameters), 'parameter')} of {format_count(len(vehicles), 'vehicle')}",
            f"{len(series)} series of {format_count(len(names), 'group')}",
            format_count(len(keys), "run"),
            format_count(len(alerts), "alert"),
        ],
        alerts=[alert.text for alert in alerts],
        quiet=begin_large(format_quiet(series, parameters)),
        notes=trend.notes,
        groups=[group for group in groups if group[-2] or group[-1]],
        runs=keys,
    )


def _draw_vehicle(
    parameters: Sequence[ParameterTrend], vehicle: str, grounds: Sequence[str], number: int
) -> tuple[list[Picture], list[Picture]]:
    """Figures of the parameters that changed, and of the others."""
    own = [one for one in parameters if one.vehicle == vehicle and one.points.height >= _FEWEST_POINTS]
    own.sort(key=lambda one: (not one.changes, -one.named, one.label))
    pictures = []
    for index, one in enumerate(own):
        name = f"parameter_{number}_{index}"
        title = f"{name_parameter(one.effect, one.parameter)} ({one.label}){bracket_unit(one.unit)}"
        pictures.append(Picture(name, title, _draw_parameter(one, name, grounds)))
    return _split(own, pictures)


def _split(
    own: Sequence[ParameterTrend | Series], pictures: Sequence[Picture]
) -> tuple[list[Picture], list[Picture]]:
    changed = sum(bool(one.changes) for one in own)
    return [*pictures[:changed]], [*pictures[changed:]]


def _describe(trend: ParameterTrend) -> str:
    """The figure of a parameter in words."""
    text = "; ".join(format_change(trend, change) for change in trend.changes) or "no change"
    return (
        f"{trend.points.height} runs, last {trend.shown_latest}. {begin_large(text)}; {format_power(trend)}. "
        f"{_format_omitted(trend)}"
    ).rstrip()


def _format_omitted(trend: ParameterTrend) -> str:
    """Sentences on the runs that are not drawn."""
    reasons = (("apart from the others", trend.odd), ("undetermined", trend.undetermined))
    return " ".join(f"Not drawn, {why}: {', '.join(runs)}." for why, runs in reasons if runs)


def _find_range(points: pl.DataFrame) -> tuple[float, float]:
    """Ends of the axis: of all values and levels, and of their intervals without outlying ends (Tukey 1977).

    A run that hardly determines the parameter does not flatten the others.
    """
    ends = [
        [*points["value"], *points["level"]],
        *(_find_whiskers(points[name].drop_nulls().to_numpy()) for name in ("low", "high", *_LIMITS)),
    ]
    return min(itertools.chain(*ends)), max(itertools.chain(*ends))


def _find_whiskers(values: Floats) -> list[float]:
    """Values within the reach of whiskers from the quartiles."""
    if not values.size:
        return []
    first, third = np.quantile(values, (0.25, 0.75))
    span = WHISKER_REACH * (third - first)
    return [float(one) for one in values if first - span <= one <= third + span]


def _draw_parameter(trend: ParameterTrend, name: str, grounds: Sequence[str]) -> Drawing:
    """Draw runs with the intervals of their estimates and the simultaneous limits, by terrain."""
    rows = _number(trend.points)
    base = Chart.of_rows(f"{name}_points").encode(x=_along(rows))
    axis = {"title": None, "format": ",.3~r", "tickCount": 4, "minExtent": 44}
    least, most = _find_range(rows)
    domain = {"domain": [least, most]} if least < most else {}
    value = encode_column("value:Q", axis=axis, scale={"zero": False, **domain})
    limits = base.mark("rule", strokeWidth=9, color=theme.CROSS, opacity=0.3, clip=True).encode(
        y="limit_low:Q", y2="limit_high:Q"
    )
    levels = base.mark("tick", thickness=2.5, width=14, color=theme.ON_COMMAND, orient="horizontal").encode(
        y="level:Q"
    )
    errors = base.mark("rule", color=theme.SLIP, clip=True).encode(y="low:Q", y2="high:Q")
    own = [ground for ground in grounds if ground in set(rows["terrain"])]
    legend = {"title": "ground", "values": own} if len(own) > 1 else None
    dots = base.mark("point", size=46, filled=True, color=theme.SLIP, opacity=1).encode(
        y=value,
        shape=encode_column("terrain:N", legend=legend, scale={"domain": list(grounds)}),
        tooltip=[
            *(f"{column}:N" for column in ("run", "day", "terrain")),
            *(encode_column(f"{column}:Q", format=".4") for column in ("value", "level")),
        ],
    )
    chart = layer(limits, levels, errors, dots).properties(width=640, height=140, usermeta={"gutter": 60})
    is_cut = ((rows["low"] < least) | (rows["high"] > most)).any()
    cut = " Intervals that are longer than the axis are cut." if is_cut and domain else ""
    note = f"{begin_large(format_power(trend))}.{cut} {_format_omitted(trend)}".rstrip()
    return Drawing(chart, {f"{name}_points": rows}, set_squares(note), _describe(trend))


def _number(points: pl.DataFrame) -> pl.DataFrame:
    return points.drop("order").with_row_index("order").with_columns(pl.col("order").cast(pl.Float64))


def _along(points: pl.DataFrame) -> Channel:
    about = f"runs in the order of their dates, {points['day'][0]} to {points['day'][-1]}"
    return encode_column(
        "order:Q",
        axis={"title": about, "labels": False, "grid": False},
        scale={"domain": [-0.5, points.height - 0.5], "nice": False, "zero": False},
    )


def _draw_group(series: Sequence[Series], number: int) -> tuple[list[Picture], list[Picture]]:
    own = [one for one in series if one.points.height >= _FEWEST_POINTS]
    own.sort(key=lambda one: (not one.changes, one.quantity.startswith(_LATER), one.quantity))
    return _split(own, [_picture(one, f"trend_{number}_{index}") for index, one in enumerate(own)])


def _picture(series: Series, name: str) -> Picture:
    steps = "; ".join(format_change(series, change) for change in series.changes)
    words = f"{series.points.height} runs, last {series.latest:.3g}. {begin_large(steps) or 'No step'}."
    title = begin_large(name_quantity(series.quantity)) + bracket_unit(series.unit)
    return Picture(name, title, _draw_series(series, name, words), "half")


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
    note = "; ".join(begin_large(format_change(series, change)) for change in series.changes)
    return Drawing(chart, rows, note, words)


def _tabulate_levels(series: Series) -> pl.DataFrame:
    runs = series.points["run"].to_list()
    edges = [0, *(runs.index(change.run) for change in series.changes), len(runs)]
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


def write_trend(store: Store, trend: Trend) -> Path:
    """Write `trend.html` and `trend.json`; return the path of the page."""
    content = {**summarize_trend(trend), "asked": trend.asked}
    store.write_results_text(TREND, json.dumps(content, indent=1, allow_nan=False) + "\n")

    return write_page(store, "trend.html", render_trend(trend))


def update_trend(store: Store) -> None:
    """Update an existing trend with the options it was made with; do nothing if there is none.

    The trend stays unchanged if no run has a date, or if its stored options cannot be read.
    """
    if _read_asked(store) is not None:
        # No run with a date, or no such column to group by.
        with contextlib.suppress(NoRunsError, ComparisonError):
            renew_trend(store)


def renew_trend(store: Store) -> Trend:
    """Follow and write the trend with the options of the last time, or with those of `slip fleet trend`.

    Raises:
        NoRunsError, ComparisonError: as `follow_trend`.
    """
    by, threshold, limits = _read_asked(store) or (("dataset",), TREND_THRESHOLD, {})
    trend = follow_trend(store, by, threshold=threshold, limits=limits)
    write_trend(store, trend)
    return trend


class _Asked(msgspec.Struct):
    """Options of a trend."""

    by: list[str]
    threshold: float
    limits: dict[str, float]


class _StoredTrend(msgspec.Struct):
    """What is read of a stored trend."""

    asked: _Asked


def _read_asked(store: Store) -> tuple[Sequence[str], float, Mapping[str, float]] | None:
    """Options of the trend that was made last; None where there is none, or it cannot be read."""
    path = store.root / TREND
    if not path.is_file():
        return None
    try:
        asked = read_stored(path, _StoredTrend).asked
    except StoreError:
        return None
    return asked.by, asked.threshold, asked.limits
