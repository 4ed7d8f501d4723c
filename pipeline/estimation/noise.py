"""The noise of residuals: how they follow from their own past, so that they can be whitened.

Residuals of field data repeat themselves for seconds, and commands that a driver or a controller gives answer
them. What a candidate explains is judged on the part of a residual that its own past does not predict (the
innovation; Ljung, System Identification, 2nd ed., section 3.2): it is independent of every earlier command.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Floats, Ints

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.identification.parts import Part

ORDER = 6
"""Past residuals that predict the next one: three seconds of half-second windows."""
_OVERLAP_S = 0.06
"""Windows that share less than half the time between poses count as following one another."""
_GAP = 1.5
"""A window that begins later than this many typical steps after the one before has no past."""
_CLIP = 4.0
_SHARE_OF_RMS = 0.5
_GAUSSIAN = 1.4826
_LARGEST_REFLECTION = 0.995


@dataclass(frozen=True)
class Tiles:
    """Windows that cover a recording without overlap.

    Attributes:
        rows: their places among all windows, shape (k,).
        past: how many of them precede each without a gap, at most `ORDER`, shape (k,).
        unit: ten-second stretch of each, shape (k,).
    """

    rows: Ints
    past: Ints
    unit: Ints


def tile_windows(part: Part) -> Tiles:
    """The windows of a part that follow one another without overlap."""
    rows: list[int] = []
    last, end, before = -1, -np.inf, -np.inf
    for place, (number, (start, stop)) in enumerate(zip(part.run.tolist(), part.times.tolist(), strict=True)):
        if number != last or start >= end - _OVERLAP_S or start < before:
            rows.append(place)
            last, end = number, stop
        before = start
    kept = np.array(rows, dtype=np.int64)
    starts, runs = part.times[kept, 0], part.run[kept]
    steps = np.diff(starts)
    typical = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 1.0
    fresh = np.concatenate(([True], (np.diff(runs) != 0) | (steps > _GAP * typical) | (steps <= 0.0)))
    first = np.maximum.accumulate(np.where(fresh, np.arange(kept.size), 0))
    return Tiles(kept, np.minimum(np.arange(kept.size) - first, ORDER), part.unit[kept])


@dataclass(frozen=True)
class Noise:
    """Autoregressive noise of each channel.

    Attributes:
        tiles: the windows that it is of.
        channels: which of x, y, w say anything.
        predictors: by channel and number of past residuals that are known, their coefficients, newest first.
        scale: standard deviation of the innovation by channel and that number, shape (c, `ORDER` + 1).
    """

    tiles: Tiles
    channels: tuple[int, ...]
    predictors: tuple[tuple[Floats, ...], ...]
    scale: Floats

    def whiten(self, columns: Floats) -> Floats:
        """Innovations of columns in units of their standard deviation.

        Args:
            columns: at the tiles, shape (k, 3, q).

        Returns:
            Shape (k, c, q).
        """
        white = np.zeros((columns.shape[0], len(self.channels), columns.shape[2]))
        for place, channel in enumerate(self.channels):
            signal = columns[:, channel, :]
            for order, coefficients in enumerate(self.predictors[place]):
                rows = np.flatnonzero(self.tiles.past == order)
                if not rows.size:
                    continue
                fresh = signal[rows]
                for lag, coefficient in enumerate(coefficients.tolist(), start=1):
                    fresh = fresh - coefficient * signal[rows - lag]
                white[rows, place] = fresh / self.scale[place, order]
        return white

    def whiten_residual(self, residual: Floats) -> Floats:
        """Innovations of residuals of all windows, shape (n, 3), at the tiles, shape (k, c)."""
        return self.whiten(residual[self.tiles.rows, :, None])[:, :, 0]


def learn_noise(tiles: Tiles, channels: Sequence[int], residual: Floats) -> Noise:
    """Noise like that of residuals at the tiles, of shape (k, 3)."""
    predictors, scales = [], []
    for channel in channels:
        coefficients, variances = _predict(_autocovariance(tiles, residual[:, channel]))
        predictors.append(coefficients)
        scales.append(np.sqrt(variances))
    shape = Noise(tiles, tuple(channels), tuple(predictors), np.array(scales))
    spread = measure_spread(shape.whiten(residual[:, :, None])[:, :, 0])
    return Noise(tiles, tuple(channels), tuple(predictors), np.array(scales) * spread[:, None])


def measure_spread(values: Floats) -> Floats:
    """Robust standard deviation of each column about zero, never far below the clipped rms, shape (c,)."""
    middle = _GAUSSIAN * np.median(np.abs(values), axis=0)
    clipped = np.sqrt(np.mean(np.minimum(np.abs(values), 6.0 * middle + 1e-12) ** 2, axis=0))
    spread: Floats = np.maximum(np.maximum(middle, _SHARE_OF_RMS * clipped), 1e-9)
    return spread


def _autocovariance(tiles: Tiles, values: Floats) -> Floats:
    """Autocovariance over lags 0 to `ORDER`, outliers clipped, shape (`ORDER` + 1,)."""
    (spread,) = measure_spread(values[:, None]).tolist()
    clipped = np.clip(values, -_CLIP * spread, _CLIP * spread)
    found = np.zeros(ORDER + 1)
    for lag in range(ORDER + 1):
        rows = np.flatnonzero(tiles.past >= lag)
        found[lag] = float(clipped[rows] @ clipped[rows - lag]) / max(rows.size + lag, 1)
    found[0] = max(found[0] * (1.0 + 1e-6), 1e-18)
    return found


def _predict(covariance: Floats) -> tuple[tuple[Floats, ...], Floats]:
    """Best linear predictors of orders 0 to `ORDER` and their variances (Levinson and Durbin)."""
    coefficients, variance = np.zeros(0), float(covariance[0])
    predictors, variances = [coefficients], [variance]
    for order in range(1, covariance.size):
        reflection = float(covariance[order] - coefficients @ covariance[order - 1 : 0 : -1]) / variance
        reflection = min(max(reflection, -_LARGEST_REFLECTION), _LARGEST_REFLECTION)
        coefficients = np.append(coefficients - reflection * coefficients[::-1], reflection)
        variance *= 1.0 - reflection**2
        predictors.append(coefficients)
        variances.append(variance)
    return tuple(predictors), np.array(variances)
