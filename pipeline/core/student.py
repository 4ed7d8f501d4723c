"""Student's t with four degrees of freedom: noise most of which is Gaussian, and some of which is far off."""

import math

import numpy as np

from pipeline.core.arrays import Floats

FREEDOM = 4.0
LOG_PEAK = math.log(0.375)
"""Logarithm of the density at zero in units of the scale."""


def find_scale(rest: Floats) -> float:
    """Scale of some residuals by reweighting."""
    squares = np.square(rest)
    power, weighed = max(1.5 * float(np.median(squares)), 1e-16), np.empty_like(squares)
    for _ in range(12):
        np.divide(squares, power, out=weighed)
        weighed += FREEDOM
        np.divide(squares, weighed, out=weighed)
        power = max((FREEDOM + 1.0) * float(np.add.reduce(weighed) / squares.size), 1e-16)
    return math.sqrt(power)


def list_likelihoods(rest: Floats, scale: float | None = None) -> Floats:
    """Log-likelihood of every residual, less `LOG_PEAK`; by default with the scale that they have."""
    scale = find_scale(rest) if scale is None else scale
    made: Floats = -np.log(scale) - 0.5 * (FREEDOM + 1.0) * np.log1p((rest / scale) ** 2 / FREEDOM)
    return made


def weigh(rest: Floats) -> Floats:
    """Weight of every residual in a regression, shape (n,)."""
    made: Floats = (FREEDOM + 1.0) / (FREEDOM + (rest / find_scale(rest)) ** 2)
    return made
