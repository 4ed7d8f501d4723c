"""Student's t with four degrees of freedom: noise most of which is Gaussian, and some of which is far off."""

import math

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.core.machine_code import compiled

FREEDOM = 4.0
LOG_PEAK = math.log(0.375)
"""Logarithm of the density at zero in units of the scale."""


@compiled("float64(float64[::1], float64)")
def _reweigh_scale(rest: Floats, power: float) -> float:
    for _ in range(12):
        total = 0.0
        for k in range(rest.size):
            square = rest[k] * rest[k]
            total += 5.0 * square / (4.0 + square / power)
        power = max(total / rest.size, 1e-16)
    return power


def find_scale(rest: Floats) -> float:
    """Scale of some residuals by reweighting."""
    rest = np.ascontiguousarray(rest)
    return float(np.sqrt(_reweigh_scale(rest, max(1.5 * float(np.median(rest * rest)), 1e-16))))


def list_likelihoods(rest: Floats, scale: float | None = None) -> Floats:
    """Log-likelihood of every residual, less `LOG_PEAK`; by default with the scale that they have."""
    scale = find_scale(rest) if scale is None else scale
    made: Floats = -np.log(scale) - 0.5 * (FREEDOM + 1.0) * np.log1p((rest / scale) ** 2 / FREEDOM)
    return made


def weigh(rest: Floats) -> Floats:
    """Weight of every residual in a regression, shape (n,)."""
    made: Floats = (FREEDOM + 1.0) / (FREEDOM + (rest / find_scale(rest)) ** 2)
    return made
