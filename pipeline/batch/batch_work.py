"""One log in a supervised worker: its outcome as a report, and as a ledger entry for the next batch."""

from __future__ import annotations

import os
import pickle
import resource
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from pipeline.core.program import SlipError
from pipeline.logs import FETCHED
from pipeline.store import JSON, LOG_NOTES, LogSighting, Mirror, Store, StoreError

if TYPE_CHECKING:
    from pipeline.job import Options
    from pipeline.job.analyze import Outcome

# Ledger: the last outcome of each log, so that an unchanged log is not even opened.
#
# A ledger entry counts only if the results confirm it: a log is done only while the results contain the
# generation named in its entry. A lost entry costs one reading of the log.

STATES = ("done", "unchanged", "lossy", "refused", "failed", "quarantined")
"""States of a log; all are counted. A refused log cannot show slip."""
WITH_RESULTS = frozenset({"done", "lossy", "refused"})

FATAL_KILLS = 2
"""Number of killed workers after which a log is quarantined until it, or its basis, changes."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """Ledger entry of a log.

    Attributes:
        log: state of the file when it was processed.
        basis: hash of everything beside the log that its results depend on (`hash_basis`).
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
        fetched_bytes: bytes fetched from an object store for it.
        at: time of the processing [s since 1970].
    """

    log: LogSighting
    basis: str
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
    fetched_bytes: int = 0
    at: float = field(default=0.0)

    def fits(self, log: LogSighting, basis: str) -> bool:
        """Whether neither the log nor its basis has changed."""
        return self.log.is_same_file(log) and self.basis == basis


class Ledger:
    """The entries of a results folder.

    Args:
        store: the results.
        mirror: where entries are published, if the results are on an object store.
    """

    def __init__(self, store: Store, mirror: Mirror | None = None) -> None:
        self._mirror = mirror
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
        if self._mirror is not None:
            # A lost entry costs one reading of the log.
            with suppress(StoreError):
                self._mirror.push_note(entry.log.path)


def _as_entry(content: Mapping[str, JSON]) -> Entry | None:
    try:
        return msgspec.convert(content, Entry)
    except msgspec.ValidationError:
        # Entry of another version: the log is processed again.
        return None


_PERIOD_S = 0.05
_PROC = Path("/proc/self/task")
_SLOW_PERIOD_S = 1.0
"""Polling period where another program must be called for the list of processes [s]."""


class MemoryWatchdog:
    """Kills child processes that exceed a memory limit.

    Args:
        limit_bytes: memory limit of each process.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._killed: dict[int, int] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="memory", daemon=True)

    def start(self) -> None:
        """Start watching in a separate thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop watching."""
        self._stop.set()
        self._thread.join()

    def held_by(self, pid: int | None) -> int | None:
        """Memory of a process when it was killed for it [bytes]; None if it was not."""
        return None if pid is None else self._killed.get(pid)

    def _watch(self) -> None:
        while not self._stop.wait(_PERIOD_S if _PROC.exists() else _SLOW_PERIOD_S):
            for pid in list_children():
                held = read_memory(pid)
                if held > self._limit and pid not in self._killed:
                    self._killed[pid] = held
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)


@contextmanager
def limit_memory(limit_bytes: int, give_up: Callable[[int], None]) -> Iterator[None]:
    """Limit the memory of this process itself.

    Args:
        limit_bytes: memory limit.
        give_up: called in a separate thread with the memory in use if it exceeds the limit; ends the process.
    """
    done = threading.Event()

    def watch() -> None:
        while not done.wait(_PERIOD_S if _PROC.exists() else _SLOW_PERIOD_S):
            held = read_memory(os.getpid())
            if held > limit_bytes:
                give_up(held)

    watcher = threading.Thread(target=watch, name="own memory", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()


def list_children() -> list[int]:
    """Running child processes of this process."""
    if not _PROC.exists():
        asked = _ask(["/usr/bin/pgrep", "-P", str(os.getpid())])
        return [int(word) for word in asked.split()]
    children: list[int] = []
    for path in _PROC.glob("*/children"):
        # A thread may end between listing the folder and reading the file.
        with suppress(OSError):
            children += [int(word) for word in path.read_bytes().split()]
    return children


def read_memory(pid: int) -> int:
    """Memory of a process [bytes], 0 if it has ended."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_bytes().split()[1])
    except FileNotFoundError:
        return 0 if Path("/proc/self").exists() else _kilobytes(pid) * 1024
    except (OSError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def _ask(command: list[str]) -> str:
    asked = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own words
    return asked.stdout


def _kilobytes(pid: int) -> int:
    return int(_ask(["/bin/ps", "-o", "rss=", "-p", str(pid)]).strip() or 0)


@dataclass(frozen=True, kw_only=True)
class Task:
    """Log with its processing options.

    Attributes:
        path: the recording.
        log: state of its file when the batch was planned.
        basis: hash of everything else the results depend on.
        options: options of the analysis, including the name of its run.
        address: address of the results, if they are on an object store.
    """

    path: Path
    log: LogSighting
    basis: str
    options: Options
    address: str | None = None


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
    entry = Entry(log=task.log, basis=task.basis, state="failed", run=task.options.run or "")
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
    mirror = None if task.address is None else Mirror(task.address, task.options.out)
    store = Store(task.options.out)
    started, fetched = time.monotonic(), FETCHED.total
    entry = Entry(log=task.log, basis=task.basis, state="failed", run=task.options.run or "")
    is_new = False
    try:
        with store.claim(entry.run) as is_ours:
            if not is_ours:
                return Report(entry=entry, is_busy=True)
            entry, is_new = _analyze(task, entry, mirror)
    except SlipError as error:
        where = f"{error.where}: " if error.where and error.where != str(task.path) else ""
        entry = replace(entry, code=error.code, reason=f"{where}{error.what}", hint=error.hint)
    except Exception as error:  # noqa: BLE001 - one log must not cost the others
        entry = _note_surprise(entry, error)
    entry = replace(
        entry,
        seconds=round(time.monotonic() - started, 3),
        peak_bytes=_peak_bytes(),
        fetched_bytes=FETCHED.total - fetched,
    )
    Ledger(store, mirror).write(entry)
    return Report(entry=entry, is_new=is_new, rss_bytes=read_rss())


def _analyze(task: Task, entry: Entry, mirror: Mirror | None) -> tuple[Entry, bool]:
    # Workers without any work need no table library.
    from pipeline.job.analyze import REPORT, analyze_log  # noqa: PLC0415

    if mirror is not None:
        mirror.pull_run(entry.run)
    before = Store(task.options.out).manifest(entry.run) if entry.run else None
    try:
        outcome = analyze_log(task.path, task.options)
    except SlipError as error:
        if error.code != "log_changed":
            raise
        # An object that was overwritten during reading is probably complete now.
        outcome = analyze_log(task.path, task.options)
    if mirror is not None:
        mirror.push_run(outcome.manifest)
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
    from pipeline.core.json_objects import objects_in  # noqa: PLC0415 - heavy
    from pipeline.job.work import stored_contexts  # noqa: PLC0415 - heavy

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


def read_rss() -> int:
    """Current memory of this process [bytes]; the peak where the system does not provide it."""
    try:
        with open("/proc/self/statm", "rb") as file:  # noqa: PTH123 - called for every log
            return int(file.read().split()[1]) * resource.getpagesize()
    except OSError:
        return _peak_bytes()
