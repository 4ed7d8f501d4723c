"""The runner of benchmarks: what it lists is there, says what it measures, and takes its options."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

RUNNER = Path(__file__).parents[2] / "benchmarks"


def run(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(RUNNER), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def list_names() -> list[str]:
    return [line.split()[0] for line in run().stdout.splitlines()]


def test_every_benchmark_is_listed_with_what_it_measures() -> None:
    lines = [line.split(maxsplit=1) for line in run().stdout.splitlines()]
    assert {"reader", "analyze", "diagnose", "game/play", "game/rings"} <= {name for name, _ in lines}
    assert all(about.endswith(".") for _, about in lines)


def test_a_name_that_is_none_is_refused_with_those_that_are() -> None:
    done = run("speed")
    assert done.returncode == 2
    assert done.stderr.startswith("there is no benchmark speed; there are analyze, ")


@pytest.mark.parametrize("name", list_names())
def test_a_benchmark_loads_and_says_how_it_is_asked(name: str) -> None:
    done = run(name, "--help")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage: ")
