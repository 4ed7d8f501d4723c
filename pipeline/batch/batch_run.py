"""Complete run of a batch: find, plan, process, pool, clean up."""

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, cast

from pipeline.analysis.analyze import describe_replaced
from pipeline.batch import Request, Shard, Stop
from pipeline.batch.batch_plan import make_plan, prune_results, refresh_pools
from pipeline.batch.batch_work import STATES, Entry, Ledger, Report, Task, work_on
from pipeline.batch.executors import Limits, find_blame, open_executor
from pipeline.batch.recordings import Recordings, Skipped, find_recordings
from pipeline.core import SlipError, format_count
from pipeline.datasets import note_robots
from pipeline.report import list_noted, mark_batch, note_vehicles
from pipeline.store import JSON, LAST_BATCH, Store

STOPPING = ("disk_full", "read_only", "no_locks", "cluster_lost")
"""Errors that would affect every other log as well."""

STOPPED = "the batch was stopped"

FAILED_STATES = ("failed", "quarantined", "not_started")
"""States of logs that should have results and have none."""

_RETRY = "It is skipped until it changes; --retry-quarantined tries it again"
_RETRIES = {
    "timed_out": "It is skipped until it changes or --timeout is longer; --retry-quarantined tries it again",
    "out_of_memory": "It is skipped until it changes or has more memory (--memory, or fewer --jobs); "
    "--retry-quarantined tries it again",
}
_BUSY_PAUSE_S = 0.25
_FATAL_KILLS = 2
"""Number of killed workers after which a log is quarantined until it, or its fingerprint, changes."""


class Watch(Protocol):
    """Interface for the progress of a batch."""

    def plan(self, todo: int, settled: int, size: int) -> None:
        """Called once: logs to process, logs that are done, size of the former [bytes]."""

    def wait(self, log: str, holder: str) -> None:
        """Called once for each log that waits for somebody else, with who that is."""

    def notify(self, line: Line, size: int) -> None:
        """Called for each finished log, with its size [bytes]."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """Outcome of one log.

    Attributes:
        path: the recording.
        run: name of its run.
        state: the one of `STATES` under which it is counted and listed: what its results are, new or not. A
            log without losses is ``unchanged`` where there was nothing to do; ``left_out`` is a path that
            cannot be read, for example a folder without permission or a pipe, and ``gone`` a log with
            results that is not there any more.
        code: code of the error.
        reason: why it failed or cannot show slip, or what was lost.
        hint: what to do.
        seconds: processing time; 0 if there was nothing to do.
        lossy: whether it has results, but the log had losses.
        refused: whether it cannot show slip, with results or without.
        unchanged: whether an earlier batch came to this, and nothing has changed since.
        peak_bytes: peak memory of its worker.
        size_bytes: size of the log.
        waited_for: who was working on it before; empty without anybody.
        replaced: what its earlier results were made with and where they are kept, if they were others.
    """

    path: str
    run: str = ""
    state: str
    code: str = ""
    reason: str = ""
    hint: str = ""
    seconds: float = 0.0
    lossy: bool = False
    refused: bool = False
    unchanged: bool = False
    peak_bytes: int = 0
    size_bytes: int = 0
    waited_for: str = ""
    replaced: str = ""


def format_not_started(number: int) -> str:
    """How many logs were not started, in words."""
    return f"{format_count(number, 'log')} {'was' if number == 1 else 'were'} not started"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of a batch.

    Attributes:
        lines: one per log, sorted by path.
        seconds: duration.
        problems: problems other than with logs: of the tables over all runs, or of pruning.
        removed: number of old generations removed.
        notified: what was reported to the command of the user.
        notes: what the user may have meant otherwise, in sentences.
        stopped: exit code of a batch that a signal stopped; 0 if none did.
    """

    lines: tuple[Line, ...]
    seconds: float
    problems: tuple[SlipError, ...] = ()
    removed: int = 0
    notified: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    stopped: int = 0

    @property
    def counts(self) -> dict[str, int]:
        """How many logs came out how; each counts once."""
        states = [line.state for line in self.lines]
        return {state: states.count(state) for state in STATES}

    def list_errors(self) -> list[tuple[str, SlipError]]:
        """The path and the error of each failure, what affects all logs first, the logs it stopped as one."""
        own = sorted(
            (line for line in self.lines if line.state in {"failed", "quarantined"}),
            key=lambda line: (line.code not in STOPPING, line.unchanged, line.path),
        )
        waiting = [line for line in self.lines if line.state == "not_started"]
        errors = [(line.path, SlipError(line.code, line.reason, hint=line.hint)) for line in own]
        errors += [("", problem) for problem in self.problems]
        if waiting:
            what = f"{format_not_started(len(waiting))}: {waiting[0].reason}"
            hint = "Run the same command again" + ("" if self.stopped else " when the cause is removed")
            errors.append(("", SlipError("not_started", what, hint=hint)))
        return errors

    @property
    def has_failed(self) -> bool:
        """Whether this batch failed: with a log that is new, changed or tried again, or with another step."""
        return any(line.state in FAILED_STATES and not line.unchanged for line in self.lines) or bool(
            self.problems
        )

    @property
    def has_losses(self) -> bool:
        """Whether a log had losses, cannot show slip, failed before, could not be read, or is newly gone."""
        # The results of a log that is gone are whole: once is enough.
        lasting = {"lossy", "refused", "left_out", *FAILED_STATES}
        return any(
            line.state in lasting or (line.state == "gone" and not line.unchanged) for line in self.lines
        )


