"""The ladder: how the error on data not seen falls, effect by effect, down to the floor."""

from __future__ import annotations

from typing import TYPE_CHECKING

import altair as alt
import polars as pl

from pipeline.report import theme
from pipeline.report.figures.figure import Drawing, Figure, Section, Width
from pipeline.report.run import INPUT_WORDS, mapping_in, number_in, objects_in
from pipeline.report.words import say_number

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.report.scene import Scene

_SCHEMA = {
    "rung": pl.Int64,
    "step": pl.String,
    "t": pl.Float64,
    "told": pl.String,
    "series": pl.String,
}
_ROOM = 2.1


def draw_ladder(scene: Scene) -> Drawing | None:
    """A staircase: one bar a rung, the longest on top; the floor as a dashed line."""
    rows = list_rungs(scene)
    if rows["ladder"].is_empty():
        return None
    colour = theme.INPUT_COLOURS.get(name_input(scene), theme.QUIET)
    scale = alt.Scale(domain=["ideal", "model"], range=[colour, theme.MODEL])
    top = float(rows["ladder"]["t"].max() or 1.0)  # type: ignore[arg-type]
    x = alt.X(
        "t:Q",
        scale=alt.Scale(domain=[0.0, top * _ROOM], nice=False),
        axis=alt.Axis(title="error over 2 s on data not seen [m]", format=",~r", tickCount=4),
    )
    y = alt.Y(
        "step:N",
        sort=None,
        scale=alt.Scale(paddingInner=0.06, paddingOuter=0.1),
        axis=alt.Axis(title=None, grid=False, labelLimit=150, labelFontSize=12, labelColor=theme.INK),
    )
    base = alt.Chart(alt.NamedData("ladder")).encode(y=y)
    bars = base.mark_bar(clip=True).encode(x=x, color=alt.Color("series:N", scale=scale, legend=None))
    words = base.mark_text(align="left", dx=6, color=theme.INK, fontSize=11).encode(
        x=alt.X("t:Q"), text="told:N"
    )
    floor = (
        alt.Chart(alt.NamedData("ladder_floor"))
        .mark_rule(color=theme.INK, strokeDash=[4, 3], strokeWidth=1.5)
        .encode(x="t:Q", tooltip=[alt.Tooltip("told:N", title="floor")])
    )
    chart = alt.layer(bars, floor, words).properties(width=480, height=alt.Step(30), usermeta={"gutter": 130})
    note = (
        "Dashed: the noise floor, the error that no model could remove."
        if rows["ladder_floor"].height
        else ""
    )
    return Drawing(chart, rows, note)


def list_rungs(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows of the staircase: ``rung step t told series``, and the floor's ``t told``."""
    rungs, floor = _find_ladder(scene)
    rows = []
    before: Sequence[object] = ()
    for number, rung in enumerate(rungs):
        size = number_in(rung, "t_mrmse_m")
        effects = rung.get("effects")
        effects = effects if isinstance(effects, list | tuple) else []
        added = [str(name) for name in effects if name not in before]
        before = effects
        if size is None:
            continue
        rows.append(
            {
                "rung": number,
                "step": "ideal" if number == 0 else "+ " + ", ".join(added),
                "t": size,
                "told": f"{say_number(size)} m \u00b7 {say_number(number_in(rung, 'r_mrmse_rad'))} rad",
                "series": "model" if effects else "ideal",
            }
        )
    lowest = number_in(floor, "t_mrmse_m")
    floors = [] if lowest is None else [{"t": lowest, "told": f"{say_number(lowest)} m"}]
    return {
        "ladder": pl.DataFrame(rows, schema=_SCHEMA),
        "ladder_floor": pl.DataFrame(floors, schema={"t": pl.Float64, "told": pl.String}),
    }


def name_input(scene: Scene) -> str:
    """What the ladder's models are fed with."""
    motion = scene.report.motion
    if motion is not None:
        return motion.input
    found = scene.report.diagnosis.get("input")
    return found if isinstance(found, str) else scene.report.main_input


def _find_ladder(scene: Scene) -> tuple[Sequence[Mapping[str, object]], Mapping[str, object]]:
    motion = scene.report.motion
    if motion is not None:
        return motion.ladder, motion.floor or {}
    return objects_in(scene.report.diagnosis, "ladder"), mapping_in(scene.report.diagnosis, "noise_floor")


def describe_ladder(scene: Scene) -> str:
    """Every rung with its errors."""
    rows = list_rungs(scene)
    told = "; ".join(f"{row['step']}: {row['told']}" for row in rows["ladder"].iter_rows(named=True))
    floor = "".join(
        f" The noise floor is {row['told']}." for row in rows["ladder_floor"].iter_rows(named=True)
    )
    words = INPUT_WORDS.get(name_input(scene), "")
    return f"Error of two-second predictions {words} on data not seen. {told}.{floor}"


FIGURE = Figure(
    id="ladder",
    title="The ladder: error after each effect",
    section=Section.WHY,
    order=0,
    width=Width.HALF,
    draw=draw_ladder,
    describe=describe_ladder,
)
