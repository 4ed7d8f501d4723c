"""Executors of logs: worker processes on this machine, and a Dask cluster.

The cluster is a local one (``dask``), or an existing one (``tcp://scheduler:8786``). The scheduler reassigns
the tasks of a lost worker. A worker ends itself if its log exceeds the time or memory limit, so such a log
costs one worker, and the nanny starts another. The scheduler suspects every task of that worker; suspects are
tried again one at a time, which makes the cause unambiguous.

The batch does not wait for a lost scheduler: it polls the list of workers over a new connection each time,
and half a minute without an answer ends the batch.
"""

from __future__ import annotations

import asyncio
import logging
import os
import threading
import time
from concurrent.futures import Future, InvalidStateError, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from functools import partial
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import TYPE_CHECKING, cast

from pebble import ProcessExpired, ProcessPool

from pipeline.batch import BatchError
from pipeline.batch.batch_work import (
    DEATHS,
    Blame,
    Report,
    Settings,
    Task,
    format_exit,
    load_libraries,
    prepare_worker,
    run_guarded,
    work_safely,
)
from pipeline.core import MemoryWatchdog, prepare_workers
from pipeline.store import Store

if TYPE_CHECKING:
    from distributed import Client

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
        prepare_workers()
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
            self._watchdog.watch(worker.pid)
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
        exit_code = worker.wait_for_exit_code()
        held = self._watchdog.held_by(worker.pid)
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
        self._process = cast("SpawnProcess", context.first)
        self._ending = threading.Thread(target=self._pool.join, name="ending", daemon=True)

    @property
    def is_busy(self) -> bool:
        """Whether it has a task."""
        return self._future is not None and not self._future.done()

    @property
    def is_ready(self) -> bool:
        """Whether it can start a task immediately."""
        return self._ready.done()

    @property
    def pid(self) -> int:
        """Id of its process."""
        return cast("int", self._process.pid)

    def wait_until_ready(self) -> None:
        """Wait until it can start a task.

        Raises:
            BatchError: ``no_workers``, the process cannot be started.
        """
        while not self._ready.done() and self._is_alive():
            wait([self._ready], timeout=_LOOK_PERIOD_S)
        error = self._ready.exception() if self._ready.done() else BrokenProcessPool("the process has died")
        if isinstance(error, BrokenProcessPool | ProcessExpired):
            raise _explain_failed_start(format_exit(self.wait_for_exit_code()))
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

    def wait_for_exit_code(self) -> int | None:
        """Exit code of its dead process; None if it is not known soon."""
        self._process.join(_END_S)
        return self._process.exitcode

    def end(self) -> None:
        """Begin to end the process."""
        self._pool.stop()
        self._ending.start()

    def wait_for_end(self) -> None:
        """Wait until the process is gone."""
        self._ending.join()

    def _is_alive(self) -> bool:
        return self._process.is_alive()


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


SCHEMES = ("tcp://", "tls://", "ucx://")
_CONNECT_S = 20
_ASK_PERIOD_S = 2.0
_LOST_S = 30.0
"""Time without an answer after which a scheduler counts as lost [s]."""


def open_cluster(word: str, settings: Settings) -> ClusterExecutor:
    """Start a cluster, or connect to the one at an address.

    Raises:
        BatchError: ``no_dask``, ``cluster_not_reached``.
    """
    try:
        import distributed  # noqa: PLC0415 - an extra
    except ImportError:
        raise BatchError(
            "no_dask", "dask is not installed", where=word, hint="pip install 'slip-pipeline[dask]'"
        ) from None
    if word == "dask":
        client = _start_cluster(settings)
        address = str(client.scheduler_info()["address"])
        return ClusterExecutor(client, settings, address=address, owns_cluster=True)
    try:
        # A client that cannot connect hangs, and again at program exit: check first whether it answers.
        count_threads(word)
        client = distributed.Client(word, timeout=_CONNECT_S, set_as_default=False)
    except Exception as error:  # noqa: BLE001 - a host, a port or a certificate: no two alike
        said = " ".join(str(error).split())
        raise BatchError(
            "cluster_not_reached",
            f"the scheduler does not answer ({type(error).__name__}{': ' if said else ''}{said})",
            where=word,
            hint="Start one with `dask scheduler` and workers with `dask worker ADDRESS --nthreads 1`",
        ) from None
    return ClusterExecutor(client, settings, address=word, owns_cluster=False)


def count_threads(address: str) -> int:
    """Ask a scheduler for the threads of all its workers, over a separate connection.

    Raises:
        Exception: any failure to answer, `TimeoutError` after too long a time.
    """
    from distributed.core import rpc  # noqa: PLC0415 - an extra
    from distributed.security import Security  # noqa: PLC0415 - likewise

    async def ask() -> int:
        arguments = Security().get_connection_args("client")
        async with rpc(address, timeout=_CONNECT_S, connection_args=arguments) as scheduler:
            threads: dict[str, int] = await scheduler.ncores()
            return sum(threads.values())

    async def ask_for_a_while() -> int:
        return await asyncio.wait_for(ask(), _CONNECT_S)

    return asyncio.run(ask_for_a_while())


