"""A dask cluster: of this machine (``dask``), or one that is there (``tcp://scheduler:8786``).

The scheduler gives the tasks of a lost worker to another one. A worker ends itself when its log takes too
long or too much memory, so a log that does so costs its worker, and the nanny starts another. The scheduler
suspects every task that the worker had; suspects are tried again alone, where there is no doubt.
"""

from __future__ import annotations

import os
import threading
from functools import partial
from typing import TYPE_CHECKING, cast

from pipeline.batch.errors import BatchError
from pipeline.batch.executors import Blame, Settings
from pipeline.batch.executors.local import THREAD_VARIABLES
from pipeline.batch.work import Report, Task, read_rss, work_safely
from pipeline.core.interpreter import keep_current_folder_out
from pipeline.store import Store

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Future

    from distributed import Client

_SCHEMES = ("tcp://", "tls://", "ucx://")
_DEATHS = "batch/deaths"
_GUARD_PERIOD_S = 0.1
_CONNECT_S = 20


def accepts(word: str) -> bool:
    """Whether ``--executor`` means this one."""
    return word == "dask" or word.startswith(_SCHEMES)


def open_executor(word: str, settings: Settings) -> ClusterExecutor:
    """Start a cluster, or reach the one at an address.

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
        return ClusterExecutor(_start_cluster(settings), settings, owns_cluster=True)
    try:
        client = distributed.Client(word, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise BatchError(
            "cluster_not_reached",
            f"the scheduler does not answer ({type(error).__name__})",
            where=word,
            hint="Start one with `dask scheduler` and workers with `dask worker ADDRESS --nthreads 1`",
        ) from None
    return ClusterExecutor(client, settings, owns_cluster=False)


def _start_cluster(settings: Settings) -> Client:
    import dask  # noqa: PLC0415 - an extra
    from distributed import Client, LocalCluster  # noqa: PLC0415

    for variable in THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")
    keep_current_folder_out()
    # The guard judges memory; dask's own limit would pause workers before it.
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


class ClusterExecutor:
    """The workers of a dask cluster."""

    def __init__(self, client: Client, settings: Settings, *, owns_cluster: bool) -> None:
        self._client = client
        self._settings = settings
        self._owns_cluster = owns_cluster
        self._pool = client.get_executor(pure=False)
        self._work = partial(
            run_guarded, settings.work, timeout_s=settings.timeout_s, memory_bytes=settings.memory_bytes
        )

    @property
    def spreads_blame(self) -> bool:
        """Tasks that wait for a worker are blamed for its death, too."""
        return True

    @property
    def depth(self) -> int:
        """Threads of all workers, which may come and go."""
        threads: dict[str, int] = self._client.nthreads()
        return max(1, sum(threads.values()))

    def expect(self, tasks: int) -> None:
        """The workers are there already."""

    def submit(self, task: Task) -> Future[Report]:
        """Work on a task some time."""
        return cast("Future[Report]", self._pool.submit(self._work, task))

    def blame(self, task: Task, error: BaseException) -> Blame:
        """What the exception of a future means."""
        from distributed import KilledWorker  # noqa: PLC0415 - an extra

        if isinstance(error, KilledWorker):
            notes = Store(task.options.out).notes(_DEATHS)
            death = notes.read(task.log.path) or {}
            notes.remove(task.log.path)
            reason = str(death.get("reason", "its workers died"))
            return Blame(str(death.get("code", "worker_died")), reason, 1)
        return Blame("no_result", f"it gave no result: {type(error).__name__}: {error}", 1)

    def close(self) -> None:
        """Leave the cluster; one that was started for this batch ends."""
        self._pool.shutdown(wait=False)
        cluster = self._client.cluster if self._owns_cluster else None
        self._client.close()
        if cluster is not None:
            cluster.close()


def run_guarded(work: Callable[[Task], Report], task: Task, *, timeout_s: float, memory_bytes: int) -> Report:
    """Work on a task; end this process when it takes too long or too much memory.

    Args:
        work: what to do.
        task: the task.
        timeout_s: longest time [s].
        memory_bytes: most memory.
    """
    done = threading.Event()

    def guard() -> None:
        left = timeout_s
        while not done.wait(_GUARD_PERIOD_S):
            left -= _GUARD_PERIOD_S
            held = read_rss()
            if held > memory_bytes:
                limit = memory_bytes / 1e9
                _die_of(task, "out_of_memory", f"it held {held / 1e9:.2g} GB, more than {limit:.2g} GB")
            if left <= 0.0:
                _die_of(task, "timed_out", f"it was not done within {timeout_s:g} s")

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
