"""Filters of signals on cells: lag and rate limit, exact for inputs that are constant in a cell."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pipeline.motion.signals import Floats, Integers, Surroundings

Complex = NDArray[np.complex128]


def lag_real(signal: Floats, tau: float, around: Surroundings, start: Floats) -> Floats:
    """First-order lag tau dy/dt = u - y of a real signal; see `lag_complex`."""
    if tau <= 0.0:
        return signal
    lagged: Floats = _lag(signal, tau, around, start, around.first)
    return lagged


def lag_complex(signal: Complex, tau: float, around: Surroundings, start: Complex, at: Integers) -> Complex:
    """First-order lag of a complex signal.

    Args:
        signal: cell means of the input, shape (n,).
        tau: time constant [s]; zero returns the input itself.
        around: the run.
        start: state before cell ``at`` of each span; where it is NaN the state is the input's first value,
            shape (k,).
        at: cell of each span at which the state is set, shape (k,).

    Returns:
        Cell means of the output, shape (n,).
    """
    if tau <= 0.0:
        return signal
    lagged: Complex = _lag(signal, tau, around, start, at)
    return lagged


def _lag(signal, tau, around, start, at):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - real or complex
    from scipy.signal import lfilter  # noqa: PLC0415 - heavy

    decay = float(np.exp(-around.step_s / tau))
    end = lfilter([1.0 - decay], [1.0, -decay], signal)
    before = np.concatenate((signal[:1], end[:-1]))
    # The filter ran through the holes: what it carried over is taken back, and the state put in its place.
    known = np.where(np.isfinite(start), start, signal[at])
    missing = known - before[at]
    if at is not around.first:
        unset = signal[around.first] - before[around.first]
        before = before + _decaying(unset, around, around.first, tau)
        missing = known - before[at]
    before = before + _decaying(missing, around, at, tau)
    held = tau / around.step_s * (1.0 - decay)
    return signal + (before - signal) * held


def _decaying(amount, around, at, tau):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - real or complex
    since = np.arange(around.times.size) - at[around.span]
    shape = np.exp(-np.maximum(since, 0) * (around.step_s / tau)) * (since >= 0)
    return amount[around.span] * shape


def limit_rate(signal: Floats, limit: float, around: Surroundings, start: Floats) -> Floats:
    """Let a signal follow its input no faster than ``limit`` per second.

    Args:
        signal: input on cells, shape (n,).
        limit: largest rate [unit/s]; infinity returns the input itself.
        around: the run.
        start: value at each span's start, NaN for the input's first value, shape (k,).
    """
    if not np.isfinite(limit):
        return signal
    most = limit * around.step_s
    starts = np.zeros(signal.size, dtype=bool)
    starts[around.first] = True
    begins = np.flatnonzero(starts | np.concatenate(([True], np.diff(signal) != 0.0)))
    level = signal[begins].tolist()
    count = np.diff(np.append(begins, signal.size)).tolist()
    fresh = {int(cell): float(value) for cell, value in zip(around.first, start, strict=True)}
    missing, value = [], level[0]
    # One short loop over the plateaus of the input; what happens inside a plateau is a straight line.
    for cell, target, cells in zip(begins.tolist(), level, count, strict=True):
        if cell in fresh:
            value = fresh[cell] if np.isfinite(fresh[cell]) else target
        gap = target - value
        missing.append(gap)
        value = target if abs(gap) <= most * cells else value + most * cells * (1.0 if gap > 0.0 else -1.0)
    gap = np.repeat(np.array(missing), count)
    inside = np.arange(signal.size) - np.repeat(begins, count) + 0.5
    left = np.maximum(np.abs(gap) - most * inside, 0.0)
    limited: Floats = signal - np.sign(gap) * left
    return limited
