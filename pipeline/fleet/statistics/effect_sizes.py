"""How large a difference is: sizes that do not depend on how many samples there are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.fleet.statistics.arrays import check_values

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

_WORDS = ((0.147, "negligible"), (0.33, "small"), (0.474, "medium"))


def shift_between(a: ArrayLike, b: ArrayLike) -> float:
    """Hodges-Lehmann shift: the median of all differences b - a, in the unit of the values.

    Source: Hodges and Lehmann, Annals of Mathematical Statistics 34 (1963).

    Args:
        a: values of one side, shape (n,).
        b: values of the other side, shape (m,).

    Raises:
        StatisticsError: a side is empty or holds a value that is not finite.
    """
    first, second = check_values(a, what="values"), check_values(b, what="values")
    return float(np.median(second[:, None] - first[None, :]))


def cliffs_delta(a: ArrayLike, b: ArrayLike) -> float:
    """Cliff's delta in [-1, 1]: how much oftener a value of b is above one of a than below it.

    Vargha and Delaney's A12 of b over a is (delta + 1) / 2. Source: Cliff, Psychological Bulletin 114 (1993).

    Args:
        a: values of one side, shape (n,).
        b: values of the other side, shape (m,).

    Raises:
        StatisticsError: a side is empty or holds a value that is not finite.
    """
    first, second = check_values(a, what="values"), check_values(b, what="values")
    ordered = np.sort(first)
    below = np.searchsorted(ordered, second, side="left")
    above = first.size - np.searchsorted(ordered, second, side="right")
    return float((below.sum() - above.sum()) / (first.size * second.size))


def name_delta(delta: float) -> str:
    """Cliff's delta in a word: negligible, small, medium or large.

    The limits 0.147, 0.33 and 0.474 are those of Romano et al. (2006), for normal values the same as Cohen's.
    """
    size = abs(delta)
    return next((word for limit, word in _WORDS if size < limit), "large")
