"""Two signals of the reader's choice over time: any number of the tables of a run, packed for the page."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from pipeline.core import INPUT_WORDS, Floats, suffix_unit
from pipeline.report import figures, set_squares, theme
from pipeline.report.figures import Figure
from pipeline.report.theme import Chart, Drawing, layer, make_axis, stack
from schemas import contract_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

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


@dataclass(frozen=True)
class Signals:
    """Signals of one table, thinned.

    Attributes:
        label: name of the table.
        t: times [s], shape (n,).
        columns: values by name, missing ones as NaN, shape (n,) each.
        words: what each is, with its unit.
    """

    label: str
    t: Floats
    columns: Mapping[str, Floats]
    words: Mapping[str, str]

    @property
    def hole_s(self) -> float:
        """Time between two points from which on a line breaks [s]."""
        return _HOLE * float(np.median(np.diff(self.t)))

    def pack(self) -> dict[str, object]:
        """For the page: times in milliseconds and values as whole numbers, as bytes in base64.

        A value is ``low`` plus its number times ``step``; -1 stands for none.
        """
        packed = {}
        for name, values in self.columns.items():
            low, high = float(np.nanmin(values)), float(np.nanmax(values))
            step = (high - low) / _LEVELS
            numbers = np.where(np.isfinite(values), np.round((values - low) / step), -1.0)
            packed[name] = {"low": low, "step": step, "values": _encode(numbers.astype("<i2"))}
        times = _encode(np.round(1e3 * self.t).astype("<i4"))
        return {"t": times, "hole": self.hole_s, "columns": packed}

    def list_rows(self, name: str) -> pl.DataFrame:
        """A signal as a line: ``t value``, null where it breaks."""
        line = pl.DataFrame({"t": self.t, "value": self.columns[name]}).fill_nan(None)
        after = line.filter(pl.col("t").diff() > self.hole_s).select(
            pl.col("t"), value=pl.lit(None, pl.Float64)
        )
        return pl.concat([after, line]).sort("t", maintain_order=True)


def _encode(numbers: NDArray[np.integer]) -> str:
    return base64.b64encode(numbers.tobytes()).decode()


def list_signals(scene: Scene) -> list[Signals]:
    """All numbers with a unit in the tables over time that vary, thinned so that a page stays small."""
    tables = {label: (name, frame) for name in _TABLES for label, frame in _split(scene, name)}
    varying = {label: list(_pick_columns(name, frame)) for label, (name, frame) in tables.items()}
    most = min(_MOST_ROWS, _MOST_POINTS // max(sum(map(len, varying.values())), 1))
    made = []
    for label, (name, frame) in tables.items():
        t = frame["t"].to_numpy()
        size = 1 if t.size <= most else -(-2 * t.size // most)
        about = {column: contract_of(name).metadata_of(column) for column in varying[label]}
        made.append(
            Signals(
                label,
                _thin_times(t, size),
                {column: thin_to_ends(frame[column].to_numpy(), size) for column in about},
                {
                    column: f"{column} [{set_squares(one['unit'])}]: {one['description'].replace('`', '')}"
                    for column, one in about.items()
                },
            )
        )
    return [one for one in made if one.columns]


def _split(scene: Scene, table: str) -> Iterator[tuple[str, pl.DataFrame]]:
    """A table in order of time, with its label; that of slip apart by inputs."""
    frame = scene.report.table(table)
    if frame is None or not {"t", "run"} <= set(frame.columns):
        return
    for name in scene.report.inputs if table == "slip" else ("",):
        rows = frame.filter(pl.col("input").cast(pl.String) == name) if name else frame
        if rows.height > 1:
            yield f"{table} {INPUT_WORDS.get(name, '')}".strip(), rows.sort("t", maintain_order=True)


def _pick_columns(table: str, frame: pl.DataFrame) -> Iterator[str]:
    """Numbers with a unit that vary, other than times."""
    for column in frame.iter_columns():
        name = column.name
        is_time = name == "t" or name.endswith("_t")
        if column.dtype == pl.Float64 and not is_time and column.min() != column.max():
            yield from [name] * bool(suffix_unit(contract_of(table).metadata_of(name).get("unit")))


def thin_to_ends(values: Floats, size: int) -> Floats:
    """The lowest and the highest value of every group of so many rows, in their order; all if it is one."""
    if size == 1:
        return values
    grid = np.full((-(-values.size // size), size), np.nan)
    grid.ravel()[: values.size] = values
    low = np.where(np.isnan(grid), np.inf, grid).argmin(axis=1)
    high = np.where(np.isnan(grid), -np.inf, grid).argmax(axis=1)
    at = np.sort(np.stack((low, high), axis=-1), axis=-1)
    return np.take_along_axis(grid, at, axis=1).ravel()


def _thin_times(t: Floats, size: int) -> Floats:
    if size == 1:
        return t
    starts = np.arange(0, t.size, size)
    return np.stack((t[starts], t[np.minimum(starts + size // 2, t.size - 1)]), axis=-1).ravel()


def view_signals(scene: Scene) -> dict[str, object]:
    """What can be chosen, which signals are drawn first, and all of them packed."""
    signals = list_signals(scene)
    return {
        "tables": {one.label: list(one.words.items()) for one in signals},
        "first": _choose_first(signals),
        "packed": {one.label: one.pack() for one in signals},
    }


def _choose_first(signals: list[Signals]) -> list[tuple[str, str]]:
    """Table and name of the signals that are drawn first."""
    there = [(one.label, name) for one in signals for name in one.columns]
    return [next((key for key in there if key[1] == name), there[0]) for name in _FIRST] if there else []


def draw_signals(scene: Scene) -> Drawing | None:
    """Two panels of one signal each; the page puts in others."""
    signals = {one.label: one for one in list_signals(scene)}
    chosen = _choose_first(list(signals.values()))
    if not chosen:
        return None
    rows, panels, words = {}, [], []
    for number, (label, name) in enumerate(chosen):
        rows[f"signal_{number}"] = signals[label].list_rows(name)
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
