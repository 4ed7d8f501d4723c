"""Command steps: stretches of one command, and the transitory span that follows each change."""

import numpy as np
from numpy.typing import NDArray

from pipeline.core.arrays import Flags, Floats

_SHARE_OF_RANGE = 0.02
_SMALLEST_CHANGE = 0.02
_NOISES = 8.0
_GROWTH = 0.6745 * 6.0**0.5
_SHORTEST_STEP = 1.0
_HELD = 2.0


def find_changes(times: Floats, ideal: Floats, length: float) -> Flags:
    """Whether the command changes before each sample.

    It does where its ideal velocity has moved by more than 2 % of its range (and eight times the noise, where
    measured wheels stand for a command) from its level, but no sooner than one second after the last change.
    The level is what the command has become one second after a change, so that a short ramp is one change.

    Args:
        times: grid times [s], shape (n,).
        ideal: ideal velocity of the command (f_x, f_y, f_w), NaN where there is none, shape (n, 3).
        length: length scale L [m] that makes yaw rates comparable with speeds.

    Returns:
        Flags of shape (n,); the first is True, since nobody knows what was asked before.
    """
    scaled = np.nan_to_num(ideal * np.array([1.0, 1.0, length]))
    size = np.linalg.norm(scaled, axis=1)
    jitter = np.linalg.norm(np.diff(scaled, axis=0), axis=1)
    changes = np.zeros(times.size, dtype=bool)
    changes[:1] = True
    if times.size < 2:  # noqa: PLR2004 - one sample has nothing to change from
        return changes
    tolerance = max(
        _SHARE_OF_RANGE * float(np.quantile(size, 0.99)),
        _NOISES * _estimate_noise(scaled),
        _SMALLEST_CHANGE,
    )
    begin, level = 0, scaled[0]
    # Only places where the command changes at all can start a step, so this loop is short for held commands.
    for place in (np.flatnonzero(jitter > 0.0) + 1).tolist():
        late_enough = times[place] - times[begin] >= _SHORTEST_STEP
        if late_enough and np.linalg.norm(scaled[place] - level) > tolerance:
            changes[place] = True
            begin = place
        if times[place] - times[begin] < _SHORTEST_STEP:
            level = scaled[place]
    return changes


def _estimate_noise(scaled: Floats) -> float:
    """Size of the white noise in a series (n, 3), from its second differences: what moves evenly has none."""
    if scaled.shape[0] < 3:  # noqa: PLR2004 - a second difference needs three
        return 0.0
    return float(np.median(np.linalg.norm(np.diff(scaled, n=2, axis=0), axis=1))) / _GROWTH


def number_steps(times: Floats, segment: NDArray[np.int32], changes: Flags) -> NDArray[np.int32]:
    """Number the command steps of a run.

    A step starts where a segment starts, and where the command changes to, or from, something that is held
    for two seconds. A command that never rests (a joystick, a path follower) makes one long step of all its
    changes: cut at each of them, it would have no window of two seconds at all.

    Args:
        times: grid times [s], shape (n,).
        segment: number of the segment, shape (n,).
        changes: whether the command changes before each sample, shape (n,).

    Returns:
        Step numbers, shape (n,), starting at zero.
    """
    places = np.flatnonzero(changes)
    period = times[1] - times[0] if times.size > 1 else 0.0
    lasts = np.diff(times[places], append=times[-1] + period)
    held = lasts >= _HELD - 1e-6
    starts = np.zeros(times.size, dtype=bool)
    starts[places[held | np.concatenate(([True], held[:-1]))]] = True
    starts[1:] |= np.diff(segment) != 0
    return (np.cumsum(starts) - 1).astype(np.int32)


def mark_transitory(times: Floats, changes: Flags, span: float) -> Flags:
    """Whether each sample lies within ``span`` [s] of the last change of the command."""
    last = np.maximum.accumulate(np.where(changes, np.arange(times.size), 0))
    return times - times[last] < span - 1e-6
