"""Serialized messages waiting for their place in time: in memory, beyond a limit in a temporary file."""

from __future__ import annotations

import mmap
import tempfile
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.logs.records import Buffer

    Ints = NDArray[np.int64]

IN_MEMORY: Final = 256 << 20
"""Bytes of messages that are kept in memory."""


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Message records of one chunk by log time.

    Attributes:
        records: end to end.
        channel: number of each message's channel, int64, shape (n,).
        log_time: [ns], int64.
        offset: where each record starts in ``records``, int64.
    """

    records: bytes
    channel: Ints
    log_time: Ints
    offset: Ints


class Spool:
    """Collects message records in any order, gives them back by log time.

    Args:
        beside: a temporary file is made in this file's folder when memory does not suffice.
        limit: bytes that are kept in memory.
    """

    def __init__(self, beside: Path, *, limit: int = IN_MEMORY) -> None:
        self._beside = beside
        self._limit = limit
        self._memory = bytearray()
        self._file: tempfile._TemporaryFileWrapper[bytes] | None = None
        self._size = 0
        self._start: list[Ints] = []
        self._length: list[Ints] = []
        self._channel: list[Ints] = []
        self._log: list[Ints] = []

    def add(self, records: NDArray[np.uint8], channel: int, log_time: Ints) -> None:
        """Keep message records, one a row of (n, length) bytes."""
        count, length = records.shape
        self._start.append(self._size + np.arange(count) * length)
        self._length.append(np.full(count, length))
        self._channel.append(np.full(count, channel))
        self._log.append(log_time)
        self._size += records.size
        self._memory += records.reshape(-1).data
        if len(self._memory) > self._limit:
            self._spill()

    def _spill(self) -> None:
        if self._file is None:
            folder, prefix = self._beside.parent, f".{self._beside.name}."
            self._file = tempfile.NamedTemporaryFile(dir=folder, prefix=prefix)  # noqa: SIM115 - closed later
        self._file.write(self._memory)
        self._memory = bytearray()

    def batches(self, size: int, before: int | None = None) -> Iterator[Batch]:
        """Take messages out in batches of about ``size`` bytes, by log time, then in the order of adding.

        Args:
            size: bytes in a batch.
            before: take only what was logged before this time [ns], and only batches that are full; the rest
                stays. By default everything.
        """
        empty = np.empty(0, dtype=np.int64)
        log = np.concatenate([empty, *self._log])
        order = np.argsort(log, kind="stable")
        start = np.concatenate([empty, *self._start])[order]
        length = np.concatenate([empty, *self._length])[order]
        channel = np.concatenate([empty, *self._channel])[order]
        log = log[order]
        until = np.cumsum(length)
        number = (until - length) // max(size, 1)
        count = log.size
        if before is not None:
            ready = int(np.searchsorted(log, before))
            # The last of those ready may have to share its batch with what is still to come.
            count = int(np.searchsorted(number, number[ready - 1])) if ready else 0
        data = np.frombuffer(self._stored(), dtype=np.uint8)
        self._keep(data, order[count:], start[count:], length[count:], channel[count:], log[count:])
        cuts = np.flatnonzero(np.diff(number[:count])) + 1
        for low, high in zip([0, *cuts.tolist()], [*cuts.tolist(), count], strict=True):
            if high > low:
                part = slice(low, high)
                offset = until[part] - length[part] - (until[low] - length[low])
                records = _gather(data, start[part], length[part], offset)
                yield Batch(records, channel[part], log[part], offset)

    def _keep(
        self,
        data: NDArray[np.uint8],
        order: Ints,
        start: Ints,
        length: Ints,
        channel: Ints,
        log: Ints,
    ) -> None:
        """Hold nothing but these messages, in the order in which they were added."""
        self._forget()
        added = np.argsort(order)
        length = length[added]
        offset = np.cumsum(length) - length
        if added.size:
            self._memory += _gather(data, start[added], length, offset)
            self._size = len(self._memory)
            self._start, self._length = [offset], [length]
            self._channel, self._log = [channel[added]], [log[added]]
        if len(self._memory) > self._limit:
            self._spill()

    def _forget(self) -> None:
        # What is being given out is still read from the old memory, or from the file's pages.
        if self._file is not None:
            self._file.close()
        self._memory, self._size, self._file = bytearray(), 0, None
        self._start, self._length, self._channel, self._log = [], [], [], []

    def _stored(self) -> Buffer | mmap.mmap:
        if self._file is None:
            return bytes(1) if not self._memory else memoryview(self._memory)
        self._spill()
        self._file.flush()
        return mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)

    def close(self) -> None:
        """Give memory and file back."""
        self._memory = bytearray()
        if self._file is not None:
            self._file.close()


def _gather(data: NDArray[np.uint8], start: Ints, length: Ints, offset: Ints) -> bytes:
    joined = np.empty(int(length.sum()), dtype=np.uint8)
    order = np.argsort(length, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(length[order])) + 1):
        size = int(length[rows[0]])
        shape = (data.size - size + 1,)
        source: NDArray[np.void] = np.ndarray(shape, f"V{size}", buffer=data.data, strides=(1,))
        target: NDArray[np.void] = np.ndarray(
            (joined.size - size + 1,), f"V{size}", buffer=joined.data, strides=(1,)
        )
        target[offset[rows]] = source[start[rows]]
    return joined.tobytes()
