"""One log as a task: its executor in this process, its outcome as a report and as a ledger entry.

An executor takes tasks and returns `concurrent.futures.Future`; the runner uses nothing else of it.
"""

import os
import pickle
import resource
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import msgspec

from pipeline.analysis import Options
from pipeline.analysis.analyze import Outcome, analyze_log
from pipeline.core import SlipError, end_with, limit_memory, objects_in, read_memory, silence_warnings
from pipeline.store import JSON, LOG_NOTES, REPORT, LogSighting, Store, stored_contexts

# Ledger: the last outcome of each log, so that an unchanged log is not even opened.
#
# A ledger entry counts only if the results confirm it: a log is done only while the results contain the
# generation named in its entry. A lost entry costs one reading of the log.

STATES = ("done", "unchanged", "lossy", "refused", "failed", "quarantined")
"""States of a log; all are counted. A refused log cannot show slip."""
WITH_RESULTS = frozenset({"done", "lossy", "refused"})

FATAL_KILLS = 2
"""Number of killed workers after which a log is quarantined until it, or its fingerprint, changes."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """Ledger entry of a log.

    Attributes:
        log: state of the file when it was processed.
        fingerprint: hash of everything beside the log that its results depend on (`find_fingerprint`).
        state: one of `STATES` but ``unchanged``, or ``copy`` of another log's content.
        run: name of its run; empty if it has none.
        key: key of the generation that was made.
        code: code of the error.
        reason: reason of the failure or refusal, or what was lost; of a copy, the run it is a copy of.
        hint: what to do about it.
        kills: number of workers it has killed in this state.
        has_report: whether the generation contains a report.
        seconds: processing time.
        peak_bytes: peak memory of its worker.
        at: time of the processing [s since 1970].
    """

    log: LogSighting
    fingerprint: str
    state: str
    run: str = ""
    key: str = ""
    code: str = ""
    reason: str = ""
    hint: str = ""
    kills: int = 0
    has_report: bool = False
    seconds: float = 0.0
    peak_bytes: int = 0
    at: float = field(default=0.0)

    def fits(self, log: LogSighting, fingerprint: str) -> bool:
        """Whether neither the log nor its fingerprint has changed."""
        return self.log.is_same_file(log) and self.fingerprint == fingerprint


class Ledger:
    """The entries of a results folder.

    Args:
        store: the results.
    """

    def __init__(self, store: Store) -> None:
        self._notes = store.notes(LOG_NOTES)

    def read_all(self) -> Mapping[str, Entry]:
        """Every entry by the path of its log."""
        entries: dict[str, Entry] = {}
        for content in self._notes.read_all():
            entry = _as_entry(content)
            if entry is not None:
                entries[entry.log.path] = entry
        return entries

    def read(self, path: str) -> Entry | None:
        """The entry of a log."""
        content = self._notes.read(path)
        return None if content is None else _as_entry(content)

    def write(self, entry: Entry) -> None:
        """Record the outcome of a log with the present time."""
        stamped = replace(entry, at=round(time.time(), 3))
        content: dict[str, JSON] = msgspec.to_builtins(stamped)
        self._notes.write(entry.log.path, content)


def _as_entry(content: Mapping[str, JSON]) -> Entry | None:
    try:
        return msgspec.convert(content, Entry)
    except msgspec.ValidationError:
        # Entry of another version: the log is processed again.
        return None


@dataclass(frozen=True, kw_only=True)
class Task:
    """Log with its processing options.

    Attributes:
        path: the recording.
        log: state of its file when the batch was planned.
        fingerprint: hash of everything else the results depend on.
        options: options of the analysis, including the name of its run.
    """

    path: Path
    log: LogSighting
    fingerprint: str
    options: Options


@dataclass(frozen=True, kw_only=True)
class Report:
    """Outcome of a task.

    Attributes:
        entry: new ledger entry of the log.
        is_new: whether a generation was published; false if nothing had changed.
        is_busy: whether another batch is working on the same run, so that nothing was done.
        rss_bytes: memory of the worker afterwards.
    """

    entry: Entry
    is_new: bool = False
    is_busy: bool = False
    rss_bytes: int = 0


def work_safely(work: Callable[[Task], Report], task: Task) -> Report:
    """Do the work and return a report that can be pickled, of a failure if necessary.

    Args:
        work: function to call.
        task: its task.
    """
    entry = Entry(log=task.log, fingerprint=task.fingerprint, state="failed", run=task.options.run or "")
    try:
        report = work(task)
        pickle.dumps(report)
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # noqa: BLE001 - includes panics of polars
        return Report(entry=_note_surprise(entry, error))
    return report


def work_on(task: Task) -> Report:
    """Analyze one log and record the outcome in the ledger; no log can make it raise."""
    store = Store(task.options.out)
    started = time.monotonic()
    entry = Entry(log=task.log, fingerprint=task.fingerprint, state="failed", run=task.options.run or "")
    is_new = False
    try:
        with store.claim(entry.run) as is_ours:
            if not is_ours:
                return Report(entry=entry, is_busy=True)
            entry, is_new = _analyze(task, entry)
    except SlipError as error:
        where = f"{error.where}: " if error.where and error.where != str(task.path) else ""
        entry = replace(entry, code=error.code, reason=f"{where}{error.what}", hint=error.hint)
    except Exception as error:  # noqa: BLE001 - one log must not cost the others
        entry = _note_surprise(entry, error)
    entry = replace(
        entry,
        seconds=round(time.monotonic() - started, 3),
        peak_bytes=_peak_bytes(),
    )
    Ledger(store).write(entry)
    return Report(entry=entry, is_new=is_new, rss_bytes=read_memory(os.getpid()))


def _analyze(task: Task, entry: Entry) -> tuple[Entry, bool]:
    before = Store(task.options.out).manifest(entry.run) if entry.run else None
    try:
        outcome = analyze_log(task.path, task.options)
    except SlipError as error:
        if error.code != "log_changed":
            raise
        # An object that was overwritten during reading is probably complete now.
        outcome = analyze_log(task.path, task.options)
    done = replace(
        entry,
        state="refused" if outcome.refusal else "lossy" if outcome.lossy else "done",
        run=outcome.manifest.run,
        key=outcome.manifest.key,
        reason=outcome.refusal or _format_losses(outcome),
        hint=f"List what the log holds: slip inspect {task.path}" if outcome.refusal else "",
        has_report=REPORT in outcome.manifest.files,
    )
    return done, before is None or before.folder != outcome.manifest.folder


def _format_losses(outcome: Outcome) -> str:
    losses = objects_in(stored_contexts(outcome.manifest).get("extract", {}), "losses")
    return "; ".join(str(loss.get("text")) for loss in losses)


def _note_surprise(entry: Entry, error: BaseException) -> Entry:
    """Entry of an unforeseen error, with its location in the program."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    text = " ".join(str(error).split()) or "no message"
    return replace(
        entry,
        code="unexpected_error",
        reason=f"{type(error).__name__}: {text} ({last.filename.rsplit('/', 1)[-1]}, line {last.lineno})",
        hint="This is a defect of the program: report it with this line and, if possible, the log",
    )


def _peak_bytes() -> int:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


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
    import pipeline.analysis.analyze  # noqa: PLC0415 - only in workers
    import pipeline.store.parquet_tables  # noqa: F401, PLC0415 - likewise


DEATHS = "batch/deaths"


def run_guarded(work: Callable[[Task], Report], task: Task, *, timeout_s: float, memory_bytes: int) -> Report:
    """Work on a task; end this process if it exceeds the time or memory limit.

    Args:
        work: function to call.
        task: its task.
        timeout_s: time limit [s].
        memory_bytes: memory limit.
    """

    def give_up(held: int) -> None:
        limit = memory_bytes / 1e9
        _die_of(task, "out_of_memory", f"it used {held / 1e9:.2g} GB, more than {limit:.2g} GB")

    late = f"it did not end within {timeout_s:g} s"
    timer = threading.Timer(timeout_s, _die_of, (task, "timed_out", late))
    timer.daemon = True
    timer.start()
    try:
        with limit_memory(memory_bytes, give_up):
            return work_safely(work, task)
    finally:
        timer.cancel()


def _die_of(task: Task, code: str, reason: str) -> None:
    Store(task.options.out).notes(DEATHS).write(task.log.path, {"code": code, "reason": reason})
    os._exit(1)
