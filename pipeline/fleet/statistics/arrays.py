"""What the functions of this room are given: plain arrays, checked once."""

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core.arrays import Floats
from pipeline.core.errors import SlipError


class StatisticsError(SlipError):
    """Numbers that no statistic can be made of."""


def check_values(values: ArrayLike, *, what: str, fewest: int = 1) -> Floats:
    """The values as a flat array of finite numbers.

    Args:
        values: any numbers, shape (n,).
        what: how to call them in an error.
        fewest: how many there must be.

    Raises:
        StatisticsError: ``not_finite`` or ``too_few_values``.
    """
    checked = np.asarray(values, dtype=np.float64).ravel()
    wrong = int(np.count_nonzero(~np.isfinite(checked)))
    if wrong:
        text = f"{wrong} of {checked.size} {what} are not finite numbers"
        raise StatisticsError("not_finite", text, hint="Leave them out before, and say so")
    if checked.size < fewest:
        text = f"there are {checked.size} {what}, and {fewest} are needed"
        hint = "Add runs, or compare what there is run against run"
        raise StatisticsError("too_few_values", text, hint=hint)
    return checked
