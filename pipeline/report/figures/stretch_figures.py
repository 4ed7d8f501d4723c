"""Figures of the half minute in which the ideal model is worst: its path and its velocities."""

import math

import numpy as np
import polars as pl

from pipeline.report import figures, theme
from pipeline.report.figures import Figure, Section
from pipeline.report.scene import Scene, break_lines
from pipeline.report.theme import Channel, Chart, Drawing, layer, make_axis, stack

_ROOM = 0.15
"""Free margin above and below, as a fraction of a panel's height."""
_SERIES = {
    "x": ("forward velocity", "m/s", 1.0),
    "w": ("yaw rate, left positive", "\u00b0/s", 180.0 / math.pi),
}


def _colour_series(source: str) -> Channel:
    """Colours of the measured, ideal and modelled motion, with a legend in one line."""
    colour = figures.series_colour(["velocity", source, "model"], figures.SERIES_WORDS)
    return {**colour, "legend": {**colour["legend"], "columns": 3}}  # type: ignore[dict-item]


def draw_paths(scene: Scene) -> Drawing | None:
    """The measured path, and the predictions over two seconds from points on it; equal scales."""
    if scene.report.motion is None or scene.driven.height <= 1:
        return None
    ideal = scene.cut_arcs(scene.report.motion.ideal_arcs)
    both = pl.concat([scene.driven.select("x", "y"), ideal.select("x", "y")])
    extent = [theme.find_extent(both["x"]), theme.find_extent(both["y"])]
    height, x_domain, y_domain = theme.fit_equal_aspect(extent[0], extent[1])
    scales = [{"domain": domain, "nice": False, "zero": False} for domain in (x_domain, y_domain)]
    x = make_axis("x", "x in the map [m]", scale=scales[0], tickCount=5)
    y = make_axis("y", "y in the map [m]", scale=scales[1], tickCount=5, minExtent=figures.GUTTER - 20)
    colour = _colour_series(scene.report.motion.input)

    def line(name: str, **look: object) -> Chart:
        mark = Chart.of_rows(name).mark("line", order=False, clip=True, **look)
        return mark.encode(x=x, y=y, color=colour)

    ends = Chart.of_rows("stretch_errors")
    chart = layer(
        line("stretch_way", strokeWidth=2.2),
        line("stretch_ideal_arcs", strokeWidth=1.2, opacity=0.45),
        ends.mark("rule", color=theme.SLIP, strokeDash=[2, 3], strokeWidth=1.2, clip=True).encode(
            x="x:Q", y="y:Q", x2="x2:Q", y2="y2:Q"
        ),
        line("stretch_arcs", strokeWidth=2.2),
        Chart.of_rows("stretch_starts")
        .mark("circle", size=30, color=theme.MEASURED, opacity=1)
        .encode(x=x, y=y),
    ).properties(
        width=480,
        height=height,
        usermeta={
            "gutter": figures.GUTTER + 4,
            "dots": {"stretch_way": "measured", "stretch_arcs": "model"},
            "equal": {"x": extent[0], "y": extent[1], "lowest": 300, "highest": 330},
        },
    )
    driven = break_lines(scene.driven, "x", "y").with_columns(series=pl.lit("velocity"))
    ideal_rows = break_lines(ideal, "x", "y").with_columns(series=pl.lit(scene.report.motion.input))
    note = (
        "Each line of the model begins where the vehicle was measured (dots) and goes on for 2 s; "
        "dotted: its error then."
    )
    rows = {"stretch_way": driven, "stretch_ideal_arcs": ideal_rows} | list_paths(scene)
    return Drawing(chart, rows, note, _format_lead(scene))


