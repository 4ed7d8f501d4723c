"""Complete run of a batch: find, plan, process, pool, clean up."""

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from pipeline.batch import BatchError, Request, Shard
from pipeline.batch.batch_plan import (
    Item,
    Plan,
    make_plan,
    prune_results,
    refresh_pools,
)
from pipeline.batch.batch_work import (
    FATAL_KILLS,
    STATES,
    WITH_RESULTS,
    Blame,
    Entry,
    Executor,
    InlineExecutor,
    Ledger,
    Report,
    Settings,
    Task,
    work_on,
)
from pipeline.batch.executors import SCHEMES, LocalExecutor, open_cluster
from pipeline.batch.recordings import find_recordings
from pipeline.core import SlipError
from pipeline.store import Store

STOPPING = ("disk_full", "read_only", "no_locks", "cluster_lost")
"""Errors that would affect every other log as well."""

_BUSY_PAUSE_S = 0.25
_LOOK_PERIOD_S = 0.5


@dataclass(frozen=True, kw_only=True)
class Result:
    """Result of the workers.

    Attributes:
        reports: reports of every processed log.
        remaining: logs that were not started after an error that affects all.
    """

    reports: tuple[Report, ...]
    remaining: tuple[Item, ...]


def run_items(
    items: Sequence[Item],
    executor: Executor,
    *,
    request: Request,
    ledger: Ledger,
    notify: Callable[[Report, Item], None],
) -> Result:
    """Process logs.

    Args:
        items: the logs, in the order of processing.
        executor: the workers.
        request: options of the user.
        ledger: ledger for logs that kill their worker.
        notify: called for each finished log.
    """
    return _Run(executor, request, ledger, notify).work_through(items)


class _Run:
    def __init__(
        self, executor: Executor, request: Request, ledger: Ledger, notify: Callable[[Report, Item], None]
    ) -> None:
        self._executor = executor
        self._request = request
        self._ledger = ledger
        self._notify = notify
        self._queue: deque[Item] = deque()
        self._suspects: deque[Item] = deque()
        self._flying: dict[Future[Report], Item] = {}
        self._kills: dict[str, int] = {}
        self._reports: list[Report] = []
        self._busy_until = 0.0
        self._is_stopped = False

    def work_through(self, items: Sequence[Item]) -> Result:
        self._queue.extend(items)
        while self._flying or ((self._queue or self._suspects) and not self._is_stopped):
            self._fill()
            landed, _ = wait(self._flying, timeout=_LOOK_PERIOD_S, return_when=FIRST_COMPLETED)
            for future in landed:
                self._land(future, self._flying.pop(future))
        return Result(reports=tuple(self._reports), remaining=(*self._queue, *self._suspects))

    def _fill(self) -> None:
        """Submit tasks to the workers."""
        if self._is_stopped:
            return
        if not self._flying and time.monotonic() < self._busy_until:
            # Only logs that another batch is processing remain.
            time.sleep(_BUSY_PAUSE_S)
        while self._queue and len(self._flying) < self._executor.depth:
            item = self._queue.popleft()
            self._submit(item)
        if self._suspects and not self._queue and not self._flying:
            self._submit(self._suspects.popleft())

    def _submit(self, item: Item) -> None:
        self._flying[self._executor.submit(self._make_task(item))] = item

    def _make_task(self, item: Item) -> Task:
        return Task(
            path=item.path,
            log=item.log,
            fingerprint=item.fingerprint,
            options=replace(self._request.options, run=item.run),
        )

    def _land(self, future: Future[Report], item: Item) -> None:
        report: Report | None
        try:
            report = future.result()
        except (Exception, CancelledError) as error:  # noqa: BLE001 - whatever a worker can die of
            report = self._judge(item, error)
        if report is None:
            (self._suspects if self._executor.spreads_blame else self._queue).append(item)
            return
        if report.is_busy:
            self._busy_until = time.monotonic() + _BUSY_PAUSE_S
            self._queue.append(item)
            return
        if report.entry.code in STOPPING:
            self._is_stopped = True
        self._reports.append(report)
        self._notify(report, item)

    def _judge(self, item: Item, error: BaseException) -> Report | None:
        """Report for a task without one; None if the log is tried again."""
        blame = self._executor.blame(self._make_task(item), error)
        kills = self._kills.get(item.log.path, _kills_before(item)) + blame.kills
        self._kills[item.log.path] = kills
        if blame.kills and kills < FATAL_KILLS:
            return None
        entry = _make_entry(item, blame, kills)
        self._ledger.write(entry)
        return Report(entry=entry)


