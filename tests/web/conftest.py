"""Logs and results that the tests of the workbench share."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from workbench_server import TRACK, Workbench

from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.simulate import simulate_case

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(scope="session")
def hidden_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of a vehicle that turns as if its wheels stood 1.6 times as far apart."""
    folder = tmp_path_factory.mktemp("logs") / "field"
    folder.mkdir()
    out = folder / "hidden.mcap"
    return simulate_case(None, {"effective_track": TRACK}, out=out, seed=3, duration_s=90.0)


@pytest.fixture(scope="session")
def analyzed(hidden_log: Path) -> Path:
    """Results of that log."""
    results = hidden_log.parents[1] / "results"
    analyze_log(hidden_log, Options(out=results, overrides={"vehicle": {"preset": "husky_a200"}}))
    return results


@pytest.fixture
def results(analyzed: Path, tmp_path: Path) -> Path:
    """Results of that log that a test may change."""
    return Path(shutil.copytree(analyzed, tmp_path / "results"))


@pytest.fixture
def workbench(results: Path) -> Iterator[Workbench]:
    server = Workbench(results)
    yield server
    server.close()


@pytest.fixture(scope="session")
def shared_workbench(analyzed: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workbench]:
    """For tests that leave the session as they found it."""
    server = Workbench(Path(shutil.copytree(analyzed, tmp_path_factory.mktemp("shared") / "results")))
    yield server
    server.close()
