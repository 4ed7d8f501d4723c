"""How long a whole analysis takes: a 10-minute log, report included, as one process.

    python benchmarks/analyze.py [--log LOG] [--runs N]

Prints wall and CPU seconds and peak memory (medians over the runs). The peer in the same run is the official
reader decoding the same topics and nothing more.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PEER = """
import sys
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
with open(sys.argv[1], "rb") as stream:
    for _ in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
        pass
"""


def measure(command: list[str], runs: int) -> tuple[float, float, float]:
    """Median wall seconds, CPU seconds and peak megabytes of a command."""
    rows = []
    for _ in range(runs):
        start = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode not in (0, 3):
            sys.exit(f"{' '.join(command)} exited with {process.returncode}")
        # Linux counts the peak in KiB, macOS in bytes.
        scale = 1024.0 if sys.platform != "darwin" else 1024.0**2
        rows.append((wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / scale))
    columns = [statistics.median(column) for column in zip(*rows, strict=True)]
    return columns[0], columns[1], columns[2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--log", type=Path, help="log to analyze; by default one of 10 minutes is simulated")
    parser.add_argument("--runs", type=int, default=5)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        slip = [sys.executable, "-m", "pipeline"]
        log = chosen.log
        if log is None:
            # In a process of its own: what a parent holds counts as its child's peak.
            log = Path(folder) / "ten_minutes.mcap"
            simulate = [*slip, "simulate", "husky_tile", "--duration", "600", "--file", str(log)]
            subprocess.run(simulate, check=True, stdout=subprocess.DEVNULL)
        analyze = [
            *slip,
            "analyze",
            str(log),
            "--results",
            f"{folder}/out",
            "--no-diagnosis",
            "--force",
            "--quiet",
        ]
        table = {
            "slip --help": [*slip, "--help"],
            "analyze, report included": analyze,
            "analyze --no-report": [*analyze, "--no-report"],
            "analyze, unchanged": [argument for argument in analyze if argument != "--force"],
            "official reader, decoding alone": [sys.executable, "-c", PEER, str(log)],
        }
        print(f"{log.name}: {log.stat().st_size / 1e6:.1f} MB, median of {chosen.runs} runs")
        print(f"{'':<34}{'wall s':>8}{'CPU s':>8}{'peak MB':>9}")
        for name, command in table.items():
            wall, cpu, peak = measure(command, chosen.runs)
            print(f"{name:<34}{wall:>8.2f}{cpu:>8.2f}{peak:>9.0f}")


if __name__ == "__main__":
    main()
