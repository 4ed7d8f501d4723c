from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pipeline.store import Store

HERE = Path(__file__).parents[1] / "fixtures"

StartWriter = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "results", patience_s=10.0)


@pytest.fixture
def start_writer() -> Iterator[StartWriter]:
    """Starts `store_writer.py` with arguments; whatever still runs at the end is killed."""
    started: list[subprocess.Popen[str]] = []
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join((str(HERE), str(HERE.parents[1]))),
        "POLARS_MAX_THREADS": "1",
    }

    def start(*arguments: object) -> subprocess.Popen[str]:
        command = [sys.executable, str(HERE / "store_writer.py"), *(str(argument) for argument in arguments)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()
