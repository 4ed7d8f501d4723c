"""Filters of signals on cells: lag and rate limit, exact for inputs that are constant in a cell."""

import math
from itertools import pairwise

import numpy as np

from pipeline.runs.signals import Floats, Integers, Resets, Signal

_INSTANT_S = 1e-9
_TINY = 1e-290
"""Added to what would fade to the smallest numbers of all: a processor is slow with these."""


def lag_signal(signal: Signal, tau: float, step_s: float, resets: Resets, start: Signal) -> Signal:
    """First-order lag tau dy/dt = u - y of a real or complex signal.

    Args:
        signal: cell means of the input, shape (n,).
        tau: time constant [s]; zero returns the input itself.
        step_s: width of a cell [s].
        resets: where the state begins anew.
        start: the state there; the input's own value where it is NaN, shape (k,).

    Returns:
        Cell means of the output, shape (n,).
    """
    if tau <= 0.0:
        return signal
    lagged = np.empty_like(signal)
    lagged.real = _lag(np.ascontiguousarray(signal.real), tau, step_s, resets, start.real)
    if np.iscomplexobj(signal):
        lagged.imag = _lag(np.ascontiguousarray(signal.imag), tau, step_s, resets, start.imag)
    return lagged


def _lag(signal: Floats, tau: float, step_s: float, resets: Resets, start: Floats) -> Floats:
    """See `lag_signal`, of a real signal."""
    from scipy.linalg.lapack import dtbtrs  # noqa: PLC0415 - heavy

    decay = math.exp(-step_s / tau)
    # States before each cell, y_k = decay y_(k-1) + (1 - decay) u_(k-1): a system with two diagonals.
    bands = np.empty((2, signal.size), order="F")
    bands[0], bands[1] = 1.0, -decay
    before = np.full_like(signal, _TINY)
    before[1:] += (1.0 - decay) * signal[:-1]
    known = np.where(np.isfinite(start), start, signal[resets.at])
    for cells, values in ((resets.first, signal[resets.first]), (resets.at, known)):
        # What is set owes nothing to the cell before; what is behind the last one is not read.
        bands[1, cells - 1], before[cells] = 0.0, values
    states: Floats = dtbtrs(bands, before, uplo="L", diag="U", overwrite_b=1)[0]
    states -= signal
    states *= tau / step_s * (1.0 - decay)
    states += signal
    return states


def limit_rate(signal: Floats, limit: float, step_s: float, resets: Resets, start: Floats) -> Floats:
    """Let a signal follow its input no faster than ``limit`` per second.

    Args:
        signal: input on cells, shape (n,).
        limit: largest rate [unit/s]; infinity returns the input itself.
        step_s: width of a cell [s].
        resets: where the state begins anew.
        start: the state there; the input's own value where it is NaN, shape (k,).
    """
    if not np.isfinite(limit):
        return signal
    most = limit * step_s
    starts = np.zeros(signal.size, dtype=bool)
    starts[resets.first] = True
    begins = np.flatnonzero(starts | np.concatenate(([True], np.diff(signal) != 0.0)))
    count = np.diff(np.append(begins, signal.size))
    gap = np.repeat(_find_gaps(signal, start, begins, most * count, resets), count)
    inside = np.arange(signal.size) - np.repeat(begins, count) + 0.5
    left = np.maximum(np.abs(gap) - most * inside, 0.0)
    limited: Floats = signal - np.sign(gap) * left
    return limited


def _find_gaps(signal: Floats, start: Floats, begins: Integers, reach: Floats, resets: Resets) -> Floats:
    """How far the limited signal is from its input where each plateau of the input begins.

    Nearly always it has arrived before the plateau ends, so that the next one begins at the level of the one
    before. What is left where it has not is passed on from plateau to plateau.
    """
    level = signal[begins]
    alone = np.diff(level, prepend=level[0])
    fresh = np.searchsorted(begins, resets.first)
    alone[fresh] = np.where(np.isfinite(start), level[fresh] - start, 0.0)
    reach = reach.copy()
    # Nothing is carried over a reset.
    reach[np.append(fresh[1:], begins.size) - 1] = np.inf
    found = alone.copy()
    # Views give plain numbers, without a list of all for the few that are asked for.
    gap, steps, most = found.data, alone.data, reach.data
    for late in np.flatnonzero(np.abs(alone) > reach).tolist():
        place, missing = late, gap[late]
        while (furthest := most[place]) < math.inf:
            place += 1
            after = steps[place]
            if missing > furthest:
                after += missing - furthest
            elif missing < -furthest:
                after += missing + furthest
            if after == gap[place]:
                break
            gap[place] = missing = after
    return found


