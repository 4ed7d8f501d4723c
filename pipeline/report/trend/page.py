"""The page of `slip trend`."""

from __future__ import annotations

import itertools
import re
from typing import TYPE_CHECKING

import altair as alt
import polars as pl

from pipeline.comparison.trend import describe_step
from pipeline.report import theme
from pipeline.report.figures import Drawing
from pipeline.report.gallery import Chapter, Picture, render_gallery
from pipeline.report.words import begin_large, escape

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.comparison.trend import Alert, Series

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
    told = "".join(f"<li>{escape(begin_large(alert.text))}.</li>" for alert in alerts)
    lead = (
        f'<div class="doubts"><p>Look at these:</p><ul>{told}</ul></div>'
        if told
        else '<p class="lead">Nothing moved beyond the threshold.</p>'
    )
    known = "".join(f"<li>{escape(begin_large(note))}.</li>" for note in notes)
    chapters = [Chapter("alerts", "What changed", lead=lead, rest=f"<ul>{known}</ul>")]
    groups = list(dict.fromkeys(one.group for one in series))
    for number, group in enumerate(groups):
        own = [one for one in series if one.group == group and one.points.height >= _FEWEST_POINTS]
        own.sort(key=lambda one: (not one.steps, one.quantity.startswith(_LATER), one.quantity))
        pictures = [_picture(one, f"trend_{number}_{place}") for place, one in enumerate(own)]
        if pictures:
            chapters.append(Chapter(f"group-{number}", group, pictures=pictures))
    listed = "".join(f"<li>{escape(key)}</li>" for key in keys)
    chapters.append(Chapter("provenance", "Runs counted", rest=f"<ul>{listed}</ul>"))
    facts = [f"{len(groups)} groups", f"{len(series)} series", f"{len(keys)} runs", f"{len(alerts)} alerts"]
    return render_gallery("Trends", facts, chapters)


def _picture(series: Series, name: str) -> Picture:
    steps = "; ".join(describe_step(series, step) for step in series.steps)
    unit = f" [{series.unit}]" if series.unit not in ("", "1") else ""
    words = f"{series.points.height} runs, last {series.latest:.3g}. {begin_large(steps) or 'No step'}."
    return Picture(name, f"{series.quantity}{unit}", _draw_series(series, re.sub(r"\W", "_", name)), words)


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
