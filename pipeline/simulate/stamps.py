"""From true seconds to the stamps of the robot's clock."""

import numpy as np

from pipeline.core.arrays import Floats, Ints
from pipeline.simulate.scenario import Clock

Stamps = Ints

_SWING_S = 7.0
_SHORTEST_BUNCH = 0.1
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


def stamp_times(clock: Clock, time_s: Floats) -> Stamps:
    """Nanoseconds that the recorder's clock shows when it gets what came at true times [s], shape (n,).

    A clock that was set before the run began counts from its own time before the run, too: a pose that is
    stamped early is a few moments older than the run. A clock that shows less than zero shows zero: stamps
    are unsigned.
    """
    got = _bunch(time_s, clock.bunch_s)
    if clock.real_time_factor is not None:
        turn = 2.0 * np.pi / _SWING_S
        passed = (got + clock.swing / turn * np.sin(turn * got)) / clock.real_time_factor
        return clock.start_ns + np.rint(passed * 1e9).astype(np.int64)
    return _show(clock, got)


def stamp_headers(clock: Clock, time_s: Floats) -> Stamps:
    """Nanoseconds that header stamps show: simulated time where there is one, else the robot's clock."""
    if clock.real_time_factor is not None:
        return np.maximum(np.rint(time_s * 1e9).astype(np.int64), 0)
    return _show(clock, time_s * (1.0 + 1e-6 * clock.drift_ppm))


def _show(clock: Clock, time_s: Floats) -> Stamps:
    elapsed = np.rint(time_s * 1e9).astype(np.int64)
    unset = (time_s < clock.unset_s) & (clock.unset_s > 0.0)
    shown = np.where(unset, elapsed, clock.start_ns + elapsed)
    gone_back = time_s >= clock.backward_at_s
    shown = np.where(gone_back, shown - round(clock.backward_s * 1e9), shown)
    return np.maximum(shown, 0)


def _bunch(time_s: Floats, longest_s: float) -> Floats:
    """When bunches arrive in which what came at these times is, the shortest a tenth of the longest."""
    if longest_s <= 0.0 or time_s.size == 0:
        return time_s
    count = 2 + int((time_s.max() + longest_s) / (_SHORTEST_BUNCH * longest_s))
    share = np.modf(np.arange(1, count) * _GOLDEN)[0]
    ends = np.cumsum(longest_s * (_SHORTEST_BUNCH + (1.0 - _SHORTEST_BUNCH) * share))
    return ends[np.searchsorted(ends, time_s)]
