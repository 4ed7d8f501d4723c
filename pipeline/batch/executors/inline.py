"""This very process, one log after the other: for debugging, and where processes cannot be started.

Nothing is isolated here: a log that crashes, hangs or eats memory takes the batch along.
"""

from __future__ import annotations

from concurrent.futures import Future

from pipeline.batch.batch_work import Report, Task, work_safely
from pipeline.batch.executors import Blame, Settings


def accepts(word: str) -> bool:
    """Whether ``--executor`` means this one."""
    return word == "inline"


def open_executor(word: str, settings: Settings) -> InlineExecutor:
    """Nothing has to be started."""
    del word
    return InlineExecutor(settings)


class InlineExecutor:
    """Works on a task as soon as it is submitted."""

    depth = 1
    # Nobody is left to blame.
    spreads_blame = False

    def __init__(self, settings: Settings) -> None:
        self._work = settings.work

    def expect(self, tasks: int) -> None:
        """Nothing has to be made ready."""

    def submit(self, task: Task) -> Future[Report]:
        """Work on a task now."""
        future: Future[Report] = Future()
        future.set_result(work_safely(self._work, task))
        return future

    def blame(self, task: Task, error: BaseException) -> Blame:
        """What the exception of a future means; none is raised by a log."""
        del task
        return Blame("no_result", f"it gave no result: {type(error).__name__}: {error}", 0)

    def close(self) -> None:
        """Nothing has to be ended."""
