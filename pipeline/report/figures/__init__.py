"""Figures: their definition, their discovery, and their common parts.

One file each; they are found by being in this folder.
"""

import functools
import importlib
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Literal

import numpy as np
import polars as pl

from pipeline.core import INPUT_WORDS, suffix_unit
from pipeline.models import name_effect
from pipeline.report import Picture, format_number, theme
from pipeline.report.scene import Scene, Thinned
from pipeline.report.theme import Channel, Chart, Drawing, Range, encode_column, layer, make_axis


class Section(Enum):
    """Question of the page that a figure answers."""

    GLANCE = "glance"
    WHY = "why"
    EFFECT = "effect"
    WHERE = "where"
    HOW_BAD = "how-bad"
    REST = "rest"


@dataclass(frozen=True)
class Figure:
    """Figure that any run may have.

    Attributes:
        title: what it shows, in a few words.
        section: the question it answers.
        draw: the function from tables to a drawing, which returns None if there is nothing to draw; None for
            a figure of panels.
        order: position within the section, in ascending order; figures of half the width may come first.
        id: stable name.
        width: share of a wide page's width.
        panels: drawings by the id of an effect, for a figure that has one for each.
        live: names of its rows that change with the model of the run.
    """

    title: str
    section: Section
    draw: Callable[[Scene], Drawing | None] | None
    order: int
    id: str
    width: Literal["half", "full"] = "half"
    panels: Callable[[Scene], Mapping[str, Drawing]] | None = None
    live: Callable[[Scene], Mapping[str, pl.DataFrame]] | None = None


@functools.cache
def list_figures() -> tuple[Figure, ...]:
    """All figures of this folder, in the order of the page."""
    folder = importlib.import_module("pipeline.report.figures")
    figures = []
    for module in pkgutil.iter_modules(folder.__path__):
        content = vars(importlib.import_module(f"{folder.__name__}.{module.name}"))
        figures += [value for value in content.values() if isinstance(value, Figure)]
    sections = list(Section)
    return tuple(
        sorted(figures, key=lambda figure: (sections.index(figure.section), figure.order, figure.id))
    )


def draw_figure(figure: Figure, scene: Scene) -> list[Picture]:
    """The pictures of a figure, one for each of its parts; empty if there is nothing to draw."""
    if figure.panels is not None:
        return [
            Picture(f"{figure.id}-{name}", name_effect(name), panel, figure.width)
            for name, panel in figure.panels(scene).items()
        ]
    drawing = None if figure.draw is None else figure.draw(scene)
    return [] if drawing is None else [Picture(figure.id, figure.title, drawing, figure.width)]


WIDTH = 720
GUTTER = 46

SERIES_WORDS = {
    "velocity": "measured",
    "command": f"ideal {INPUT_WORDS['command']}",
    "measured": f"ideal {INPUT_WORDS['measured']}",
    "model": "model",
}
SERIES_COLOURS = {"velocity": theme.MEASURED, **theme.INPUT_COLOURS, "model": theme.MODEL}

MARKED_SPANS = "marked_spans"
MARKED_POINTS = "marked_points"
SHOWN_SPAN = "shown_span"

BAR_STEP = 44
_BAR, _BAR_BELOW, _WORDS_ABOVE = 15, 9, -10

_EMPTY_SPANS = pl.DataFrame(schema={"t_start": pl.Float64, "t_end": pl.Float64})
_EMPTY_POINTS = pl.DataFrame(schema=dict.fromkeys(("t", "x", "y", "f_x", "f_w", "modulus"), pl.Float64))


def time_axis(scene: Scene, *, title: str | None = "time since the start of the run [s]") -> Channel:
    """Time axis of every figure over time; without a title it has no labels either."""
    scale = {"domain": list(scene.time_domain or (0, 1)), "nice": False, "zero": False}
    return make_axis("t", title, scale=scale, tickCount=8, labels=title is not None, grid=False)


def value_axis(shown: Range) -> Channel:
    """Vertical axis without a title (the panel's title states quantity and unit)."""
    scale = {"domain": [shown.low, shown.high], "nice": shown.beyond is None}
    return make_axis("value", None, scale=scale, tickCount=4, minExtent=GUTTER - 10)


