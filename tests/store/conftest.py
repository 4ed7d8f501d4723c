import multiprocessing
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import store_writer

from pipeline.store import Store

StartWriter = Callable[..., "Writer"]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "results", patience_s=10.0)


class Writer:
    """A function of `store_writer.py` in a process of its own, and what that says."""

    def __init__(self, *arguments: object) -> None:
        # A server that has loaded everything forks the writers: none waits for its libraries.
        server = multiprocessing.get_context("forkserver")
        server.set_forkserver_preload(["pytest", "polars", "pipeline.store", "schemas"])
        hears, says = server.Pipe(duplex=False)
        self._process = server.Process(target=store_writer.run, args=(says, *map(str, arguments)))
        self._process.start()
        says.close()
        self.stdout = os.fdopen(os.dup(hears.fileno()))
        hears.close()

    @property
    def pid(self) -> int | None:
        return self._process.pid

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float = 30.0) -> int | None:
        self._process.join(timeout)
        return self._process.exitcode

    def kill(self) -> None:
        self._process.kill()

    def close(self) -> None:
        self.kill()
        self._process.join()
        self.stdout.close()


@pytest.fixture
def start_writer() -> Iterator[StartWriter]:
    """Starts a `Writer`; whatever still runs at the end is killed."""
    started: list[Writer] = []

    def start(*arguments: object) -> Writer:
        started.append(Writer(*arguments))
        return started[-1]

    yield start
    for writer in started:
        writer.close()
