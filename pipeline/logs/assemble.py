"""Putting the decoded pieces of a field together as one column."""

from typing import Final, Generic

import numpy as np
from numpy.typing import NDArray

from pipeline.core.arrays import Ints
from pipeline.logs.cdr import Vocabulary
from pipeline.logs.columns import Column, Ragged, RaggedStrings, Scalar, Strings
from pipeline.logs.decode import Leaf, Piece, take_ragged

_FIRST_CAPACITY: Final = 64 << 20
"""Most bytes that are set aside for a column because the index promises so many messages."""


class ColumnParts:
    """The values of one field, in the order they are decoded.

    Args:
        leaf: the field.
        expected: how many rows will come, as far as the index knows.
    """

    def __init__(self, leaf: Leaf, expected: int) -> None:
        self._leaf = leaf
        self._expected = expected
        self._values = _Growing(leaf.nothing)
        self._counts = _Growing(np.empty(0, dtype=np.int64))

    def add(self, piece: Piece) -> None:
        """Copy the values of the next rows."""
        rows = piece.values.shape[0] if piece.counts is None else piece.counts.size
        share = self._expected / max(rows, 1)
        self._values.append(piece.values, share)
        if piece.counts is not None:
            self._counts.append(piece.counts, share)

    def take_column(self, order: Ints, vocabulary: Vocabulary | None) -> Column:
        """The column of some rows; to be asked once, the values are given up.

        Args:
            order: places of the rows among those that were added.
            vocabulary: of a string field.
        """
        values, count = self._values.give_up(), self._counts.give_up()
        texts = () if vocabulary is None else vocabulary.texts()
        if not self._leaf.ragged:
            values = _take(values, order)
            return Strings(values.astype(np.int32, copy=False), texts) if self._leaf.text else values
        if not _is_plain(order, count.size):
            values = take_ragged(values, count, order)
        offsets = np.append(0, np.cumsum(count[order]))
        if self._leaf.text:
            return RaggedStrings(values.astype(np.int32, copy=False), texts, offsets)
        return Ragged(values, offsets)


class _Growing(Generic[Scalar]):
    """An array that is appended to; what was read from a file never decides how much memory it takes."""

    def __init__(self, nothing: NDArray[Scalar]) -> None:
        self._nothing = nothing
        self._data = nothing
        self._size = 0

    def append(self, values: NDArray[Scalar], share: float) -> None:
        """Append values; in all about ``share`` times as many are expected."""
        need = self._size + values.shape[0]
        if need > self._data.shape[0]:
            row = max(1, self._nothing.dtype.itemsize * int(np.prod(self._nothing.shape[1:])))
            promised = int(min(values.shape[0] * share, _FIRST_CAPACITY // row))
            capacity = max(need, promised, 2 * self._data.shape[0] if self._size else 0)
            grown = np.empty((capacity, *self._nothing.shape[1:]), dtype=self._nothing.dtype)
            grown[: self._size] = self._data[: self._size]
            self._data = grown
        self._data[self._size : need] = values
        self._size = need

    def give_up(self) -> NDArray[Scalar]:
        """All values; none are kept."""
        values, self._data, self._size = self._data[: self._size], self._nothing, 0
        return values


def _take(values: NDArray[np.generic], order: Ints) -> NDArray[np.generic]:
    return values if _is_plain(order, values.shape[0]) else values[order]


def _is_plain(order: Ints, size: int) -> bool:
    return order.size == size and bool((order == np.arange(size)).all())
