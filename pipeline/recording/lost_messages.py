"""Messages that are missing in a topic of even intervals, as those that a recorder lost."""

import numpy as np
import polars as pl

from pipeline.core import Floats, Ints
from pipeline.core.arrays import PERIODS

_EVEN = 0.25
"""Largest distance of an interval from a multiple of the period [periods] that is one: half of all lie there
by chance."""
_MOST_UNEVEN = 0.1
"""Share of uneven intervals from which on messages have no clock."""


def number_gaps(times: Floats) -> tuple[Ints, float]:
    """Number of periods between messages and the period [s]; zeros where the messages have no clock.

    Args:
        times: of the messages [s], increasing, shape (n,).

    Returns:
        Numbers, shape (n - 1,): zero of a pause, which is longer than `PERIODS`.
    """
    gaps = np.diff(times)
    number, period = np.zeros(gaps.size, dtype=np.int64), 0.0
    if not gaps.size or (period := float(np.median(gaps))) <= 0.0:
        return number, 0.0
    usual = gaps[np.abs(gaps / period - 1.0) < _EVEN]
    if not usual.size:
        return number, 0.0
    period = float(usual.mean())
    counted = np.rint(gaps / period)
    is_short = counted <= PERIODS
    is_uneven = (np.abs(gaps / period - counted) > _EVEN) | (counted < 1.0)
    if not is_short.any() or is_uneven[is_short].mean() > _MOST_UNEVEN:
        return number, 0.0
    return np.where(is_short & ~is_uneven, counted, 0.0).astype(np.int64), period


def fill_gaps(frame: pl.DataFrame) -> pl.DataFrame:
    """A drive with the messages that are missing, between those around them.

    Where a command changed within a gap is unknown: on average it lies on the line between both.
    """
    number, _ = number_gaps(frame["t"].to_numpy())
    missing = np.maximum(number - 1, 0)
    if not missing.any():
        return frame
    before = np.repeat(np.arange(frame.height), np.append(missing, 0) + 1)
    # The first row of each is the message itself.
    index = np.arange(before.size) - np.searchsorted(before, before)
    share = index / np.append(np.maximum(number, 1), 1)[before]
    first, then = frame[before], frame[np.minimum(before + 1, frame.height - 1)]
    made = {}
    for name, kind in frame.schema.items():
        start, end = first[name], then[name]
        if kind == pl.Boolean:
            made[name] = start
        elif kind.is_float():
            made[name] = start + (end - start) * share
        else:
            step = np.rint((end - start).to_numpy() * share).astype(np.int64)
            made[name] = (start + pl.Series(step)).cast(kind)
    # A message without a successor is as it is.
    is_own = pl.Series(index == 0)
    return pl.DataFrame(made).with_columns(
        pl.when(is_own).then(first[name]).otherwise(pl.col(name)).alias(name) for name in frame.columns
    )
