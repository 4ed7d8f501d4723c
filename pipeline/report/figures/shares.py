"""The share of samples below a value, one curve an input, with the median marked."""

from __future__ import annotations

import altair as alt
import numpy as np
import polars as pl

from pipeline.report import theme
from pipeline.report.figures import parts
from pipeline.report.run import INPUT_WORDS

_POINTS = 201
_HIGHEST_SHOWN = 0.995


def tabulate_shares(values: dict[str, pl.Series]) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Curves and medians of each series.

    Returns:
        Long curves ``value share series`` up to the 99.5th percentile, and medians ``value share series label``.
    """
    shares = np.linspace(0.0, _HIGHEST_SHOWN, _POINTS)
    curves, medians = [], []
    for name, series in values.items():
        numbers = series.to_numpy()
        levels = np.quantile(numbers, shares)
        curves.append(pl.DataFrame({"value": levels, "share": shares}).with_columns(series=pl.lit(name)))
        median = float(np.median(numbers))
        medians.append({"value": median, "share": 0.5, "series": name, "label": f"median {median:.2f} m/s"})
    return pl.concat(curves), pl.DataFrame(medians)


def draw_shares(name: str, medians: pl.DataFrame, *, title: str) -> alt.LayerChart:
    """The chart of curves called ``name`` and medians called ``<name>_medians``."""
    there = medians["series"].to_list()
    colour = parts.series_colour(there, INPUT_WORDS)
    curve = (
        alt.Chart(alt.NamedData(name))
        .mark_line(strokeWidth=2)
        .encode(
            x=alt.X("value:Q", axis=alt.Axis(title=title, format="~g", tickCount=6, grid=False)),
            y=alt.Y(
                "share:Q",
                axis=alt.Axis(title="share of the samples below", format="%", tickCount=4, minExtent=30),
                scale=alt.Scale(domain=[0, 1]),
            ),
            color=colour,
            order="share:Q",
        )
    )
    base = alt.Chart(alt.NamedData(f"{name}_medians")).encode(x="value:Q", y="share:Q", color=colour)
    dots = base.mark_point(size=60, filled=True, fill=theme.PAPER, strokeWidth=2, opacity=1)
    layers: list[alt.Chart] = [curve, dots]
    lowest = medians["value"].min()
    for series, value in medians.select("series", "value").iter_rows():
        leads = len(there) == 1 or value != lowest
        side = {"align": "left", "dx": 9, "dy": 12} if leads else {"align": "right", "dx": -9, "dy": -8}
        layers.append(
            base.transform_filter(alt.datum.series == series).mark_text(fontWeight=600, **side).encode(text="label:N")
        )
    return alt.layer(*layers).properties(width=480, height=220, usermeta={"gutter": parts.GUTTER + 16})


def describe_medians(medians: pl.DataFrame, what: str) -> str:
    """The medians in words."""
    told = [f"{row['value']:.2f} m/s {INPUT_WORDS[row['series']]}" for row in medians.iter_rows(named=True)]
    return f"Share of the samples below each {what}. Half of them are below " + ", ".join(told) + "."
