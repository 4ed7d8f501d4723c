"""From drawings to Vega-Lite specifications, with one block of rows for all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import polars as pl

from pipeline.report import theme
from pipeline.report.vega import SCHEMA

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from pipeline.report.figures import Drawing

_DIGITS = 4

Columns = dict[str, object]


def build_spec(drawing: Drawing) -> dict[str, object]:
    """The Vega-Lite specification of a drawing in the light colours, without its rows."""
    return {"$schema": SCHEMA, **drawing.chart.to_dict(), "config": theme.chart_config()}


def fill_spec(drawing: Drawing) -> dict[str, object]:
    """The specification with its rows inside, for one picture of its own."""
    rows = {name: _round_floats(frame).to_dicts() for name, frame in drawing.rows.items()}
    spec = {**build_spec(drawing), "datasets": rows, "background": theme.PAPER, "padding": 12}
    spec.pop("usermeta", None)
    return spec


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
