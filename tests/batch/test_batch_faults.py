"""A batch that memory or the disk fails at any moment: whole runs, and the same command again finishes."""

import multiprocessing
import os
import sys
from pathlib import Path

import pytest
from batch_tools import assert_whole, batch, read_tables

from pipeline.simulate import simulate_case
from pipeline.store import Store

pytest.importorskip("_testcapi", reason="this Python cannot refuse memory on purpose")

from faults import DISK, MEMORY, Fault, arm, draw_faults

ROUNDS = 500
FINISHED, FAILED = 0, 3
PATIENCE_S = 120.0
MOST = {MEMORY: 160_000, DISK: 180}
"""About as many allocations and calls as a batch of two short logs takes."""


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short logs, so that one of them can be whole while the other is not."""
    folder = tmp_path_factory.mktemp("faults") / "season"
    for number in range(2):
        simulate_case("husky_tile", out=folder / f"{number}.mcap", duration_s=6.0, seed=number)
    return folder


def batch_under(fault: Fault, field: Path, out: Path) -> None:
    """In a process of its own: the libraries may well die of what is done to them here."""
    # Panics of polars are long, and are not what is looked at here.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
    try:
        with arm(fault):
            outcome = batch(field, out, force=True)
    except BaseException:  # noqa: BLE001 - whatever it is, the results are looked at afterwards
        sys.exit(FAILED)
    sys.exit(FAILED if outcome.has_failed else FINISHED)


# Beside the test of the store that meets the same faults.
@pytest.mark.long
def test_memory_and_disk_fail(field: Path, tmp_path: Path) -> None:
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(["test_batch_faults", "pipeline.analysis.analyze", "pipeline.report.page"])
    out = tmp_path / "out"
    batch(field, tmp_path / "undisturbed")
    undisturbed = read_tables(tmp_path / "undisturbed")
    outcomes = []
    for fault in draw_faults(ROUNDS, most=MOST, seed=ROUNDS):
        process = server.Process(target=batch_under, args=(fault, field, out), daemon=True)
        process.start()
        process.join(PATIENCE_S)
        process.kill()
        process.join()
        assert_whole(out, undisturbed)
        outcomes.append(process.exitcode)
    assert outcomes.count(FINISHED) < ROUNDS, "faults were met"
    assert FAILED in outcomes
    last = batch(field, out)
    assert not last.problems
    assert len(Store(out).runs()) == 2
    assert_whole(out, undisturbed)
    assert read_tables(out)["datasets.parquet"] == undisturbed["datasets.parquet"]
