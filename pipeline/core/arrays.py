"""Names of the usual kinds of arrays, and complex ones made of real ones in few passes over memory."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Complex = NDArray[np.complex128]

_POINTS = 4096
_CIRCLE: Complex = np.exp(2j * np.pi * np.arange(_POINTS) / _POINTS)


def join_parts(real: Floats, imaginary: Floats | float) -> Complex:
    """Complex numbers of their parts, shape (n,)."""
    joined = np.empty(real.shape, dtype=np.complex128)
    joined.real, joined.imag = real, imaginary
    return joined


def group_rows(number: NDArray[Any]) -> list[Ints]:
    """Rows that have the same number, group by group in order of the numbers, each in order."""
    order = np.argsort(number, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(number[order])) + 1)


def turn_units(angle: Floats) -> Complex:
    """exp(i angle) to rounding, of angles [rad] of shape (n,): points of a circle, turned on by a series.

    Of the 8e-4 rad that are left at most, powers from the fifth on are below rounding.
    """
    nearest = np.rint(angle * (_POINTS / (2.0 * np.pi)))
    rest = angle - nearest * (2.0 * np.pi / _POINTS)
    square = rest * rest
    turned = join_parts(1.0 - square * (0.5 - square / 24.0), rest * (1.0 - square / 6.0))
    turned *= _CIRCLE.take(nearest.astype(np.int64) & (_POINTS - 1))
    return turned
