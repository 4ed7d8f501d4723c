"""Linear regression whose numbers are as large as the data show: both precisions maximize the evidence."""

from __future__ import annotations

import numpy as np

from pipeline.core import Floats

_ROUNDS = 200
"""Maximum number of fixed-point iterations of the evidence; about twenty are usual."""
_CONVERGED = 1e-4
"""Relative change of both precisions below which the evidence has converged."""

_LEAST = 1e-10
"""Square of a direction's size in the inputs, over that of the largest one, below which no row has it."""


def regress(inputs: Floats, target: Floats, independent: float = 1.0) -> Floats:
    """Coefficients of Bayesian linear regression (MacKay, Neural Computation 4, 1992), shape (p,).

    Args:
        inputs: of similar size, shape (n, p).
        target: shape (n,).
        independent: share of the rows that are independent.
    """
    normal, pull = (independent * product for product in (np.asarray(inputs.T @ inputs), inputs.T @ target))
    square, count = independent * float(target @ target), independent * target.size
    sizes, turn = np.linalg.eigh(normal)
    # Directions that no row has differ from zero by rounding.
    sizes = np.where(sizes > _LEAST * sizes.max(initial=0.0), sizes, 0.0)
    turned = np.where(sizes > 0.0, turn.T @ pull, 0.0)
    weight, noise = 1.0, count / max(square, 1e-12)
    mean = np.zeros(sizes.size)
    if not sizes.any():
        return mean
    for _ in range(_ROUNDS):
        mean = noise * turned / (noise * sizes + weight)
        known = float((noise * sizes / (noise * sizes + weight)).sum())
        remaining = max(square - float(2.0 * mean @ turned - (mean**2) @ sizes), 1e-12)
        precisions = min(known / max(float(mean @ mean), 1e-12), 1e12), max(count - known, 1.0) / remaining
        is_done = all(
            abs(new - old) <= _CONVERGED * old for new, old in zip(precisions, (weight, noise), strict=True)
        )
        weight, noise = precisions
        if is_done:
            break
    coefficients: Floats = turn @ mean
    return coefficients