def _start_cluster(settings: Settings) -> Client:
    import dask  # noqa: PLC0415 - an extra
    from distributed import Client, LocalCluster  # noqa: PLC0415

    prepare_workers()
    # The guard limits the memory; dask's own limit would pause workers before it.
    plain = {
        "distributed.scheduler.allowed-failures": 0,
        "distributed.worker.memory.pause": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.terminate": False,
    }
    with dask.config.set(plain):
        cluster = LocalCluster(
            n_workers=settings.jobs,
            threads_per_worker=1,
            processes=True,
            protocol="tcp://",
            dashboard_address=None,
            memory_limit=0,
            silence_logs=50,
        )
        return Client(cluster, set_as_default=False)


class SchedulerLostError(Exception):
    """The scheduler no longer answers."""


class ClusterExecutor:
    """Workers of a dask cluster.

    Attributes:
        depth: threads of all workers; varies as workers join and leave.
    """

    # Tasks queued on a worker are blamed for its death, too.
    spreads_blame = True

    def __init__(self, client: Client, settings: Settings, *, address: str, owns_cluster: bool) -> None:
        self._client = client
        self._settings = settings
        self._address = address
        self._owns_cluster = owns_cluster
        self._pool = client.get_executor(pure=False)
        self._work = partial(
            run_guarded, settings.work, timeout_s=settings.timeout_s, memory_bytes=settings.memory_bytes
        )
        self.depth = 1
        self._waiting: set[Future[Report]] = set()
        self._closing = threading.Event()
        self._is_lost = False
        # This program reports errors; dask would log them as well, in many lines.
        logging.disable(logging.CRITICAL)
        threading.Thread(target=self._look_after_scheduler, name="scheduler", daemon=True).start()

    def expect(self, tasks: int) -> None:
        """Do nothing: the workers are already running."""

    def submit(self, task: Task) -> Future[Report]:
        """Submit a task."""
        waiting: Future[Report] = Future()
        self._waiting.add(waiting)
        if self._is_lost:
            self._finish(waiting, error=SchedulerLostError())
            return waiting
        try:
            self._pool.submit(self._work, task).add_done_callback(partial(self._hand_over, waiting))
        except Exception as error:  # noqa: BLE001 - it is told where the report is waited for
            self._finish(waiting, error=error)
        return waiting

    def blame(self, task: Task, error: BaseException) -> Blame:
        """Interpret the exception of a future."""
        from distributed import KilledWorker  # noqa: PLC0415 - an extra

        if isinstance(error, KilledWorker):
            notes = Store(task.options.out).notes(DEATHS)
            death = notes.read(task.log.path) or {}
            notes.remove(task.log.path)
            reason = str(death.get("reason", "its workers died"))
            return Blame(str(death.get("code", "worker_died")), reason, 1)
        if self._is_lost:
            return Blame("cluster_lost", f"the scheduler at {self._address} does not answer any more", 0)
        return Blame("no_result", f"it gave no result: {type(error).__name__}: {error}", 1)

    def close(self) -> None:
        """Disconnect from the cluster; end it if it was started for this batch."""
        self._closing.set()
        if self._is_lost:
            # Closing would wait for an answer, and again at program exit.
            self._client.status = "closed"
            return
        logging.disable(logging.NOTSET)
        self._pool.shutdown(wait=False)
        cluster = self._client.cluster if self._owns_cluster else None
        self._client.close()
        if cluster is not None:
            cluster.close()

    def _look_after_scheduler(self) -> None:
        answered = time.monotonic()
        while not self._closing.is_set():
            try:
                self.depth = max(1, count_threads(self._address))
                answered = time.monotonic()
            except Exception:  # noqa: BLE001 - no answer, for whatever reason
                self._is_lost = time.monotonic() - answered > _LOST_S
            if self._is_lost:
                for waiting in tuple(self._waiting):
                    self._finish(waiting, error=SchedulerLostError())
                return
            self._closing.wait(_ASK_PERIOD_S)

    def _hand_over(self, waiting: Future[Report], given: Future[object]) -> None:
        try:
            self._finish(waiting, report=cast("Report", given.result()))
        except BaseException as error:  # noqa: BLE001 - whatever a worker can die of
            self._finish(waiting, error=error)

    def _finish(
        self, waiting: Future[Report], *, report: Report | None = None, error: BaseException | None = None
    ) -> None:
        self._waiting.discard(waiting)
        # The loss of the scheduler may have been reported already.
        with suppress(InvalidStateError):
            if report is not None:
                waiting.set_result(report)
            else:
                waiting.set_exception(error)
