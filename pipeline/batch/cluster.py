"""Dask cluster: a local one (``dask``), or an existing one (``tcp://scheduler:8786``).

The scheduler reassigns the tasks of a lost worker. A worker ends itself if its log exceeds the time or memory
limit, so such a log costs one worker, and the nanny starts another. The scheduler suspects every task of that
worker; suspects are tried again one at a time, which makes the cause unambiguous.

The batch does not wait for a lost scheduler: it polls the list of workers over a new connection each time,
and half a minute without an answer ends the batch.
"""

from __future__ import annotations

import asyncio
import logging
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, cast

from pipeline.batch.batch_work import Report, Task, read_rss, work_safely
from pipeline.batch.executors import Blame, Settings
from pipeline.batch.request import BatchError
from pipeline.core.program import THREAD_VARIABLES, keep_current_folder_out
from pipeline.store import Store

if TYPE_CHECKING:
    from distributed import Client

SCHEMES = ("tcp://", "tls://", "ucx://")
_DEATHS = "batch/deaths"
_GUARD_PERIOD_S = 0.1
_CONNECT_S = 20
_LOOK_PERIOD_S = 2.0
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

    for variable in THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")
    keep_current_folder_out()
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
            notes = Store(task.options.out).notes(_DEATHS)
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
            self._closing.wait(_LOOK_PERIOD_S)

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


def run_guarded(work: Callable[[Task], Report], task: Task, *, timeout_s: float, memory_bytes: int) -> Report:
    """Work on a task; end this process if it exceeds the time or memory limit.

    Args:
        work: function to call.
        task: its task.
        timeout_s: time limit [s].
        memory_bytes: memory limit.
    """
    done = threading.Event()

    def guard() -> None:
        remaining_s = timeout_s
        while not done.wait(_GUARD_PERIOD_S):
            remaining_s -= _GUARD_PERIOD_S
            held = read_rss()
            if held > memory_bytes:
                limit = memory_bytes / 1e9
                _die_of(task, "out_of_memory", f"it used {held / 1e9:.2g} GB, more than {limit:.2g} GB")
            if remaining_s <= 0.0:
                _die_of(task, "timed_out", f"it did not end within {timeout_s:g} s")

    watcher = threading.Thread(target=guard, name="guard", daemon=True)
    watcher.start()
    try:
        return work_safely(work, task)
    finally:
        done.set()
        watcher.join()


def _die_of(task: Task, code: str, reason: str) -> None:
    Store(task.options.out).notes(_DEATHS).write(task.log.path, {"code": code, "reason": reason})
    os._exit(1)
