"""100 runs of 12,000 rows: lazy, without a loop over rows."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
from comparison_store import Run, write_budgets, write_run

from pipeline.store import Store

# A program counts as large as what started it ever was, and tests before this one may have been large.
MEASURE = """
import json, resource, subprocess, sys
done = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL)
spent = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([done.returncode, spent.ru_utime + spent.ru_stime, spent.ru_maxrss]))
"""


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
    program = "import sys; from pipeline.cli import main; main(sys.argv[1:])"
    # The first start on a machine bundles the scripts of the page once.
    subprocess.run([sys.executable, "-c", program, "fleet", "map", str(tmp_path), "--quiet"], check=True)
    spent = _run([program, "compare", str(tmp_path), "--quiet"])
    # It runs on one core: what it takes of it is what it takes where nothing else runs.
    assert spent.cpu_s < 10.0
    assert spent.memory_gb < 1.0


@pytest.mark.long
@pytest.mark.parametrize(
    "verb", [("fleet", "fit"), ("compare", "--causes"), ("fleet", "trend")], ids=lambda verb: verb[-1]
)
def test_three_hundred_runs_by_cause_take_ten_seconds_and_a_gigabyte(
    tmp_path: Path, verb: tuple[str, ...]
) -> None:
    write_budgets(Store(tmp_path), 300)
    program = "import sys; from pipeline.cli import main; main(sys.argv[1:])"
    spent = _run([program, *verb, str(tmp_path), "--quiet"])
    assert spent.cpu_s < 10.0
    assert spent.memory_gb < 1.0


@dataclass(frozen=True)
class Spent:
    """CPU time [s] and largest memory [GB] of a program."""

    cpu_s: float
    memory_gb: float


def _run(words: list[str]) -> Spent:
    """What a program took, it alone."""
    command = [sys.executable, "-c", MEASURE, sys.executable, "-c", *words]
    told = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    code, cpu_s, memory_kb = json.loads(told)
    assert code in (0, 4)
    return Spent(cpu_s, memory_kb / 1e6)
