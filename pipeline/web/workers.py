"""Analyses and diagnoses in a process of their own: one that dies, hangs or eats memory costs only itself.

The process is a worker of a batch, with its limits of time and memory; a fresh one follows one that was lost.
"""

import threading
from collections.abc import Callable
from concurrent.futures import wait
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.batch.executors import Settings
from pipeline.batch.executors.local import LocalExecutor
from pipeline.batch.ledger import Entry
from pipeline.batch.work import Report, Task
from pipeline.store import Store
from pipeline.web.diagnoses import write_diagnosis
from pipeline.web.errors import WorkbenchError
from pipeline.web.limits import Limits
from pipeline.web.plans import write_run_plan
from pipeline.web.runs import find_run

DIAGNOSE = "diagnose"
PLAN = "plan"
ANALYZE = "analyze"

_LOOK_S = 0.2
_HINTS = {
    "timed_out": "Give `slip serve` a longer --timeout, or run it in a terminal.",
    "out_of_memory": "Give `slip serve` more --memory, or look at the log with `slip inspect`.",
    "worker_died": "Look at the log with `slip inspect`; the other runs are as they were.",
}


@dataclass(frozen=True, kw_only=True)
class Errand(Task):
    """A task of the workbench; ``basis`` says which, ``DIAGNOSE``, ``PLAN`` or ``ANALYZE``.

    Attributes:
        notes: file that the worker keeps the name of the present stage in; None where it has only one.
        area: free ground for a plan.
    """

    notes: Path | None
    area: str = ""


class Workers:
    """The process that works, one errand at a time.

    Args:
        limits: time and memory for an errand.
        work: what is done; importable by its name in a fresh process.
    """

    def __init__(self, limits: Limits, work: Callable[[Task], Report] | None = None) -> None:
        self._settings = Settings(1, limits.timeout_s, limits.memory_bytes, work or work_on_errand)
        self._executor: LocalExecutor | None = None
        self._one_at_a_time = threading.Lock()
        self._closed = threading.Event()

    def run(self, errand: Errand, tell: Callable[[str], None]) -> Entry:
        """Do an errand; returns when it is done.

        Args:
            errand: what to do.
            tell: told the name of each stage.

        Raises:
            SlipError: it failed, or the process was lost over it.
        """
        with self._one_at_a_time:
            if self._closed.is_set():
                raise WorkbenchError("closing", "the server is ending", hint="Start it again.")
            self._executor = self._executor or LocalExecutor(self._settings)
            future = self._executor.submit(errand)
            stage = ""
            while not future.done():
                if self._closed.is_set():
                    raise WorkbenchError("closing", "the server is ending", hint="Start it again.")
                wait([future], timeout=_LOOK_S)
                told = _read_notes(errand)
                if told not in {"", stage}:
                    stage = told
                    tell(stage)
            error = future.exception()
            if error is not None:
                blame = self._executor.blame(errand, error)
                hint = _HINTS.get(blame.code, "Try it in a terminal.")
                raise WorkbenchError(blame.code, blame.reason, hint=hint)
            entry = future.result().entry
        if entry.state == "failed":
            raise WorkbenchError(entry.code, entry.reason, hint=entry.hint)
        return entry

    def close(self) -> None:
        """End the process, whatever it is doing."""
        self._closed.set()
        with self._one_at_a_time:
            if self._executor is not None:
                self._executor.close()
                self._executor = None


def _read_notes(errand: Errand) -> str:
    try:
        return "" if errand.notes is None else errand.notes.read_text(encoding="utf-8")
    except OSError:
        return ""


def work_on_errand(task: Task) -> Report:
    """Analyze a log, or diagnose a stored run or plan what to drive after it.

    Raises:
        SlipError: it cannot be done.
    """
    from pipeline.core.errors import SlipError  # noqa: PLC0415 - only in workers

    entry = Entry(log=task.log, basis=task.basis, state="failed", run=task.options.run or "")
    try:
        store = Store(task.options.out)
        if task.basis == DIAGNOSE:
            write_diagnosis(task.options.out, find_run(store, entry.run))
        elif isinstance(task, Errand) and task.basis == PLAN:
            write_run_plan(store, find_run(store, entry.run), task.area)
        else:
            return Report(entry=_analyze(task, entry))
        return Report(entry=replace(entry, state="done"))
    except SlipError as error:
        told = f"{error.where}: {error.what}" if error.where else error.what
        return Report(entry=replace(entry, code=error.code, reason=told, hint=error.hint))


def _analyze(task: Task, entry: Entry) -> Entry:
    from pipeline.analysis.analyze import analyze_log, update_datasets  # noqa: PLC0415 - only in workers

    def tell(stage: str) -> None:
        # A stage that is not told is no reason to stop.
        with suppress(OSError):
            if isinstance(task, Errand) and task.notes is not None:
                task.notes.write_text(stage, encoding="utf-8")

    outcome = analyze_log(task.path, task.options, tell)
    update_datasets(Store(task.options.out))
    return replace(entry, state="lossy" if outcome.lossy else "done", run=outcome.manifest.run)