def _kills_before(item: Item) -> int:
    """Number of workers that the log killed before, if neither it nor its fingerprint has changed."""
    before = item.before
    if before is None or before.state == "quarantined" or not before.fits(item.log, item.fingerprint):
        return 0
    return before.kills


def _make_entry(item: Item, blame: Blame, kills: int) -> Entry:
    quarantined = kills >= FATAL_KILLS
    return Entry(
        log=item.log,
        fingerprint=item.fingerprint,
        state="quarantined" if quarantined else "failed",
        run=item.run,
        code=blame.code,
        reason=f"{blame.reason}; {kills} times" if quarantined else blame.reason,
        hint="It is skipped until it changes; --retry-quarantined tries it again"
        if quarantined
        else "Run the same command again",
        kills=kills,
    )


class Watch(Protocol):
    """Interface for the progress of a batch."""

    def plan(self, todo: int, settled: int, size: int) -> None:
        """Called once: logs to process, logs that are done, size of the former [bytes]."""

    def notify(self, line: Line, size: int) -> None:
        """Called for each finished log, with its size [bytes]."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """Outcome of one log.

    Attributes:
        path: the recording.
        run: name of its run.
        state: one of `STATES`, or ``growing``, ``left`` for a log that was not started, ``skipped`` for an
            unreadable path, for example a folder without permission or a pipe.
        code: code of the error.
        reason: why it failed or cannot show slip, or what was lost.
        hint: what to do.
        seconds: processing time; 0 if there was nothing to do.
        lossy: whether it has results, but the log had losses.
        refused: whether it has results, but cannot show slip.
        peak_bytes: peak memory of its worker.
        rss_bytes: memory of its worker afterwards.
        size_bytes: size of the log.
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
    peak_bytes: int = 0
    rss_bytes: int = 0
    size_bytes: int = 0


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of a batch.

    Attributes:
        lines: one per log, sorted by path.
        seconds: duration.
        problems: problems other than with logs: of the tables over all runs, or of pruning.
        removed: number of old generations removed.
        notified: what the command of the user was told.
    """

    lines: tuple[Line, ...]
    seconds: float
    problems: tuple[SlipError, ...] = ()
    removed: int = 0
    notified: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(init=False)

    def __post_init__(self) -> None:
        states = [line.state for line in self.lines]
        object.__setattr__(self, "counts", {state: states.count(state) for state in STATES})

    @property
    def has_failed(self) -> bool:
        """Whether an item that should have results has none."""
        is_short = any(line.state in {"failed", "quarantined", "left"} for line in self.lines)
        return is_short or bool(self.problems)

    @property
    def has_losses(self) -> bool:
        """Whether a log with results had losses or cannot show slip, or a path could not be read."""
        return any(line.lossy or line.refused or line.state == "skipped" for line in self.lines)


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
    store = Store(request.options.out)
    listed = find_recordings(request.targets, settle_s=request.settle_s)
    store.check_writable()
    ledger = Ledger(store)
    workforce = _Workforce(request, work, most=len(listed.recordings))
    try:
        new = _count_new(listed.recordings, ledger, request.shard)
        if new:
            workforce.call(new)
        plan = make_plan(listed.recordings, store, request)
        todo = _select(plan.todo, request.shard)
        watch.plan(len(todo), len(plan.settled), sum(item.log.size for item in todo))
        result = _work_through(todo, request, ledger, watch, workforce)
    finally:
        workforce.dismiss()
    problems, removed = _tidy_up(store, request)
    why = f"changed less than {request.settle_s:g} s ago, or still being written: run the batch again"
    growing = [Line(path=str(path), state="growing", reason=why) for path in listed.growing]
    skipped = [Line(path=str(each.path), state="skipped", reason=each.reason) for each in listed.skipped]
    why = "not started: see the other errors"
    remaining = [Line(path=one.log.path, run=one.run, state="left", reason=why) for one in result.remaining]
    lines = [*_list_plan(plan), *map(_make_line, result.reports), *remaining]
    return Outcome(
        lines=tuple(sorted((*lines, *growing, *skipped), key=lambda line: line.path)),
        seconds=time.monotonic() - started,
        problems=problems,
        removed=removed,
    )


def _tidy_up(store: Store, request: Request) -> tuple[tuple[SlipError, ...], int]:
    """Pool the runs and remove old generations; errors are returned, so that they do not hide the outcome."""
    problems: list[SlipError] = []
    removed = 0
    try:
        refresh_pools(store)
        if request.pruning is not None:
            pruned = prune_results(store, request.pruning)
            removed = len(pruned.removed)
            problems += pruned.problems
    except SlipError as error:
        problems.append(error)
    every = {str(problem): problem for problem in (*problems, *store.survey().errors)}
    return tuple(every.values()), removed


def _select(todo: Sequence[Item], shard: Shard | None) -> list[Item]:
    """Logs of this machine: selected by the run's name, so that machines need no communication."""
    if shard is None:
        return list(todo)
    digests = [hashlib.sha256(item.run.encode()).digest() for item in todo]
    numbers = [int.from_bytes(digest[:8], "big") % shard.count + 1 for digest in digests]
    return [item for item, number in zip(todo, numbers, strict=True) if number == shard.number]


