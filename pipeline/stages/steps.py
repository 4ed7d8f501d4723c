"""Command steps: stretches of one command, and the transitory span that follows each change."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_SHARE_OF_RANGE = 0.02
_SMALLEST_CHANGE = 0.02
_SHORTEST_STEP = 1.0


def number_steps(
    times: Floats, segment: NDArray[np.int32], ideal: Floats, length: float
) -> NDArray[np.int32]:
    """Number the command steps of a run.

    A step starts where a segment starts, and where the ideal velocity of the command has moved by more than
    2 % of its range from its level, but no sooner than one second after the last start. The level of a step
    is what the command has become one second after the step's start, so that a ramp is one step.

    Args:
        times: grid times [s], shape (n,).
        segment: number of the segment, shape (n,).
        ideal: ideal velocity of the command (f_x, f_y, f_w), NaN where there is none, shape (n, 3).
        length: length scale L [m] that makes yaw rates comparable with speeds.

    Returns:
        Step numbers, shape (n,), starting at zero.
    """
    scaled = np.nan_to_num(ideal * np.array([1.0, 1.0, length]))
    size = np.linalg.norm(scaled, axis=1)
    tolerance = max(_SHARE_OF_RANGE * float(np.quantile(size, 0.99)) if size.size else 0.0, _SMALLEST_CHANGE)
    starts = np.zeros(times.size, dtype=bool)
    starts[:1] = True
    starts[1:] = np.diff(segment) != 0
    moved = np.concatenate(([False], np.linalg.norm(np.diff(scaled, axis=0), axis=1) > 0.0))
    begin, level = 0, scaled[:1].sum(axis=0)
    # Only places where the command changes at all can start a step, so this loop is short for held commands.
    for place in np.flatnonzero(moved | starts).tolist():
        late_enough = times[place] - times[begin] >= _SHORTEST_STEP
        if late_enough and np.linalg.norm(scaled[place] - level) > tolerance:
            starts[place] = True
        if starts[place]:
            begin = place
        if times[place] - times[begin] < _SHORTEST_STEP:
            level = scaled[place]
    return (np.cumsum(starts) - 1).astype(np.int32)


def mark_transitory(times: Floats, step: NDArray[np.int32], span: float) -> NDArray[np.bool_]:
    """Whether each sample lies within ``span`` [s] of its step's start."""
    first = np.searchsorted(step, np.arange(int(step[-1]) + 1)) if step.size else np.zeros(0, dtype=int)
    since = times - times[first][step]
    marked: NDArray[np.bool_] = since < span - 1e-6
    return marked
