"""Executors of logs: this process, or worker processes on this machine.

An executor takes tasks and returns `concurrent.futures.Future`; the runner uses nothing else of it.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Protocol, cast

from pebble import ProcessExpired, ProcessPool

from pipeline.batch.batch_work import MemoryWatchdog, Report, Task, work_safely
from pipeline.batch.request import BatchError
from pipeline.core.program import THREAD_VARIABLES, end_with, keep_current_folder_out, silence_warnings


@dataclass(frozen=True)
class Settings:
    """Settings of an executor.

    Attributes:
        jobs: number of parallel tasks.
        timeout_s: time limit of a task [s].
        memory_bytes: memory limit of a task.
        work: function to call with a task; importable by its name in a fresh process.
    """

    jobs: int
    timeout_s: float
    memory_bytes: int
    work: Callable[[Task], Report]


@dataclass(frozen=True)
class Blame:
    """Reason why a task has no report.

    Attributes:
        code: ``worker_died``, ``timed_out``, ``out_of_memory``, ``no_result``, ...
        reason: one sentence without a full stop.
        kills: number of workers lost to the task.
    """

    code: str
    reason: str
    kills: int


class Executor(Protocol):
    """Interface of the executors."""

    depth: int
    """Preferred number of submitted tasks, including waiting ones."""
    spreads_blame: bool
    """Whether a dying worker may implicate innocent tasks; suspects are then tried alone."""

    def expect(self, tasks: int) -> None:
        """Prepare for this number of tasks, which will certainly be submitted."""

    def submit(self, task: Task) -> Future[Report]:
        """Submit a task."""

    def blame(self, task: Task, error: BaseException) -> Blame:
        """Interpret the exception of a future."""

    def close(self) -> None:
        """End the workers, without waiting for unfinished tasks."""


class InlineExecutor:
    """This process, one log after the other: for debugging, and where processes cannot be started.

    There is no isolation: a log that crashes, hangs or exhausts the memory ends the batch.
    """

    depth = 1
    # No other task can be blamed.
    spreads_blame = False

    def __init__(self, settings: Settings) -> None:
        self._work = settings.work

    def expect(self, tasks: int) -> None:
        """Do nothing: no preparation is needed."""

    def submit(self, task: Task) -> Future[Report]:
        """Work on a task immediately."""
        future: Future[Report] = Future()
        future.set_result(work_safely(self._work, task))
        return future

    def blame(self, task: Task, error: BaseException) -> Blame:
        """Interpret the exception of a future; a log raises none."""
        del task
        return Blame("no_result", f"it gave no result: {type(error).__name__}: {error}", 0)

    def close(self) -> None:
        """Do nothing: there are no workers."""


_TASKS_PER_WORKER = 2000
"""Number of logs after which a worker is replaced: limits memory leaks of libraries."""

_LOOK_PERIOD_S = 0.25
_LOOKS_UNTIL_DEAD = 4
"""Number of polls after which a process counts as dead: a working pool has reported its death by then."""

_END_S = 5.0
"""Time within which a killed process has ended [s]."""


class LocalExecutor:
    """Worker processes, spawned so that they inherit nothing from this process.

    Every process is a separate pool with one task at a time. In a shared pool, a process that dies before the
    pool knows its task breaks the pool or leaves the task waiting forever, and one that dies with the lock of
    the common pipe blocks the others. With separate pools a death has one possible cause and ends only its
    own pool, and it is detected from the process itself.
    """

    # A process has only one task.
    spreads_blame = False

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.depth = settings.jobs
        # Spawned processes inherit the environment; more threads than cores slow each other down.
        for variable in THREAD_VARIABLES:
            os.environ.setdefault(variable, "1")
        keep_current_folder_out()
        self._workers: list[_Worker] = []
        self._ended: list[_Worker] = []
        self._watchdog = MemoryWatchdog(settings.memory_bytes)
        self._watchdog.start()
        self._closing = threading.Event()
        self._supervisor = threading.Thread(target=self._look_after_workers, name="supervisor", daemon=True)
        self._supervisor.start()

    def expect(self, tasks: int) -> None:
        """Start the processes, which load their libraries while their work is still being planned.

        Raises:
            BatchError: ``no_workers``.
        """
        for _ in range(min(self._settings.jobs, tasks) - len(self._workers)):
            self._start_worker()

    def submit(self, task: Task) -> Future[Report]:
        """Work on a task.

        Raises:
            BatchError: ``no_workers``, a process cannot be started.
        """
        while True:
            free = [worker for worker in self._workers if not worker.is_busy] or [self._start_worker()]
            worker = min(free, key=lambda worker: not worker.is_ready)
            worker.wait_until_ready()
            try:
                if worker.count < _TASKS_PER_WORKER:
                    return worker.begin(self._settings, task)
            except RuntimeError:
                # It died while it was idle.
                pass
            self._end_worker(worker)

    def blame(self, task: Task, error: BaseException) -> Blame:
        """Interpret the exception of a future."""
        if not isinstance(error, TimeoutError | ProcessExpired | BrokenProcessPool):
            return Blame("no_result", f"it gave no result: {type(error).__name__}: {error}", 1)
        # A worker that died may have been offered the next task before this call, and may have been ended.
        worker = next(worker for worker in (*self._workers, *self._ended[::-1]) if worker.task == task)
        if worker in self._workers:
            self._end_worker(worker)
        if isinstance(error, TimeoutError):
            return Blame("timed_out", f"it did not end within {self._settings.timeout_s:g} s", 1)
        pid, exit_code = worker.notify_end()
        held = self._watchdog.held_by(pid)
        if held is not None:
            limit = self._settings.memory_bytes / 1e9
            return Blame(
                "out_of_memory", f"it used {held / 1e9:.2g} GB of memory, more than {limit:.2g} GB", 1
            )
        return Blame("worker_died", f"its process died ({format_exit(exit_code)})", 1)

    def close(self) -> None:
        """End the workers, without waiting for unfinished tasks."""
        self._closing.set()
        self._supervisor.join()
        self._watchdog.stop()
        for worker in tuple(self._workers):
            self._end_worker(worker)
        for worker in self._ended:
            worker.wait_for_end()

    def _start_worker(self) -> _Worker:
        try:
            worker = _Worker()
        except (BrokenProcessPool, OSError) as error:
            raise _explain_failed_start(str(error.__cause__ or error)) from error
        self._workers.append(worker)
        return worker

    def _end_worker(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        self._ended.append(worker)
        worker.end()

    def _look_after_workers(self) -> None:
        while not self._closing.wait(_LOOK_PERIOD_S):
            for worker in tuple(self._workers):
                worker.give_up_if_dead()


class _Worker:
    """Pool of one process, which prepares itself at once.

    Attributes:
        task: current task, or the last one.
        count: number of tasks so far.
    """

    def __init__(self) -> None:
        self.task: Task | None = None
        self.count = 0
        self._future: Future[Report] | None = None
        self._looks_dead = 0
        context = _RememberingContext()
        self._pool = ProcessPool(
            max_workers=1, initializer=prepare_worker, initargs=(os.getpid(),), context=context
        )
        self._ready = self._pool.submit(load_libraries, None)
        # Its pool may start another process after a death, which gets no task.
        self._process = context.first
        self._ending = threading.Thread(target=self._pool.join, name="ending", daemon=True)

    @property
    def is_busy(self) -> bool:
        """Whether it has a task."""
        return self._future is not None and not self._future.done()

    @property
    def is_ready(self) -> bool:
        """Whether it can start a task immediately."""
        return self._ready.done()

    def wait_until_ready(self) -> None:
        """Wait until it can start a task.

        Raises:
            BatchError: ``no_workers``, the process cannot be started.
        """
        while not self._ready.done() and self._is_alive():
            wait([self._ready], timeout=_LOOK_PERIOD_S)
        error = self._ready.exception() if self._ready.done() else BrokenProcessPool("the process has died")
        if isinstance(error, BrokenProcessPool | ProcessExpired):
            _, exit_code = self.notify_end()
            raise _explain_failed_start(format_exit(exit_code))
        if error is not None:
            raise _explain_failed_start(f"{type(error).__name__}: {error}")

    def begin(self, settings: Settings, task: Task) -> Future[Report]:
        """Start a task.

        Raises:
            RuntimeError: its process has died.
        """
        if not self._is_alive():
            raise RuntimeError("the process has died")
        given = self._pool.submit(work_safely, settings.timeout_s, settings.work, task)
        self.task = task
        self.count += 1
        self._looks_dead = 0
        self._future = Future()
        given.add_done_callback(partial(_hand_over, self._future))
        return self._future

    def give_up_if_dead(self) -> None:
        """Fail the current task if the process is dead and the pool does not report it."""
        if self._future is None or not self.is_busy or self._is_alive():
            return
        self._looks_dead += 1
        if self._looks_dead >= _LOOKS_UNTIL_DEAD:
            with suppress(InvalidStateError):
                self._future.set_exception(BrokenProcessPool("the process has died"))

    def notify_end(self) -> tuple[int | None, int | None]:
        """Process id and exit code, as far as known."""
        if self._process is None:
            return None, None
        self._process.join(_END_S)
        return self._process.pid, self._process.exitcode

    def end(self) -> None:
        """Begin to end the process."""
        self._pool.stop()  # type: ignore[no-untyped-call]
        self._ending.start()

    def wait_for_end(self) -> None:
        """Wait until the process is gone."""
        self._ending.join()

    def _is_alive(self) -> bool:
        return self._process is not None and self._process.is_alive()


def _hand_over(waiting: Future[Report], given: Future[object]) -> None:
    # The death of the process may have been reported already.
    with suppress(InvalidStateError):
        error = given.exception()
        if error is None:
            waiting.set_result(cast("Report", given.result()))
        else:
            waiting.set_exception(error)


class _RememberingContext(SpawnContext):
    """Spawns processes and remembers the first: pools do not always report their exit code."""

    def __init__(self) -> None:
        super().__init__()
        self.first: SpawnProcess | None = None

    def Process(self, *args: object, **options: object) -> SpawnProcess:  # type: ignore[override]  # noqa: N802
        process = SpawnProcess(*args, **options)  # type: ignore[arg-type]
        self.first = self.first or process
        return process


def _explain_failed_start(reason: str) -> BatchError:
    hint = "See their messages above; --executor inline works without them"
    return BatchError("no_workers", f"worker processes cannot be started ({reason})", hint=hint)


def format_exit(code: int | None) -> str:
    """Describe an exit code in words."""
    if code is None:
        return "reason unknown"
    return f"signal {-code}" if code < 0 else f"exit code {code}"


def prepare_worker(parent: int) -> None:
    """End this process when the batch that it works for is killed, and suppress its output."""
    silence_warnings()
    end_with(parent)


def load_libraries() -> None:
    """Load the libraries that every log needs, so that the first log does not include this time."""
    import pipeline.job.analyze  # noqa: PLC0415 - only in workers
    import pipeline.store.parquet_tables  # noqa: F401, PLC0415 - likewise