def title_panel(quantity: str, unit: str, shown: Range) -> Channel:
    """Title of a panel: quantity and unit; below, the range of peaks beyond the axis."""
    if shown.beyond is None:
        return {"text": f"{quantity} [{unit}]"}
    value, time = shown.beyond
    return {
        "text": f"{quantity} [{unit}]",
        "subtitle": (
            f"peaks cut; the furthest is {format_number(value)}{suffix_unit(unit)} at {format_number(time)} s"
        ),
    }


def draw_lines(
    scene: Scene, names: list[str], shown: Range, colour: Channel, x: Channel | None = None
) -> Chart:
    """Draw lines of `names` over time in front of the bands; the caller sets title and height."""
    lines = [
        Chart.of_rows(name)
        .mark("line", clip=True, order=False)
        .encode(x=x or time_axis(scene), y=value_axis(shown), color=colour)
        for name in names
    ]
    return layer(*shade_spans(), *lines).properties(width=WIDTH)


def shade_spans() -> list[Chart]:
    """Bands over the full height of a panel: after a change of command, suspect, marked by the user."""
    bands = (
        ("transitory", theme.SHADE, 1.0),
        ("suspect", theme.SUSPECT, 1.0),
        (MARKED_SPANS, theme.MARK, 0.2),
    )
    return [
        Chart.of_rows(name)
        .mark("rect", color=colour, opacity=opacity, clip=True)
        .encode(x="t_start:Q", x2="t_end:Q")
        for name, colour, opacity in bands
    ]


@dataclass(frozen=True)
class NamedBars:
    """Bars over the whole width, each below its name and values; variable channels must be encoded.

    Attributes:
        bars: the bars.
        ticks: short lines across single bars.
        rules: lines along the bars.
        words: the names and values.
    """

    bars: Chart
    ticks: Chart
    rules: Chart
    words: Chart


def name_bars(rows: str, name: str) -> NamedBars:
    """Make bars labelled by the columns ``name`` and ``told``, in the order of the rows.

    Args:
        rows: name of the rows.
        name: name of the column with the names.
    """
    y = encode_column(f"{name}:N", sort=None, scale={"padding": 0}, axis=None)
    base = Chart.of_rows(rows).encode(y=y)
    words = base.calculate("words", f"datum.{name} + '  \u00b7  ' + datum.told")
    return NamedBars(
        bars=base.mark("bar", size=_BAR, yOffset=_BAR_BELOW, clip=True),
        ticks=base.mark(
            "point",
            shape="stroke",
            angle=90,
            size=(_BAR + 3) ** 2,
            stroke=theme.INK,
            strokeWidth=1.5,
            opacity=1,
            yOffset=_BAR_BELOW,
        ),
        rules=base.mark("rule", color=theme.INK, strokeWidth=1.2, yOffset=_BAR_BELOW, y2Offset=_BAR_BELOW),
        words=words.mark("text", align="left", dy=_WORDS_ABOVE, fontSize=12).encode(
            x={"value": 0}, text="words:N"
        ),
    )


def series_colour(names: list[str], words: dict[str, str]) -> Channel:
    """Colour of each series, the same in every figure, with texts in the legend."""
    label = " : ".join(f"datum.value === '{name}' ? '{words[name]}'" for name in names)
    scale = {"domain": names, "range": [SERIES_COLOURS[name] for name in names]}
    legend = {"title": None, "labelExpr": f"{label} : datum.value", "symbolType": "stroke", "symbolSize": 220}
    return encode_column("series:N", scale=scale, legend=legend)


def before_and_after(input_name: str) -> Channel:
    """Colours of the ideal model on an input and of the model, with a legend."""
    scale = {
        "domain": ["ideal", "model"],
        "range": [theme.INPUT_COLOURS.get(input_name, theme.QUIET), theme.MODEL],
    }
    words = INPUT_WORDS.get(input_name, "")
    label = f"datum.value === 'ideal' ? 'ideal {words}' : 'model'"
    legend = {
        "title": None,
        "labelExpr": label,
        "symbolType": "stroke",
        "symbolSize": 220,
        "symbolOpacity": 1,
        "symbolStrokeWidth": 2.5,
    }
    return encode_column("series:N", scale=scale, legend=legend)


