"""Where logs are worked on: in processes of this machine, in this process, or on a Dask cluster.

Each executor calls the same function, `run_guarded`, and gives a future of its report. On this machine every
log has a process of its own, forked from a server that has loaded the libraries: it inherits nothing of the
logs before it, and its death has one cause. On a cluster a scheduler shares the logs among workers; the death
of a worker is blamed on every log that it held, and these are tried again, one at a time.
"""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass
from functools import partial
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

from pebble import ProcessExpired, concurrent

from pipeline.batch import BatchError
from pipeline.batch.batch_work import Report, Task, work_safely
from pipeline.core import limit_memory, prepare_workers, require_package, silence_warnings
from pipeline.store import Store

if TYPE_CHECKING:
    from distributed import Client

_LIBRARIES = ["pipeline.analysis.analyze", "pipeline.store.parquet_tables", "numba"]
"""What every log needs; they are loaded once, and not in every process."""
_GRACE_S = 2.0
"""Time after which a process that did not end itself is killed [s]: a library may hold the interpreter."""
_ORPHAN_PERIOD_S = 0.5
"""Period of checking for the server [s]: a check takes microseconds."""
_DEATHS = "batch/deaths"
SCHEMES = ("tcp://", "tls://", "ucx://")
_CONNECT_S = 20


@dataclass(frozen=True)
class Limits:
    """Limits of one log: time [s] and memory [bytes]."""

    timeout_s: float
    memory_bytes: int


@dataclass(frozen=True)
class Executor:
    """Workers.

    Attributes:
        submit: starts the work on a log.
        close: ends the workers, without waiting for unfinished logs.
        depth: number of logs that are submitted at once.
        spreads_blame: whether a worker that dies may implicate other logs than the one that killed it.
    """

    submit: Callable[[Task], Future[Report]]
    close: Callable[[], None] = lambda: None
    depth: float = 1
    spreads_blame: bool = False


def open_executor(word: str, work: Callable[[Task], Report], limits: Limits, jobs: int) -> Executor:
    """The workers of the given name: ``local``, ``inline``, ``dask`` or the address of a scheduler.

    Args:
        word: the name.
        work: function called for each log, importable by its name in a fresh process.
        limits: limits of each log; in this process (``inline``) there are none.
        jobs: number of logs at once on this machine.

    Raises:
        BatchError: ``no_such_executor``; ``no_workers``, ``no_dask``, ``cluster_not_reached``.
    """
    if word == "local":
        return _start_processes(work, limits, jobs)
    if word == "inline":
        return Executor(partial(_work_here, work))
    if word == "dask" or word.startswith(SCHEMES):
        return _open_cluster(word, work, limits, jobs)
    hint = "Use local, inline, dask, or the address of a dask scheduler such as tcp://host:8786"
    raise BatchError("no_such_executor", f"no executor is called {word!r}", hint=hint)


def _work_here(work: Callable[[Task], Report], task: Task) -> Future[Report]:
    future: Future[Report] = Future()
    future.set_result(work_safely(work, task))
    return future


def _start_processes(work: Callable[[Task], Report], limits: Limits, jobs: int) -> Executor:
    prepare_workers()
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(_LIBRARIES)
    try:
        forkserver.ensure_running()
    except OSError as error:
        hint = "--executor inline works without them"
        raise BatchError("no_workers", f"worker processes cannot be started ({error})", hint=hint) from error
    # The argument has either name: that of the signature, and that which is read.
    contexts: Any = {"context": server, "mp_context": server}
    start = concurrent.process(timeout=limits.timeout_s + _GRACE_S, **contexts)(_run_alone)
    # Nobody writes to it: it closes with this process, however that ends.
    line, end = server.Pipe(duplex=False)

    def submit(task: Task) -> Any:  # noqa: ANN401 - as `Executor.submit`
        future = start(work, task, limits, line)
        # It stays open as long as anybody waits for a report, whether or not they hold the executor.
        future.add_done_callback(lambda _: end)
        return future

    return Executor(submit, end.close, depth=jobs)


def _run_alone(
    work: Callable[[Task], Report], task: Task, limits: Limits, line: Connection[None, None]
) -> Report:
    silence_warnings()
    # Not with the server alone: that lives as long as a process of it does.
    threading.Thread(target=_end_with, args=(line, os.getppid()), name="parent", daemon=True).start()
    return run_guarded(work, task, limits)


def _end_with(line: Connection[None, None], server: int) -> None:
    """End this process, and free what it claims, when the batch or the server of its processes has ended."""
    while os.getppid() == server and not line.poll(_ORPHAN_PERIOD_S):
        pass
    os._exit(1)


