"""How long a whole analysis takes: a 10-minute log, report included, as one process.

Prints wall and CPU seconds and peak memory (medians over the runs). The peer in the same run is the official
reader decoding the same topics and nothing more.
"""

import argparse
import statistics
import sys
import tempfile
from pathlib import Path

from measuring import measure_command, simulate_ten_minutes

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
    costs = [measure_command(command) for _ in range(runs)]
    wall, cpu, peak = (
        statistics.median(getattr(cost, name) for cost in costs) for name in ("wall_s", "cpu_s", "peak_mb")
    )
    return wall, cpu, peak


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--log", type=Path, help="log to analyze; by default one of 10 minutes is simulated")
    parser.add_argument("--runs", type=int, default=5)


def run(chosen: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory() as folder:
        slip = [sys.executable, "-m", "pipeline"]
        log = chosen.log or simulate_ten_minutes(Path(folder))
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
