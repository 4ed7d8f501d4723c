"""Derivative columns of many residuals, one after the other in memory: so they are made, picked and summed.

All arrays are of shape (n, 3, p): n windows, three channels, p numbers.
"""

from collections.abc import Sequence

import numpy as np

from pipeline.core.arrays import Flags, Floats


def make_columns(windows: int, numbers: int) -> Floats:
    """Zeros, shape (n, 3, p)."""
    return np.zeros((numbers, windows, 3)).transpose(1, 2, 0)


def stack_columns(columns: Sequence[Floats]) -> Floats:
    """Columns of shape (n, 3) side by side, shape (n, 3, p)."""
    return np.array(columns).transpose(1, 2, 0)


def pick_columns(columns: Floats, places: Sequence[int]) -> Floats:
    """The columns at these places; the same array where it is all of them."""
    if list(places) == list(range(columns.shape[2])):
        return columns
    return columns.transpose(2, 0, 1)[list(places)].transpose(1, 2, 0)


def pick_windows(columns: Floats, windows: Flags) -> Floats:
    """The rows of some windows, flags of shape (n,)."""
    return columns.transpose(2, 0, 1)[:, windows].transpose(1, 2, 0)


def flatten(columns: Floats) -> Floats:
    """Columns as those of a matrix, shape (3 n, p)."""
    return columns.reshape(columns.shape[0] * columns.shape[1], columns.shape[2])


def weigh_columns(columns: Floats, factor: Floats) -> Floats:
    """Columns times factors of shape (n, 3), as those of a matrix, shape (3 n, p)."""
    return flatten(columns * factor[:, :, None])


def combine_columns(columns: Floats, step: Floats) -> Floats:
    """Sum of the columns, each times its part of a step of shape (p,), shape (n, 3)."""
    return (flatten(columns) @ step).reshape(columns.shape[:2])
