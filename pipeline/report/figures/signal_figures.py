"""Two signals of the reader's choice over time: any number of the tables of a run, packed for the page."""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from pipeline.core import INPUT_WORDS, suffix_unit
from pipeline.report import figures, set_squares, theme
from pipeline.report.figures import Figure
from pipeline.report.theme import Chart, Drawing, layer, make_axis, stack
from schemas import contract_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.report.scene import Scene

_MOST_POINTS = 120_000
"""Points of all signals together on a page, three bytes each."""
_MOST_ROWS = 3000
"""Points of one signal on a page."""
_LEVELS = 2**15 - 1
_HOLE = 2.5
"""Time between two points from which on a line breaks, in usual times between points."""
_TABLES = ("velocities", "slip", "commands", "wheels", "imu", "poses")
_FIRST = ("v_x", "modulus")
"""Signals that are drawn at first."""


def list_signals(scene: Scene) -> dict[str, pl.DataFrame]:
    """Tables over time by label: ``t`` [s] and all numbers with a unit that vary, thinned for a page."""
    tables = {
        label: frame.select("t", *_pick_columns(name, frame))
        for name in _TABLES
        for label, frame in _split(scene, name)
    }
    count = sum(frame.width - 1 for frame in tables.values())
    most = min(_MOST_ROWS, _MOST_POINTS // max(count, 1))
    return {label: thin_to_ends(frame, most) for label, frame in tables.items() if frame.width > 1}


def _split(scene: Scene, table: str) -> Iterator[tuple[str, pl.DataFrame]]:
    """A table in order of time, with its label; that of slip apart by inputs."""
    frame = scene.report.table(table)
    if frame is None or "t" not in frame.columns:
        return
    for name in scene.report.inputs if table == "slip" else ("",):
        rows = frame.filter(pl.col("input").cast(pl.String) == name) if name else frame
        if rows.height > 1:
            yield f"{table} {INPUT_WORDS.get(name, '')}".strip(), rows.sort("t", maintain_order=True)


def _pick_columns(table: str, frame: pl.DataFrame) -> list[str]:
    return [
        column.name
        for column in frame.iter_columns()
        if column.dtype == pl.Float64
        and not f"_{column.name}".endswith("_t")
        and column.min() != column.max()
        and suffix_unit(contract_of(table).metadata_of(column.name).get("unit"))
    ]


def thin_to_ends(frame: pl.DataFrame, most: int) -> pl.DataFrame:
    """Of groups of consecutive rows the lowest and the highest value of each column, in their order.

    Args:
        frame: ``t`` [s], ascending, and columns of numbers.
        most: number of rows up to which all remain.
    """
    if frame.height <= most:
        return frame
    size, t = -(-2 * frame.height // most), pl.col("t")
    pairs = [pl.concat_list(t.first(), t.get(t.len() // 2))]
    for name in frame.columns[1:]:
        column = pl.col(name)
        is_rising = column.arg_min() <= column.arg_max()
        ends = (column.min(), column.max())
        pairs.append(
            pl.concat_list(
                pl.when(is_rising).then(one).otherwise(other).alias(name) for one, other in (ends, ends[::-1])
            )
        )
    group = (pl.int_range(pl.len()) // size).alias("group")
    return frame.group_by(group, maintain_order=True).agg(pairs).drop("group").explode(frame.columns)


def _find_hole(frame: pl.DataFrame) -> float:
    """Time between two points from which on a line breaks [s]."""
    return _HOLE * float(np.median(np.diff(frame["t"].to_numpy())))


def pack_signals(frame: pl.DataFrame) -> dict[str, object]:
    """For the page: times in milliseconds and values as whole numbers, as bytes in base64.

    A value is ``low`` plus its number times ``step``; -1 stands for none.
    """
    packed = {}
    for column in frame.drop("t").iter_columns():
        values = column.to_numpy()
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        step = (high - low) / _LEVELS
        numbers = np.where(np.isfinite(values), np.round((values - low) / step), -1.0)
        packed[column.name] = {"low": low, "step": step, "values": _encode(numbers.astype("<i2"))}
    times = _encode(np.round(1e3 * frame["t"].to_numpy()).astype("<i4"))
    return {"t": times, "hole": _find_hole(frame), "columns": packed}


def _encode(numbers: NDArray[np.integer]) -> str:
    return base64.b64encode(numbers.tobytes()).decode()


def view_signals(scene: Scene) -> dict[str, object]:
    """What can be chosen, which signals are drawn first, and all of them packed."""
    signals = list_signals(scene)
    return {
        "tables": {label: _describe_columns(label, frame.columns[1:]) for label, frame in signals.items()},
        "first": _choose_first(signals),
        "packed": {label: pack_signals(frame) for label, frame in signals.items()},
    }


def _describe_columns(label: str, names: Sequence[str]) -> list[tuple[str, str]]:
    """Names of columns, and what they are with their units."""
    about = {name: contract_of(label.split(maxsplit=1)[0]).metadata_of(name) for name in names}
    return [
        (name, f"{name} [{set_squares(one['unit'])}]: {one['description'].replace('`', '')}")
        for name, one in about.items()
    ]


def _choose_first(signals: Mapping[str, pl.DataFrame]) -> list[tuple[str, str]]:
    """Table and name of the signals that are drawn first."""
    there = [(label, name) for label, frame in signals.items() for name in frame.columns[1:]]
    return [next((key for key in there if key[1] == name), there[0]) for name in _FIRST] if there else []


def break_holes(line: pl.DataFrame) -> pl.DataFrame:
    """A line ``t value`` with a null where rows are far apart in time."""
    far = line.filter(pl.col("t").diff() > _find_hole(line)).with_columns(value=pl.lit(None, pl.Float64))
    return pl.concat([far, line]).sort("t", maintain_order=True)


def draw_signals(scene: Scene) -> Drawing | None:
    """Two panels of one signal each; the page puts in others."""
    signals = list_signals(scene)
    chosen = _choose_first(signals)
    if not chosen:
        return None
    rows, panels, words = {}, [], []
    for number, (label, name) in enumerate(chosen):
        rows[f"signal_{number}"] = break_holes(signals[label].select("t", value=name))
        words.append(f"{name} of {label}")
        y = make_axis("value", None, scale={"zero": False}, tickCount=4, minExtent=figures.GUTTER - 10)
        x = figures.time_axis(scene, has_title=number == len(chosen) - 1)
        line = (
            Chart.of_rows(f"signal_{number}")
            .mark("line", color=theme.MEASURED, clip=True, order=False)
            .encode(x=x, y=y)
        )
        marked = figures.shade_spans(figures.MARKED_SPANS)
        panels.append(layer(*marked, line).properties(width=figures.WIDTH, height=150))
    rows[figures.MARKED_SPANS] = figures.EMPTY_SPANS
    chart = stack(*panels).properties(usermeta=figures.brush_over_time())
    note = (
        "Drag over a panel to mark a stretch and zoom into it. Values are those of the tables, at ends too."
    )
    return Drawing(chart, rows, note, f"Over time: {' and '.join(words)}.")


SIGNALS = Figure("signals", "Signals over time", draw_signals, width="full")
