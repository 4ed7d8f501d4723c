"""Filters of signals on cells: lag and rate limit, exact for inputs that are constant in a cell."""

import math
from itertools import pairwise

import numpy as np

from pipeline.runs.signals import Floats, Integers, Resets, Signal

_INSTANT_S = 1e-9
_BLOCK = 16
_ROUND = 100
"""Plateaus that are followed one by one in the time that a step of all at once takes."""


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
    decay = math.exp(-step_s / tau)
    before = _follow_lagged(signal, decay, 1.0 - decay)
    # The sum ran through the resets: what it carried over is taken back, and the state put in its place.
    # One reset after the other, in closed form: what is missing at each fades until the next.
    from_first, from_set = resets.fade(step_s / tau)
    known = np.where(np.isfinite(start), start, signal[resets.at])
    if from_first is not from_set:
        before += (signal[resets.first] - before[resets.first])[resets.number] * from_first
    before += (known - before[resets.at])[resets.number] * from_set
    before -= signal
    before *= tau / step_s * (1.0 - decay)
    before += signal
    return before


def _follow_lagged(signal: Floats, keep: float, share: float) -> Floats:
    """States y before each cell, y_(k+1) = keep y_k + share u_k from zero: within blocks by a matrix.

    What blocks begin with is followed from block to block in the same way.

    Args:
        signal: u, shape (n,).
        keep: at least zero, below one.
        share: of the input.
    """
    size = max(min(signal.size, _BLOCK), 1)
    blocks, (whole, rest) = -(-signal.size // size), divmod(signal.size, size)
    padded = np.zeros((blocks, size + 1))
    padded[:whole, :size] = signal[: whole * size].reshape(whole, size)
    padded[whole:, :rest] = signal[whole * size :]
    ages = np.arange(size)
    if blocks > 1:
        ends = padded[:, :size] @ (share * keep ** ages[::-1])
        padded[:, size] = _follow_lagged(ends, keep**size, 1.0)
    inside = share * np.triu(keep ** np.abs(ages - ages[:, None] - 1.0), 1)
    before: Floats = (padded @ np.vstack((inside, keep**ages))).reshape(-1)[: signal.size]
    return before


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
    before. What is left where it has not is passed on to the next plateau, at all such places at once, until
    nothing changes any more; what goes on for long is followed place by place.
    """
    level = signal[begins]
    alone = np.diff(level, prepend=level[0])
    fresh = np.searchsorted(begins, resets.first)
    alone[fresh] = np.where(np.isfinite(start), level[fresh] - start, 0.0)
    reach = reach.copy()
    # Nothing is carried over a reset.
    reach[np.append(fresh[1:], begins.size) - 1] = np.inf
    gap = alone.copy()
    late = np.flatnonzero(np.abs(gap) > reach)
    done = 0
    while late.size and done < 2 * begins.size:
        done += late.size + _ROUND
        most, missing = reach[late], gap[late]
        after = alone[late + 1] + (missing - np.minimum(np.maximum(missing, -most), most))
        changed = after != gap[late + 1]
        late = late[changed] + 1
        gap[late] = after[changed]
        late = late[np.isfinite(reach[late])]
    return _follow(late.tolist(), gap.tolist(), alone.tolist(), reach.tolist()) if late.size else gap


def _follow(late: list[int], gap: list[float], alone: list[float], reach: list[float]) -> Floats:
    """Gaps of `_find_gaps` with what is left at some places passed on as far as it goes."""
    for place in late:
        while (most := reach[place]) < math.inf:
            missing = gap[place]
            place += 1  # noqa: PLW2901 - it walks on from there
            after = alone[place]
            if missing > most:
                after += missing - most
            elif missing < -most:
                after += missing + most
            if after == gap[place]:
                break
            gap[place] = after
    return np.array(gap)


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
