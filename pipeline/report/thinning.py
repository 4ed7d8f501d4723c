"""Fewer points, no lost peaks."""

import math

import polars as pl

_BIN = "_bin"
_ROW = "_row"
_KEPT_PER_BIN = 4


def drop_flat_rows(frame: pl.DataFrame, value: str) -> pl.DataFrame:
    """Leave out the rows that repeat both neighbours: the line through the rest is the same.

    Args:
        frame: rows in order of ``t`` [s] with ``piece``, across which no line is drawn.
        value: the column that is drawn.
    """
    column, piece = pl.col(value), pl.col("piece")
    flat = [(column == column.shift(by)) & (piece == piece.shift(by)) for by in (1, -1)]
    return frame.filter(~(flat[0] & flat[1]).fill_null(value=False))


def thin_series(
    frame: pl.DataFrame, value: str, *, bins: int, whole: tuple[float, float] | None = None
) -> pl.DataFrame:
    """Keep what a line needs: of every time bin the first, last, lowest and highest row.

    A line through them looks the same at ``bins`` pixels (Jugel et al., VLDB 2014, "M4").

    Args:
        frame: rows in order of ``t`` [s] with ``piece``, across which no line is drawn.
        value: the column that is drawn.
        bins: number of equal bins over the whole span of ``t``.
        whole: a stretch [s] of which every row is kept.

    Returns:
        Rows of ``frame`` in their order; all of them when there are no more than four a bin.
    """
    if frame.height <= _KEPT_PER_BIN * bins:
        return frame
    row, column = pl.col(_ROW), pl.col(value)
    picks = [row.first(), row.last(), row.get(column.arg_min()), row.get(column.arg_max())]
    kept = _number_bins(frame, bins).group_by(_BIN, "piece").agg(pl.concat_list(picks).explode())[_ROW]
    rows = kept.explode()
    if whole is not None:
        rows = rows.append(frame.with_row_index(_ROW).filter(pl.col("t").is_between(*whole))[_ROW])
    return frame[rows.unique().sort()]


def thin_to_peaks(frame: pl.DataFrame, value: str, *, bins: int) -> pl.DataFrame:
    """Keep of every time bin and piece the row where ``value`` is largest.

    Args:
        frame: rows in order of ``t`` [s] with ``piece``.
        value: the column whose peaks must survive.
        bins: number of equal bins over the whole span of ``t``.

    Returns:
        Rows of ``frame`` in their order; all of them when there are no more than ``bins``.
    """
    if frame.height <= bins:
        return frame
    kept = (
        _number_bins(frame, bins)
        .group_by(_BIN, "piece")
        .agg(pl.col(_ROW).get(pl.col(value).arg_max()))[_ROW]
        .sort()
    )
    return frame[kept]


def break_lines(frame: pl.DataFrame, *columns: str) -> pl.DataFrame:
    """End every piece but the last with a row whose values are null: there a line is broken.

    Args:
        frame: rows in order, with ``piece``.
        columns: the columns that are drawn.

    Returns:
        The rows without ``piece``, which is no longer needed: one broken line is drawn many times faster than
        as many lines as there are pieces.
    """
    ends = frame.filter(pl.col("piece") != pl.col("piece").shift(-1))
    gaps = ends.with_columns(pl.lit(None, frame.schema[name]).alias(name) for name in columns)
    both = pl.concat(
        [frame.with_columns(_gap=pl.lit(value=False)), gaps.with_columns(_gap=pl.lit(value=True))]
    )
    return both.sort("piece", "_gap", maintain_order=True).drop("piece", "_gap")


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
    far = (pl.col("t") - pl.col("t").shift(1)).abs() > max(1.5 * period, shortest_gap)
    other = (pl.col("segment") != pl.col("segment").shift(1)) & (shortest_gap <= period)
    return (
        marked.with_columns(span=(far | other).fill_null(value=True).cum_sum())
        .group_by("span", maintain_order=True)
        .agg(t_start=pl.col("t").min(), t_end=pl.col("t").max() + period)
        .drop("span")
    )


def _number_bins(frame: pl.DataFrame, bins: int) -> pl.DataFrame:
    start, end = frame.select(low=pl.col("t").min(), high=pl.col("t").max()).row(0)
    width = math.nextafter((end - start) / bins, math.inf) or 1.0
    number = ((pl.col("t") - start) / width).cast(pl.Int64)
    return frame.with_row_index(_ROW).with_columns(number.alias(_BIN))
