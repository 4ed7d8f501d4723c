"""Slip as it is in the field: autocorrelated within a run, scattered from run to run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

if TYPE_CHECKING:
    from numpy.typing import NDArray

RATE = 20.0


def simulate_runs(
    runs: int, *, seconds: float, memory: float, spread: float, rng: np.random.Generator, median: float = 1.0
) -> NDArray[np.float64]:
    """Slip moduli of equal runs.

    Args:
        runs: how many.
        seconds: length of a run.
        memory: correlation time of the logarithm [s].
        spread: standard deviation of the logarithm of the runs' medians.
        rng: generator.
        median: median of the dataset [m/s].

    Returns:
        Moduli [m/s], shape (runs, samples).
    """
    count = round(seconds * RATE)
    rho = np.exp(-1.0 / (memory * RATE))
    noise = rng.standard_normal((runs, count)) * np.sqrt(1.0 - rho**2)
    start = rng.standard_normal((runs, 1)) * rho
    waves, _ = lfilter([1.0], [1.0, -rho], noise, axis=1, zi=start)
    level = rng.normal(0.0, spread, (runs, 1))
    return median * np.exp(0.6 * waves + level)
