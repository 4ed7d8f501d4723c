"""Filters on a grid: lags, limits and loops; linear ones are exact for inputs constant in a cell."""

import math

import numpy as np

from pipeline.core import compiled
from pipeline.run import Floats, Resets, Signal

_INSTANT_S = 1e-9  # time constant below which there is no lag: avoids a division by nearly zero
_TINY = 1e-290
"""Values below it are set to zero: denormal numbers are slow."""


def lag_signal(signal: Signal, tau: float, step_s: float, resets: Resets, start: Signal) -> Signal:
    """First-order lag tau dy/dt = u - y of a real or complex signal.

    Args:
        signal: cell means of the input, shape (n,).
        tau: time constant [s]; zero returns the input itself.
        step_s: width of a cell [s].
        resets: where the state is reset.
        start: the state there; the input's own value where it is NaN, shape (k,).

    Returns:
        Cell means of the output, shape (n,).
    """
    if tau <= 0.0:
        return signal
    lagged, is_complex = np.empty_like(signal), np.iscomplexobj(signal)
    part = np.empty(signal.size) if is_complex else lagged.real
    _lag(np.ascontiguousarray(signal.real), set_states(signal.real, resets, start.real), tau, step_s, part)
    if is_complex:
        lagged.real = part
        states = set_states(signal.imag, resets, start.imag)
        _lag(np.ascontiguousarray(signal.imag), states, tau, step_s, part)
        lagged.imag = part
    return lagged


def set_states(signal: Floats, resets: Resets, start: Floats) -> Floats:
    """States before the cells at which they are reset, NaN elsewhere, shape (n,)."""
    states = np.full(signal.size, np.nan)
    states[resets.first] = signal[resets.first]
    states[resets.at] = np.where(np.isfinite(start), start, signal[resets.at])
    return states


@compiled()
def _approach(goal: float, state: float, most: float) -> tuple[float, float]:
    """Mean and last value in a cell of a state that approaches its goal by at most ``most``."""
    gap = goal - state
    size = abs(gap)
    if size < most:
        return goal - gap * size / (2.0 * most), goal
    step = most if gap > 0.0 else -most
    return state + 0.5 * step, state + step


@compiled()
def _pull(
    goal: float, state: float, tau: float, limit: float, time: float, lagged: float
) -> tuple[float, float]:
    """Integral and last value of a state that approaches its goal for some time: a ramp, then a lag.

    ``lagged`` is the share of its way that a lag goes in this time: most cells are no ramp.
    """
    gap = state - goal
    if abs(gap) <= limit * tau:
        return goal * time + tau * gap * lagged, goal + gap * (1.0 - lagged)
    ramp = min(abs(gap) / limit - tau, time)
    gone = limit * ramp if gap > 0.0 else -limit * ramp
    rest = gap - gone
    grown = -math.expm1((ramp - time) / tau) if ramp < time else 0.0
    return goal * time + ramp * (gap - 0.5 * gone) + tau * rest * grown, goal + rest * (1.0 - grown)


@compiled("void(float64[::1], float64[::1], float64, float64, float64[::1])")
def _lag(signal: Floats, states: Floats, tau: float, step_s: float, lagged: Floats) -> None:
    """Cell means of a first-order lag.

    Args:
        signal: cell means of the input, shape (n,).
        states: states that are set before a cell, NaN elsewhere; the first one is set, shape (n,).
        tau: time constant [s].
        step_s: width of a cell [s].
        lagged: the result, shape (n,).
    """
    decay = math.exp(-step_s / tau)
    share, grown = tau / step_s * (1.0 - decay), -math.expm1(-step_s / tau)
    state = signal[0]
    for cell in range(signal.size):
        if not math.isnan(states[cell]):
            state = states[cell]
        asked = signal[cell]
        lagged[cell] = asked + (state - asked) * share
        state = state * decay + asked * grown
        if abs(state) < _TINY:
            state = 0.0


def limit_rate(signal: Floats, limit: float, step_s: float, resets: Resets, start: Floats) -> Floats:
    """Limit the rate of a signal to ``limit`` per second.

    Args:
        signal: input on cells, shape (n,).
        limit: largest rate [unit/s]; infinity returns the input itself.
        step_s: width of a cell [s].
        resets: where the state is reset.
        start: the state there; the input's own value where it is NaN, shape (k,).
    """
    if not np.isfinite(limit):
        return signal
    known = np.where(np.isfinite(start), start, signal[resets.first])
    states = np.full(signal.size, np.nan)
    states[resets.first] = known
    limited = np.empty(signal.size)
    _limit(np.ascontiguousarray(signal), states, limit * step_s, limited)
    return limited


