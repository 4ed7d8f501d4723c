"""Levels of statistics that several rooms share, and numbers as they stand in JSON."""

import math
from typing import Any

NORMAL_95 = 1.959964
"""Half of a normal distribution's 95 % interval, in standard deviations."""


CONFIDENCE = 0.95
"""Coverage probability of intervals: the convention of the published comparisons."""


FEWEST_OF_SPREAD = 3
"""Fewest values, runs or stretches for a spread: the difference of two does not determine one."""


FOLDS = 5
"""Number of folds of a cross-validation: each is fitted to four fifths of the run."""


JSON_DIGITS = 6
"""Significant digits of estimates in JSON, more than any estimate has."""


def round_digits(value: float, digits: int = JSON_DIGITS) -> float:
    """A number of that many significant digits."""
    return float(f"{value:.{digits}g}")


def finite_or_none(value: float, digits: int | None = None) -> float | None:
    """A number, rounded to ``digits`` significant digits if given; None if it is not finite."""
    if not math.isfinite(value):
        return None
    return value if digits is None else round_digits(value, digits)


def pick(item: object, *names: str) -> dict[str, Any]:
    """Selected fields of an object by name."""
    return {name: getattr(item, name) for name in names}


def pick_finite(item: object, *names: str, digits: int | None = None) -> dict[str, float | None]:
    """Selected numbers of an object by name, as `finite_or_none`."""
    return {name: finite_or_none(getattr(item, name), digits) for name in names}
