"""Messages that stand in a recording more than once: doubled chunks, ranges that were copied into the file.

Two messages of one channel are the same when all bytes of their records are: number, times, content. Where
no two share their times, which is nearly always so, nothing is read for it.
"""

from collections.abc import Iterable, Mapping
from hashlib import blake2b
from typing import Final

import numpy as np

from pipeline.core.arrays import Ints
from pipeline.logs.messages import MESSAGE_OVERHEAD, Messages
from pipeline.logs.records import Buffer

Key = tuple[int, int, bytes]

_DIGEST: Final = 16

_MOST_ALIKE: Final = 1000
"""More messages with the same times are no copies: the clock that gave them stands still."""


def share_times(log_time: Ints, publish_time: Ints) -> Ints:
    """Numbers of the messages that share both times [ns] with a few others, ascending."""
    if (log_time[1:] > log_time[:-1]).all():
        return np.empty(0, dtype=np.int64)
    order = np.lexsort((publish_time, log_time))
    log, publish = log_time[order], publish_time[order]
    begins = np.append(True, (log[1:] != log[:-1]) | (publish[1:] != publish[:-1]))
    alike = np.diff(np.append(np.flatnonzero(begins), log.size))
    chosen = np.repeat((alike > 1) & (alike <= _MOST_ALIKE), alike)
    return np.sort(order[chosen])


def digest_messages(chunk: Buffer, messages: Messages, times: Mapping[int, Ints]) -> dict[int, list[Key]]:
    """Log time, publish time and digest of the messages logged at certain times, in the order of the file.

    Args:
        chunk: inflated records.
        messages: where its messages stand.
        times: by channel number the log times [ns] that are looked for, ascending.
    """
    found: dict[int, list[Key]] = {}
    view = memoryview(chunk)
    for number, wanted in times.items():
        chosen = np.flatnonzero(messages.channel == number)
        log = messages.log_time[chosen]
        chosen = chosen[wanted[np.minimum(np.searchsorted(wanted, log), wanted.size - 1)] == log]
        start = messages.start[chosen] - MESSAGE_OVERHEAD
        spans = zip(start.tolist(), (messages.start + messages.size)[chosen].tolist(), strict=True)
        digests = [blake2b(view[low:high], digest_size=_DIGEST).digest() for low, high in spans]
        log, publish = messages.log_time[chosen].tolist(), messages.publish_time[chosen].tolist()
        found[number] = list(zip(log, publish, digests, strict=True))
    return found


def find_repeated(keys: Iterable[Key]) -> list[int]:
    """Positions of those that stood there before."""
    seen: set[Key] = set()
    repeated = []
    for position, key in enumerate(keys):
        if key in seen:
            repeated.append(position)
        seen.add(key)
    return repeated
