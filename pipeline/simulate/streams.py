"""Independent streams of random numbers, one a purpose, all from one seed."""

from __future__ import annotations

import zlib

import numpy as np


def open_stream(seed: int, purpose: str) -> np.random.Generator:
    """A generator that depends on the seed and the purpose alone.

    A sensor or an effect that is added leaves every other purpose's numbers as they were.
    """
    return np.random.default_rng([seed, zlib.crc32(purpose.encode())])
