"""Figures of a run: what a figure is, and the parts that figures share."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from pipeline.core import INPUT_WORDS, suffix_unit
from pipeline.models import name_effect
from pipeline.report import Picture, format_number, theme
from pipeline.report.scene import Scene, Thinned
from pipeline.report.theme import Channel, Chart, Drawing, encode_column, find_range, layer, make_axis


@dataclass(frozen=True)
class Figure:
    """Figure that any run may have.

    Attributes:
        id: stable name.
        title: what it shows, in a few words.
        draw: from tables to a drawing, or to one for each effect by its id; None if there is nothing to draw.
        width: share of a wide page's width, `half` or `full`.
        live: names of its rows that change with the model of the run.
    """

    id: str
    title: str
    draw: Callable[[Scene], Drawing | Mapping[str, Drawing] | None]
    width: str = "half"
    live: Callable[[Scene], Mapping[str, pl.DataFrame]] | None = None


def draw_figure(figure: Figure, scene: Scene) -> list[Picture]:
    """The pictures of a figure, one for each of its parts; empty if there is nothing to draw."""
    drawn = figure.draw(scene)
    if isinstance(drawn, Mapping):
        return [
            Picture(f"{figure.id}-{name}", name_effect(name), one, figure.width)
            for name, one in drawn.items()
        ]
    return [] if drawn is None else [Picture(figure.id, figure.title, drawn, figure.width)]


WIDTH, MAP_WIDTH = 720, 480
GUTTER = 46
_MARGIN = 0.05
_SMALLEST_SPAN_M = 1.0

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

BAR_STEP, BAR_BELOW = 44, 9
_BAR, _WORDS_ABOVE = 15, -10

EMPTY_SPANS = pl.DataFrame(schema={"t_start": pl.Float64, "t_end": pl.Float64})
EMPTY_POINTS = pl.DataFrame(schema=dict.fromkeys(("t", "x", "y", "f_x", "f_w", "modulus"), pl.Float64))


def time_axis(
    scene: Scene, span: tuple[float, float] | None = None, *, has_title: bool = True, ticks: int = 8
) -> Channel:
    """Axis of time over the whole run or a span of it; without a title it has no labels either."""
    scale = {"domain": list(span or scene.time_domain or (0, 1)), "nice": False, "zero": False}
    title = "time since the start of the run [s]" if has_title else None
    return make_axis("t", title, scale=scale, tickCount=ticks, labels=has_title, grid=False)


def make_map(
    places: pl.DataFrame, origin: tuple[float, float], heights: tuple[float, float]
) -> tuple[Channel, Channel, dict[str, Any]]:
    """Axes of a map on which x and y have the same scale.

    Args:
        places: all ``x`` and ``y`` [m] that the map contains.
        origin: what was subtracted from them [m].
        heights: smallest and largest height of the map [px].

    Returns:
        The axes; and width and height of the chart, with the metadata that let the page fit both to its room.
    """
    middles, spans = [], []
    for name in "xy":
        low, high = float(places[name].min() or 0.0), float(places[name].max() or 0.0)  # type: ignore[arg-type]
        middles.append((low + high) / 2.0)
        spans.append(max(high - low, _SMALLEST_SPAN_M) * (1.0 + 2.0 * _MARGIN))
    height = round(min(max(MAP_WIDTH * spans[1] / spans[0], heights[0]), heights[1]))
    metres = max(spans[0] / MAP_WIDTH, spans[1] / height)
    equal: dict[str, object] = {"lowest": heights[0], "highest": heights[1]}
    axes = []
    for name, middle, span, pixels, offset in zip(
        "xy", middles, spans, (MAP_WIDTH, height), origin, strict=True
    ):
        equal[name] = [round(middle - span / 2.0, 4), round(middle + span / 2.0, 4)]
        half, less = metres * pixels / 2.0, f", less {offset:,.0f} m" if offset else ""
        scale = {"domain": [middle - half, middle + half], "nice": False, "zero": False}
        title = f"{name} in the map{less} [m]"
        axes.append(make_axis(name, title, scale=scale, tickCount=5, minExtent=GUTTER - 20))
    meta = {"gutter": GUTTER + 4, "equal": equal}
    return axes[0], axes[1], {"width": MAP_WIDTH, "height": height, "usermeta": meta}


def draw_lines(
    names: Sequence[str],
    lines: pl.DataFrame,
    usual: tuple[float, float],
    quantity: tuple[str, str],
    colour: Channel,
    *,
    x: Channel,
    height: int,
    bands: Sequence[Chart] | None = None,
    room: float = 0.0,
    stroke: float = 1.2,
) -> Chart:
    """Draw a panel of lines over time in front of bands; isolated peaks beyond its axis are told.

    Args:
        names: names of the rows of the lines.
        lines: rows that the vertical axis is made for, with ``t`` [s] and ``value``.
        usual: their range without isolated peaks.
        quantity: what the panel shows, and its unit.
        colour: colour of each series.
        x: axis of time.
        height: of the panel [px].
        bands: bands behind the lines; None for all of `shade_spans`.
        room: free margin above and below, as a fraction of the range of the lines.
        stroke: width of the lines [px].
    """
    low, high, beyond = find_range(lines, usual)
    margin = room * (high - low)
    scale = {"domain": [low - margin, high + margin], "nice": beyond is None}
    y = make_axis("value", None, scale=scale, tickCount=4, minExtent=GUTTER - 10)
    title = {"text": f"{quantity[0]} [{quantity[1]}]"}
    if beyond is not None:
        furthest, time = f"{format_number(beyond[0])}{suffix_unit(quantity[1])}", format_number(beyond[1])
        title["subtitle"] = f"peaks cut; the furthest is {furthest} at {time} s"
    drawn = [
        Chart.of_rows(name)
        .mark("line", clip=True, order=False, strokeWidth=stroke)
        .encode(x=x, y=y, color=colour)
        for name in names
    ]
    behind = shade_spans() if bands is None else bands
    return layer(*behind, *drawn).properties(width=WIDTH, height=height, title=title)


def shade_spans(*names: str) -> list[Chart]:
    """Bands over the full height of a panel, all or those of these names, as in `span_rows`."""
    bands = {"transitory": (theme.SHADE, 1.0), "suspect": (theme.SUSPECT, 1.0)}
    bands |= {MARKED_SPANS: (theme.MARK, 0.2), SHOWN_SPAN: (theme.MARK, 0.35)}
    return [
        Chart.of_rows(name)
        .mark("rect", color=bands[name][0], opacity=bands[name][1], clip=True)
        .encode(x="t_start:Q", x2="t_end:Q")
        for name in names or ("transitory", "suspect", MARKED_SPANS)
    ]


def name_bars(rows: str, name: str) -> tuple[Chart, Chart, Chart]:
    """Bars over the whole width, each below its name and values, in the order of the rows.

    Args:
        rows: name of the rows, with a column ``told``, which is written beside the name.
        name: name of the column with the names.

    Returns:
        The rows without a mark, the bars, which have no ends yet, and the names.
    """
    y = encode_column(f"{name}:N", sort=None, scale={"padding": 0}, axis=None)
    base = Chart.of_rows(rows).encode(y=y)
    text = {"expr": f"datum.{name} + '  \u00b7  ' + datum.told"}
    words = base.mark("text", align="left", dy=_WORDS_ABOVE, fontSize=12, text=text)
    return (
        base,
        base.mark("bar", size=_BAR, yOffset=BAR_BELOW, clip=True),
        words.encode(x={"value": 0}),
    )


def series_colour(
    words: Mapping[str, str], colours: Mapping[str, str] = SERIES_COLOURS, symbol: str = "stroke"
) -> Channel:
    """Colour of each series, the same in every figure, with these words in the legend."""
    label = " : ".join(f"datum.value === '{name}' ? '{text}'" for name, text in words.items())
    scale = {"domain": list(words), "range": [colours[name] for name in words]}
    legend = {
        "title": None,
        "labelExpr": f"{label} : datum.value",
        "symbolType": symbol,
        "symbolSize": 220 if symbol == "stroke" else 60,
        "symbolOpacity": 1,
    }
    return encode_column("series:N", scale=scale, legend=legend)


def before_and_after(source: str) -> Channel:
    """Colours of the ideal model on an input and of the model, with a legend."""
    colours = {"ideal": theme.INPUT_COLOURS.get(source, theme.QUIET), "model": theme.MODEL}
    return series_colour({"ideal": f"ideal {INPUT_WORDS.get(source, '')}", "model": "model"}, colours)


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
    """Rows of bands: after a change of command, suspect, and marked by the user, at first none."""
    return {"transitory": scene.transitory_spans, "suspect": scene.suspect_spans, MARKED_SPANS: EMPTY_SPANS}


def format_bands(scene: Scene, *lines: Thinned) -> str:
    """Explain the bands that exist, and which points of lines are drawn."""
    texts = (
        (scene.transitory_spans, "Grey bands: transitory, after a change of command."),
        (scene.suspect_spans, "Red bands: incidents and suspect poses, left out of medians and fits."),
    )
    bands = [text for spans, text in texts if not spans.is_empty()]
    thinned = format_thinning(*lines, rule="first, last, lowest and highest of every bin")
    return " ".join(filter(None, [*bands, format_ends(scene), thinned]))


def format_ends(scene: Scene) -> str:
    """Sentence about the ends of segments, where no speed is drawn."""
    return (
        f"Measured speeds nearer than {scene.one_sided_s:.2g} s to a gap of the poses are not drawn: "
        "they rest on poses of one side."
    )


def format_thinning(*lines: Thinned, rule: str) -> str:
    """Sentence about omitted points; empty if there are none."""
    drawn, total = sum(line.drawn for line in lines), sum(line.total for line in lines)
    words = f"Drawn from {drawn:,} of {total:,} points: {rule}, so no peak is lost."
    return words if drawn < total else ""
