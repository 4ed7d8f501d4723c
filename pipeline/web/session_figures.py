"""Figures of a session and of a stretch of its run, complete or only the rows that a change affects."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import polars as pl

from pipeline.core.untrusted import number_in
from pipeline.report import figures, theme
from pipeline.report.figures import Drawing, Figure, Section, list_figures, slip_figures
from pipeline.report.motion_view import MotionView
from pipeline.report.scene import RunReport, Scene, break_lines
from pipeline.report.theme import Channel, Chart, build_spec, layer, make_axis, pack_rows, share_rows, stack
from pipeline.results import RunDiagnosis
from pipeline.run.windows import HORIZON_S
from pipeline.stages.slip_stage import find_residual_modulus
from pipeline.store import Manifest
from pipeline.web import WorkbenchError
from pipeline.web.actions import Shown
from pipeline.web.stored_runs import read_summary

STRETCH_S = 30.0
_FEWEST = 5
"""Smallest number of predictions of a ranked stretch."""
_ROOM = 0.15
"""Free margin above and below, as a fraction of a panel's height."""
_SERIES = {
    "x": ("forward velocity", "m/s", 1.0),
    "w": ("yaw rate, left positive", "\u00b0/s", 180.0 / math.pi),
}


def rank_stretches(motion: MotionView) -> list[tuple[float, float]]:
    """Stretches of half a minute [s], in order of decreasing error of the ideal model."""
    errors = motion.horizon_errors
    if errors.is_empty():
        return []
    first = float(errors["t"].min() or 0.0)  # type: ignore[arg-type]
    number = ((pl.col("t") - first) / STRETCH_S).floor().cast(pl.Int64)
    ranked = (
        errors.group_by(number=number)
        .agg(error=(pl.col("ideal") ** 2).mean(), count=pl.len())
        .with_columns(few=pl.col("count") < _FEWEST)
        .sort("few", pl.col("error") * -1.0, "number")
    )
    starts = [first + STRETCH_S * number for number in ranked["number"].to_list()]
    end = float(errors["t"].max() or 0.0) + HORIZON_S  # type: ignore[arg-type]
    # The last stretch starts earlier to have the full length.
    begins = [max(min(start, end - STRETCH_S), first) for start in starts]
    return [(start, min(start + STRETCH_S, end)) for start in begins]


@dataclass(frozen=True)
class StretchScene(Scene):
    """A run and its model, with the enlarged stretch.

    Attributes:
        ideal_cap: end of the colour scale of slip [m/s], the same for every model.
        stretch: enlarged stretch [s]; None if there is nothing to draw.
    """

    ideal_cap: float
    stretch: tuple[float, float] | None

    @cached_property
    def modulus_cap(self) -> float:
        """See `Scene`."""
        return self.ideal_cap

    @cached_property
    def driven(self) -> pl.DataFrame:
        """Positions of the vehicle in the stretch: ``t x y piece``."""
        if self.velocities is None or self.stretch is None:
            return pl.DataFrame(schema={"t": pl.Float64, "x": pl.Float64, "y": pl.Float64, "piece": pl.Int32})
        east, north = self.origin
        inside = self.velocities.filter(pl.col("t").is_between(*self.stretch))
        return inside.select("t", pl.col("x") - east, pl.col("y") - north, "piece").drop_nulls()

    def cut_arcs(self, arcs: pl.DataFrame) -> pl.DataFrame:
        """The predicted paths that start in the stretch."""
        if self.stretch is None or arcs.is_empty():
            return arcs
        east, north = self.origin
        low, high = self.stretch
        begins = pl.col("t").first().over("piece")
        inside = arcs.filter((begins >= low) & (begins < high))
        return inside.with_columns(pl.col("x") - east, pl.col("y") - north)


def _colour_series(source: str) -> Channel:
    """Colours of the measured, ideal and modelled motion, with a legend in one line."""
    colour = figures.series_colour(["velocity", source, "model"], figures.SERIES_WORDS)
    return {**colour, "legend": {**colour["legend"], "columns": 3}}  # type: ignore[dict-item]


def draw_paths(scene: Scene) -> Drawing | None:
    """The measured path, and the predictions over two seconds from points on it; equal scales."""
    if not isinstance(scene, StretchScene) or scene.report.motion is None or scene.driven.height <= 1:
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
    if not isinstance(scene, StretchScene) or scene.report.motion is None or scene.driven.height <= 1:
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


def _format_lead(scene: StretchScene) -> str:
    low, high = scene.stretch or (0.0, 0.0)
    return (
        f"Measured path from {low:.0f} s to {high:.0f} s, and where the model goes in two seconds from "
        "measured poses."
    )


def draw_motion(scene: Scene) -> Drawing | None:
    """Forward velocity and yaw rate over the stretch: measured, ideal, model."""
    if not isinstance(scene, StretchScene) or scene.report.motion is None or scene.stretch is None:
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


def _draw_panel(
    scene: StretchScene, name: str, title: str, known: pl.Series, colour: dict[str, object]
) -> Chart:
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
    if not isinstance(scene, StretchScene) or scene.report.motion is None or scene.stretch is None:
        return {}
    velocity = scene.report.motion.velocity
    return {
        f"stretch_model_{name}": _cut_line(scene, velocity, f"v_{name}", "model", factor)
        for name, (_, _, factor) in _SERIES.items()
    }


