"""The share of samples below a value, one curve an input, with the median marked."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.report import theme
from pipeline.report.axes import make_axis
from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing
from pipeline.report.run import INPUT_WORDS
from pipeline.report.vega import Chart, layer

_POINTS = 201
_HIGHEST_SHOWN = 0.995


def tabulate_shares(values: dict[str, pl.Series]) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Curves and medians of each series.

    Args:
        values: numbers [m/s] by input; none of them empty.

    Returns:
        Long curves ``value share series`` up to the 99.5th percentile, and medians ``value share series``.
    """
    shares = np.linspace(0.0, _HIGHEST_SHOWN, _POINTS)
    curves, medians = [], []
    for name, series in values.items():
        numbers = series.to_numpy()
        curve = pl.DataFrame({"value": np.quantile(numbers, shares), "share": shares})
        curves.append(curve.with_columns(series=pl.lit(name)))
        medians.append({"value": float(np.median(numbers)), "share": 0.5, "series": name})
    return pl.concat(curves), pl.DataFrame(medians)


def draw_shares(
    name: str, values: dict[str, pl.Series], what: str, *, of: str = "", note: str = ""
) -> Drawing:
    """Curves called ``name`` and medians called ``<name>_medians``, which the legend tells.

    Args:
        name: of the rows.
        values: numbers [m/s] by input; none of them empty.
        what: the numbers are.
        of: of what they are, for the axis.
        note: of the drawing.
    """
    curves, medians = tabulate_shares(values)
    words = {
        row["series"]: f"{INPUT_WORDS[row['series']]}, median {row['value']:.2f} m/s"
        for row in medians.iter_rows(named=True)
    }
    colour, whole = parts.series_colour(list(words), words), {"domain": [0, 1]}
    curve = (
        Chart.of_rows(name)
        .mark("line", strokeWidth=2)
        .encode(
            x=make_axis("value", f"{what}{of} [m/s]", tickCount=6, grid=False),
            y=make_axis("share", "share below", scale=whole, format="%", tickCount=4, minExtent=30),
            color=colour,
            order="share:Q",
        )
    )
    base = Chart.of_rows(f"{name}_medians").encode(x="value:Q", y="share:Q", color=colour)
    drops = base.mark("rule", strokeDash=[2, 3], strokeWidth=1.2).encode(y2={"value": "height"})
    dots = base.mark("point", size=60, filled=False, fill=theme.PAPER, strokeWidth=2, opacity=1)
    meta = {"gutter": parts.GUTTER + 19}
    chart = layer(drops, curve, dots).properties(width=480, height=220, usermeta=meta)
    told = [f"{row['value']:.2f} m/s {INPUT_WORDS[row['series']]}" for row in medians.iter_rows(named=True)]
    half = f"Share of the samples below each {what}. Half of them are below {', '.join(told)}."
    return Drawing(chart, {name: curves, f"{name}_medians": medians}, note, half)
