"""Figures of the electric power of the drive: current over time, energy over the way."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.report.figures import figure
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.scene import LINE_BINS, Scene, thin_series
from pipeline.report.templating import format_number
from pipeline.report.theme import find_range, usual_ends
from pipeline.report.vega import Chart, stack

_PANELS = {"current": ("current of the drive", "A"), "energy_per_m": ("energy over the way", "J/m")}


def draw_power(scene: Scene) -> Drawing | None:
    """Current of the drive, and below it energy a metre where a voltage was recorded."""
    table = scene.report.table("power")
    if table is None or table.is_empty():
        return None
    lines = {name: _thin(table, name) for name in _PANELS if not table[name].drop_nulls().is_empty()}
    if not lines:
        return None
    last = list(lines)[-1]
    chart = stack(*(_draw_panel(scene, name, frame, last=name == last) for name, frame in lines.items()))
    words = [f"{_PANELS[name][0]}: {_format_median(table[name])} {_PANELS[name][1]}" for name in lines]
    rows = {f"power_{name}": frame for name, frame in lines.items()} | figure.span_rows(scene)
    note = "Energy over the way is shown above 0.1 m/s; below zero the motors feed the battery."
    return Drawing(
        chart.properties(usermeta=figure.brush_over_time()), rows, note, f"Over time: {'; '.join(words)}."
    )


def _format_median(column: pl.Series) -> str:
    return f"median {format_number(float(np.median(column.drop_nulls().to_numpy())))}"


def _thin(table: pl.DataFrame, name: str) -> pl.DataFrame:
    line = table.select("t", pl.lit(0).alias("piece"), value=pl.col(name)).drop_nulls()
    return thin_series(line, "value", bins=LINE_BINS).select("t", "piece", "value", series=pl.lit("velocity"))


def _draw_panel(scene: Scene, name: str, frame: pl.DataFrame, *, last: bool) -> Chart:
    low, high = usual_ends(frame["value"], exact=True)
    shown = find_range(frame, (low, high))
    colour = figure.series_colour(["velocity"], {"velocity": "measured"})
    x = figure.time_axis(scene) if last else figure.time_axis(scene, title=None)
    chart = figure.draw_lines(scene, [f"power_{name}"], shown, colour, x)
    return chart.properties(height=100, title=figure.title_panel(*_PANELS[name], shown))


POWER = Figure("Power of the drive", Section.WHERE, draw_power, order=60, width="full", id="power")
