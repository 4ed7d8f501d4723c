"""Finding the next record after damage.

Every byte may be the start of a record. A place is taken when its opcode and length are possible and the
records that follow from it are possible too, several in a row or up to the very end.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pipeline.core.arrays import Ints
from pipeline.logs import records as rec
from pipeline.logs.records import Buffer

_CHAIN: Final = 4
"""Records in a row that must be possible; a random place passes one with a chance below 1e-4."""

FIRST_BLOCK: Final = 1 << 12
LAST_BLOCK: Final = 1 << 20
"""A search looks at little first and at ever more, so that dense damage does not make it slow."""


def find_record(buffer: Buffer, start: int, end: int, opcodes: Sequence[int]) -> int:
    """The next place from ``start`` where records go on, ``end`` when there is none.

    Args:
        buffer: bytes in memory.
        start: first place to try.
        end: where the records must end.
        opcodes: kinds of record that may stand there.
    """
    data = np.frombuffer(buffer, dtype=np.uint8)
    low, block = start, FIRST_BLOCK
    while low <= end - rec.HEAD_SIZE:
        high = min(low + block, end - rec.HEAD_SIZE + 1)
        for place in possible_places(data, low, high, end, opcodes).tolist():
            if _goes_on(buffer, place, end, opcodes):
                return int(place)
        low, block = high, min(2 * block, LAST_BLOCK)
    return end


def possible_places(data: NDArray[np.uint8], low: int, high: int, end: int, opcodes: Sequence[int]) -> Ints:
    """Places in [low, high) whose opcode and length are possible for a record that ends by ``end``."""
    least = np.full(256, np.iinfo(np.int64).max, dtype=np.int64)
    for opcode in opcodes:
        least[opcode] = rec.LEAST_BODY[opcode]
    window = data[low : high + rec.HEAD_SIZE - 1]
    shape = (high - low,)
    opcode_here = window[: high - low]
    length: NDArray[np.uint64] = np.ndarray(shape, "<u8", buffer=window.data, offset=1, strides=(1,))
    room = np.uint64(end - rec.HEAD_SIZE) - np.arange(low, high, dtype=np.uint64)
    fits = (length <= room) & (length >= least[opcode_here].astype(np.uint64))
    return np.flatnonzero(fits) + low


def _goes_on(buffer: Buffer, place: int, end: int, opcodes: Sequence[int]) -> bool:
    for _ in range(_CHAIN):
        if place == end:
            return True
        if place + rec.HEAD_SIZE > end:
            return False
        opcode, length = rec.HEAD.unpack_from(buffer, place)
        if opcode not in opcodes or length < rec.LEAST_BODY[opcode]:
            return False
        place += rec.HEAD_SIZE + length
        if place > end:
            return False
    return True