def lag_unevenly(
    signal: Floats, taus: tuple[float, float], step_s: float, resets: Resets, start: Floats
) -> Floats:
    """First-order lag as `lag_signal`, with another time constant where the output is slowed down.

    Args:
        signal: cell means of the input, shape (n,).
        taus: time constants of speeding up and of slowing down [s].
        step_s: width of a cell [s].
        resets: where the state begins anew.
        start: the state there; the input's own value where it is NaN, shape (k,).
    """
    up, down = taus
    keeps = keep_up, keep_down = [math.exp(-step_s / tau) if tau > 0.0 else 0.0 for tau in taus]
    known = np.where(np.isfinite(start), start, signal[resets.at])
    begun = dict(zip(resets.first.tolist(), signal[resets.first].tolist(), strict=True))
    begun |= dict(zip(resets.at.tolist(), known.tolist(), strict=True))
    before = _follow_unevenly(signal.tolist(), begun, (keep_up, keep_down, max(up, _INSTANT_S), down), step_s)
    size = np.abs(signal)
    crosses = before * signal < 0.0
    slows = crosses | (size < np.abs(before))
    # Where it passes zero within a cell it speeds up for the rest of it.
    turns = np.flatnonzero(crosses)
    passed = down * (np.log(size[turns] + np.abs(before[turns])) - np.log(size[turns]))
    turns, passed = turns[passed < step_s], passed[passed < step_s]
    sped = -np.expm1((passed - step_s) / max(up, _INSTANT_S))
    share_up, share_down = (tau / step_s * (1.0 - keep) for tau, keep in zip(taus, keeps, strict=True))
    lagged: Floats = signal + (before - signal) * np.where(slows, share_down, share_up)
    lagged[turns] = signal[turns] + (down * before[turns] - up * signal[turns] * sped) / step_s
    return lagged


def _follow_unevenly(
    signal: list[float], begun: dict[int, float], rates: tuple[float, float, float, float], step_s: float
) -> Floats:
    """States before each cell of `lag_unevenly`, cell by cell: each decides how the next one is reached.

    Args:
        signal: cell means of the input, n of them.
        begun: states by cell before which they are set.
        rates: what a cell leaves of a difference when speeding up and slowing down, and the time constants.
        step_s: width of a cell [s].
    """
    keep_up, keep_down, up, down = rates
    before, cells = list[float](), sorted(begun)
    for first, end in pairwise([*cells, len(signal)]):
        now = begun[first]
        for asked in signal[first:end]:
            before.append(now)
            gap = now - asked
            if not now * gap > 0.0:
                now = asked + gap * keep_up
            elif now * asked < 0.0 and (passed := down * math.log1p(-now / asked)) < step_s:
                now = -asked * math.expm1((passed - step_s) / up)
            else:
                now = asked + gap * keep_down
    return np.array(before)


def wait_at_reversal(signal: Floats, wait_s: float, step_s: float, resets: Resets) -> Floats:
    """A signal that is zero for a while whenever its sign has changed, not counting zeros in between.

    Args:
        signal: cell means of the input, shape (n,).
        wait_s: how long [s].
        step_s: width of a cell [s].
        resets: where nothing is known of what was before.
    """
    cells, way = np.arange(signal.size), np.sign(signal)
    last = np.maximum.accumulate(np.where(way != 0.0, cells, -1))
    before = np.concatenate(([-1], last[:-1]))
    known = before >= resets.first[resets.number]
    turns = known & (way * way[before] < 0.0)
    since = cells - np.maximum.accumulate(np.where(turns, cells, -signal.size - math.ceil(wait_s / step_s)))
    waiting: Floats = signal * np.clip(since + 1.0 - wait_s / step_s, 0.0, 1.0)
    return waiting


def follow_with_play(signal: Floats, half: float, resets: Resets) -> Floats:
    """The play operator: what stays where it is while its input is nearer than half the play, shape (n,).

    Args:
        signal: cell means of the input, shape (n,).
        half: of the play, in the signal's unit.
        resets: where it begins at the input's own value.
    """
    followed: list[float] = []
    ends = np.append(resets.first[1:], signal.size)
    for first, end in zip(resets.first.tolist(), ends.tolist(), strict=True):
        now = float(signal[first])
        for asked in signal[first:end].tolist():
            now = min(max(now, asked - half), asked + half)
            followed.append(now)
    return np.array(followed)
