"""Where logs are worked on: one file an executor, found by being in this folder.

An executor takes tasks and gives `concurrent.futures.Future`; the runner knows nothing else of it. A module
here defines ``accepts(word)`` and ``open_executor(word, settings)``.
"""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from pipeline.batch.request import BatchError

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Future

    from pipeline.batch.batch_work import Report, Task


@dataclass(frozen=True)
class Settings:
    """What an executor needs to know.

    Attributes:
        jobs: tasks at once.
        timeout_s: longest time for one task [s].
        memory_bytes: most memory for one task.
        work: what is done with a task; importable by its name in a fresh process.
    """

    jobs: int
    timeout_s: float
    memory_bytes: int
    work: Callable[[Task], Report]


@dataclass(frozen=True)
class Blame:
    """Why a task has no report.

    Attributes:
        code: ``worker_died``, ``timed_out``, ``out_of_memory``, ``no_result``, ...
        reason: one sentence without a full stop.
        kills: workers that the task has cost.
    """

    code: str
    reason: str
    kills: int


class Executor(Protocol):
    """Workers."""

    depth: int
    """Tasks that it likes to have at once, waiting ones included."""
    spreads_blame: bool
    """Whether a worker that dies may make innocent tasks look guilty; suspects are then tried alone."""

    def expect(self, tasks: int) -> None:
        """Get ready for so many tasks, which are certain to come."""

    def submit(self, task: Task) -> Future[Report]:
        """Work on a task some time."""

    def blame(self, task: Task, error: BaseException) -> Blame:
        """What the exception of a future means."""

    def close(self) -> None:
        """End the workers, without waiting for unfinished tasks."""


class _Module(Protocol):
    def accepts(self, word: str) -> bool:
        """Whether this executor is meant by the word of ``--executor``."""

    def open_executor(self, word: str, settings: Settings) -> Executor:
        """Start or reach the workers."""


def find_executor(word: str, settings: Settings) -> Executor:
    """Start or reach the workers that a word names.

    Raises:
        BatchError: ``no_such_executor``, or the workers cannot be had.
    """
    for info in pkgutil.iter_modules(__path__):
        module: _Module = importlib.import_module(f"{__name__}.{info.name}")
        if module.accepts(word):
            return module.open_executor(word, settings)
    hint = "Use local, inline, dask, or the address of a dask scheduler such as tcp://host:8786"
    raise BatchError("no_such_executor", f"no executor is called {word!r}", hint=hint)
