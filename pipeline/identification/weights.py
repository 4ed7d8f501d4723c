"""What a residual costs: each channel by its own spread, outliers no more than linearly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.core.compiled import compiled

if TYPE_CHECKING:
    from pipeline.identification.parts import Part


_GAUSSIAN = 1.4826
_CLIP = 6.0
_SHARE_OF_RMS = 0.5
_RIDGE = 1e-6


@dataclass(frozen=True)
class Weights:
    """Weights of residuals.

    Attributes:
        scale: spread of each residual, shape (n, 3); infinite in channels that say nothing.
        clip: where a residual stops to count quadratically, in units of `scale`, shape (n, 3).
    """

    scale: Floats
    clip: Floats

    def weigh(self, residual: Floats) -> Floats:
        """Residuals in units of their spread, square-rooted Huber weights included, shape (n, 3)."""
        scaled = residual / self.scale
        size = np.abs(scaled)
        return scaled * np.sqrt(self.clip / np.maximum(size, self.clip))

    def factors(self, residual: Floats) -> Floats:
        """Factors that turn rows of a Jacobian into those of `weigh`, shape (n, 3)."""
        size = np.abs(residual / self.scale)
        return np.sqrt(self.clip / np.maximum(size, self.clip)) / self.scale

    def cost(self, residual: Floats) -> Floats:
        """Huber cost of every window, shape (n,)."""
        return _sum_costs(*map(np.ascontiguousarray, (residual, self.scale, self.clip)))

    def loss(self, residual: Floats) -> float:
        """Mean cost of a window."""
        return float(self.cost(residual).mean())


@compiled("float64[::1](float64[:, ::1], float64[:, ::1], float64[:, ::1])")
def _sum_costs(residual: Floats, scale: Floats, clip: Floats) -> Floats:
    """See `Weights.cost`."""
    costs = np.zeros(residual.shape[0])
    for row in range(residual.shape[0]):
        for channel in range(residual.shape[1]):
            size = abs(residual[row, channel] / scale[row, channel])
            held = min(size, clip[row, channel])
            costs[row] += held * (2.0 * size - held)
    return costs


def measure_spread(residual: Floats, part: Part) -> Floats:
    """Robust spread of each run and channel while it drives, laid out like the residuals, shape (n, 3).

    It is never far below the clipped rms: where a vehicle mostly drives straight, the median of the yaw
    residual says nothing about turning.
    """
    spread = np.full(residual.shape, np.inf)
    for number in np.unique(part.run).tolist():
        rows = part.run == number
        live = rows & part.live
        for channel in part.channels:
            size = np.abs(residual[live if live.any() else rows, channel])
            middle = max(_GAUSSIAN * float(np.median(size)), float(part.least[channel]))
            clipped = float(np.sqrt(np.mean(np.minimum(size, _CLIP * middle) ** 2)))
            spread[rows, channel] = max(middle, _SHARE_OF_RMS * clipped)
    return spread


def make_weights(residual: Floats, part: Part) -> Weights:
    """Weights at a model: spreads at most those that a saturated fit leaves, clipped at six of its own.

    Args:
        residual: of the model, shape (n, 3).
        part: whose residuals they are.
    """
    own = measure_spread(residual, part)
    scale = np.minimum(own, part.noise)
    with np.errstate(invalid="ignore"):
        clip = np.where(np.isfinite(scale), _CLIP * own / scale, 1.0)
    return Weights(scale, clip)


def measure_noise(part: Part, residual: Floats) -> Floats:
    """Spread that remains when nearly anything linear in the input's past may act, shape (n, 3).

    Args:
        part: what is explained.
        residual: of the ideal model, or of the model to start from.
    """
    design = _make_features(part)
    rest = np.array(residual)
    for number in np.unique(part.run).tolist():
        rows = part.run == number
        columns = design[rows]
        columns = columns[:, columns.std(axis=0) > 0.0]
        size = np.sqrt((columns**2).mean(axis=0))
        columns = np.column_stack((columns / size, np.ones(columns.shape[0])))
        for channel in part.channels:
            rest[rows, channel] = _fit_robustly(columns, residual[rows, channel])
    return measure_spread(rest, part)


def _fit_robustly(columns: Floats, values: Floats) -> Floats:
    weight = np.ones(values.size)
    rest = values
    ridge = _RIDGE * values.size * np.eye(columns.shape[1])
    for _ in range(3):
        weighted = columns * weight[:, None]
        rest = values - columns @ np.linalg.solve(weighted.T @ columns + ridge, weighted.T @ values)
        spread = _GAUSSIAN * float(np.median(np.abs(rest))) + 1e-12
        weight = np.minimum(1.0, 3.0 * spread / np.maximum(np.abs(rest), 1e-12))
    freedom = max(values.size - columns.shape[1], 0.25 * values.size)
    widened: Floats = rest * np.sqrt(values.size / freedom)
    return widened


def _make_features(part: Part) -> Floats:
    lags = part.find_ideal()
    forward, turning = lags[:, :, 0], lags[:, :, 1]
    products = forward * turning
    now = [
        forward[:, 0] * np.abs(forward[:, 0]),
        forward[:, 0] * np.abs(turning[:, 0]),
        turning[:, 0] * np.abs(turning[:, 0]),
        np.sign(forward[:, 0]),
        np.sign(turning[:, 0]),
        np.abs(forward[:, 0]),
        np.abs(turning[:, 0]),
    ]
    columns = [forward, turning, products[:, [0, 1, 2, 4, 6]], *now]
    for sideways in np.moveaxis(lags[:, :, 2:], 2, 0):
        across = sideways * turning
        first = sideways[:, 0]
        columns += [
            sideways,
            across[:, [0, 1, 2, 4, 6]],
            first * np.abs(first),
            first * np.abs(turning[:, 0]),
        ]
        columns += [
            first * np.abs(forward[:, 0]),
            np.abs(first) * forward[:, 0],
            np.sign(first),
            np.abs(first),
        ]
    return np.column_stack(columns)
