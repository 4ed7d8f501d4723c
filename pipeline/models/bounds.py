"""What a number can be: whether it stopped there, and intervals within it."""

import math

_MARGIN = 1e-6
"""Of the size of the bounds: fits stop that close to them."""


def stands_at_bound(value: float, bounds: tuple[float, float]) -> bool:
    """Whether a number stopped because it may go no further."""
    low, high = bounds
    margin = _MARGIN * (abs(low) + abs(high)) if math.isfinite(low + high) else 0.0
    return not low + margin < value < high - margin


def cut_interval(low: float, high: float, bounds: tuple[float, float]) -> tuple[float, float]:
    """An interval within what the number can be; NaN stays NaN."""
    least, most = bounds
    return max(low, least), min(high, most)
