"""What a batch costs: per log as the season grows, once more over nothing new, on one and two processes.

    python tests/bench/batch.py [--most 1000] [--folder DIR]

Logs are simulated, ten seconds of a Husky each. Times are of the whole command, its start included.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from pipeline.simulate import simulate_case

ROOT = Path(__file__).parents[2]
COUNTS = (10, 100, 1000)
COMPARED = 100


@dataclass(frozen=True)
class Run:
    """One command: its wall time [s], the processor time of it and its workers [s], and its answer."""

    seconds: float
    cpu_s: float
    answer: dict[str, list[dict[str, float]]]


def make_logs(folder: Path, count: int) -> None:
    """Simulate logs that are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        path = folder / f"run{number:04d}.mcap"
        if not path.exists():
            simulate_case("husky_tile", out=path, duration_s=10.0, seed=number)


def run_batch(logs: Path, out: Path, jobs: int) -> Run:
    """Run the command as a user would."""
    command = [sys.executable, "-m", "pipeline", "batch", str(logs), "--out", str(out), "--jobs", str(jobs)]
    before, started = os.times(), time.perf_counter()
    done = subprocess.run(
        [*command, "--settle", "0", "--json"],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    seconds, after = time.perf_counter() - started, os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return Run(seconds, cpu, json.loads(done.stdout))


def select(logs: Path, folder: Path, count: int) -> Path:
    """A folder with the first logs of another one."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for path in sorted(logs.iterdir())[:count]:
        os.link(path, folder / path.name)
    return folder


def measure_growth(logs: Path, work: Path, most: int) -> None:
    """Cost per log as the season grows, and of a second look at it."""
    print("  logs    first [s]  per log [ms]  cpu per log [ms]  second [s]  worker MB: first | last tenth")
    for count in [count for count in COUNTS if count <= most]:
        season, out = select(logs, work / "season", count), work / f"out{count}"
        shutil.rmtree(out, ignore_errors=True)
        first = run_batch(season, out, 2)
        second = run_batch(season, out, 2)
        rss = [line["rss_bytes"] / 1e6 for line in first.answer["logs"]]
        tenth = max(1, count // 10)
        print(
            f"{count:>6}  {first.seconds:>11.1f}  {first.seconds / count * 1e3:>12.0f}  "
            f"{first.cpu_s / count * 1e3:>16.0f}  {second.seconds:>10.2f}  "
            f"{max(rss[:tenth]):>22.0f} | {max(rss[-tenth:]):.0f}",
            flush=True,
        )


def compare_processes(logs: Path, work: Path) -> None:
    """Throughput on one and two processes, taken in turns so that other load hits both."""
    season = select(logs, work / "season", COMPARED)
    times: dict[int, list[float]] = {1: [], 2: []}
    for jobs in (1, 2, 1, 2):
        shutil.rmtree(work / "compared", ignore_errors=True)
        times[jobs].append(run_batch(season, work / "compared", jobs).seconds)
    one, two = min(times[1]), min(times[2])
    print(f"{COMPARED} logs: 1 process {one:.1f} s, 2 processes {two:.1f} s: {one / two:.2f} times as fast")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--most", type=int, default=COUNTS[-1])
    parser.add_argument("--folder", type=Path, default=None)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = given.folder or Path(temporary)
        make_logs(work / "logs", max(given.most, COMPARED))
        measure_growth(work / "logs", work, given.most)
        compare_processes(work / "logs", work)


if __name__ == "__main__":
    main()