def run_batch(request: Request, watch: Watch, work: Callable[[Task], Report] = work_on) -> Outcome:
    """Update the results from the logs.

    Args:
        request: options of the user.
        watch: receives the progress.
        work: function called for each log, importable by its name in a fresh process.

    Raises:
        BatchError: there are no such logs, or no workers can be started.
        StoreError: the results cannot be written at all.
    """
    started = time.monotonic()
    try:
        return _run(request, watch, work, started)
    except Stop as stop:
        # The logs were not known yet.
        return Outcome(lines=(), seconds=time.monotonic() - started, stopped=int(stop.code or 0))


def _run(request: Request, watch: Watch, work: Callable[[Task], Report], started: float) -> Outcome:
    began = round(time.time(), 3)
    store = Store(request.options.out)
    listed = find_recordings(request.targets, settle_s=request.settle_s)
    store.check_writable()
    try:
        planned, settled, notes = make_plan(listed, store, request)
    except SlipError as error:
        _note_failure(store, began, error)
        raise
    ignored = {entry.log.path for entry in settled if entry.state == "ignored"}
    skipped = [each for each in listed.skipped if str(each.path) not in ignored]
    unseen: list[JSON] = [
        {"path": str(each.path), "reason": each.reason, "hint": each.hint} for each in skipped
    ]
    note: dict[str, JSON] = {"began": began, "at": None, "left_out": unseen}
    if request.targets:
        _note_batch(store, note)
    todo = _select(planned, request.shard)
    if request.targets:
        watch.plan(len(todo), len(settled), sum(task.log.size for task in todo))
    lines = [*map(_settle, settled)]
    waited: dict[str, str] = {}
    earlier: dict[str, tuple[str, Path]] = {}

    def receive(report: Report) -> None:
        path = report.entry.log.path
        if report.holder:
            if path not in waited:
                watch.wait(report.entry.run or path, report.holder)
            waited[path] = report.holder
            return
        line = _make_line(report.entry, is_new=report.is_new)
        lines.append(replace(line, waited_for=waited.get(path, "")))
        earlier[path] = report.made, report.earlier
        watch.notify(lines[-1], report.entry.log.size)

    problems: tuple[SlipError, ...] = ()
    removed = stopped = 0
    try:
        _work_through(todo, request, work, receive)
        problems, removed = _tidy_up(store, request)
    except Stop as stop:
        stopped = int(stop.code or 0)
    finally:
        if request.targets:
            ended: dict[str, JSON] = {"at": round(time.time(), 3), "stopped": bool(stopped)}
            _note_batch(store, note | ended | {"not_started": len(_list_waiting(todo, lines, ""))})
    # Pruning may have removed them by now.
    lines = [
        replace(line, replaced=describe_replaced(*earlier.get(line.path, ("", Path())))) for line in lines
    ]
    # Only an error that affects every log, or a signal, leaves some.
    cause = STOPPED if stopped else next((line.reason for line in lines if line.code in STOPPING), "")
    lines += _list_waiting(todo, lines, cause)
    lines += _list_absent(store, listed, skipped, request, is_whole=not cause)
    runs = {line.run for line in lines}
    manifests = store.survey().manifests
    notes += [*note_robots(manifests), *note_vehicles(one for one in manifests if one.run in runs)]
    return Outcome(
        lines=tuple(sorted(lines, key=lambda line: line.path)),
        seconds=time.monotonic() - started,
        problems=problems,
        removed=removed,
        notes=tuple(notes),
        stopped=stopped,
    )


