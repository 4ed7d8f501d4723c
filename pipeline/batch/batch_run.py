"""Complete run of a batch: find, plan, process, pool, clean up."""

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, cast

from pipeline.analysis.analyze import describe_replaced
from pipeline.batch import Request, Shard, Stop
from pipeline.batch.batch_plan import make_plan, prune_results, refresh_pools
from pipeline.batch.batch_work import STATES, Entry, Ledger, Report, Task, work_on
from pipeline.batch.executors import Executor, Limits, find_blame, open_executor
from pipeline.batch.recordings import Recordings, Skipped, find_recordings
from pipeline.core import INTERRUPTED, NOT_STARTED, UNFINISHED, SlipError
from pipeline.datasets import note_robots
from pipeline.report import list_noted, mark_batch, note_vehicles
from pipeline.store import JSON, LAST_BATCH, Store
from pipeline.words import describe_unfinished

STOPPING = ("disk_full", "read_only", "no_locks", "cluster_lost")
"""Errors that would affect every other log as well."""

STOPPED = "the batch was stopped"

FAILED_STATES = ("failed", "quarantined", *UNFINISHED)
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
        """The path and the error of each failure, what affects all logs first, what is unfinished last."""
        own = sorted(
            (line for line in self.lines if line.state in {"failed", "quarantined"}),
            key=lambda line: (line.code not in STOPPING, line.unchanged, line.path),
        )
        errors = [(line.path, SlipError(line.code, line.reason, hint=line.hint)) for line in own]
        errors += [("", problem) for problem in self.problems]
        return [*errors, *(("", error) for error in self.list_unfinished())]

    def list_unfinished(self) -> list[SlipError]:
        """An error for each of `UNFINISHED` that there are logs in: they have one cause."""
        hint = "Run the same command again" + ("" if self.stopped else " when the cause is removed")
        causes = {state: [line.reason for line in self.lines if line.state == state] for state in UNFINISHED}
        return [
            SlipError(state, f"{describe_unfinished({state: len(each)})}: {each[0]}", hint=hint)
            for state, each in causes.items()
            if each
        ]

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
        what = "the batch was stopped before it could say what became of its logs"
        problem = SlipError("stopped", what, hint="Run the same command again")
        return Outcome(
            lines=(),
            seconds=time.monotonic() - started,
            problems=(problem,),
            stopped=int(stop.code or 0),
        )


@dataclass
class _Progress:
    """What a batch has done with its logs so far.

    Attributes:
        watch: is told of each log.
        todo: the logs to work on.
        lines: outcomes.
        interrupted: logs that a signal interrupted; of a cluster nobody knows which these are.
        waited: who was working on a log before, by its path.
        earlier: of a log with new results, what the earlier ones were made with, and their folder.
    """

    watch: Watch
    todo: Sequence[Task]
    lines: list[Line]
    interrupted: list[Task] = field(default_factory=list)
    waited: dict[str, str] = field(default_factory=dict)
    earlier: dict[str, tuple[str, Path]] = field(default_factory=dict)

    def receive(self, report: Report) -> None:
        """Take the report on a log."""
        path = report.entry.log.path
        if report.holder:
            if path not in self.waited:
                self.watch.wait(report.entry.run or path, report.holder)
            self.waited[path] = report.holder
            return
        line = _make_line(report.entry, is_new=report.is_new)
        self.lines.append(replace(line, waited_for=self.waited.get(path, "")))
        self.earlier[path] = report.made, report.earlier
        self.watch.notify(self.lines[-1], report.entry.log.size)

    def interrupt(self, given: Mapping[Future[Report], Task]) -> None:
        """Take the reports that are there of the logs that workers were given; the others are interrupted."""
        for future, task in given.items():
            if future.done() and not future.cancelled() and future.exception() is None:
                self.receive(future.result())
            elif future.done() or future.running():
                self.interrupted.append(task)

    def list_unfinished(self) -> list[Line]:
        """Logs without an outcome, because of an error that affects all or a signal."""
        known = {line.path for line in self.lines}
        interrupted = {one.log.path for one in self.interrupted}
        return [
            Line(path=path, run=one.run, state=state, code=state)
            for one in self.todo
            if (path := one.log.path) not in known
            for state in (INTERRUPTED if path in interrupted else NOT_STARTED,)
        ]


