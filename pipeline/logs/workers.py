"""Doing independent reads on several threads with bounded memory."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def usable_threads() -> int:
    """How many threads this process may keep busy.

    The cores it may run on, or fewer where ``POLARS_MAX_THREADS`` says so: who runs many processes at once
    limits with it what each does to its data.
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
    """Apply ``function`` to every item; results in order, at most twice as many waiting as run.

    Args:
        function: called on other threads; with one thread it is called on this one.
        items: its arguments.
        threads: how many calls run at once.
        weigh: what an item takes while it is worked on and until its result has been used.
        limit: most weight at once; an item that is heavier alone is worked on alone.
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
                    # What is given out is held by the caller until it asks for more.
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
