"""Parallel work on cores and threads, its budget, a cache of recent results, and release of freed memory."""

from __future__ import annotations

import copyreg
import ctypes
import io
import math
import os
import pickle
import signal
import struct
import sys
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    from numpy.typing import NDArray


# Independent computations on two cores, with the same results in the same order as one after the other.
#
# Within `both_cores` a process forked from this one works in parallel, with a copy of its memory. If no fork
# is possible (one core, no Linux, a worker, a thread of a server), this process does all the work.

Item = TypeVar("Item")
Result = TypeVar("Result")

_NUMBER = struct.Struct("Q")
_END = 2**64 - 1
"""Index of no item: a process that reads it stops."""
_PIECES = 500
"""Number of indices that fit into any unread pipe: the smallest is a page of 4096 bytes."""
_DIE_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of <linux/prctl.h>."""


@dataclass
class _Beside:
    """The other process: its id, the connection to it, and a pipe from which both read the next index."""

    pid: int
    line: Connection
    waiting: int
    numbers: int
    shared: Sequence[object]

    def end(self) -> None:
        """Stop the other process; further calls have no effect."""
        pid, self.pid = self.pid, 0
        if not pid:
            return
        _at_hand.clear()
        _spent_s[:] = [sum(_spent_s), 0.0]
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        self.line.close()
        os.close(self.waiting)
        os.close(self.numbers)


_at_hand: list[_Beside] = []
_depth = [0]
_spent_s = [0.0, 0.0]


def measure_cpu() -> float:
    """CPU time of this process and of its parallel processes [s]."""
    return time.process_time() + sum(_spent_s)


@contextmanager
def both_cores(shared: Sequence[object]) -> Iterator[None]:
    """Let `map_parallel` use two processes.

    Libraries use one thread meanwhile: else their order of summation would depend on the number of cores.

    Args:
        shared: large objects referenced by functions, items and results, which are not copied.
    """
    from threadpoolctl import threadpool_limits  # noqa: PLC0415 - heavy

    with threadpool_limits(limits=1, user_api="blas"):
        beside = _fork(shared) if _may_fork() else None
        _depth[0] += 1
        try:
            yield
        finally:
            _depth[0] -= 1
            if beside is not None:
                beside.end()


def _may_fork() -> bool:
    from multiprocessing import parent_process  # noqa: PLC0415 - few need it

    return (
        sys.platform == "linux"
        and _depth[0] == 0
        and len(os.sched_getaffinity(0)) > 1
        and parent_process() is None
        and _is_main()
    )


def _is_main() -> bool:
    return threading.current_thread() is threading.main_thread()


def _fork(shared: Sequence[object]) -> _Beside | None:
    from multiprocessing.connection import Pipe  # noqa: PLC0415 - few need it

    parent = os.getpid()
    ends: list[int] = []
    try:
        ends += os.pipe()
        line, theirs = Pipe()
        pid = os.fork()
    except OSError:
        # The machine has no resources for another process.
        for end in ends:
            os.close(end)
        return None
    waiting, numbers = ends
    if pid == 0:
        try:
            _depth[0] = 1
            line.close()
            ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
            while os.getppid() == parent:
                function, items = _unpack(theirs.recv_bytes(), shared)
                results = dict(_take(function, items, waiting))
                theirs.send_bytes(_pack((results, time.process_time()), shared))
        finally:
            os._exit(0)
    theirs.close()
    _at_hand.append(_Beside(pid, line, waiting, numbers, shared))
    return _at_hand[0]


def map_parallel(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Results of a function for every item, computed in parallel where possible.

    Args:
        function: has no side effects that matter; if it cannot be pickled, this process does all the work.
        items: its arguments; the process that is free takes the next one.
    """
    results = _share(_at_hand[0], function, items) if len(items) > 1 and _is_main() and _at_hand else {}
    # What failed in the other process is repeated here, where its error is raised.
    return [results[n] if n in results else function(item) for n, item in enumerate(items)]


