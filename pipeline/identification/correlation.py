"""What system identification asks of residuals: do they repeat themselves, do they follow the input?

Residuals of a model that lacks nothing are white and uncorrelated with its input (Ljung, System
Identification, section 16.6). Windows that overlap share data: only lags of whole windows are looked at.
"""

from collections.abc import Sequence

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.core.numbers import NORMAL_95
from pipeline.runs.windows import WINDOW_S

LONGEST_S = 5.0
FEWEST = 40

_CLIP = 6.0


def autocorrelate(times: Floats, residual: Floats) -> tuple[Floats, Floats, float]:
    """Autocorrelation over lags up to `LONGEST_S`.

    Args:
        times: middles of the windows [s], increasing, shape (n,).
        residual: at the windows, shape (n,); pairs across a hole take no part.

    Returns:
        Lags [s] and correlations, shape (k,) each, the first at lag zero, and the bound that 95 % of white
        noise would keep.
    """
    values = _standardise(residual)
    lags, found = _correlate(times, values, values, range(_longest(times) + 1))
    return lags, found, NORMAL_95 / np.sqrt(_count_apart(times))


def cross_correlate(times: Floats, signal: Floats, residual: Floats) -> tuple[Floats, Floats, float]:
    """Correlation of a residual with the input that many seconds before it; behind zero, after it.

    Args:
        times: middles of the windows [s], increasing, shape (n,).
        signal: the input at the windows, shape (n,).
        residual: at the windows, shape (n,).

    Returns:
        Lags [s] from `-LONGEST_S` to `LONGEST_S` and correlations, shape (k,) each, and the bound that 95 %
        of residuals would keep that repeat themselves as this one does and know nothing of the input
        (Bartlett).
    """
    given, values = _standardise(signal, clip=False), _standardise(residual)
    longest = _longest(times)
    lags, found = _correlate(times, given, values, range(-longest, longest + 1))
    own = [_correlate(times, one, one, range(longest + 1))[1] for one in (given, values)]
    size = min(one.size for one in own)
    repeated = 1.0 + 2.0 * float(np.sum(own[0][1:size] * own[1][1:size])) if size else 1.0
    return lags, found, float(NORMAL_95 * np.sqrt(max(repeated, 1.0) / _count_apart(times)))


def _standardise(values: Floats, *, clip: bool = True) -> Floats:
    """Centred, of mean square one; lone outliers held to six robust standard deviations."""
    centred = values - (np.median(values) if clip else values.mean())
    if clip:
        limit = _CLIP * 1.4826 * float(np.median(np.abs(centred))) + 1e-12
        centred = np.clip(centred, -limit, limit)
    scaled: Floats = centred / np.sqrt(float(np.mean(centred**2)) + 1e-24)
    return scaled


def _stride(times: Floats) -> int:
    """Windows from one to the next that does not overlap it."""
    return max(round(WINDOW_S / float(np.median(np.diff(times)))), 1)


def _longest(times: Floats) -> int:
    return int(LONGEST_S / float(np.median(np.diff(times)))) // _stride(times)


def _count_apart(times: Floats) -> float:
    return times.size / _stride(times)


def _correlate(times: Floats, before: Floats, after: Floats, lags: Sequence[int]) -> tuple[Floats, Floats]:
    """Mean products of windows and of those that many strides later, for lags with enough pairs."""
    stride, step = _stride(times), float(np.median(np.diff(times)))
    found = []
    for lag in lags:
        shift = abs(lag) * stride
        if shift >= times.size:
            continue
        early, late = slice(None, times.size - shift), slice(shift, None)
        if lag < 0:
            early, late = late, early
        together = np.abs(np.abs(times[late] - times[early]) - shift * step) < 0.5 * step
        if int(together.sum()) >= FEWEST // 2:
            found.append((lag * stride * step, float(np.mean((before[early] * after[late])[together]))))
    table = np.array(found, dtype=np.float64).reshape(-1, 2)
    return table[:, 0], table[:, 1]
