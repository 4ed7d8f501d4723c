"""Shared by benchmarks: where recordings are, rows of results, what a command costs."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

RECORDINGS = Path(__file__).parents[2] / "shared" / "logs"
"""Recordings of real robots, which are no part of the repository."""
RUNNER = (sys.executable, str(Path(__file__).parent))
"""Command of the runner: for parts of a benchmark that need a process of their own."""
_UNIT = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss [bytes]
_WITH_LOSSES = 3


@dataclass(frozen=True)
class Cost:
    """What a command took: wall, user and all CPU seconds, peak memory."""

    wall_s: float
    user_s: float
    cpu_s: float
    peak_mb: float


def measure_command(
    command: Sequence[str], *, folder: Path | None = None, environment: Mapping[str, str] | None = None
) -> Cost:
    """Run a command and all that it starts, without its output.

    Raises:
        SystemExit: it failed.
    """
    start = time.perf_counter()
    process = subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    wall = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in {0, _WITH_LOSSES}:
        raise SystemExit(f"{' '.join(command[:4])} exited with {process.returncode}")
    return Cost(wall, usage.ru_utime, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * _UNIT / 2**20)


def simulate_ten_minutes(folder: Path) -> Path:
    """A log of a Husky, made in a process of its own: what a parent holds counts as its child's peak."""
    log = folder / "ten_minutes.mcap"
    words = ["simulate", "husky_tile", "--duration", "600", "--file", str(log)]
    measure_command([sys.executable, "-m", "pipeline", *words])
    return log


def read_rows(path: Path | None) -> list[dict[str, Any]]:
    """Rows that a benchmark wrote while it measured, to go on where it ended; none without a file."""
    if path is None or not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def add_row(path: Path | None, row: Mapping[str, Any]) -> None:
    """Add a row to a file, where one was asked for."""
    if path is not None:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
