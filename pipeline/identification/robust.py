"""Robust least squares: weights, losses and steps, which fits, their starts and their scores share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pipeline.identification.problem import Problem

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_HUBER = 3.0
_LEAST_SCALE = 1e-6


@dataclass(frozen=True)
class Weights:
    """How much each residual counts: 1 / scale of its run and channel.

    Attributes:
        scale: typical size of a residual, shape (runs, 3).
    """

    scale: Floats

    def normalise(self, residuals: Floats, problem: Problem) -> Floats:
        """Residuals over their scales, shape (n, 3)."""
        normal: Floats = residuals / self.scale[problem.run_of]
        return normal


def estimate_scales(problem: Problem, residuals: Floats, used: Flags) -> Weights:
    """Spread of the residuals per run and channel: robust, but never far below their rms.

    Where a vehicle mostly drives straight, the median of the yaw residual says nothing about turning.
    """
    scale = np.empty((len(problem.comparisons), 3))
    for run in range(scale.shape[0]):
        rows = residuals[(problem.run_of == run) & used]
        size = np.abs(rows)
        middle = 1.4826 * np.median(size, axis=0)
        clipped = np.minimum(size, 6.0 * np.maximum(middle, 1e-9))
        scale[run] = np.maximum(middle, 0.5 * np.sqrt(np.mean(clipped**2, axis=0)))
    return Weights(np.maximum(scale, _LEAST_SCALE))


def measure_loss(problem: Problem, residuals: Floats, weights: Weights, used: Flags) -> float:
    """Mean Huber loss over the used windows and channels."""
    size = np.abs(weights.normalise(residuals, problem)[used])
    loss = np.where(size <= _HUBER, 0.5 * size**2, _HUBER * (size - 0.5 * _HUBER))
    return float(loss.mean())


def solve_step(normal: Floats, gradient: Floats, values: Floats, bounds: Floats, damping: float) -> Floats:
    """Damped Gauss-Newton step that stays inside bounds.

    Args:
        normal: J' W J, shape (p, p).
        gradient: J' W r, shape (p,).
        values: where the step starts, shape (p,).
        bounds: shape (p, 2).
        damping: Levenberg-Marquardt damping relative to the diagonal.
    """
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    active = np.diag(normal) > 1e-12 * max(float(np.diag(normal).max(initial=0.0)), 1e-300)
    step = np.zeros(values.size)
    for _ in range(values.size + 1):
        rows = np.flatnonzero(active)
        if rows.size == 0:
            break
        scaled = normal[np.ix_(rows, rows)] / np.outer(size[rows], size[rows])
        scaled = scaled + np.eye(rows.size) * (damping + 1e-9)
        step[:] = 0.0
        step[rows] = -np.linalg.solve(scaled, gradient[rows] / size[rows]) / size[rows]
        clipped = np.clip(values + step, bounds[:, 0], bounds[:, 1]) - values
        # A number on its bound that is pushed outward leaves the system; the others are solved again.
        stuck = active & (clipped == 0.0) & (step != 0.0)
        step = clipped
        if not stuck.any():
            break
        active &= ~stuck
    return step


def weigh_system(
    problem: Problem, residuals: Floats, jacobian: Floats, weights: Weights, used: Flags
) -> tuple[Floats, Floats]:
    """Normal matrix and gradient under Huber weights."""
    normal = weights.normalise(residuals, problem)[used]
    size = np.abs(normal)
    robust = np.sqrt(np.where(size <= _HUBER, 1.0, _HUBER / np.maximum(size, _HUBER)))
    columns = jacobian[used] * (robust / weights.scale[problem.run_of[used]])[:, :, None]
    flat = columns.reshape(-1, columns.shape[2])
    return flat.T @ flat, flat.T @ (normal * robust).ravel()
