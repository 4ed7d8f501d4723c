"""Steps at which a vehicle stands and is asked to: there is no slip to measure."""

from collections.abc import Mapping

import numpy as np
import polars as pl

from pipeline.core import ROUNDING_S, Flags, Floats
from pipeline.run import ANSWERS_S, STILL_MPS
from pipeline.stages.inputs import Ideal


def mark_standing(velocities: pl.DataFrame, inputs: Mapping[str, Ideal]) -> Flags:
    """Whether each sample is at rest: nothing is commanded and nothing moves within `ANSWERS_S` of it.

    A command that is not obeyed, a wheel that turns and a body that slides are driving, and so is the time in
    which a drive begins and ends to move. Of the body the mean velocity over that time counts, in which the
    noise of poses averages out.

    Args:
        velocities: table `velocities`.
        inputs: all known inputs on its grid.

    Returns:
        Shape (n,).
    """
    times = velocities["t"].to_numpy()
    moves = np.zeros(times.size, dtype=bool)
    for one in inputs.values():
        moves |= (np.abs(np.nan_to_num(one.velocity)) > STILL_MPS).any(axis=1)
    busy = np.sort(times[moves])
    last = np.searchsorted(busy, times + ANSWERS_S + ROUNDING_S)
    standing: Flags = last == np.searchsorted(busy, times - ANSWERS_S - ROUNDING_S)
    body, segment = velocities.select("v_x", "v_y", "v_w").to_numpy(), velocities["segment"].to_numpy()
    for number in np.unique(segment).tolist():
        rows = segment == number
        standing[rows] &= (np.abs(_average_near(times[rows], body[rows])) < STILL_MPS).all(axis=1)
    return standing


def _average_near(times: Floats, values: Floats) -> Floats:
    """Mean of the values, shape (n, k), within `ANSWERS_S` of each of their times."""
    sums = np.vstack((np.zeros(values.shape[1]), np.cumsum(values, axis=0)))
    first = np.searchsorted(times, times - ANSWERS_S - ROUNDING_S)
    end = np.searchsorted(times, times + ANSWERS_S + ROUNDING_S)
    means: Floats = (sums[end] - sums[first]) / (end - first)[:, None]
    return means