def _cut_line(
    scene: StretchScene, frame: pl.DataFrame, column: str, series: str, factor: float
) -> pl.DataFrame:
    inside = frame.filter(pl.col("t").is_between(*(scene.stretch or (0.0, 0.0))))
    line = inside.select("t", "piece", value=pl.col(column) * factor)
    return break_lines(line, "value").with_columns(series=pl.lit(series))


PATHS = Figure("Path: measured and model", Section.GLANCE, draw_paths, order=0, live=list_paths, id="paths")
MOTION = Figure("Velocity and yaw rate", Section.GLANCE, draw_motion, order=1, live=list_motion, id="stretch")


TABS: Mapping[str, tuple[str, ...]] = {
    "first": (PATHS.id, MOTION.id),
    "where": ("trajectory", "command_space", "reach", "velocities"),
    "effects": ("ladder", "step_response", "signature"),
    "residual": ("residuals", "autocorrelation"),
    "budget": ("budget",),
}
"""Figures of every tab, in order."""
BUDGET = "budget"
_COLOURED = {"trajectory": slip_figures.format_map, "command_space": slip_figures.format_cells}
_LEFT = "Colours: residual slip of the model."


class FigureCache:
    """Figures of models of one run, whose tables are read once.

    Args:
        manifest: the run.
    """

    def __init__(self, manifest: Manifest) -> None:
        wanted = ("velocities", "slip", "windows", "aggregates")
        self._tables = {name: manifest.read(name) for name in wanted if name in manifest.tables}
        self._summary = read_summary(manifest)
        self._length = number_in(self._summary, "length_scale_m") or 1.0
        self._caps: dict[str, float] = {}

    def draw(self, shown: Shown, tab: str, stretch: int) -> dict[str, object]:
        """Specifications, rows, titles and texts of the figures of a tab.

        Args:
            shown: the model.
            tab: one of `TABS`; empty for all of them.
            stretch: index of the enlarged stretch, 0 for the one with the largest error.

        Raises:
            WorkbenchError: ``bad_request``, there is no such tab.
        """
        ids = _list_ids(tab)
        scene = self._scene(shown, stretch, with_budget=BUDGET in ids)
        there = {}
        for known in _list_known():
            drawing = known.draw(scene) if known.id in ids else None
            if drawing is not None:
                there[known.id] = (known, drawing)
        ordered = [there[name] for name in ids if name in there]
        return {
            "figures": {known.id: build_spec(drawing) for known, drawing in ordered},
            "rows": share_rows(drawing for _, drawing in ordered),
            "dark": dict(theme.DARK_TWINS),
            "where": shown.where,
            "stretch": _show_stretch(shown, stretch),
            "tabs": TABS,
            "shown": [
                {
                    "id": known.id,
                    "title": known.title,
                    "width": known.width,
                    "words": drawing.words,
                    "note": f"{_LEFT} {drawing.note}" if known.id in _COLOURED else drawing.note,
                }
                for known, drawing in ordered
            ],
        }

    def redraw(self, shown: Shown, stretch: int) -> dict[str, object]:
        """The rows and texts that depend on the model."""
        scene = self._scene(shown, stretch)
        rows: dict[str, pl.DataFrame] = {}
        for known in _list_known():
            rows.update(known.live(scene) if known.live else {})
        if scene.track is not None:
            rows["track"] = scene.track.frame
        words = {name: format_words(scene) for name, format_words in _COLOURED.items()}
        return {"rows": pack_rows(rows), "where": shown.where, "words": words}

    def _scene(self, shown: Shown, stretch: int, *, with_budget: bool = False) -> StretchScene:
        """Data of the figures of the run, with the input of the model."""
        source = shown.view.input
        summary = {**self._summary, "input": source}
        if source not in self._caps:
            self._caps[source] = Scene(RunReport(summary, self._tables)).modulus_cap
        tables = {**self._tables, "slip": self._leave(shown)} if "slip" in self._tables else self._tables
        budget = tuple(shown.apportion(self._length)) if with_budget else ()
        report = RunReport(summary, tables, RunDiagnosis(input=source, budget=budget), motion=shown.view)
        ranked = rank_stretches(shown.view)
        return StretchScene(report, self._caps[source], ranked[stretch % len(ranked)] if ranked else None)

    def _leave(self, shown: Shown) -> pl.DataFrame:
        """The table `slip` with the modulus of the model's residual."""
        slip = self._tables["slip"]
        if not shown.view.effects:
            return slip
        followed = pl.col("input").cast(pl.String) == shown.view.input
        part, rest = slip.filter(followed), slip.filter(~followed)
        remaining = find_residual_modulus(shown.predict(part["t"].to_numpy()), part, length=self._length)
        column = pl.Series("modulus", remaining).fill_nan(None)
        return pl.concat([part.with_columns(column).filter(pl.col("modulus").is_not_null()), rest])


def _list_known() -> tuple[Figure, ...]:
    return (PATHS, MOTION, *list_figures())


def _list_ids(tab: str) -> Collection[str]:
    if tab and tab not in TABS:
        raise WorkbenchError("bad_request", f"there is no tab {tab!r}", hint=f"Tabs are {', '.join(TABS)}.")
    if tab:
        return TABS[tab]
    return tuple(name for names in TABS.values() for name in names)


def _show_stretch(shown: Shown, stretch: int) -> dict[str, object] | None:
    """Index and times of the enlarged stretch, and the number of stretches."""
    ranked = rank_stretches(shown.view)
    if not ranked:
        return None
    index = stretch % len(ranked)
    return {"place": index, "count": len(ranked), "from": ranked[index][0], "to": ranked[index][1]}
