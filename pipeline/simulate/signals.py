"""Held signals, first-order lags, rate limits and coloured noise on a uniform grid.

A signal lives on cells of ``step`` seconds: entry k is its mean over [k step, (k+1) step].
"""

from collections.abc import Callable

import numpy as np

from pipeline.core.arrays import Floats


def hold_on_grid(event_s: Floats, values: Floats, *, delay_s: float, step_s: float, cells: int) -> Floats:
    """Cell means of a signal that keeps each value until the next event, shifted by a delay.

    Exact for any event times: a cell that holds an event gets the time-weighted mean of both values.

    Args:
        event_s: increasing times [s], shape (n,); the signal is zero before the first.
        values: value from that time on, shape (n,).
        delay_s: shift towards later [s].
        step_s: cell width [s].
        cells: number of cells.

    Returns:
        Cell means, shape (cells,).
    """
    edges = np.arange(cells + 1) * step_s - delay_s
    padded = np.concatenate(([0.0], values))
    at_start = np.searchsorted(event_s, edges[:-1], side="right")
    at_end = np.searchsorted(event_s, edges[1:], side="left")
    held = padded[at_start]
    mixed = np.flatnonzero(at_start < at_end)
    if mixed.size:
        knots = np.concatenate((event_s, [max(event_s[-1], edges[-1]) + 1.0]))
        integral = np.concatenate(([0.0], np.cumsum(values * np.diff(knots))))
        area = np.interp(edges[mixed + 1], knots, integral) - np.interp(edges[mixed], knots, integral)
        held[mixed] = area / step_s
    return held


def lag_signal(signal: Floats, *, tau_s: float, step_s: float) -> Floats:
    """First-order lag from rest, exact for a signal constant in each cell: tau dy/dt = u - y.

    Without a time constant it is the signal itself.
    """
    if tau_s <= 0.0:
        return signal
    decay = float(np.exp(-step_s / tau_s))
    at_end = filter_pole(signal * (1.0 - decay), decay)
    return 0.5 * (at_end + np.concatenate(([0.0], at_end[:-1])))


def filter_pole(signal: Floats, pole: float) -> Floats:
    """The recurrence y_k = pole y_(k-1) + u_k from rest."""
    from scipy.signal import lfilter  # noqa: PLC0415 - heavy, and the room is imported by the command line

    return np.asarray(lfilter([1.0], [1.0, -pole], signal), dtype=np.float64)


def follow(signal: Floats, step: Callable[[float, float], float]) -> Floats:
    """Follow a signal from rest, cell by cell: what is there and what is asked give what is there next.

    For what depends on its own past and has no closed form for arbitrary input; floats in a plain list are
    several times faster here than elements of an array.
    """
    now, out = 0.0, []
    for target in signal.tolist():
        now = step(now, target)
        out.append(now)
    return np.array(out)


def limit_rate(signal: Floats, *, per_second: float, step_s: float) -> Floats:
    """Follow a signal from rest with at most ``per_second`` of change a second."""
    largest = per_second * step_s

    def step(now: float, target: float) -> float:
        gap = target - now
        return target if -largest <= gap <= largest else now + (largest if gap > 0.0 else -largest)

    return follow(signal, step)


def make_coloured_noise(
    generator: np.random.Generator, *, size: int, deviation: float, correlation_s: float, step_s: float
) -> Floats:
    """Stationary first-order Gauss-Markov noise (size,), autocorrelation exp(-|t|/correlation_s)."""
    pole = float(np.exp(-step_s / correlation_s))
    white = generator.standard_normal(size)
    drive = white * np.sqrt(1.0 - pole**2)
    if size:
        drive[0] = white[0]
    return filter_pole(drive * deviation, pole)


def walk_in_plane(along: Floats, aside: Floats, heading: Floats, *, step_s: float) -> Floats:
    """Places from the origin on of a body that moves so [m/s], shape (n,), in the plane, shape (n + 1, 3).

    Args:
        along: its speed ahead.
        aside: its speed to the left.
        heading: at the edges of the steps [rad], shape (n + 1,).
        step_s: length of a step [s].
    """
    middle = 0.5 * (heading[:-1] + heading[1:])
    cosine, sine = np.cos(middle), np.sin(middle)
    x = integrate_cells(along * cosine - aside * sine, step_s=step_s)
    y = integrate_cells(along * sine + aside * cosine, step_s=step_s)
    return np.stack((x, y, np.zeros_like(heading)), axis=1)


def integrate_cells(signal: Floats, *, step_s: float) -> Floats:
    """Integral at the cell edges, shape (n + 1,), starting from zero."""
    return np.concatenate(([0.0], np.cumsum(signal) * step_s))
