"""Time and memory of what is asked of many runs: levels, causes, trends, maps.

Run: python benchmarks/fleet_speed.py [--runs 300]. Made-up runs of three vehicles on four terrains, each with
estimates of all effects and a budget.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "fixtures"))

from comparison_store import write_budgets

from pipeline.store import Store

VERBS = (
    ("fleet", "fit"),
    ("compare", "--causes"),
    ("compare",),
    ("fleet", "trend"),
    (
        "fleet",
        "map",
    ),
)
PROGRAM = "import sys; from pipeline.cli import main; main(sys.argv[1:])"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=300)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        write_budgets(Store(Path(folder)), chosen.runs)
        print(f"{chosen.runs} runs{'':<14}{'wall s':>8}{'CPU s':>8}{'peak MB':>9}")
        for verb in VERBS:
            start = time.perf_counter()
            process = subprocess.Popen([sys.executable, "-c", PROGRAM, *verb, folder, "--quiet"])
            _, _, used = os.wait4(process.pid, 0)
            wall = time.perf_counter() - start
            spent = used.ru_utime + used.ru_stime
            print(
                f"slip {' '.join(verb):<20}{wall:>6.1f}{spent:>8.1f}{used.ru_maxrss / 1e3:>9.0f}", flush=True
            )


if __name__ == "__main__":
    main()
