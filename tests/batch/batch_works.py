"""What the tests let workers do; importable in fresh processes."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

from poison import do_harm

from pipeline.batch.batch_work import Report, Task, work_on
from pipeline.job import analyze
from pipeline.store import Store

if TYPE_CHECKING:
    from collections.abc import Callable


def work_poisoned(task: Task) -> Report:
    """As usual, but logs whose names say so are poison."""
    kind = task.path.stem
    do_harm(kind, str(task.path))
    if kind == "unpicklable":
        return lambda: None  # type: ignore[return-value]
    return work_on(task)


def work_dying_at_steps(task: Task) -> Report:
    """As usual, but each worker is killed once, at the step of a commit that its log is named after."""
    with watch_commits(task, lambda: os.kill(os.getpid(), signal.SIGKILL)):
        return work_on(task)


class watch_commits:  # noqa: N801 - reads like a function
    """Calls ``kill`` at the step of a commit that the log is named after, the first time."""

    def __init__(self, task: Task, kill: Callable[[], None]) -> None:
        self.step = task.path.stem
        self.marker = task.path.with_suffix(".killed")
        self.kill = kill
        self.original = analyze.Store

    def __enter__(self) -> None:
        def watch(step: str) -> None:
            if step == self.step and not self.marker.exists():
                self.marker.write_bytes(b"")
                self.kill()

        analyze.Store = lambda root: Store(root, watch=watch)  # type: ignore[assignment, misc]

    def __exit__(self, *_: object) -> None:
        analyze.Store = self.original  # type: ignore[misc]


def work_slowly(task: Task) -> Report:
    """As usual, but telling who began, and long enough to be caught at it."""
    marker = Path(os.environ["BEGUN"]) / f"{task.path.stem}-{os.getpid()}"
    marker.write_bytes(b"")
    time.sleep(float(os.environ.get("PAUSE_S", "0.5")))
    return work_on(task)


def work_killing_the_batch(task: Task) -> Report:
    """As usual, but at the step that ``DIE_AT`` names the batch is killed with all its workers."""
    if task.path.stem != os.environ["DIE_AT"]:
        return work_on(task)
    with watch_commits(task, lambda: os.killpg(0, signal.SIGKILL)):
        return work_on(task)
