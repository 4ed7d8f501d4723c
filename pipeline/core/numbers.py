"""Numbers for JSON and tables, which have none that are not finite."""

import math


def finite_or_none(value: float, digits: int | None = None) -> float | None:
    """The number, to so many significant digits where they are given; None where it is not finite."""
    if not math.isfinite(value):
        return None
    return value if digits is None else float(f"{value:.{digits}g}")
