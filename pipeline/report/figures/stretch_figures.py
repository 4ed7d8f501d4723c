"""Figures of the half minute in which the ideal model is worst: its path and its velocities."""

import math

import numpy as np
import polars as pl

from pipeline.report import figures, theme
from pipeline.report.figures import Figure
from pipeline.report.scene import Scene, break_lines
from pipeline.report.theme import Channel, Chart, Drawing, layer, stack, usual_ends

_ROOM = 0.15
"""Free margin above and below, as a fraction of a panel's height."""
_SERIES = {
    "x": ("forward velocity", "m/s", 1.0),
    "w": ("yaw rate, left positive", "\u00b0/s", 180.0 / math.pi),
}


def _colour_series(source: str) -> Channel:
    """Colours of the measured, ideal and modelled motion, with a legend in one line."""
    words = {name: figures.SERIES_WORDS[name] for name in ("velocity", source, "model")}
    colour = figures.series_colour(words)
    return {**colour, "legend": {**colour["legend"], "columns": 3}}  # type: ignore[dict-item]


def draw_paths(scene: Scene) -> Drawing | None:
    """The measured path, and the predictions over two seconds from points on it; equal scales."""
    if scene.report.motion is None or scene.driven.height <= 1:
        return None
    ideal = scene.cut_arcs(scene.report.motion.ideal_arcs)
    both = pl.concat([scene.driven.select("x", "y"), ideal.select("x", "y")])
    x, y, properties = figures.make_map(both, scene.origin, (300, 330))
    properties["usermeta"]["dots"] = {"stretch_way": "measured", "stretch_arcs": "model"}
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
    ).properties(**properties)
    driven = break_lines(scene.driven, "x", "y").with_columns(series=pl.lit("velocity"))
    ideal_rows = break_lines(ideal, "x", "y").with_columns(series=pl.lit(scene.report.motion.input))
    note = (
        "Each line of the model begins where the vehicle was measured (dots) and goes on for 2 s; "
        "dotted: its error then."
    )
    low, high = scene.stretch or (0.0, 0.0)
    words = (
        f"Measured path from {low:.0f} s to {high:.0f} s, and where the model goes in two seconds from "
        "measured poses."
    )
    rows = {"stretch_way": driven, "stretch_ideal_arcs": ideal_rows} | list_paths(scene)
    return Drawing(chart, rows, note, words)


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


def draw_motion(scene: Scene) -> Drawing | None:
    """Forward velocity and yaw rate over the stretch: measured, ideal, model."""
    if scene.report.motion is None or scene.stretch is None:
        return None
    source = scene.report.motion.input
    measured, ideal = scene.velocities, scene.slip.get(source)
    if measured is None or ideal is None:
        return None
    marked = figures.shade_spans(figures.MARKED_SPANS)
    rows, panels = list_motion(scene), []
    for name, (words, unit, factor) in _SERIES.items():
        lines = [(measured, f"v_{name}", "velocity"), (ideal, f"f_{name}", source)]
        fixed = pl.concat([_cut_line(scene, *line, factor) for line in lines])
        both = pl.concat([fixed, rows[f"stretch_model_{name}"]])
        rows[f"stretch_v_{name}"] = fixed
        panel = figures.draw_lines(
            [f"stretch_v_{name}", f"stretch_model_{name}"],
            both,
            usual_ends(both["value"].drop_nulls(), exact=True),
            (words, unit),
            _colour_series(source),
            x=figures.time_axis(scene, scene.stretch, has_title=name == list(_SERIES)[-1], ticks=7),
            height=116,
            bands=marked,
            # Another model may exceed the range of the first one; the axis is fixed.
            room=_ROOM,
            stroke=1.8,
        )
        panels.append(panel.properties(width=480))
    rows[figures.MARKED_SPANS] = figures.EMPTY_SPANS
    text = "Forward velocity and yaw rate of the stretch: measured, ideal and model."
    chart = stack(*panels).properties(usermeta=figures.brush_over_time())
    return Drawing(chart, rows, figures.format_ends(scene), text)


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


PATHS = Figure("paths", "Path: measured and model", draw_paths, live=list_paths)
MOTION = Figure("stretch", "Velocity and yaw rate", draw_motion, live=list_motion)