@compiled("void(float64[::1], float64[::1], float64, float64[::1])")
def _limit(signal: Floats, states: Floats, most: float, limited: Floats) -> None:
    """Cell means of a signal that follows its input by at most ``most`` per cell.

    If the input of a cell lies between those of its neighbours, a held command changed within the cell. The
    time of the step follows from the mean of the cell; a ramp from the start of the cell would be early by
    half a cell.
    """
    state, last = signal[0], signal.size - 1
    for cell in range(signal.size):
        asked = signal[cell]
        if not math.isnan(states[cell]):
            state = states[cell]
        elif cell < last and math.isnan(states[cell + 1]):
            before, after = signal[cell - 1], signal[cell + 1]
            if (asked - before) * (after - asked) > 0.0:
                share = (asked - before) / (after - before)
                first, state = _approach(before, state, (1.0 - share) * most)
                second, state = _approach(after, state, share * most)
                limited[cell] = first + share * (second - first)
                continue
        limited[cell], state = _approach(asked, state, most)


def lag_within(
    signal: Floats, tau: float, limit: float, step_s: float, resets: Resets, start: Floats
) -> Floats:
    """First-order lag as `lag_signal` whose rate stays within ``limit`` per second.

    Args:
        signal: cell means of the input, shape (n,).
        tau: time constant [s].
        limit: largest rate [unit/s]; infinity is a lag.
        step_s: width of a cell [s].
        resets: where the state is reset.
        start: the state there; the input's own value where it is NaN, shape (k,).
    """
    if not math.isfinite(limit):
        return lag_signal(signal, tau, step_s, resets, start)
    states, lagged = set_states(signal, resets, start), np.empty(signal.size)
    _lag_within(np.ascontiguousarray(signal), states, max(tau, _INSTANT_S), limit, step_s, lagged)
    return lagged


@compiled("void(float64[::1], float64[::1], float64, float64, float64, float64[::1])")
def _lag_within(
    signal: Floats, states: Floats, tau: float, limit: float, step_s: float, lagged: Floats
) -> None:
    """See `lag_within`; ``states`` as in `_lag`. The time of a step within a cell is that of `_limit`."""
    state, last, whole = signal[0], signal.size - 1, -math.expm1(-step_s / tau)
    for cell in range(signal.size):
        asked = signal[cell]
        if not math.isnan(states[cell]):
            state = states[cell]
        elif 0 < cell < last and math.isnan(states[cell + 1]):
            before, after = signal[cell - 1], signal[cell + 1]
            if (asked - before) * (after - asked) > 0.0:
                until = (after - asked) / (after - before) * step_s
                beyond = step_s - until
                first, state = _pull(before, state, tau, limit, until, -math.expm1(-until / tau))
                second, state = _pull(after, state, tau, limit, beyond, -math.expm1(-beyond / tau))
                lagged[cell] = (first + second) / step_s
                continue
        passed, state = _pull(asked, state, tau, limit, step_s, whole)
        lagged[cell] = passed / step_s
        if abs(state) < _TINY:
            state = 0.0


def lag_unevenly(
    signal: Floats, taus: tuple[float, float], step_s: float, resets: Resets, start: Floats
) -> Floats:
    """First-order lag as `lag_signal`, with another time constant for slowing down.

    Args:
        signal: cell means of the input, shape (n,).
        taus: time constants of speeding up and of slowing down [s].
        step_s: width of a cell [s].
        resets: where the state is reset.
        start: the state there; the input's own value where it is NaN, shape (k,).
    """
    up, down = taus
    states, lagged = set_states(signal, resets, start), np.empty(signal.size)
    _lag_unevenly(np.ascontiguousarray(signal), states, up, down, step_s, lagged)
    return lagged


@compiled("void(float64[::1], float64[::1], float64, float64, float64, float64[::1])")
def _lag_unevenly(
    signal: Floats, states: Floats, up: float, down: float, step_s: float, lagged: Floats
) -> None:
    """See `lag_unevenly`; ``states`` as in `_lag`."""
    keep_up = math.exp(-step_s / up) if up > 0.0 else 0.0
    keep_down = math.exp(-step_s / down) if down > 0.0 else 0.0
    share_up, share_down = up / step_s * (1.0 - keep_up), down / step_s * (1.0 - keep_down)
    fast = max(up, _INSTANT_S)
    state = signal[0]
    for cell in range(signal.size):
        if not math.isnan(states[cell]):
            state = states[cell]
        asked = signal[cell]
        gap = state - asked
        if state * asked < 0.0:
            # After a zero crossing within a cell it speeds up for the rest of the cell.
            passed = down * math.log1p(-state / asked)
            if passed < step_s:
                sped = -math.expm1((passed - step_s) / fast)
                lagged[cell] = asked + (down * state - up * asked * sped) / step_s
                state = asked * sped
            else:
                lagged[cell] = asked + gap * share_down
                state = asked + gap * keep_down
        elif abs(asked) < abs(state):
            lagged[cell] = asked + gap * share_down
            state = asked + gap * keep_down
        else:
            lagged[cell] = asked + gap * share_up
            state = asked + gap * keep_up