class _Workforce:
    """The workers: started as soon as there is certainly work, possibly before the plan is complete."""

    def __init__(self, request: Request, work: Callable[[Task], Report], *, most: int) -> None:
        self._request = request
        self._settings = Settings(
            jobs=min(request.jobs, most),
            timeout_s=request.timeout_s,
            memory_bytes=request.memory_bytes,
            work=work,
        )
        self._executor: Executor | None = None

    def call(self, tasks: int) -> Executor:
        """Start the workers and prepare them for this number of tasks."""
        if self._executor is None:
            self._executor = open_executor(self._request.executor, self._settings)
        self._executor.expect(tasks)
        return self._executor

    def dismiss(self) -> None:
        """End the workers."""
        if self._executor is not None:
            self._executor.close()


def open_executor(word: str, settings: Settings) -> Executor:
    """Start or connect to the workers of the given name.

    Raises:
        BatchError: ``no_such_executor``, or the workers cannot be started.
    """
    if word == "dask" or word.startswith(SCHEMES):
        return open_cluster(word, settings)
    if word == "local":
        return LocalExecutor(settings)
    if word == "inline":
        return InlineExecutor(settings)
    hint = "Use local, inline, dask, or the address of a dask scheduler such as tcp://host:8786"
    raise BatchError("no_such_executor", f"no executor is called {word!r}", hint=hint)


def _count_new(paths: Sequence[Path], ledger: Ledger, shard: Shard | None) -> int:
    """Number of logs without a ledger entry; zero with a shard, as none is certain to be this machine's."""
    if shard is not None:
        return 0
    known = ledger.read_all()
    return sum(str(path) not in known for path in paths)


def _work_through(
    todo: Sequence[Item], request: Request, ledger: Ledger, watch: Watch, workforce: _Workforce
) -> Result:
    if not todo:
        return Result(reports=(), remaining=())
    executor = workforce.call(len(todo))
    return run_items(
        todo,
        executor,
        request=request,
        ledger=ledger,
        notify=lambda report, item: watch.notify(_make_line(report), item.log.size),
    )


def _list_plan(plan: Plan) -> list[Line]:
    lines = []
    for entry in plan.settled:
        if entry.state == "quarantined":
            lines.append(_make_line_of(entry, "quarantined"))
        elif entry.state == "copy":
            reason = f"the same content as {entry.reason}"
            lines.append(Line(path=entry.log.path, run=entry.reason, state="unchanged", reason=reason))
        else:
            lines.append(_make_line_of(entry, "unchanged"))
    return lines


def _make_line(report: Report) -> Line:
    entry = report.entry
    is_fine = entry.state in WITH_RESULTS
    state = "unchanged" if is_fine and not report.is_new else entry.state
    return _make_line_of(entry, state, report)


def _make_line_of(entry: Entry, state: str, report: Report | None = None) -> Line:
    line = Line(
        path=entry.log.path,
        run=entry.run,
        state=state,
        code=entry.code,
        reason=entry.reason,
        hint=entry.hint,
        lossy=entry.state == "lossy",
        refused=entry.state == "refused",
        size_bytes=entry.log.size,
    )
    if report is None:
        return line
    cost = {name: getattr(entry, name) for name in ("seconds", "peak_bytes")}
    return replace(line, rss_bytes=report.rss_bytes, **cost)
