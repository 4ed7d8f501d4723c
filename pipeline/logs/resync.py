"""Finding the next record after damage.

Every byte may be the start of a record. A place is taken when its opcode and length are possible and the
records that follow from it are possible too, several in a row or up to the very end.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

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

_SEARCH: Final = 16
"""Units of effort of a search, which are for its first block; a place that is tried takes one."""

_LEAST_EFFORT: Final = 1 << 6
"""Units for any chunk: four places of damage are looked behind in the smallest."""


@dataclass(slots=True)
class Effort:
    """How much longer records are searched for in a chunk.

    It grows with the bytes that are stored, as damage does, and not with what they inflate to: that costs
    nothing to whoever writes a file that shall take long. A unit takes about 2 us.

    Attributes:
        left: units.
    """

    left: int

    @classmethod
    def for_bytes(cls, stored: int) -> Self:
        """What so many stored bytes are worth."""
        return cls(_LEAST_EFFORT + stored // 2)

    def spend(self, units: int) -> bool:
        """Whether there was so much left."""
        self.left -= units
        return self.left >= 0


def find_record(buffer: Buffer, start: int, end: int, opcodes: Sequence[int], effort: Effort) -> int:
    """The next place from ``start`` where records go on, ``end`` when there is none.

    Args:
        buffer: bytes in memory.
        start: first place to try.
        end: where the records must end.
        opcodes: kinds of record that may stand there.
        effort: how long to search.
    """
    data = np.frombuffer(buffer, dtype=np.uint8)
    low, block = start, FIRST_BLOCK
    if not effort.spend(_SEARCH):
        return end
    while low <= end - rec.HEAD_SIZE:
        high = min(low + block, end - rec.HEAD_SIZE + 1)
        for place in possible_places(data, low, high, end, opcodes).tolist():
            if not effort.spend(1):
                return end
            if _goes_on(buffer, place, end, opcodes):
                return int(place)
        low, block = high, min(2 * block, LAST_BLOCK)
    return end


def possible_places(data: NDArray[np.uint8], low: int, high: int, end: int, opcodes: Sequence[int]) -> Ints:
    """Places in [low, high) whose opcode and length are possible for a record that ends by ``end``."""
    least = np.full(256, np.iinfo(np.int64).max, dtype=np.int64)
    for opcode in opcodes:
        least[opcode] = rec.LEAST_BODY[opcode]
    first = min(opcodes)
    # Most bytes are no opcode: lengths are looked at only behind those that may be one.
    places = np.flatnonzero(data[low:high] - np.uint8(first) <= np.uint8(max(opcodes) - first)) + low
    heads: NDArray[np.uint64] = np.ndarray((data.size - 8,), "<u8", data, offset=1, strides=(1,))
    length = heads[places]
    room = (end - rec.HEAD_SIZE - places).astype(np.uint64)
    return places[(length <= room) & (length >= least[data[places]].astype(np.uint64))]


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
