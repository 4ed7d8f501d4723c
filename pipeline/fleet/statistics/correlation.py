"""How long slip remembers: integrated autocorrelation time, blocks, and the samples that count."""

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core.arrays import Floats, Ints
from pipeline.fleet.statistics.arrays import check_values

_FEWEST_PAIRS = 20
_LONGEST_SHARE = 0.25
_WINDOW = 3.0
TIMES_PER_BLOCK = 5.0


def integrated_time(values: ArrayLike, ticks: ArrayLike) -> float:
    """Integrated autocorrelation time tau = 1 + 2 sum of rho_k, in grid steps; at least one.

    The mean of n samples scatters as that of n / tau independent ones. The sum ends at the first lag that is
    3 tau long (Sokal 1997), or where the correlation is no longer positive. Samples that are missing, in
    gaps between segments for example, are left out pair by pair.

    Args:
        values: samples, shape (n,).
        ticks: number of each sample on the uniform grid, ascending, shape (n,).

    Raises:
        StatisticsError: a value is not finite, or there are fewer than two.
    """
    samples = check_values(values, what="samples", fewest=2)
    index = np.asarray(ticks, dtype=np.int64) - int(np.asarray(ticks)[0])
    span = int(index[-1]) + 1
    size = 1 << (2 * span - 1).bit_length()
    filled, there = np.zeros(span), np.zeros(span)
    filled[index], there[index] = samples - samples.mean(), 1.0
    products, pairs = _autocorrelate(filled, size)[:span], _autocorrelate(there, size)[:span]
    if products[0] <= 0.0:
        return 1.0
    variance = products[0] / pairs[0]
    tau = 1.0
    for lag in range(1, max(int(span * _LONGEST_SHARE), 2)):
        if lag >= span or pairs[lag] < _FEWEST_PAIRS:
            break
        rho = products[lag] / pairs[lag] / variance
        if rho <= 0.0 or lag > _WINDOW * tau:
            break
        tau += 2.0 * float(rho)
    return tau


def number_blocks(ticks: ArrayLike, pieces: ArrayLike, length: float) -> Ints:
    """Cut samples into blocks of about ``length`` grid steps; no block crosses the end of a piece.

    A piece is cut into as many equal blocks of at least that length as fit; a shorter one is a block.

    Args:
        ticks: number of each sample on the uniform grid, ascending, shape (n,).
        pieces: number of the segment or stretch of each sample, shape (n,).
        length: shortest block wanted [grid steps].

    Returns:
        Block numbers from zero, shape (n,).
    """
    index = np.asarray(ticks, dtype=np.int64)
    if not index.size:
        return np.zeros(0, dtype=np.int64)
    _, piece = np.unique(np.asarray(pieces), return_inverse=True)
    first = np.full(piece.max() + 1, np.iinfo(np.int64).max)
    last = np.full(piece.max() + 1, np.iinfo(np.int64).min)
    np.minimum.at(first, piece, index)
    np.maximum.at(last, piece, index)
    span = (last - first + 1).astype(np.float64)
    count = np.maximum(np.floor(span / max(length, 1.0)), 1.0).astype(np.int64)
    within = ((index - first[piece]) * count[piece] / span[piece]).astype(np.int64)
    offset = np.concatenate(([0], np.cumsum(count)[:-1]))
    _, block = np.unique(offset[piece] + within, return_inverse=True)
    return block.astype(np.int64)


def _autocorrelate(signal: Floats, size: int) -> Floats:
    spectrum = np.fft.rfft(signal, size)
    return np.fft.irfft(spectrum * np.conj(spectrum), size)
