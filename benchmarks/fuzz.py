"""Damaged files and odd words for every part of the program; what fails is kept in fuzz_finds.

make bench NAME=fuzz [ARGS="--minutes 60"]
"""

import argparse
import subprocess
import sys
from pathlib import Path

SCRIPTS = sorted((Path(__file__).parents[1] / "tests" / "fuzz").glob("fuzz_*.py"))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--minutes", type=float, default=60.0, help="of all parts together")


def run(given: argparse.Namespace) -> int:
    """Give each script its share of the time; whether one failed."""
    share = given.minutes / len(SCRIPTS)
    failed = 0
    for script in SCRIPTS:
        sys.stdout.write(f"{script.name} for {share:.1f} minutes\n")
        sys.stdout.flush()
        words = [sys.executable, str(script), "--minutes", str(share)]
        failed |= subprocess.run(words, check=False).returncode != 0
    return int(failed)