def wait_at_reversal(signal: Floats, wait_s: float, step_s: float, resets: Resets) -> Floats:
    """A signal that is zero for a time after each change of its sign, ignoring zeros in between.

    Args:
        signal: cell means of the input, shape (n,).
        wait_s: that time [s].
        step_s: width of a cell [s].
        resets: where the preceding signal is unknown.
    """
    index, direction = np.arange(signal.size), np.sign(signal)
    last = np.maximum.accumulate(np.where(direction != 0.0, index, -1))
    before = np.concatenate(([-1], last[:-1]))
    known = before >= resets.first[resets.number]
    turns = known & (direction * direction[before] < 0.0)
    since = index - np.maximum.accumulate(np.where(turns, index, -signal.size - math.ceil(wait_s / step_s)))
    waiting: Floats = signal * np.clip(since + 1.0 - wait_s / step_s, 0.0, 1.0)
    return waiting


def follow_with_play(signal: Floats, half: float, resets: Resets) -> Floats:
    """The play operator: the output is constant while the input is within half the play of it, shape (n,).

    Args:
        signal: cell means of the input, shape (n,).
        half: of the play, in the signal's unit.
        resets: where the output is reset to the input.
    """
    states = np.full(signal.size, np.nan)
    states[resets.first] = signal[resets.first]
    followed = np.empty(signal.size)
    _follow(np.ascontiguousarray(signal), states, half, followed)
    return followed


@compiled("void(float64[::1], float64[::1], float64, float64[::1])")
def _follow(signal: Floats, states: Floats, half: float, followed: Floats) -> None:
    """See `follow_with_play`."""
    now = signal[0]
    for cell in range(signal.size):
        if not math.isnan(states[cell]):
            now = states[cell]
        now = min(max(now, signal[cell] - half), signal[cell] + half)
        followed[cell] = now


def swing_signal(
    signal: Floats,
    tau: float,
    damping: float,
    step_s: float,
    resets: Resets,
    start: Floats,
    *,
    from_base: bool = False,
) -> Floats:
    """Second-order lag tau^2 d2y/dt2 + 2 damping tau dy/dt = u - y; low damping overshoots.

    Args:
        signal: cell means of the input, shape (n,).
        tau: one over the natural frequency [s]; zero returns the input itself.
        damping: damping ratio.
        step_s: width of a cell [s].
        resets: where the state is reset, with a rate of zero.
        start: the state there; the input's own value where it is NaN, shape (k,).
        from_base: whether the damper, too, stands on what moves: the output is y + 2 damping tau dy/dt.

    Returns:
        Cell means of the output, shape (n,).
    """
    if tau <= 0.0:
        return signal
    states, swung = set_states(signal, resets, start), np.empty(signal.size)
    damped = 0.0 if from_base else 2.0 * damping * tau
    _swing(np.ascontiguousarray(signal), states, tau, damping, damped, step_s, swung)
    return swung


@compiled("void(float64[::1], float64[::1], float64, float64, float64, float64, float64[::1])")
def _swing(
    signal: Floats,
    states: Floats,
    tau: float,
    damping: float,
    damped: float,
    step_s: float,
    swung: Floats,
) -> None:
    """See `swing_signal`; ``states`` as in `_lag`. Exact for inputs constant in a cell.

    ``damped`` [s] is the factor of the rate that the output lacks.
    """
    rate, turned = damping / tau, abs(damping * damping - 1.0) ** 0.5 / tau
    fade = math.exp(-rate * step_s)
    if turned * step_s < _INSTANT_S:
        even, odd = fade, fade * step_s
    elif damping < 1.0:
        even, odd = fade * math.cos(turned * step_s), fade * math.sin(turned * step_s) / turned
    else:
        grown, faded = math.exp((turned - rate) * step_s), math.exp(-(turned + rate) * step_s)
        even, odd = 0.5 * (grown + faded), 0.5 * (grown - faded) / turned
    state, pace = signal[0], 0.0
    for cell in range(signal.size):
        if not math.isnan(states[cell]):
            state, pace = states[cell], 0.0
        asked = signal[cell]
        gap = state - asked
        if abs(gap) + abs(pace) * tau < _TINY:
            gap, pace = 0.0, 0.0
        end = (even + rate * odd) * gap + odd * pace
        then = (even - rate * odd) * pace - odd * gap / (tau * tau)
        # The integral of the equation over the cell.
        swung[cell] = asked - (tau * tau * (then - pace) + damped * (end - gap)) / step_s
        state, pace = asked + end, then
