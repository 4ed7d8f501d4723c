"""A stored table read once, from its beginning to its end, one stretch of time after the other."""

from collections.abc import Iterator

import polars as pl


class Feed:
    """Rows by time, of which only the stretch asked for is in memory.

    Args:
        batches: a table's rows in pieces, by time.
        key: the column that orders them.
    """

    def __init__(self, batches: Iterator[pl.DataFrame], key: str) -> None:
        self._batches = batches
        self._key = key
        self._held: list[pl.DataFrame] = []
        self._is_empty = False

    def take(self, low: float, high: float) -> pl.DataFrame | None:
        """The rows from ``low`` until before ``high``; what lies before ``low`` is let go.

        Args:
            low: start of the stretch; no earlier than at the call before.
            high: its end.

        Returns:
            The rows; None where there are none.
        """
        while not self._is_empty and not (self._held and self._held[-1][self._key][-1] >= high):
            batch = next(self._batches, None)
            if batch is None:
                self._is_empty = True
            elif not batch.is_empty():
                self._held.append(batch)
        self._held = [frame for frame in self._held if frame[self._key][-1] >= low]
        key = pl.col(self._key)
        found = [frame.filter((key >= low) & (key < high)) for frame in self._held]
        found = [frame for frame in found if not frame.is_empty()]
        return pl.concat(found) if found else None