def _list_waiting(todo: Sequence[Task], lines: Sequence[Line], cause: str) -> list[Line]:
    """Logs that were not started, because of an error that affects all or a signal."""
    known = {line.path for line in lines}
    return [
        Line(path=one.log.path, run=one.run, state="not_started", code="not_started", reason=cause)
        for one in todo
        if one.log.path not in known
    ]


def _list_absent(
    store: Store, listed: Recordings, skipped: Sequence[Skipped], request: Request, *, is_whole: bool
) -> list[Line]:
    """Paths without a log to work on: still growing, left out, or gone."""
    why = f"changed less than {request.settle_s:g} s ago, or still being written: run the batch again"
    absent = [
        Line(path=str(each.path), state="left_out", reason=each.reason, hint=each.hint) for each in skipped
    ]
    # Whether a log is gone or was moved is known when all logs were worked on.
    absent += _find_gone(store, listed, request.shard) if is_whole else []
    lines = _mark_named(store, absent)
    if is_whole:
        _forget_named(store, absent, listed, request.shard)
    return [*lines, *(Line(path=str(path), state="growing", reason=why) for path in listed.growing)]


_NAMED = "batch/absent"
"""Folder of the notes on paths without a log that a batch has named."""


def _find_gone(store: Store, listed: Recordings, shard: Shard | None) -> list[Line]:
    """Logs with results that this batch would have found if they were still there."""
    runs = {path: entry.run for path, entry in Ledger(store).read_all().items()}
    return [
        Line(path=one["path"], run=runs[one["path"]], state="gone", reason=one["reason"])
        for one in list_noted(store)
        if one["state"] == "gone"
        and listed.would_list(Path(one["path"]))
        and _is_own(runs[one["path"]], shard)
    ]


def _mark_named(store: Store, absent: Sequence[Line]) -> list[Line]:
    """Lines of paths without a log: unchanged where an earlier batch has said the same; remembered."""
    notes = store.notes(_NAMED)
    marked: list[Line] = []
    for line in absent:
        note = {"path": line.path, "run": line.run, "reason": line.reason}
        is_old = notes.read(line.path) == note
        if not is_old:
            with suppress(SlipError):
                notes.write(line.path, note)
        marked.append(replace(line, unchanged=is_old))
    return marked


def _forget_named(store: Store, absent: Sequence[Line], listed: Recordings, shard: Shard | None) -> None:
    """Forget which paths had no log where that is over."""
    notes = store.notes(_NAMED)
    now = {line.path for line in absent}
    for note in list(notes.read_all()):
        path = str(note.get("path"))
        if path not in now and listed.would_list(Path(path)) and _is_own(str(note.get("run")), shard):
            notes.remove(path)


def _note_batch(store: Store, note: dict[str, JSON]) -> None:
    """Note that a batch began or ended, also where all logs are unchanged; a full disk is told elsewhere."""
    folder, name = LAST_BATCH
    with suppress(SlipError):
        store.notes(folder).write(name, note)
        mark_batch(store)


def _note_failure(store: Store, began: float, error: SlipError) -> None:
    """Note that a batch failed before it came to its logs; which paths it left out stays as it was."""
    folder, name = LAST_BATCH
    unseen = (store.notes(folder).read(name) or {}).get("left_out")
    _note_batch(
        store,
        {"began": began, "at": round(time.time(), 3), "failed": str(error), "left_out": cast("JSON", unseen)},
    )


