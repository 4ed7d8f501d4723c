"""Mapping between the recorder's clock and that of the stamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.core import (
    Floats,
    Ints,
    robust_spread,
)
from pipeline.models import LEAST_DELAY_S
from pipeline.recording.findings import SURE

# Rates of the recorder's clock and of the stamps' clock: a map between them from topics that have both.
#
# A message is recorded some time after its stamp, never before: the least delay between the two, not the
# usual one, shows the clocks. Busy networks and bridges only add to it.

Stamps = Ints

JUMP_NS = 500_000_000
"""Leap of a clock [ns] above which it was set: networks and busy recorders delay messages by less."""
_FASTEST_SIMULATION = 50.0
"""Largest real-time factor of simulations."""
_FLOOR_SHARE = 0.02
"""Quantile of delays used as the least delay: a single stamp may be wrong."""
_PIECES = 20
"""Pieces of a run for the median rate of a clock, and for a line through the least delays: a leap of the
clock spoils one piece."""
_FEWEST_IN_PIECE = 50
"""Least number of messages per piece: of 50, one is at `_FLOOR_SHARE`."""
FEWEST_PIECES = 5
"""Least number of pieces, or of steps of a clock, for a median and a spread."""
_LEAST_DRIFT_NS = round(1e9 * LEAST_DELAY_S)
"""Least drift over a whole run: without drift stamps deviate by as much (`LEAST_DELAY_S`)."""
_FASTEST_DRIFT = 5e-4
"""Largest drift: quartz clocks differ by less than 200e-6, NTP adjusts a clock by up to 500e-6 (slew)."""


@dataclass(frozen=True)
class ClockMap:
    """Piecewise linear map from the recorder's clock to the stamps' clock.

    Attributes:
        log: times of the recorder's clock [ns], increasing, shape (n,).
        stamp: of the stamps' clock [ns], increasing, shape (n,).
    """

    log: Floats
    stamp: Floats

    @property
    def rate(self) -> float:
        """Rate of the stamps' clock relative to the recorder's, over the whole run."""
        return float((self.stamp[-1] - self.stamp[0]) / (self.log[-1] - self.log[0]))

    def follow(self, times: Stamps) -> Stamps:
        """Map the recorder's times to the stamps' clock [ns]; beyond the ends the mean rate is used."""
        inside = np.interp(times, self.log, self.stamp)
        before = np.minimum(times - self.log[0], 0.0) * self.rate
        after = np.maximum(times - self.log[-1], 0.0) * self.rate
        mapped: Stamps = np.rint(inside + before + after).astype(np.int64)
        return mapped

    @property
    def usual_rate(self) -> float:
        """Median of the same rate over pieces of the run, which a leap of the clock does not change."""
        at = np.linspace(self.log[0], self.log[-1], _PIECES + 1)
        return float(np.median(np.diff(np.interp(at, self.log, self.stamp)))) / float(at[1] - at[0])

    @property
    def bend_s(self) -> float:
        """Largest deviation of the map from a straight line [s of the stamps' clock]."""
        away = self.stamp - self.stamp[0] - self.rate * (self.log - self.log[0])
        return float(np.ptp(away)) / 1e9

    @property
    def leaps(self) -> bool:
        """Whether the clock was set forward, by more than any simulation advances."""
        most = _FASTEST_SIMULATION * np.diff(self.log) + JUMP_NS
        return bool((np.diff(self.stamp) > most).any())


def map_clock(log_time: Stamps, stamp: Stamps) -> ClockMap | None:
    """Latest stamp recorded up to each time.

    Args:
        log_time: when messages were recorded [ns], increasing, shape (n,).
        stamp: stamps of the headers [ns], shape (n,).

    Returns:
        The map; None if the stamps go back, or are too few.
    """
    latest = np.maximum.accumulate(stamp)
    if (latest - stamp > JUMP_NS).any():
        return None
    # Of simultaneous messages the last is used, and only an advance of the clock is a knot.
    log, shown = log_time.astype(np.float64), latest.astype(np.float64)
    last = np.append(np.diff(log) > 0, [True])
    log, shown = log[last], shown[last]
    new = np.append([True], np.diff(shown) > 0)
    log, shown = log[new], shown[new]
    return ClockMap(log, shown) if log.size >= FEWEST_PIECES else None


@dataclass(frozen=True)
class Drift:
    """Drift of a topic's stamps against the recorder's clock.

    Attributes:
        rate: [s/s], positive if the stamps' clock is faster.
        scatter: of the least delays about the straight line [ns].
        first, last: stamps between which it was measured [ns].
        least_ns: the least delay of the topic's messages at the first stamp, on the straight line.
    """

    rate: float = 0.0
    scatter: float = 0.0
    first: int = 0
    last: int = 0
    least_ns: float = 0.0

    @property
    def is_certain(self) -> bool:
        """Whether it is the drift of a clock, and exceeds the variation of the delays."""
        return self._is_apart(0.0) and abs(self.rate) < _FASTEST_DRIFT

    def is_same(self, other: Drift) -> bool:
        """Whether it is compatible with another, more accurate drift, and closer to it than to zero."""
        return not self._is_apart(other.rate) and abs(self.rate - other.rate) < abs(self.rate)

    def find_agreement(self) -> int:
        """The stamp at which both clocks agree, or the end of the run that is closer to it [ns].

        No message is recorded before its stamp, and the fastest one hardly later.
        """
        return round(min(max(self.first + self.least_ns / self.rate, self.first), self.last))

    def _is_apart(self, rate: float) -> bool:
        return abs(self.rate - rate) * (self.last - self.first) > max(_LEAST_DRIFT_NS, SURE * self.scatter)


def measure_drift(log_time: Stamps, stamp: Stamps) -> Drift:
    """Drift of a topic's stamps: a straight line through the least delays of pieces of the run."""
    pieces = min(_PIECES, stamp.size // _FEWEST_IN_PIECE)
    if pieces < FEWEST_PIECES:
        return Drift()
    delay = (log_time - stamp).astype(np.float64)
    spans = np.array_split(np.arange(stamp.size), pieces)
    at = np.array([float(np.median(stamp[span])) for span in spans]) - float(stamp[0])
    floor = np.array([float(np.quantile(delay[span], _FLOOR_SHARE)) for span in spans])
    one, two = np.triu_indices(pieces, 1)
    apart = at[two] - at[one]
    if not (apart > 0.0).all():
        return Drift()
    slope = float(np.median((floor[two] - floor[one]) / apart))
    rest = floor - slope * at
    scatter = robust_spread(rest - np.median(rest))
    return Drift(-slope, scatter, int(stamp.min()), int(stamp.max()), float(np.median(rest)))
