"""The page of `slip trend`."""

from __future__ import annotations

import itertools
import re
from typing import TYPE_CHECKING

import altair as alt
import polars as pl

from pipeline.fleet.trend import describe_quiet, describe_step
from pipeline.report import theme
from pipeline.report.elements import Picture
from pipeline.report.figures import Drawing
from pipeline.report.page import render_figures
from pipeline.report.words import begin_large

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.fleet.trend import Alert, Series

_FEWEST_POINTS = 3
_LATER = ("finding ", "suspect share", "warnings")


def render_trend(
    series: Sequence[Series], alerts: Sequence[Alert], *, notes: Sequence[str], keys: Sequence[str]
) -> str:
    """The whole page as HTML.

    Args:
        series: as of `follow_quantities`; those with fewer than three runs are left out.
        alerts: as of `raise_alerts`.
        notes: what must be known.
        keys: run/generation of every run.
    """
    names = list(dict.fromkeys(one.group for one in series))
    groups = [
        (number, name, _draw_group([one for one in series if one.group == name], number))
        for number, name in enumerate(names)
    ]
    return render_figures(
        "report/templates/trend.html",
        [picture for _, _, pictures in groups for picture in pictures],
        title="Trends",
        facts=[f"{len(names)} groups", f"{len(series)} series", f"{len(keys)} runs", f"{len(alerts)} alerts"],
        alerts=[alert.text for alert in alerts],
        quiet=begin_large(describe_quiet(series)),
        notes=notes,
        groups=[group for group in groups if group[2]],
        runs=keys,
    )


def _draw_group(series: Sequence[Series], number: int) -> list[Picture]:
    own = [one for one in series if one.points.height >= _FEWEST_POINTS]
    own.sort(key=lambda one: (not one.steps, one.quantity.startswith(_LATER), one.quantity))
    return [_picture(one, f"trend_{number}_{place}") for place, one in enumerate(own)]


def _picture(series: Series, name: str) -> Picture:
    steps = "; ".join(describe_step(series, step) for step in series.steps)
    unit = f" [{series.unit}]" if series.unit not in ("", "1") else ""
    words = f"{series.points.height} runs, last {series.latest:.3g}. {begin_large(steps) or 'No step'}."
    drawing = _draw_series(series, re.sub(r"\W", "_", name))
    return Picture(name, f"{series.quantity}{unit}", drawing, words, "half")


def _draw_series(series: Series, name: str) -> Drawing:
    points = series.points.with_row_index("order").with_columns(pl.col("order").cast(pl.Float64))
    levels = _tabulate_levels(series)
    axis = alt.Axis(title=None, format=",~r", tickCount=4, minExtent=44)
    about = f"runs in the order of their dates, {points['day'][0]} to {points['day'][-1]}"
    along = alt.X(
        "order:Q",
        axis=alt.Axis(title=about, labels=False, grid=False),
        scale=alt.Scale(domain=[-0.5, points.height - 0.5], nice=False, zero=False),
    )
    dots = (
        alt.Chart(alt.NamedData(f"{name}_points"))
        .mark_point(size=46, filled=True, color=theme.SLIP, opacity=0.9)
        .encode(
            x=along,
            y=alt.Y("value:Q", axis=axis, scale=alt.Scale(zero=False)),
            tooltip=[alt.Tooltip("run:N"), alt.Tooltip("day:N"), alt.Tooltip("value:Q", format=".4")],
        )
    )
    lines = (
        alt.Chart(alt.NamedData(f"{name}_levels"))
        .mark_rule(strokeWidth=2.5, color=theme.ON_COMMAND)
        .encode(x=alt.X("start:Q"), x2="end:Q", y="value:Q")
    )
    chart = alt.layer(lines, dots).properties(width=640, height=120, usermeta={"gutter": 60})
    rows = {f"{name}_points": points, f"{name}_levels": levels}
    return Drawing(chart, rows, "; ".join(begin_large(describe_step(series, step)) for step in series.steps))


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
