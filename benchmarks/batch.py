"""What a batch costs: per log as the season grows, once more over nothing new, on one and two processes.

Logs are simulated, ten seconds of a Husky each. Times are of the whole command, its start included. One and
two processes take turns, so that other load hits both, and the best of the rounds counts. *Alone* is the time
in which no log is worked on: until the first is begun, and after the last is done.
"""

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

from pipeline.batch import count_cores
from pipeline.batch.batch_work import Ledger
from pipeline.simulate import simulate_case
from pipeline.store import Store

ROOT = Path(__file__).parents[1]
COUNTS = (10, 100, 1000)
COMPARED = (100, 1000)
PROCESSES = (1, 2)


@dataclass(frozen=True)
class Run:
    """One command.

    Attributes:
        seconds: of the clock.
        begun_s: until the first log was begun.
        ending_s: after the last log was done.
        own_s: processor time of the process that leads.
        workers_s: time of the workers.
        peak_bytes: most memory of the process that leads.
        rss_bytes: peak memory of the worker of each log, in the order in which they were done.
    """

    seconds: float
    begun_s: float
    ending_s: float
    own_s: float
    workers_s: float
    peak_bytes: int
    rss_bytes: tuple[int, ...]

    @property
    def alone_s(self) -> float:
        return self.begun_s + self.ending_s


def make_logs(folder: Path, count: int) -> None:
    """Simulate logs that are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        path = folder / f"run{number:04d}.mcap"
        if not path.exists():
            simulate_case("husky_tile", out=path, duration_s=10.0, seed=number)


def run_batch(logs: Path, out: Path, jobs: int) -> Run:
    """Run the command as a user would."""
    program = [sys.executable, str(Path(__file__).parent / "slip_measured.py")]
    arguments = ["batch", str(logs), "--results", str(out), "--jobs", str(jobs), "--settle", "0", "--json"]
    before, started = time.time(), time.perf_counter()
    done = subprocess.run(
        [*program, *arguments],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    seconds = time.perf_counter() - started
    cost = json.loads(done.stderr.splitlines()[-1])
    rss = {line["path"]: line["peak_bytes"] for line in json.loads(done.stdout)["logs"]}
    entries = sorted(Ledger(Store(out)).read_all().values(), key=lambda entry: entry.at)
    return Run(
        seconds=seconds,
        begun_s=min(entry.at - entry.seconds for entry in entries) - before,
        ending_s=before + seconds - entries[-1].at,
        own_s=cost["own_s"],
        workers_s=sum(entry.seconds for entry in entries),
        peak_bytes=cost["own_peak_bytes"],
        rss_bytes=tuple(rss[entry.log.path] for entry in entries),
    )


def select(logs: Path, folder: Path, count: int) -> Path:
    """A folder with the first logs of another one."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for path in sorted(logs.iterdir())[:count]:
        os.link(path, folder / path.name)
    return folder


def measure_growth(logs: Path, work: Path, counts: list[int]) -> None:
    """Cost per log as the season grows, of a second look at it, and the memory over time."""
    print("two processes, as the season grows")
    print("       first  per log  work per  second  memory [MB]: workers in the")
    print("logs   [s]    [ms]     log [ms]  [s]     first | last tenth; leader")
    for count in counts:
        season, out = select(logs, work / "season", count), work / "grown"
        shutil.rmtree(out, ignore_errors=True)
        first = run_batch(season, out, 2)
        second = run_batch(season, out, 2)
        tenth = max(1, count // 10)
        rss = [held / 1e6 for held in first.rss_bytes]
        print(
            f"{count:<5}  {first.seconds:<5.1f}  {first.seconds / count * 1e3:<7.1f}  "
            f"{(first.own_s + first.workers_s) / count * 1e3:<8.1f}  {second.seconds:<6.2f}  "
            f"{max(rss[:tenth]):.0f} | {max(rss[-tenth:]):.0f}; {first.peak_bytes / 1e6:.0f}",
            flush=True,
        )


def compare_processes(logs: Path, work: Path, count: int, rounds: int) -> None:
    """Throughput on one and two processes."""
    season = select(logs, work / "season", count)
    runs: dict[int, list[Run]] = {jobs: [] for jobs in PROCESSES}
    for _ in range(rounds):
        for jobs in PROCESSES:
            shutil.rmtree(work / "compared", ignore_errors=True)
            runs[jobs].append(run_batch(season, work / "compared", jobs))
    print(f"\n{count} logs on one and two processes, best of {rounds}")
    print("           clock  alone:        leader  workers'      workers'")
    print("processes  [s]    begin + end   cpu [s] per log [ms] memory [MB]")
    best = {jobs: min(some, key=lambda run: run.seconds) for jobs, some in runs.items()}
    for jobs, run in best.items():
        print(
            f"{jobs:<9}  {run.seconds:<5.1f}  {run.begun_s:<5.2f} + {run.ending_s:<4.2f}  {run.own_s:<7.2f} "
            f"{run.workers_s / count * 1e3:<12.1f}  {max(run.rss_bytes) / 1e6:.0f}"
        )
    one, two = best[1], best[2]
    bound = one.seconds / (one.alone_s + (one.seconds - one.alone_s) / 2.0)
    print(
        f"two processes are {one.seconds / two.seconds:.2f} times as fast (every round: "
        f"{', '.join(f'{a.seconds / b.seconds:.2f}' for a, b in zip(runs[1], runs[2], strict=True))}); "
        f"what happens alone would allow {bound:.2f}",
        flush=True,
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--counts", type=int, nargs="*", default=COUNTS)
    parser.add_argument("--compare", type=int, nargs="*", default=COMPARED)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--folder", type=Path, default=None)


def run(given: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        work = given.folder or Path(temporary)
        make_logs(work / "logs", max((*given.counts, *given.compare)))
        print(f"{count_cores()} cores, load before: {os.getloadavg()[0]:.1f}")
        if given.counts:
            measure_growth(work / "logs", work, given.counts)
        for count in given.compare:
            compare_processes(work / "logs", work, count, given.rounds)
