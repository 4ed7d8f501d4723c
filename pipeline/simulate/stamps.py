"""From true seconds to the stamps of the robot's clock."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pipeline.simulate.scenario import Clock

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]


def stamp_times(clock: Clock, time_s: Floats) -> Stamps:
    """Nanoseconds that the clock shows at true times since the run's start [s], shape (n,).

    A clock that was set before the run began counts from its own time before the run, too: a pose that is
    stamped early is a few moments older than the run. A clock that shows less than zero shows zero: stamps
    are unsigned.
    """
    if clock.real_time_factor is not None:
        return clock.start_ns + np.rint(time_s * 1e9 / clock.real_time_factor).astype(np.int64)
    elapsed = np.rint(time_s * 1e9).astype(np.int64)
    unset = (time_s < clock.unset_s) & (clock.unset_s > 0.0)
    shown = np.where(unset, elapsed, clock.start_ns + elapsed)
    gone_back = time_s >= clock.backward_at_s
    shown = np.where(gone_back, shown - round(clock.backward_s * 1e9), shown)
    return np.maximum(shown, 0)


def stamp_headers(clock: Clock, time_s: Floats) -> Stamps:
    """Nanoseconds that header stamps show: simulated time where there is one, else as `stamp_times`."""
    if clock.real_time_factor is not None:
        return np.maximum(np.rint(time_s * 1e9).astype(np.int64), 0)
    return stamp_times(clock, time_s)
