from collections.abc import Iterator
from pathlib import Path

import pytest
from store_writer import StartWriter, Writer

from pipeline.store import Store


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "results", patience_s=10.0)


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
