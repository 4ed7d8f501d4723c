"""Velocities over time: what was measured against what the ideal model says, gaps left open."""

from __future__ import annotations

from typing import TYPE_CHECKING

import altair as alt

from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section, Width
from pipeline.report.scales import find_range
from pipeline.report.scene import COMPONENTS

if TYPE_CHECKING:
    from pipeline.report.figures.figure import Picture
    from pipeline.report.scene import Scene, Thinned

_QUANTITIES = {
    "x": ("forward velocity v_x", "m/s"),
    "y": ("sideways velocity v_y, left positive", "m/s"),
    "w": ("yaw rate v_w, left positive", "rad/s"),
}


def draw_velocities(scene: Scene) -> Drawing | None:
    """Three panels over one time axis: measured, ideal on command, ideal on measured wheels."""
    lines = {component: scene.component_lines(component) for component in COMPONENTS}
    there = {component: line for component, line in lines.items() if line is not None}
    if not there:
        return None
    chart = alt.vconcat(*(_draw_panel(scene, component, line) for component, line in there.items()))
    rows = {f"velocity_{component}": line.frame for component, line in there.items()}
    note = parts.tell_thinning(*there.values(), kept="first, last, lowest and highest of every bin")
    return Drawing(
        chart.properties(usermeta=parts.brush_over_time()),
        rows | parts.span_rows(scene),
        f"{parts.tell_bands(scene)} {note}".strip(),
    )


def _draw_panel(scene: Scene, component: str, lines: Thinned) -> Picture:
    shown = find_range(lines.frame, lines.usual)
    title = parts.title_panel(*_QUANTITIES[component], shown)
    last = component == COMPONENTS[-1]
    line = (
        alt.Chart(alt.NamedData(f"velocity_{component}"))
        .mark_line(clip=True, order=False)
        .encode(
            x=parts.time_axis(scene) if last else parts.time_axis(scene, title=None),
            y=parts.value_axis(shown),
            color=parts.series_colour([*scene.slip, "velocity"], parts.SERIES_WORDS),
        )
    )
    return alt.layer(*parts.shade_spans(), line).properties(width=parts.WIDTH, height=118, title=title)


def describe_velocities(scene: Scene) -> str:
    """Names the lines and their root mean square distance."""
    words = [parts.SERIES_WORDS[name] for name in scene.slip]
    return (
        "Forward velocity, sideways velocity and yaw rate over time in three panels: measured"
        + "".join(f", {word}" for word in words)
        + ". The distance between a line and the measured one is the slip in that direction."
    )


FIGURE = Figure(
    id="velocities",
    title="Velocities: measured against ideal",
    section=Section.WHERE,
    order=30,
    width=Width.FULL,
    draw=draw_velocities,
    describe=describe_velocities,
)
