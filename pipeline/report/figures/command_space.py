"""Slip over what was asked: forward speed against yaw rate of the ideal velocity."""

import polars as pl

from pipeline.report import theme
from pipeline.report.axes import make_axis
from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.run import INPUT_WORDS
from pipeline.report.scales import round_up
from pipeline.report.scene import Scene
from pipeline.report.vega import Chart, encode_column, layer

_CELLS = 20
_FEWEST_SAMPLES = 3
_SMALLEST_BOUND = 0.1


def draw(scene: Scene) -> Drawing | None:
    """A heat map: colour is the median modulus of the samples in a cell; empty cells stay empty."""
    slip = scene.sound_slip.get(scene.report.main_input)
    if slip is None:
        return None
    bounds = {name: _bound(slip, name) for name in ("f_x", "f_w")}
    words = INPUT_WORDS[scene.report.main_input]
    turn, speed = f"ideal yaw rate f_w {words} [rad/s]", f"ideal speed f_x {words} [m/s]"
    x = make_axis("f_w", turn, bounds["f_w"], tickCount=6)
    y = make_axis("f_x", speed, bounds["f_x"], tickCount=6, minExtent=26)
    tooltip = [
        encode_column("modulus:Q", title="median slip [m/s]", format=".2f"),
        encode_column("samples:Q", title="samples", format=","),
    ]
    base = Chart.of_rows("command_cells")
    heat = base.mark("rect").encode(
        x="w_low:Q",
        x2="w_high:Q",
        y="x_low:Q",
        y2="x_high:Q",
        color=parts.slip_colour(scene),
        tooltip=tooltip,
    )
    marked = (
        Chart.of_rows(parts.MARKED_POINTS)
        .mark("circle", size=26, opacity=0.9, color=theme.MARK, stroke=theme.INK, strokeWidth=0.5)
        .encode(x=x, y=y)
    )
    meta = parts.brush_over_plane("f_w", "f_x")
    chart = layer(heat, marked).properties(width=480, height=340, usermeta=meta)
    note = f"Cells with fewer than {_FEWEST_SAMPLES} samples are left empty."
    return Drawing(chart, list_cells(scene) | parts.marked_rows(), note, describe(scene))


def list_cells(scene: Scene) -> dict[str, pl.DataFrame]:
    """Cells of the plane of commands: edges, median modulus, samples; empty without slip."""
    slip = scene.sound_slip.get(scene.report.main_input)
    return {} if slip is None else {"command_cells": _count_cells(slip)}


def _bound(slip: pl.DataFrame, name: str) -> list[float]:
    low, high = (float(slip[name].min() or 0.0), float(slip[name].max() or 0.0))  # type: ignore[arg-type]
    return [
        -round_up(-low) if low < -_SMALLEST_BOUND else -_SMALLEST_BOUND,
        round_up(high) if high > _SMALLEST_BOUND else _SMALLEST_BOUND,
    ]


def _count_cells(slip: pl.DataFrame) -> pl.DataFrame:
    """Cells of equal size over the plane of commands: edges, median modulus, samples."""
    columns = []
    for name, short in (("f_x", "x"), ("f_w", "w")):
        low, high = _bound(slip, name)
        size = (high - low) / _CELLS
        number = ((pl.col(name) - low) / size).floor().clip(0, _CELLS - 1)
        columns += [
            (low + number * size).alias(f"{short}_low"),
            (low + (number + 1) * size).alias(f"{short}_high"),
        ]
    edges = ["x_low", "x_high", "w_low", "w_high"]
    return (
        slip.select(*columns, "modulus")
        .group_by(edges)
        .agg(modulus=pl.col("modulus").median(), samples=pl.len())
        .filter(pl.col("samples") >= _FEWEST_SAMPLES)
        .sort(edges)
    )


def describe(scene: Scene) -> str:
    """Which commands slip most and least."""
    cells = list_cells(scene).get("command_cells")
    told = "Median slip modulus over ideal speed and ideal yaw rate."
    if cells is None or cells.is_empty():
        return told
    row = cells.row(cells["modulus"].arg_max() or 0, named=True)
    return (
        f"{told} It is highest, {row['modulus']:.2f} m/s, near {(row['x_low'] + row['x_high']) / 2:.2f} m/s "
        f"and {(row['w_low'] + row['w_high']) / 2:.2f} rad/s."
    )


FIGURE = Figure("Over the commands", Section.WHERE, draw, order=20, live=list_cells)
