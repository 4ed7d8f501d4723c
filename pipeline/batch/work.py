"""One log in a worker: every outcome, good or bad, comes back as a report that any process can carry."""

from __future__ import annotations

import pickle
import resource
import sys
import time
import traceback
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pipeline.batch.ledger import Entry, Ledger
from pipeline.core.errors import SlipError
from pipeline.logs import FETCHED
from pipeline.store import LogSighting, Mirror, Store

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from pipeline.analysis import Options
    from pipeline.analysis.analyze import Outcome


@dataclass(frozen=True, kw_only=True)
class Task:
    """A log and what to do with it.

    Attributes:
        path: the recording.
        log: what its file looked like when the batch was planned.
        basis: hash of everything else the results depend on.
        options: what it is analyzed with, the name of its run among them.
        address: of the results, if they are on an object store.
    """

    path: Path
    log: LogSighting
    basis: str
    options: Options
    address: str | None = None


@dataclass(frozen=True, kw_only=True)
class Report:
    """What became of a task.

    Attributes:
        entry: what the ledger says of the log now.
        is_new: whether a generation was published; not where nothing had changed.
        is_busy: whether another batch is working on the same run: nothing was done.
        rss_bytes: memory of the worker afterwards.
    """

    entry: Entry
    is_new: bool = False
    is_busy: bool = False
    rss_bytes: int = 0


def work_safely(work: Callable[[Task], Report], task: Task) -> Report:
    """Do the work so that whatever comes of it can leave the process: a report, if need be of a failure.

    Args:
        work: what to do.
        task: the task.
    """
    entry = Entry(log=task.log, basis=task.basis, state="failed", run=task.options.run or "")
    try:
        report = work(task)
        pickle.dumps(report)
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # noqa: BLE001 - one log must not cost the others; a panic of polars is this
        return Report(entry=_describe_surprise(entry, error))
    return report


def work_on(task: Task) -> Report:
    """Analyze one log and note the outcome in the ledger; raises nothing that a log can cause."""
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
        entry = _describe_surprise(entry, error)
    entry = replace(
        entry,
        seconds=round(time.monotonic() - started, 3),
        peak_bytes=_peak_bytes(),
        fetched_bytes=FETCHED.total - fetched,
    )
    Ledger(store, mirror).write(entry)
    return Report(entry=entry, is_new=is_new, rss_bytes=read_rss())


def _analyze(task: Task, entry: Entry, mirror: Mirror | None) -> tuple[Entry, bool]:
    # Workers that find nothing to do need no table library.
    from pipeline.analysis.analyze import REPORT, analyze_log  # noqa: PLC0415

    if mirror is not None:
        mirror.pull_run(entry.run)
    before = Store(task.options.out).manifest(entry.run) if entry.run else None
    try:
        outcome = analyze_log(task.path, task.options)
    except SlipError as error:
        if error.code != "log_changed":
            raise
        # An object that was overwritten while it was read is most likely whole now.
        outcome = analyze_log(task.path, task.options)
    if mirror is not None:
        mirror.push_run(outcome.manifest)
    done = replace(
        entry,
        state="lossy" if outcome.lossy else "done",
        run=outcome.manifest.run,
        key=outcome.manifest.key,
        reason=_describe_losses(outcome),
        has_report=REPORT in outcome.manifest.files,
    )
    return done, before is None or before.folder != outcome.manifest.folder


def _describe_losses(outcome: Outcome) -> str:
    from pipeline.analysis.work import stored_contexts  # noqa: PLC0415 - heavy
    from pipeline.report.run import objects_in  # noqa: PLC0415 - heavy

    losses = objects_in(stored_contexts(outcome.manifest).get("extract", {}), "losses")
    return "; ".join(str(loss.get("text")) for loss in losses)


def _describe_surprise(entry: Entry, error: BaseException) -> Entry:
    """An error that nobody foresaw: where it happened is what whoever mends it needs."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    text = " ".join(str(error).split()) or "no message"
    return replace(
        entry,
        code="unexpected_error",
        reason=f"{type(error).__name__}: {text} ({last.filename.rsplit('/', 1)[-1]}, line {last.lineno})",
        hint="This is a defect of the program: report it with this line, and the log if you may",
    )


def _peak_bytes() -> int:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def read_rss() -> int:
    """Memory that this process holds now [bytes]; the peak where the system does not tell."""
    try:
        with open("/proc/self/statm", "rb") as file:  # noqa: PTH123 - called for every log
            return int(file.read().split()[1]) * resource.getpagesize()
    except OSError:
        return _peak_bytes()
