"""Robust linear regression, by iteratively reweighted least squares with Cauchy weights."""

import numpy as np

from pipeline.core.arrays import Floats

_ROUNDS = 10
_WIDTH = 2.0
_LEAST = 1e-9


def fit_robustly(design: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Fit values on columns, so that a minority of outliers counts little.

    Args:
        design: columns, shape (n, p).
        values: what they should add up to, shape (n,).

    Returns:
        The coefficients, shape (p,), and the residuals, shape (n,).

    Source: Holland and Welsch, Robust regression using iteratively reweighted least-squares, 1977.
    """
    weight = np.ones(values.size)
    found: Floats = np.zeros(design.shape[1])
    rest: Floats = values
    for _ in range(_ROUNDS):
        found = np.asarray(np.linalg.lstsq(design * weight[:, None], values * weight, rcond=None)[0])
        rest = values - design @ found
        size = np.abs(rest)
        weight = 1.0 / np.sqrt(1.0 + (size / (_WIDTH * max(float(np.median(size)), _LEAST))) ** 2)
    return found, rest
