"""Velocities over time: what was measured against what the ideal model says, gaps left open."""

from __future__ import annotations

from typing import TYPE_CHECKING

import altair as alt

from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section, Width
from pipeline.report.scene import COMPONENTS

if TYPE_CHECKING:
    from pipeline.report.figures.figure import Picture
    from pipeline.report.scene import Scene

_TITLES = {
    "x": "forward velocity v_x [m/s]",
    "y": "sideways velocity v_y, left positive [m/s]",
    "w": "yaw rate v_w, left positive [rad/s]",
}


def draw_velocities(scene: Scene) -> Drawing | None:
    """Three panels over one time axis: measured, ideal on command, ideal on measured wheels."""
    lines = {component: scene.component_lines(component) for component in COMPONENTS}
    there = {component: line for component, line in lines.items() if line is not None}
    if not there or scene.time_domain is None:
        return None
    names = [*scene.slip, "velocity"]
    panels = [_draw_panel(scene, component, names) for component in there]
    panels[-1] = _draw_panel(scene, COMPONENTS[-1], names, title="time since the start of the run [s]")
    chart = alt.vconcat(*panels).properties(usermeta=parts.brush_over_time())
    rows = {f"velocity_{component}": line.frame for component, line in there.items()}
    note = parts.tell_thinning(*there.values(), kept="first, last, lowest and highest of every bin")
    return Drawing(chart, rows | parts.span_rows(scene), f"{parts.tell_bands(scene)} {note}".strip())


def _draw_panel(scene: Scene, component: str, names: list[str], *, title: str | None = None) -> Picture:
    line = (
        alt.Chart(alt.NamedData(f"velocity_{component}"))
        .mark_line(clip=True)
        .encode(
            x=parts.time_axis(scene, title=title),
            y=parts.value_axis(),
            color=parts.series_colour(names, parts.SERIES_WORDS),
            detail="piece:N",
        )
    )
    return alt.layer(*parts.shade_spans(), line).properties(
        width=parts.WIDTH, height=118, title=_TITLES[component]
    )


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
