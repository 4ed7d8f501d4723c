"""One log as a task, its outcome as a report and as a ledger entry."""

import pickle
import resource
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec

from pipeline.analysis import Options
from pipeline.analysis.analyze import Outcome, analyze_log
from pipeline.core import LONGEST_TEXT, UNFINISHED, SlipError, objects_in, shorten
from pipeline.logs import LogError
from pipeline.recording import RecordingError, StageError
from pipeline.sources import ConfigurationError
from pipeline.store import (
    JSON,
    LOG_NOTES,
    LOG_STATES,
    REPORT,
    LogSighting,
    Store,
    stored_contexts,
)

# Ledger: the last outcome of each log, so that an unchanged log is not even opened.
#
# A ledger entry counts only if the results confirm it: a log is done only while the results contain the
# generation named in its entry. A lost entry costs one reading of the log.

STATES = ("done", "unchanged", *LOG_STATES[1:], "growing", *UNFINISHED)
"""What logs come out as in a batch; all are counted. A refused log cannot show slip."""
WITH_RESULTS = frozenset({"done", "lossy", "refused"})

_OF_THE_PLACE = {"log_not_found", "log_unreachable", "log_changed", "no_object_store"}
"""Errors of a log whose cause is where it is, not what it holds."""
_NOT_RECORDED = {
    "log_without_messages",
    "no_pose",
    "no_command",
    "no_wheels",
    "no_gyro",
    "no_clock",
    "no_interval",
    "no_segment",
    "empty_interval",
}
"""Errors of a log that is as it was recorded, but without what slip is computed from."""


def judge_error(error: SlipError) -> tuple[str, bool]:
    """What a log comes out as after an error, and whether it stays so until it or its fingerprint changes.

    An error of a full disk, a lost worker or an unreachable store does not stay: the next batch tries again.
    """
    kinds = (LogError, RecordingError, StageError, ConfigurationError)
    lasts = isinstance(error, kinds) and error.code not in _OF_THE_PLACE
    return "refused" if lasts and error.code in _NOT_RECORDED else "failed", lasts


@dataclass(frozen=True, kw_only=True)
class Entry:
    """Ledger entry of a log.

    Attributes:
        log: state of the file when it was processed.
        fingerprint: hash of everything beside the log that its results depend on (`find_fingerprint`).
        state: one of `STATES` but ``unchanged``, or ``copy`` of another log's content.
        run: name of its run; empty if it has none.
        key: key of the generation that was made; of a copy, the SHA-256 of its content if it is known.
        code: code of the error.
        reason: reason of the failure or refusal, or what was lost; of a copy, the run it is a copy of.
        hint: what to do about it.
        lasts: whether an error stays until the log or its fingerprint changes (`judge_error`).
        kills: number of workers it has killed in this state.
        limit: of a log that exceeded its time [s] or memory [bytes], that limit.
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
    lasts: bool = False
    kills: int = 0
    limit: float = 0.0
    has_report: bool = False
    seconds: float = 0.0
    peak_bytes: int = 0
    at: float = field(default=0.0)

    def fits(self, log: LogSighting, fingerprint: str) -> bool:
        """Whether neither the log nor its fingerprint has changed."""
        return self.log.is_same_file(log) and self.fingerprint == fingerprint


def see_nothing(path: str) -> LogSighting:
    """The sighting of a log that cannot be looked at."""
    return LogSighting(path=path, size=0, mtime_ns=0, inode=0, seen_ns=0)


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


def _as_entry(content: Mapping[str, object]) -> Entry | None:
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
        log: state of its file when the batch was planned; empty if it cannot be read.
        fingerprint: hash of everything else the results depend on.
        options: options of the analysis, including the name of its run.
        before: previous ledger entry, whether or not the log has changed since.
    """

    path: Path
    log: LogSighting
    fingerprint: str
    options: Options
    before: Entry | None = None

    @property
    def run(self) -> str:
        """Name of its run; empty if it has none yet."""
        return self.options.run or ""


@dataclass(frozen=True, kw_only=True)
class Report:
    """Outcome of a task.

    Attributes:
        entry: new ledger entry of the log.
        is_new: whether a generation was published; false if nothing had changed.
        made: what the earlier results that it replaced were made with, where that was something else.
        earlier: folder of these.
        holder: who is working on the same run, so that nothing was done; empty where nobody is.
    """

    entry: Entry
    is_new: bool = False
    made: str = ""
    earlier: Path = Path()
    holder: str = ""


def work_safely(work: Callable[[Task], Report], task: Task) -> Report:
    """Do the work and return a report that can be pickled, of a failure if necessary.

    Args:
        work: function to call.
        task: its task.
    """
    entry = Entry(log=task.log, fingerprint=task.fingerprint, state="failed", run=task.run)
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
    entry = Entry(log=task.log, fingerprint=task.fingerprint, state="failed", run=task.run)
    is_new, made, earlier = False, "", Path()
    try:
        with store.claim(entry.run) as holder:
            if holder:
                return Report(entry=entry, holder=holder)
            entry, is_new, made, earlier = _analyze(task, entry)
    except SlipError as error:
        where = f"{error.where}: " if error.where and error.where != str(task.path) else ""
        state, lasts = judge_error(error)
        entry = replace(
            entry, state=state, lasts=lasts, code=error.code, reason=f"{where}{error.what}", hint=error.hint
        )
    except Exception as error:  # noqa: BLE001 - one log must not cost the others
        entry = _note_surprise(entry, error)
    entry = replace(
        entry,
        seconds=round(time.monotonic() - started, 3),
        peak_bytes=_peak_bytes(),
    )
    Ledger(store).write(entry)
    return Report(entry=entry, is_new=is_new, made=made, earlier=earlier)


def _analyze(task: Task, entry: Entry) -> tuple[Entry, bool, str, Path]:
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
    is_new = before is None or before.folder != outcome.manifest.folder
    return done, is_new, outcome.made, outcome.earlier


def _format_losses(outcome: Outcome) -> str:
    losses = objects_in(stored_contexts(outcome.manifest).get("extract", {}), "losses")
    return shorten("; ".join(str(loss.get("text")) for loss in losses), LONGEST_TEXT)


def _note_surprise(entry: Entry, error: BaseException) -> Entry:
    """Entry of an unforeseen error, with its location in the program."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    text = shorten(" ".join(str(error).split()), LONGEST_TEXT) or "no message"
    return replace(
        entry,
        code="unexpected_error",
        reason=f"{type(error).__name__}: {text} ({last.filename.rsplit('/', 1)[-1]}, line {last.lineno})",
        hint="This is a defect of the program: report it with this line and, if possible, the log",
    )


def _peak_bytes() -> int:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
