"""Quartiles for the published figure."""

from __future__ import annotations

import polars as pl

_REACH = 1.5


def spread_windows(windows: pl.LazyFrame, groups: pl.DataFrame) -> pl.DataFrame:
    """Box plot numbers of the 2 s window norms of every group and input.

    Whiskers end at the last window within 1.5 quartile distances of the box (Tukey 1977).

    Args:
        windows: table `windows`; suspect ones are left out.
        groups: ``run`` and ``group``.

    Returns:
        ``group``, ``input``, ``windows``, ``low``, ``q1``, ``median``, ``q3``, ``high`` [m/s].
    """
    norm = pl.col("window_norm")
    first, third = norm.quantile(0.25), norm.quantile(0.75)
    reach = _REACH * (third - first)
    return (
        windows.filter(~pl.col("suspect"), norm.is_finite())
        .join(groups.lazy(), on="run")
        .group_by("group", "input")
        .agg(
            pl.len().alias("windows"),
            norm.filter(norm >= first - reach).min().alias("low"),
            first.alias("q1"),
            norm.median().alias("median"),
            third.alias("q3"),
            norm.filter(norm <= third + reach).max().alias("high"),
        )
        .sort("median", "group")
        .collect()
    )