def _share(beside: _Beside, function: Callable[[Item], Result], items: Sequence[Item]) -> dict[int, Result]:
    """Results by index; none after a failure, which also ends the other process."""
    try:
        request = _pack((function, items), beside.shared)
    except (pickle.PicklingError, AttributeError, TypeError):
        return {}
    _at_hand.clear()
    try:
        numbers = (*range(min(len(items), _PIECES)), _END, _END)
        os.write(beside.numbers, b"".join(map(_NUMBER.pack, numbers)))
        beside.line.send_bytes(request)
        results = dict(_take(function, items, beside.waiting))
        theirs: dict[int, Result]
        theirs, _spent_s[1] = _unpack(beside.line.recv_bytes(), beside.shared)
    except BaseException as error:
        beside.end()
        if isinstance(error, Exception):
            return {}
        raise
    _at_hand.append(beside)
    return results | theirs


def _take(
    function: Callable[[Item], Result], items: Sequence[Item], waiting: int
) -> Iterator[tuple[int, Result]]:
    while (number := _NUMBER.unpack(os.read(waiting, _NUMBER.size))[0]) != _END:
        for n in range(number, len(items), _PIECES):
            yield n, function(items[n])


def _pack(content: object, shared: Sequence[object]) -> bytes:
    stream, places = io.BytesIO(), {id(one): index for index, one in enumerate(shared)}
    pickler = pickle.Pickler(stream, protocol=5)
    pickler.persistent_id = lambda one: places.get(id(one))  # type: ignore[method-assign]
    pickler.dispatch_table = {**copyreg.dispatch_table, np.ndarray: _reduce}
    pickler.dump(content)
    return stream.getvalue()


def _reduce(values: NDArray[Any]) -> Any:  # noqa: ANN401 - as pickle has it
    """Pickle an array with its memory layout: sums over its axes remain identical to the last bit."""
    if values.flags.forc:
        return values.__reduce_ex__(5)
    order = np.argsort(values.strides, kind="stable")[::-1]
    return np.transpose, (np.ascontiguousarray(values.transpose(order)), np.argsort(order).tolist())


def _unpack(content: bytes, shared: Sequence[object]) -> Any:  # noqa: ANN401 - whatever was packed
    unpickler = pickle.Unpickler(io.BytesIO(content))  # noqa: S301 - our own process packed it
    unpickler.persistent_load = lambda index: shared[index]  # type: ignore[method-assign]
    return unpickler.load()


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
        result = self._known.pop(key, None)
        if result is None:
            result = make()
        self._known[key] = result
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


_USUAL_S = 60.0
"""CPU time of a search [s] for `_FOR_S` of driving, and the least."""
_FOR_S = 600.0
"""Driving [s] that `_USUAL_S` is for."""


@dataclass
class Budget:
    """CPU time that a search may take; after it the best answer so far stands.

    Attributes:
        seconds: of CPU time of this process and of what works beside it.
        notify: called with the effects identified so far.
        was_cut: whether a search was ended by it.
    """

    seconds: float = math.inf
    notify: Callable[[str], None] | None = None
    was_cut: bool = False
    _started: float = field(default_factory=measure_cpu)

    @property
    def spent_s(self) -> float:
        """CPU time since it began [s]."""
        return measure_cpu() - self._started

    def is_spent(self) -> bool:
        """Whether it is used up: whoever asks ends then."""
        self.was_cut |= self.spent_s > self.seconds
        return self.was_cut

    def report(self, title: str, effects: Iterable[str]) -> None:
        """Report the effects identified on a part of the path."""
        if self.notify is not None:
            self.notify(f"{title}: {', '.join(effects) or 'none yet'} ({self.spent_s:.0f} s)")


def usual_budget(driven_s: float) -> float:
    """CPU time [s] for a run of so much driving [s]: a minute for ten minutes, and never less."""
    return max(_USUAL_S, _USUAL_S * driven_s / _FOR_S)


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