def run_guarded(work: Callable[[Task], Report], task: Task, limits: Limits) -> Report:
    """Work on a log; end this process, with a note why, if it exceeds a limit."""
    notes = Store(task.options.out).notes(_DEATHS)
    notes.remove(task.log.path)

    def end(code: str, reason: str) -> None:
        notes.write(task.log.path, {"code": code, "reason": reason})
        os._exit(1)

    def give_up(held: int) -> None:
        limit = limits.memory_bytes / 1e9
        end("out_of_memory", f"it used {held / 1e9:.2g} GB of memory, more than {limit:.2g} GB")

    late = ("timed_out", f"it did not end within {limits.timeout_s:g} s")
    timer = threading.Timer(limits.timeout_s, end, late)
    timer.daemon = True
    timer.start()
    try:
        with limit_memory(limits.memory_bytes, give_up):
            return work_safely(work, task)
    finally:
        timer.cancel()


def find_blame(task: Task, error: BaseException) -> tuple[str, str]:
    """Code and reason, one sentence without a full stop, of a log without a report.

    Args:
        task: the log.
        error: exception of its future.
    """
    notes = Store(task.options.out).notes(_DEATHS)
    if (death := notes.read(task.log.path)) is not None:
        notes.remove(task.log.path)
        return str(death["code"]), str(death["reason"])
    if isinstance(error, TimeoutError):
        return "timed_out", "it did not end, and its process was killed"
    if isinstance(error, ProcessExpired):
        ended = error.exitcode
        how = f"signal {-ended}" if ended is not None and ended < 0 else f"exit code {ended}"
        return "worker_died", f"its process died ({how})"
    if isinstance(error, CancelledError):
        return "cluster_lost", "the scheduler does not answer any more"
    if type(error).__name__ == "KilledWorker":
        return "worker_died", "its workers died"
    return "no_result", f"it gave no result: {type(error).__name__}: {error}"


def _open_cluster(word: str, work: Callable[[Task], Report], limits: Limits, jobs: int) -> Executor:
    require_package("distributed", "dask", "A cluster")
    client: Any = _start_cluster(jobs) if word == "dask" else _connect(word)
    pool = client.get_executor(pure=False)
    # This program reports errors; dask would log them as well, in many lines.
    logging.disable(logging.CRITICAL)

    def close() -> None:
        logging.disable(logging.NOTSET)
        pool.shutdown(wait=False)
        client.close()
        if word == "dask":
            client.cluster.close()

    run = partial(run_guarded, work, limits=limits)
    return Executor(partial(pool.submit, run), close, depth=float("inf"), spreads_blame=True)


def _connect(address: str) -> Client:
    from distributed import Client  # noqa: PLC0415 - an extra
    from distributed.core import rpc  # noqa: PLC0415 - likewise
    from distributed.security import Security  # noqa: PLC0415 - likewise

    async def ask() -> None:
        arguments = Security().get_connection_args("client")
        async with (
            asyncio.timeout(_CONNECT_S),
            rpc(address, timeout=_CONNECT_S, connection_args=arguments) as scheduler,
        ):
            await scheduler.ncores()

    try:
        # A client that finds nobody there hangs, and again at the end of the program.
        asyncio.run(ask())
        return Client(address, timeout=_CONNECT_S, set_as_default=False)
    except Exception as error:  # noqa: BLE001 - a host, a port or a certificate: no two alike
        said = " ".join(str(error).split())
        raise BatchError(
            "cluster_not_reached",
            f"the scheduler does not answer ({type(error).__name__}{': ' if said else ''}{said})",
            where=address,
            hint="Start one with `dask scheduler` and workers with `dask worker ADDRESS --nthreads 1`",
        ) from None


def _start_cluster(jobs: int) -> Client:
    import dask  # noqa: PLC0415 - an extra
    from distributed import Client, LocalCluster  # noqa: PLC0415 - likewise

    prepare_workers()
    # A log that kills its worker is not given to another; dask's own limit would pause workers before ours.
    plain = {
        "distributed.scheduler.allowed-failures": 0,
        "distributed.worker.memory.pause": False,
        "distributed.worker.memory.terminate": False,
    }
    with dask.config.set(plain):
        cluster = LocalCluster(
            n_workers=jobs,
            threads_per_worker=1,
            protocol="tcp://",
            dashboard_address=None,
            memory_limit=0,
            silence_logs=50,
        )
        return Client(cluster, set_as_default=False)
