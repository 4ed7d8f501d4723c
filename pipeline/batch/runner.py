"""Working on many logs: keeps the workers busy, keeps going past failures, tries again what may be chance."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from dataclasses import dataclass, replace

from pipeline.batch.executors import Blame, Executor
from pipeline.batch.ledger import FATAL_KILLS, Entry, Ledger
from pipeline.batch.plan import Item
from pipeline.batch.request import Request
from pipeline.batch.work import Report, Task

STOPPING = ("disk_full", "read_only", "no_locks", "cluster_lost")
"""Errors that every other log would meet as well."""

_BUSY_PAUSE_S = 0.25
_LOOK_PERIOD_S = 0.5


@dataclass(frozen=True, kw_only=True)
class Result:
    """What the workers gave.

    Attributes:
        reports: of every log that was worked on.
        left: logs that were not begun, because none could have been finished.
    """

    reports: tuple[Report, ...]
    left: tuple[Item, ...]


def run_items(
    items: Sequence[Item],
    executor: Executor,
    *,
    request: Request,
    ledger: Ledger,
    tell: Callable[[Report, Item], None],
) -> Result:
    """Work on logs.

    Args:
        items: the logs, in the order to begin them.
        executor: the workers.
        request: what the user asked for.
        ledger: where it is noted that a log has killed its worker.
        tell: told of each log that is finished.
    """
    return _Run(executor, request, ledger, tell).work_through(items)


class _Run:
    def __init__(
        self, executor: Executor, request: Request, ledger: Ledger, tell: Callable[[Report, Item], None]
    ) -> None:
        self._executor = executor
        self._request = request
        self._ledger = ledger
        self._tell = tell
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
        return Result(reports=tuple(self._reports), left=(*self._queue, *self._suspects))

    def _fill(self) -> None:
        """Give the workers something to do."""
        if self._is_stopped:
            return
        if not self._flying and time.monotonic() < self._busy_until:
            # Nothing is left but what another batch is working on.
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
            basis=item.basis,
            options=replace(self._request.options, run=item.run),
            address=self._request.address,
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
        self._tell(report, item)

    def _judge(self, item: Item, error: BaseException) -> Report | None:
        """A report in the place of one that never came; None when the log gets another chance."""
        blame = self._executor.blame(self._make_task(item), error)
        kills = self._kills.get(item.log.path, _kills_before(item)) + blame.kills
        self._kills[item.log.path] = kills
        if blame.kills and kills < FATAL_KILLS:
            return None
        entry = _describe_blame(item, blame, kills)
        self._ledger.write(entry)
        return Report(entry=entry)


def _kills_before(item: Item) -> int:
    """Workers that the log killed in earlier batches, if neither it nor the program has changed since."""
    before = item.before
    if before is None or before.state == "quarantined" or not before.fits(item.log, item.basis):
        return 0
    return before.kills


def _describe_blame(item: Item, blame: Blame, kills: int) -> Entry:
    quarantined = kills >= FATAL_KILLS
    return Entry(
        log=item.log,
        basis=item.basis,
        state="quarantined" if quarantined else "failed",
        run=item.run,
        code=blame.code,
        reason=f"{blame.reason}; {kills} times" if quarantined else blame.reason,
        hint="It is left alone until it changes; try it again with --retry-quarantined"
        if quarantined
        else "Run the same command again",
        kills=kills,
    )
