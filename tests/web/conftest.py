"""Logs and results that the tests of the workbench share."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from stored import make_once
from workbench_server import TRACK, ServedWorkbench, Workbench

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.simulate import simulate_case


@pytest.fixture(scope="session")
def hidden_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of a vehicle that turns as if its wheels stood 1.6 times as far apart, beside its results."""
    return make_once(tmp_path_factory, "workbench", _analyze) / "field" / "hidden.mcap"


def _analyze(folder: Path) -> None:
    out = folder / "field" / "hidden.mcap"
    simulate_case(None, {"effective_track": TRACK}, out=out, seed=3, duration_s=60.0)
    analyze_log(out, Options(out=folder / "results", overrides={"vehicle": {"preset": "husky_a200"}}))


@pytest.fixture
def results(hidden_log: Path, tmp_path: Path) -> Path:
    """Results of that log that a test may change."""
    return Path(shutil.copytree(hidden_log.parents[1] / "results", tmp_path / "results"))


@pytest.fixture
def workbench(results: Path) -> Iterator[Workbench]:
    bench = Workbench(results)
    yield bench
    bench.close()


@pytest.fixture
def served(results: Path) -> Iterator[ServedWorkbench]:
    """For a browser."""
    bench = ServedWorkbench(results)
    yield bench
    bench.close()


@pytest.fixture
def diagnosed(stored_run: Path) -> Iterator[Workbench]:
    """Of a diagnosed run, `field/wide`, with two effects; to read only."""
    bench = Workbench(stored_run / "results")
    yield bench
    bench.close()
