"""100 runs of 12,000 rows: lazy, without a loop over rows."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from comparison_store import Run, write_budgets, write_run

from pipeline.store import Store

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.long
def test_a_hundred_runs_take_ten_seconds_and_a_gigabyte(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for i in range(100):
        terrain = f"t{i % 8}"
        write_run(
            store,
            Run(
                name=f"r{i:03d}",
                dataset=f"warthog_{terrain}",
                terrain=terrain,
                seconds=300.0,
                median=1 + i % 8,
            ),
            seed=i,
        )
    program = "import sys; from pipeline.cli.app import main; main(sys.argv[1:])"
    # The first start on a machine bundles the scripts of the page once.
    subprocess.run([sys.executable, "-c", program, "fleet", "map", str(tmp_path), "--quiet"], check=True)
    spent = _run([program, "compare", str(tmp_path), "--quiet"])
    # It runs on one core: what it takes of it is what it takes where nothing else runs.
    assert spent.ru_utime + spent.ru_stime < 10.0
    assert spent.ru_maxrss / 1e6 < 1.0


@pytest.mark.long
@pytest.mark.parametrize(
    "verb", [("fleet", "fit"), ("compare", "--causes"), ("fleet", "trend")], ids=lambda verb: verb[-1]
)
def test_three_hundred_runs_by_cause_take_ten_seconds_and_a_gigabyte(
    tmp_path: Path, verb: tuple[str, ...]
) -> None:
    write_budgets(Store(tmp_path), 300)
    program = "import sys; from pipeline.cli.app import main; main(sys.argv[1:])"
    spent = _run([program, *verb, str(tmp_path), "--quiet"])
    assert spent.ru_utime + spent.ru_stime < 10.0
    assert spent.ru_maxrss / 1e6 < 1.0


def _run(words: list[str]) -> resource.struct_rusage:
    """What a program took, it alone."""
    with subprocess.Popen([sys.executable, "-c", *words]) as started:
        _, status, spent = os.wait4(started.pid, 0)
        started.returncode = os.waitstatus_to_exitcode(status)
    assert started.returncode in (0, 4)
    return spent
