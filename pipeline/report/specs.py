"""From drawings to Vega-Lite specifications, with one block of rows for all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import polars as pl

from pipeline.report import theme

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from pipeline.report.axes import Picture
    from pipeline.report.figures import Drawing

_DIGITS = 4

Columns = dict[str, object]


def build_spec(drawing: Drawing) -> dict[str, object]:
    """The Vega-Lite specification of a drawing in the light colours, without its rows."""
    spec: dict[str, object] = drawing.chart.to_dict(validate=False)
    spec["config"] = theme.chart_config()
    return spec


def fill_spec(drawing: Drawing) -> dict[str, object]:
    """The specification with its rows inside, for one picture of its own."""
    spec = {**build_spec(drawing), **_fill(drawing)}
    spec.pop("usermeta", None)
    return spec


def fill_chart(drawing: Drawing, title: str) -> Picture:
    """The same as a chart with a title, for notebooks."""
    chart = drawing.chart.copy(deep=False)
    for key, value in {**_fill(drawing), "title": title, "config": theme.chart_config()}.items():
        setattr(chart, key, value)
    return chart


def _fill(drawing: Drawing) -> dict[str, object]:
    rows = {name: _round_floats(frame).to_dicts() for name, frame in drawing.rows.items()}
    return {"datasets": rows, "background": theme.PAPER, "padding": 12}


def share_rows(drawings: Iterable[Drawing]) -> dict[str, Columns]:
    """The rows of all drawings, each name once, as columns; texts as numbers into a list of levels.

    Returns:
        By name, columns: a list of numbers, or ``{"levels": [...], "codes": [...]}`` for texts.
    """
    frames: dict[str, pl.DataFrame] = {}
    for drawing in drawings:
        frames.update(drawing.rows)
    return pack_rows(frames)


def pack_rows(frames: Mapping[str, pl.DataFrame]) -> dict[str, Columns]:
    """Rows by name as columns, as `share_rows` gives them."""
    return {name: _pack_columns(frame) for name, frame in sorted(frames.items())}


def _pack_columns(frame: pl.DataFrame) -> Columns:
    packed: Columns = {}
    for column in _round_floats(frame).iter_columns():
        if column.dtype == pl.String:
            levels = column.unique(maintain_order=True)
            codes = column.replace_strict(levels, list(range(levels.len())), return_dtype=pl.Int64)
            packed[column.name] = {"levels": levels.to_list(), "codes": codes.to_list()}
        else:
            packed[column.name] = column.to_list()
    return packed


def _round_floats(frame: pl.DataFrame) -> pl.DataFrame:
    return frame.with_columns(pl.col(pl.Float64, pl.Float32).round(_DIGITS) + 0.0)