def slip_colour(scene: Scene) -> Channel:
    """Colour ramp of slip modulus, the same in every figure of a run."""
    words = INPUT_WORDS[scene.report.main_input]
    legend = {
        "title": f"slip modulus {words} [m/s]",
        "gradientLength": 150,
        "gradientThickness": 8,
        "tickCount": 3,
        "format": ",~r",
    }
    scale = {
        "domain": [0.0, scene.modulus_cap],
        "range": list(theme.SLIP_RAMP),
        "clamp": True,
        "interpolate": "rgb",
    }
    return encode_column("modulus:Q", scale=scale, legend=legend)


def brush_over_time() -> dict[str, object]:
    """Metadata for the page: dragging sideways selects a stretch of time."""
    return {"brush": "time", "gutter": GUTTER - 11}


def brush_over_plane(x: str, y: str) -> dict[str, object]:
    """Metadata for the page: dragging a box selects the points with ``x`` and ``y`` inside."""
    return {"brush": "plane", "x": x, "y": y, "gutter": GUTTER + 4}


def span_rows(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows of `shade_spans`."""
    return {"transitory": scene.transitory_spans, "suspect": scene.suspect_spans, MARKED_SPANS: _EMPTY_SPANS}


def marked_rows() -> dict[str, pl.DataFrame]:
    """Rows of the points marked by the user: initially empty."""
    return {MARKED_POINTS: _EMPTY_POINTS}


def format_bands(scene: Scene) -> str:
    """Explain the bands that exist."""
    sentences = []
    if not scene.transitory_spans.is_empty():
        sentences.append("Grey bands: transitory, after a change of command.")
    if not scene.suspect_spans.is_empty():
        sentences.append("Red bands: incidents and suspect poses, left out of medians and fits.")
    return " ".join(sentences)


def format_thinning(*lines: Thinned, rule: str) -> str:
    """Sentence about omitted points; empty if there are none."""
    drawn, total = sum(line.drawn for line in lines), sum(line.total for line in lines)
    if drawn >= total:
        return ""
    return f"Drawn from {drawn:,} of {total:,} points: {rule}, so no peak is lost."


_POINTS = 201
_HIGHEST_SHOWN = 0.995


def tabulate_shares(values: dict[str, pl.Series]) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Cumulative distributions and medians of each series.

    Args:
        values: samples [m/s] by input; none of them empty.

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
    """Draw distributions called ``name`` and medians called ``<name>_medians``, listed in the legend.

    Args:
        name: name of the rows.
        values: samples [m/s] by input; none of them empty.
        what: name of the quantity.
        of: addition to this name, for the axis.
        note: note of the drawing.
    """
    curves, medians = tabulate_shares(values)
    words = {
        row["series"]: f"{INPUT_WORDS[row['series']]}, median {row['value']:.2f} m/s"
        for row in medians.iter_rows(named=True)
    }
    colour, whole = series_colour(list(words), words), {"domain": [0, 1]}
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
    meta = {"gutter": GUTTER + 19}
    chart = layer(drops, curve, dots).properties(width=480, height=220, usermeta=meta)
    parts = [f"{row['value']:.2f} m/s {INPUT_WORDS[row['series']]}" for row in medians.iter_rows(named=True)]
    half = f"Share of the samples below each {what}. Half of them are below {', '.join(parts)}."
    return Drawing(chart, {name: curves, f"{name}_medians": medians}, note, half)


def list_events(scene: Scene) -> dict[str, pl.DataFrame]:
    """Start of each motion event: ``t kind x y``; empty without any."""
    table = scene.report.tables.get("events")
    if table is None or table.is_empty():
        return {}
    east, north = scene.origin
    kind = pl.col("kind").cast(pl.String).str.replace_all("_", " ")
    return {"events": table.select(t="t_start", kind=kind, x=pl.col("x") - east, y=pl.col("y") - north)}


def format_events(events: pl.DataFrame) -> str:
    """Number of events of each kind, and start of the first."""
    counts = events.group_by("kind", maintain_order=True).agg(pl.len().alias("count"), pl.col("t").first())
    sentences = []
    for kind, count, first in counts.select("kind", "count", "t").iter_rows():
        others = f" and {count - 1} more" if count > 1 else ""
        sentences.append(f"{kind} at {first:.0f} s{others}")
    return ", ".join(sentences)