def list_paths(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows of `draw_paths` that depend on the model."""
    if scene.report.motion is None or scene.driven.height <= 1:
        return {}
    arcs, driven = scene.cut_arcs(scene.report.motion.arcs), scene.driven
    by_piece = arcs.group_by("piece", maintain_order=True)
    last = by_piece.last()
    at = [np.interp(last["t"].to_numpy(), driven["t"].to_numpy(), driven[name].to_numpy()) for name in "xy"]
    errors = last.select("x", "y").with_columns(x2=pl.Series(at[0]), y2=pl.Series(at[1]))
    # The path is not drawn beyond the end of the stretch.
    errors = errors.filter(last["t"] <= float(driven["t"].max() or 0.0))  # type: ignore[arg-type]
    return {
        "stretch_arcs": break_lines(arcs, "x", "y").with_columns(series=pl.lit("model")),
        "stretch_starts": by_piece.first().select("x", "y"),
        "stretch_errors": errors,
    }


def _format_lead(scene: Scene) -> str:
    low, high = scene.stretch or (0.0, 0.0)
    return (
        f"Measured path from {low:.0f} s to {high:.0f} s, and where the model goes in two seconds from "
        "measured poses."
    )


def draw_motion(scene: Scene) -> Drawing | None:
    """Forward velocity and yaw rate over the stretch: measured, ideal, model."""
    if scene.report.motion is None or scene.stretch is None:
        return None
    source = scene.report.motion.input
    measured, ideal = scene.velocities, scene.slip.get(source)
    if measured is None or ideal is None:
        return None
    colour = _colour_series(source)
    rows, panels = list_motion(scene), []
    for name, (words, unit, factor) in _SERIES.items():
        lines = [(measured, f"v_{name}", "velocity"), (ideal, f"f_{name}", source)]
        fixed = pl.concat([_cut_line(scene, *line, factor) for line in lines])
        rows[f"stretch_v_{name}"] = fixed
        known = pl.concat([fixed, rows[f"stretch_model_{name}"]])["value"].drop_nulls()
        panels.append(_draw_panel(scene, name, f"{words} [{unit}]", known, colour))
    chart = stack(*panels).properties(usermeta=figures.brush_over_time())
    words = "Forward velocity and yaw rate of the stretch: measured, ideal and model."
    return Drawing(
        chart, rows | {figures.MARKED_SPANS: figures.span_rows(scene)[figures.MARKED_SPANS]}, "", words
    )


def _draw_panel(scene: Scene, name: str, title: str, known: pl.Series, colour: dict[str, object]) -> Chart:
    last = name == list(_SERIES)[-1]
    scale = {"domain": list(scene.stretch or ()), "nice": False, "zero": False}
    text = "time since the start of the run [s]" if last else None
    x = make_axis("t", text, scale=scale, tickCount=7, labels=last, grid=False)
    ends = [min(float(known.min() or 0.0), 0.0), max(float(known.max() or 0.0), 0.0)]  # type: ignore[arg-type]
    # Another model may exceed the range of the first one; the axis is fixed.
    room = _ROOM * (ends[1] - ends[0])
    y = make_axis(
        "value",
        None,
        scale={"domain": [ends[0] - room, ends[1] + room], "nice": True},
        tickCount=4,
        minExtent=figures.GUTTER - 10,
    )
    widths = {f"stretch_v_{name}": 1.6, f"stretch_model_{name}": 2.0}
    marked = (
        Chart.of_rows(figures.MARKED_SPANS)
        .mark("rect", color=theme.MARK, opacity=0.2, clip=True)
        .encode(x="t_start:Q", x2="t_end:Q")
    )
    lines = [
        Chart.of_rows(rows)
        .mark("line", clip=True, order=False, strokeWidth=width)
        .encode(x=x, y=y, color=colour)
        for rows, width in widths.items()
    ]
    return layer(marked, *lines).properties(width=480, height=116, title={"text": title})


def list_motion(scene: Scene) -> dict[str, pl.DataFrame]:
    """The model's velocities over the stretch."""
    if scene.report.motion is None or scene.stretch is None:
        return {}
    velocity = scene.report.motion.velocity
    return {
        f"stretch_model_{name}": _cut_line(scene, velocity, f"v_{name}", "model", factor)
        for name, (_, _, factor) in _SERIES.items()
    }


def _cut_line(scene: Scene, frame: pl.DataFrame, column: str, series: str, factor: float) -> pl.DataFrame:
    inside = frame.filter(pl.col("t").is_between(*(scene.stretch or (0.0, 0.0))))
    line = inside.select("t", "piece", value=pl.col(column) * factor)
    return break_lines(line, "value").with_columns(series=pl.lit(series))


PATHS = Figure("Path: measured and model", Section.GLANCE, draw_paths, order=0, live=list_paths, id="paths")
MOTION = Figure("Velocity and yaw rate", Section.GLANCE, draw_motion, order=1, live=list_motion, id="stretch")