def _work_through(
    todo: Sequence[Task], request: Request, work: Callable[[Task], Report], receive: Callable[[Report], None]
) -> None:
    """Process logs, in their order, up to an error that affects all."""
    if not todo:
        return
    limits = Limits(request.timeout_s, request.memory_bytes)
    executor = open_executor(request.executor, work, limits, min(request.jobs, len(todo)))
    ledger = Ledger(Store(request.options.out))
    queue, suspects = deque(todo), deque[Task]()
    flying: dict[Future[Report], Task] = {}
    is_stopped = False
    try:
        while flying or ((queue or suspects) and not is_stopped):
            while queue and len(flying) < executor.depth and not is_stopped:
                task = queue.popleft()
                flying[executor.submit(task)] = task
            if suspects and not flying and not is_stopped:
                task = suspects.popleft()
                flying[executor.submit(task)] = task
            for future in wait(flying, return_when=FIRST_COMPLETED).done:
                task = flying.pop(future)
                try:
                    report = future.result()
                except (Exception, CancelledError) as error:  # noqa: BLE001 - whatever a worker can die of
                    code, reason = find_blame(task, error)
                    report = Report(entry=_judge(task, code, reason, request.find_limit(code), ledger))
                    if report.entry.kills == 1:
                        (suspects if executor.spreads_blame else queue).append(task)
                        continue
                if report.holder:
                    receive(report)
                    time.sleep(_BUSY_PAUSE_S)
                    queue.append(task)
                    continue
                is_stopped |= report.entry.code in STOPPING
                receive(report)
    finally:
        executor.close()


def _judge(task: Task, code: str, reason: str, limit: float, ledger: Ledger) -> Entry:
    """Entry of a log whose worker was lost: failed at first, then quarantined until it changes.

    One that exceeded a limit also leaves the quarantine when that limit is raised.
    """
    before = ledger.read(task.log.path)
    is_known = before is not None and before.state == "failed" and before.fits(task.log, task.fingerprint)
    kills = 0 if code in STOPPING else 1 + (before.kills if before is not None and is_known else 0)
    quarantined = kills >= _FATAL_KILLS
    entry = Entry(
        log=task.log,
        fingerprint=task.fingerprint,
        state="quarantined" if quarantined else "failed",
        run=task.run,
        code=code,
        reason=f"{reason}; {kills} times" if quarantined else reason,
        hint=_RETRIES.get(code, _RETRY) if quarantined else "Run the same command again",
        kills=kills,
        limit=limit,
    )
    ledger.write(entry)
    return entry


def _tidy_up(store: Store, request: Request) -> tuple[tuple[SlipError, ...], int]:
    """Pool the runs and remove old generations; errors are returned, so that they do not hide the outcome."""
    problems: list[SlipError] = []
    removed = 0
    try:
        refresh_pools(store)
        if request.pruning is not None:
            removed, unmet = prune_results(store, request.pruning)
            problems += unmet
    except SlipError as error:
        problems.append(error)
    every = {str(problem): problem for problem in (*problems, *store.survey().errors)}
    return tuple(every.values()), removed


def _select(todo: Sequence[Task], shard: Shard | None) -> list[Task]:
    """Logs of this machine."""
    return [task for task in todo if _is_own(task.run, shard)]


def _is_own(run: str, shard: Shard | None) -> bool:
    """Whether a run is this machine's: by its name, so that machines need no communication."""
    if shard is None:
        return True
    digest = hashlib.sha256(run.encode()).digest()
    return int.from_bytes(digest[:8], "big") % shard.count + 1 == shard.number


def _settle(entry: Entry) -> Line:
    """Line of a log that there is nothing to do for."""
    line = _make_line(replace(entry, seconds=0.0, peak_bytes=0), is_new=False)
    if entry.state == "copy":
        line = replace(line, run=entry.reason, reason=f"the same content as {entry.reason}")
    return replace(line, unchanged=entry.at > 0.0)


def _make_line(entry: Entry, *, is_new: bool) -> Line:
    return Line(
        path=entry.log.path,
        run=entry.run,
        state="unchanged" if entry.state == "done" and not is_new else entry.state,
        code=entry.code,
        reason=entry.reason,
        hint=entry.hint,
        seconds=entry.seconds,
        lossy=entry.state == "lossy",
        refused=entry.state == "refused",
        peak_bytes=entry.peak_bytes,
        size_bytes=entry.log.size,
    )
