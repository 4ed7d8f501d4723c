"""Velocities over time: what was measured against what the ideal model says, gaps left open."""

import polars as pl

from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.scales import find_range
from pipeline.report.scene import COMPONENTS, LINE_BINS, Scene, Thinned
from pipeline.report.thinning import break_lines, drop_flat_rows, thin_series
from pipeline.report.vega import Chart, stack

_QUANTITIES = {
    "x": ("forward velocity v_x", "m/s"),
    "y": ("sideways velocity v_y, left positive", "m/s"),
    "w": ("yaw rate v_w, left positive", "rad/s"),
}


def draw(scene: Scene) -> Drawing | None:
    """Three panels over one time axis: measured, ideal on command, ideal on measured wheels."""
    lines = {component: scene.component_lines(component) for component in COMPONENTS}
    there = {component: line for component, line in lines.items() if line is not None}
    if not there:
        return None
    chart = stack(*(_draw_panel(scene, component, line) for component, line in there.items()))
    rows = {f"velocity_{component}": line.frame for component, line in there.items()} | model_rows(scene)
    note = parts.tell_thinning(*there.values(), kept="first, last, lowest and highest of every bin")
    # The page shows the worst stretch alone at first.
    window = {} if scene.worst_span is None else {"window": list(scene.worst_span)}
    return Drawing(
        chart.properties(usermeta=parts.brush_over_time() | window),
        rows | parts.span_rows(scene),
        f"{parts.tell_bands(scene)} {note}".strip(),
        _describe(scene),
    )


def _draw_panel(scene: Scene, component: str, lines: Thinned) -> Chart:
    shown = find_range(lines.frame, lines.usual)
    title = parts.title_panel(*_QUANTITIES[component], shown)
    last = component == COMPONENTS[-1]
    series = [*scene.slip, "velocity", *(["model"] if scene.report.motion else [])]
    names = [f"velocity_{component}", *([f"model_{component}"] if scene.report.motion else [])]
    colour = parts.series_colour(series, parts.SERIES_WORDS)
    x = parts.time_axis(scene) if last else parts.time_axis(scene, title=None)
    return parts.draw_lines(scene, names, shown, colour, x).properties(height=118, title=title)


def model_rows(scene: Scene) -> dict[str, pl.DataFrame]:
    """The model's velocity by component, thinned: ``t value series``; empty without a model."""
    motion = scene.report.motion
    if motion is None:
        return {}
    rows = {}
    for component in COMPONENTS:
        line = motion.velocity.select("t", "piece", value=pl.col(f"v_{component}"))
        thinned = thin_series(drop_flat_rows(line, "value"), "value", bins=LINE_BINS, whole=scene.worst_span)
        rows[f"model_{component}"] = break_lines(thinned, "value").with_columns(series=pl.lit("model"))
    return rows


def _describe(scene: Scene) -> str:
    """Names the lines and their root mean square distance."""
    words = [parts.SERIES_WORDS[name] for name in scene.slip]
    return (
        "Forward velocity, sideways velocity and yaw rate over time in three panels: measured"
        + "".join(f", {word}" for word in words)
        + (", model" if scene.report.motion else "")
        + ". The distance between a line and the measured one is the slip in that direction."
    )


FIGURE = Figure(
    "Velocities: measured against ideal", Section.WHERE, draw, order=30, width="full", live=model_rows
)
