"""Where axes and colour ramps end."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import polars as pl

_LONE_SHARE = 0.01
_WIDEST_RATIO = 2.0
_ROOM = 0.25


@dataclass(frozen=True)
class Range:
    """What an axis shows.

    Attributes:
        low: lower end.
        high: upper end.
        beyond: the value furthest outside and its time [s]; None where nothing is cut.
    """

    low: float
    high: float
    beyond: tuple[float, float] | None = None


def usual_ends(values: pl.Series, *, exact: bool) -> list[float]:
    """Lower and upper end of a line: ``exact``, or without the 1 % of values that lie furthest out."""
    shares = [0.0, 1.0] if exact else [_LONE_SHARE / 2.0, 1.0 - _LONE_SHARE / 2.0]
    return [float(end) for end in np.quantile(values.to_numpy(), shares)]


def find_range(lines: pl.DataFrame, usual: tuple[float, float]) -> Range:
    """The axis of lines over time: all of them, or without lone peaks that would flatten the rest.

    Args:
        lines: rows with ``t`` [s] and ``value``, null where a line breaks.
        usual: where all but lone peaks lie.

    Returns:
        The range with zero inside; peaks are cut where they would make it more than twice as wide.
    """
    lines = lines.drop_nulls("value")
    values = lines["value"].to_numpy()
    whole = Range(min(float(values.min()), 0.0), max(float(values.max()), 0.0))
    low, high = min(usual[0], 0.0), max(usual[1], 0.0)
    room = _ROOM * (high - low)
    if room == 0.0 or whole.high - whole.low <= _WIDEST_RATIO * (high - low):
        return whole
    low, high = max(low - room, whole.low), min(high + room, whole.high)
    furthest = int(np.argmax(np.maximum(values - high, low - values)))
    return Range(low, high, (float(values[furthest]), float(lines["t"][furthest])))


def round_up(value: float) -> float:
    """The next number of two significant digits, for example 1.53 to 1.6."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / unit - 1e-9) * unit:.12g}")
