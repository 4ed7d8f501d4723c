"""Putting the decoded pieces of a field together as one column."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.logs.columns import Ragged, RaggedStrings, Strings
from pipeline.logs.decode import take_ragged

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.logs.cdr import Vocabulary
    from pipeline.logs.columns import Column
    from pipeline.logs.decode import Leaf, Piece

    Ints = NDArray[np.int64]


class ColumnParts:
    """The pieces of one field, in the order they were decoded.

    Args:
        leaf: the field.
    """

    def __init__(self, leaf: Leaf) -> None:
        self._leaf = leaf
        self._pieces: list[Piece] = []

    def add(self, piece: Piece) -> None:
        """Take the values of the next rows."""
        self._pieces.append(piece)

    def take_column(self, order: Ints, vocabulary: Vocabulary | None) -> Column:
        """The column of some rows; gives the pieces up, so that memory holds every value about once.

        Args:
            order: places of the rows among those that were added.
            vocabulary: of a string field.
        """
        values = np.concatenate([self._leaf.nothing, *(piece.values for piece in self._pieces)])
        counts = [piece.counts for piece in self._pieces if piece.counts is not None]
        self._pieces = []
        texts = () if vocabulary is None else vocabulary.texts()
        if not self._leaf.ragged:
            values = _take(values, order)
            return Strings(values.astype(np.int32, copy=False), texts) if self._leaf.text else values
        count = np.concatenate([np.empty(0, dtype=np.int64), *counts])
        if not _is_plain(order, count.size):
            values = take_ragged(values, count, order)
        offsets = np.r_[0, np.cumsum(count[order])]
        if self._leaf.text:
            return RaggedStrings(values.astype(np.int32, copy=False), texts, offsets)
        return Ragged(values, offsets)


def _take(values: NDArray[np.generic], order: Ints) -> NDArray[np.generic]:
    return values if _is_plain(order, values.shape[0]) else values[order]


def _is_plain(order: Ints, size: int) -> bool:
    return order.size == size and bool((order == np.arange(size)).all())
