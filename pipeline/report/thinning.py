"""Fewer points, no lost peaks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import polars as pl

_BIN = "_bin"
_ROW = "_row"


def thin_series(frame: pl.DataFrame, values: Sequence[str], *, bins: int) -> pl.DataFrame:
    """Keep of every time bin the rows where a column is smallest or largest, and the ends of segments.

    Args:
        frame: rows in order of ``t`` [s] with ``segment``.
        values: columns whose extremes must survive.
        bins: number of equal bins over the whole span of ``t``.

    Returns:
        Rows of ``frame`` in their order; all of them when thinning would not shorten it.
    """
    if frame.height <= 2 * bins * len(values):
        return frame
    numbered = _with_bins(frame, bins)
    extremes = [
        pl.col(_ROW).get(getattr(pl.col(name), pick)()).alias(f"{name}_{pick}")
        for name in values
        for pick in ("arg_min", "arg_max")
    ]
    ends = [pl.col(_ROW).first().alias("first"), pl.col(_ROW).last().alias("last")]
    kept = numbered.group_by(_BIN, "segment").agg(extremes)
    edges = numbered.group_by("segment").agg(ends)
    rows = [kept[name] for name in kept.columns if name not in {_BIN, "segment"}]
    rows += [edges["first"], edges["last"]]
    wanted = pl.concat([row.rename(_ROW) for row in rows]).unique().sort()
    return frame[wanted] if wanted.len() < frame.height else frame


def thin_to_peaks(frame: pl.DataFrame, value: str, *, bins: int) -> pl.DataFrame:
    """Keep of every time bin and segment the row where ``value`` is largest.

    Args:
        frame: rows in order of ``t`` [s] with ``segment``.
        value: the column whose peaks must survive.
        bins: number of equal bins over the whole span of ``t``.

    Returns:
        Rows of ``frame`` in their order; all of them when there are no more than ``bins``.
    """
    if frame.height <= bins:
        return frame
    kept = (
        _with_bins(frame, bins)
        .group_by(_BIN, "segment")
        .agg(pl.col(_ROW).get(pl.col(value).arg_max()))[_ROW]
        .sort()
    )
    return frame[kept]


def find_spans(frame: pl.DataFrame, flag: str, *, period: float, shortest_gap: float = 0.0) -> pl.DataFrame:
    """Stretches of consecutive rows where a flag is set.

    Args:
        frame: rows in order of ``t`` [s] with ``segment``.
        flag: boolean column.
        period: time one row stands for [s]; a span ends that long after its last row.
        shortest_gap: spans closer than this [s] are drawn as one.

    Returns:
        Columns ``t_start``, ``t_end`` [s].
    """
    marked = frame.filter(pl.col(flag)).select("t", "segment")
    far = (pl.col("t") - pl.col("t").shift(1)) > max(1.5 * period, shortest_gap)
    other = (pl.col("segment") != pl.col("segment").shift(1)) & (shortest_gap <= period)
    return (
        marked.with_columns(span=(far | other).fill_null(value=True).cum_sum())
        .group_by("span", maintain_order=True)
        .agg(t_start=pl.col("t").min(), t_end=pl.col("t").max() + period)
        .drop("span")
    )


def _with_bins(frame: pl.DataFrame, bins: int) -> pl.DataFrame:
    start, end = float(frame["t"][0]), float(frame["t"][-1])
    width = math.nextafter((end - start) / bins, math.inf) or 1.0
    number = ((pl.col("t") - start) / width).cast(pl.Int64)
    return frame.with_row_index(_ROW).with_columns(number.alias(_BIN))
