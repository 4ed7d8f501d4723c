"""Processes of this machine: a log that crashes, hangs or eats memory costs itself and nothing else."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from typing import TYPE_CHECKING, cast

from pebble import ProcessExpired, ProcessPool

from pipeline.batch.executors import Blame, Settings
from pipeline.batch.memory import MemoryWatchdog
from pipeline.batch.work import work_safely

if TYPE_CHECKING:
    from concurrent.futures import Future

    from pipeline.batch.work import Report, Task

_TASKS_PER_WORKER = 500
"""A worker is replaced after so many logs: whatever leaks in a library stays small."""

_ORPHAN_PERIOD_S = 0.5
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "POLARS_MAX_THREADS")
"""What tells numeric libraries how many threads to take."""


def accepts(word: str) -> bool:
    """Whether ``--executor`` means this one."""
    return word == "local"


def open_executor(word: str, settings: Settings) -> LocalExecutor:
    """Start the processes."""
    del word
    return LocalExecutor(settings)


class LocalExecutor:
    """Worker processes, spawned so that nothing of this process leaks into them."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        # Spawned processes take the environment over; more threads than cores only get in each other's way.
        for variable in THREAD_VARIABLES:
            os.environ.setdefault(variable, "1")
        self._pool = ProcessPool(
            max_workers=settings.jobs,
            max_tasks=_TASKS_PER_WORKER,
            initializer=prepare_worker,
            initargs=(os.getpid(),),
            context=multiprocessing.get_context("spawn"),
        )
        self._watchdog = MemoryWatchdog(settings.memory_bytes)
        self._watchdog.start()

    @property
    def depth(self) -> int:
        """Two for each process, so that none waits for us."""
        return 2 * self._settings.jobs

    @property
    def spreads_blame(self) -> bool:
        """A process has one task."""
        return False

    def submit(self, task: Task) -> Future[Report]:
        """Work on a task some time."""
        future = self._pool.submit(work_safely, self._settings.timeout_s, self._settings.work, task)
        return cast("Future[Report]", future)

    def blame(self, task: Task, error: BaseException) -> Blame:
        """What the exception of a future means."""
        del task
        if isinstance(error, TimeoutError):
            return Blame("timed_out", f"it was not done within {self._settings.timeout_s:g} s", 1)
        if isinstance(error, ProcessExpired):
            held = self._watchdog.held_by(error.pid)
            if held is not None:
                limit = self._settings.memory_bytes / 1e9
                return Blame(
                    "out_of_memory", f"it held {held / 1e9:.2g} GB of memory, more than {limit:.2g} GB", 1
                )
            return Blame("worker_died", f"its process died ({describe_exit(error.exitcode)})", 1)
        return Blame("no_result", f"it gave no result: {type(error).__name__}: {error}", 1)

    def close(self) -> None:
        """End the workers, without waiting for unfinished tasks."""
        self._watchdog.stop()
        self._pool.stop()  # type: ignore[no-untyped-call]
        self._pool.join()


def describe_exit(code: int) -> str:
    """An exit code in words."""
    return f"signal {-code}" if code < 0 else f"exit code {code}"


def prepare_worker(parent: int) -> None:
    """End this process when the batch that it works for is killed."""
    threading.Thread(target=_die_with, args=(parent,), name="parent", daemon=True).start()


def _die_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_ORPHAN_PERIOD_S)
    os._exit(1)
