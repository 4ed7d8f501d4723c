"""Independent streams of random numbers, one a purpose, all from one seed."""

import zlib

import numpy as np

from pipeline.core.arrays import Floats


def open_stream(seed: int, purpose: str) -> np.random.Generator:
    """A generator that depends on the seed and the purpose alone.

    A sensor or an effect that is added leaves every other purpose's numbers as they were.
    """
    return np.random.default_rng([seed, zlib.crc32(purpose.encode())])


def spread_times(count: int, *, duration_s: float, generator: np.random.Generator) -> Floats:
    """One random time [s] in each of ``count`` equal parts of the middle 80 %, so that faults stay apart."""
    part = 0.8 * duration_s / max(count, 1)
    return 0.1 * duration_s + (np.arange(count) + generator.uniform(0.2, 0.8, count)) * part
