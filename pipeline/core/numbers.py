"""Numbers for JSON and tables, which have none that are not finite, and quantiles."""

import functools
import math
from typing import Any

NORMAL_95 = 1.959964
"""Half of a normal distribution's 95 % interval, in standard deviations."""


def finite_or_none(value: float, digits: int | None = None) -> float | None:
    """The number, to so many significant digits where they are given; None where it is not finite."""
    if not math.isfinite(value):
        return None
    return value if digits is None else float(f"{value:.{digits}g}")


def pick(item: object, *names: str) -> dict[str, Any]:
    """Some of an object's fields by name."""
    return {name: getattr(item, name) for name in names}


def pick_finite(item: object, *names: str, digits: int | None = None) -> dict[str, float | None]:
    """Some of an object's numbers by name, as `finite_or_none`."""
    return {name: finite_or_none(getattr(item, name), digits) for name in names}


@functools.lru_cache(maxsize=256)
def student_quantile(level: float, freedom: float) -> float:
    """Quantile of Student's t for a two-sided level."""
    from scipy.special import stdtrit  # noqa: PLC0415 - heavy, and only this function of it

    return float(stdtrit(freedom, (1.0 + level) / 2.0))
