"""Doing independent reads on several threads with bounded memory."""

from __future__ import annotations

import os
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

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


def map_in_order(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """Apply ``function`` to every item; results in order, at most twice as many waiting as run.

    Args:
        function: called on other threads; with one thread it is called on this one.
        items: its arguments.
        threads: how many calls run at once.
    """
    if threads <= 1:
        for item in items:
            yield function(item)
        return
    with ThreadPoolExecutor(threads, thread_name_prefix="log") as pool:
        waiting: deque[Future[Result]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > 2 * threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
