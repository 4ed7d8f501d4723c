"""How late one signal is against another, by the lag of their best correlation."""

from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Floats

_STEP = 0.02
_FEWEST = 50


@dataclass(frozen=True)
class Delay:
    """A delay and how sure it is.

    Attributes:
        seconds: how late the signal is; negative when it is early.
        correlation: signed correlation at that lag.
        deviation: standard deviation of the delay [s]: the power that the signals do not share, over the
            power of the signal's rate of change, over the number of independent samples.
    """

    seconds: float
    correlation: float
    deviation: float


def estimate_delay(
    times: Floats, signal: Floats, reference_times: Floats, reference: Floats, *, largest: float = 0.6
) -> Delay | None:
    """Delay of a signal against a reference.

    Args:
        times: times of the signal [s], shape (n,).
        signal: values, shape (n,).
        reference_times: times of the reference [s], increasing, shape (m,).
        reference: values, shape (m,).
        largest: largest lag looked at, both ways [s].

    Returns:
        The delay; None where either signal does not vary or there are fewer than fifty samples.
    """
    if times.size < _FEWEST or reference_times.size < _FEWEST:
        return None
    centred = signal - signal.mean()
    spread = float(np.sqrt(np.mean(centred**2)))
    if spread < 1e-9 or float(np.std(reference)) < 1e-9:  # noqa: PLR2004 - constant up to rounding
        return None
    lags = np.arange(-largest, largest + _STEP / 2.0, _STEP)
    scores = np.array(
        [_correlate(centred, spread, np.interp(times - lag, reference_times, reference)) for lag in lags]
    )
    best = int(np.argmax(np.abs(scores)))
    sign = np.sign(scores[best]) or 1.0
    tall = sign * scores
    if 0 < best < lags.size - 1:
        left, middle, right = tall[best - 1 : best + 2]
        bend = left - 2.0 * middle + right
        shift = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    else:
        bend, shift = 0.0, 0.0
    # What the signals do not share stays alike for about a second: seconds are counted, not samples.
    seconds = max(float(np.median(np.diff(times))) * times.size, 1.0)
    unshared = 1.0 - min(tall[best], 1.0) ** 2
    deviation = float(_STEP * np.sqrt(unshared / (seconds * -bend))) if bend < 0.0 else largest
    return Delay(float(lags[best] + shift * _STEP), float(scores[best]), deviation)


def _correlate(centred: Floats, spread: float, other: Floats) -> float:
    rest = other - other.mean()
    size = float(np.sqrt(np.mean(rest**2)))
    return float(np.mean(centred * rest)) / (spread * size) if size > 0.0 else 0.0