def _run(request: Request, watch: Watch, work: Callable[[Task], Report], started: float) -> Outcome:
    began = round(time.time(), 3)
    store = Store(request.options.out)
    listed, planned, settled, notes = _find_work(store, request, began)
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
    progress = _Progress(watch, todo, [*map(_settle, settled)])
    problems: tuple[SlipError, ...] = ()
    removed = stopped = 0
    try:
        try:
            _work_through(progress, request, work)
        except Stop as stop:
            stopped = int(stop.code or 0)
        # Tables and pages hold what a stopped batch has done, unless it is stopped again.
        problems, removed = _tidy_up(store, request, prunes=not stopped)
    except Stop as stop:
        stopped = int(stop.code or 0)
    finally:
        unfinished = progress.list_unfinished()
        if request.targets:
            ended: dict[str, JSON] = {"at": round(time.time(), 3), "stopped": bool(stopped)}
            states = [line.state for line in unfinished]
            _note_batch(store, note | ended | {state: states.count(state) for state in UNFINISHED})
    # Pruning may have removed them by now.
    lines = [
        replace(line, replaced=describe_replaced(*progress.earlier.get(line.path, ("", Path()))))
        for line in progress.lines
    ]
    # Only an error that affects every log, or a signal, leaves some.
    cause = STOPPED if stopped else next((line.reason for line in lines if line.code in STOPPING), "")
    lines += [replace(line, reason=cause) for line in unfinished]
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


def _find_work(
    store: Store, request: Request, began: float
) -> tuple[Recordings, list[Task], list[Entry], list[str]]:
    """The recordings, and what `make_plan` makes of them; with a note where that comes to no end."""
    try:
        listed = find_recordings(request.targets, settle_s=request.settle_s)
        store.check_writable()
        try:
            return listed, *make_plan(listed, store, request)
        except SlipError as error:
            _note_early_end(store, began, {"failed": str(error)})
            raise
    except Stop:
        _note_early_end(store, began, {"stopped": True})
        raise


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


def _note_early_end(store: Store, began: float, how: dict[str, JSON]) -> None:
    """Note that a batch ended before it came to its logs; which paths it left out stays as it was."""
    folder, name = LAST_BATCH
    unseen = (store.notes(folder).read(name) or {}).get("left_out")
    _note_batch(store, {"began": began, "at": round(time.time(), 3), "left_out": cast("JSON", unseen), **how})


def _work_through(progress: _Progress, request: Request, work: Callable[[Task], Report]) -> None:
    """Process logs, in their order, up to an error that affects all.

    Raises:
        Stop: a signal.
    """
    todo = progress.todo
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
                _submit(queue.popleft(), executor, flying, progress)
            if suspects and not flying and not is_stopped:
                _submit(suspects.popleft(), executor, flying, progress)
            for future in wait(flying, return_when=FIRST_COMPLETED).done:
                task = flying.pop(future)
                report = _take_report(future, task, request, ledger)
                if report.entry.kills == 1:
                    (suspects if executor.spreads_blame else queue).append(task)
                    continue
                progress.receive(report)
                if report.holder:
                    time.sleep(_BUSY_PAUSE_S)
                    queue.append(task)
                is_stopped |= report.entry.code in STOPPING
    except Stop:
        progress.interrupt(flying)
        raise
    finally:
        executor.close()


def _submit(task: Task, executor: Executor, flying: dict[Future[Report], Task], progress: _Progress) -> None:
    """Give a log to the workers; that of this process works on it here, where a signal interrupts it."""
    progress.interrupted.append(task)
    flying[executor.submit(task)] = task
    progress.interrupted.remove(task)


def _take_report(future: Future[Report], task: Task, request: Request, ledger: Ledger) -> Report:
    """The report on a log; one of its own where the worker was lost."""
    try:
        return future.result()
    except (Exception, CancelledError) as error:  # noqa: BLE001 - whatever a worker can die of
        code, reason = find_blame(task, error)
        return Report(entry=_judge(task, code, reason, request.find_limit(code), ledger))


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


def _tidy_up(store: Store, request: Request, *, prunes: bool) -> tuple[tuple[SlipError, ...], int]:
    """Pool the runs and remove old generations; errors are returned, so that they do not hide the outcome."""
    problems: list[SlipError] = []
    removed = 0
    try:
        refresh_pools(store)
        if prunes and request.pruning is not None:
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
