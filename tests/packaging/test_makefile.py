"""The Makefile as people use it who know nothing else."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from pipeline.simulate import simulate_case

ROOT = Path(__file__).parents[2]
LOCKS = ("requirements.txt", "requirements-dev.txt")
LISTED = re.compile(r"^  make ([a-z-]+) +\S", re.MULTILINE)


def make(*arguments: str) -> subprocess.CompletedProcess[str]:
    clean = {key: value for key, value in os.environ.items() if not key.startswith(("MAKE", "MFLAGS"))}
    return subprocess.run(
        ["make", "--no-print-directory", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        env=clean,
    )


@pytest.fixture
def ready() -> None:
    if not (ROOT / ".venv" / ".ready").exists():
        pytest.skip("the environment was not made by `make`")


def test_make_alone_lists_the_verbs() -> None:
    done = make()

    assert done.returncode == 0
    users, _, developers = done.stdout.partition("For developers")
    assert LISTED.findall(users) == ["help", "analyze", "batch", "compare", "serve", "docs", "test", "clean"]
    assert LISTED.findall(developers) == [
        "check",
        "test-long",
        "bench",
        "hidden-effect",
        "samples",
        "release",
        "browser",
    ]


@pytest.mark.long
@pytest.mark.usefixtures("ready")
def test_a_path_may_hold_spaces_and_quotes(tmp_path: Path) -> None:
    log = simulate_case("husky_tile", out=tmp_path / "first day" / "bob's $run.mcap", duration_s=20.0)
    done = make(
        "analyze",
        f"LOG={str(log).replace('$', '$$')}",
        f"OUT={tmp_path / 'my results'}",
        "ARGS=--no-report --no-diagnosis",
    )

    assert done.returncode == 0, done.stderr
    assert "slip      median slip modulus" in done.stdout
    assert list((tmp_path / "my results").rglob("slip.parquet"))


@pytest.mark.usefixtures("ready")
def test_losses_are_told_and_are_no_failure_of_make(tmp_path: Path) -> None:
    log = simulate_case("husky_tile", out=tmp_path / "cut.mcap", duration_s=30.0)
    log.write_bytes(log.read_bytes()[: log.stat().st_size * 2 // 3])
    done = make("analyze", f"LOG={log}", f"OUT={tmp_path / 'out'}", "ARGS=--no-report --no-diagnosis")

    assert done.returncode == 0
    assert "with losses" in done.stdout + done.stderr


@pytest.mark.long
@pytest.mark.usefixtures("ready")
def test_a_failure_fails(tmp_path: Path) -> None:
    done = make("analyze", f"LOG={tmp_path / 'missing.mcap'}", f"OUT={tmp_path / 'out'}")
    assert done.returncode != 0
    assert "no such file" in done.stderr
    assert make("analyze").returncode != 0


@pytest.mark.lint
@pytest.mark.parametrize("name", LOCKS)
def test_locks_pin_by_hash_and_name_no_host(name: str) -> None:
    text = (ROOT / name).read_text()

    assert "--hash=sha256:" in text
    assert "://" not in text
    assert "index-url" not in text


@pytest.mark.lint
def test_ci_needs_nothing_but_the_repository() -> None:
    script = (ROOT / ".ci" / "run").read_text()

    assert "make check test" in script
    assert "make bench NAME=audit" in script
    assert shutil.which("make")
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
