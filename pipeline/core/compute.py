"""Work on several threads, the budget of a search, a cache of recent results, release of freed memory."""

import ctypes
import math
import os
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Generic, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class Newest(Generic[Result]):
    """Cache of the most recent results.

    Args:
        most: maximum number of results.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._known: OrderedDict[Hashable, Result] = OrderedDict()

    def recall(self, key: Hashable, make: Callable[[], Result]) -> Result:
        """The cached result of a key, computed if it is missing."""
        result = self.find(key)
        return self.keep(key, make()) if result is None else result

    def find(self, key: Hashable) -> Result | None:
        """The cached result of a key, which is then the newest; None if it is missing."""
        if key in self._known:
            self._known.move_to_end(key)
        return self._known.get(key)

    def keep(self, key: Hashable, result: Result) -> Result:
        """Cache a result in place of an earlier one of its key, and return it."""
        self._known[key] = result
        self._known.move_to_end(key)
        while len(self._known) > self._most:
            self._known.popitem(last=False)
        return result


def return_freed_memory() -> None:
    """Return freed memory to the operating system, if the C library can.

    Columns of a log are many small allocations of several threads: the free memory between them, up to half
    of what was read, otherwise remains with the process.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


@dataclass
class Budget:
    """CPU time that a search may take; after it the best answer so far stands.

    Attributes:
        seconds: of CPU time of this process.
        notify: called with the effects identified so far.
        was_cut: whether a search was ended by it.
    """

    seconds: float = math.inf
    notify: Callable[[str], None] | None = None
    was_cut: bool = False
    _started: float = field(default_factory=time.process_time)

    @property
    def spent_s(self) -> float:
        """CPU time since it began [s]."""
        return time.process_time() - self._started

    def is_spent(self) -> bool:
        """Whether it is used up: whoever asks ends then."""
        self.was_cut |= self.spent_s > self.seconds
        return self.was_cut

    def report(self, title: str, effects: Iterable[str]) -> None:
        """Report the effects identified on a part of the path."""
        if self.notify is not None:
            self.notify(f"{title}: {', '.join(effects) or 'none yet'} ({self.spent_s:.0f} s)")


def usable_threads() -> int:
    """Number of threads that this process may use.

    This is the number of cores it may run on, or ``POLARS_MAX_THREADS`` if that is less: a caller that runs
    many processes at once sets it to limit each of them.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    limit = os.environ.get("POLARS_MAX_THREADS", "")
    return max(1, min(cores, int(limit))) if limit.isdigit() else cores


def map_in_order(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    threads: int,
    *,
    weigh: Callable[[Item], int] = lambda _item: 0,
    limit: int = 0,
) -> Iterator[Result]:
    """Apply ``function`` to every item; yields results in order, about two per thread waiting at most.

    Args:
        function: called on other threads; with one thread it is called on this one.
        items: its arguments.
        threads: number of calls that run at once.
        weigh: weight of an item, from the start of its processing until its result has been used.
        limit: maximum total weight at once; an item that exceeds it is processed alone.
    """
    if threads <= 1:
        for item in items:
            yield function(item)
        return
    with ThreadPoolExecutor(threads, thread_name_prefix="log") as pool:
        waiting: deque[tuple[Future[Result], int]] = deque()
        held = 0
        try:
            for item in items:
                weight = weigh(item)
                while waiting and (len(waiting) > 2 * threads or held + weight > limit):
                    # The caller uses a yielded result until it asks for the next one.
                    future, freed = waiting.popleft()
                    yield future.result()
                    held -= freed
                waiting.append((pool.submit(function, item), weight))
                held += weight
            while waiting:
                yield waiting.popleft()[0].result()
        finally:
            for future, _ in waiting:
                future.cancel()
