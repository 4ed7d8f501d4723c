"""The two recipes that run a batch every night: what they run does run."""

import configparser
import fcntl
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.simulate import simulate_case
from pipeline.store import Store

HERE = Path(__file__).parents[2]
RECIPES = HERE / "packaging" / "nightly"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """The home of a user with logs, and slip where its installer puts it."""
    simulate_case("husky_tile", out=tmp_path / "robots" / "logs" / "a.mcap", duration_s=12.0)
    program = tmp_path / ".local" / "bin" / "slip"
    program.parent.mkdir(parents=True)
    program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m pipeline "$@" --settle 0\n')
    program.chmod(0o755)
    return tmp_path


def run(command: str, home: Path, folder: Path, code: int = 0) -> str:
    around = os.environ | {"HOME": str(home), "PYTHONPATH": str(HERE)}
    done = subprocess.run(
        ["/bin/bash", "-c", command], check=False, cwd=folder, env=around, capture_output=True, text=True
    )
    assert done.returncode == code, done.stderr
    return done.stdout


def test_the_service_brings_the_results_up_to_date(home: Path) -> None:
    unit = configparser.ConfigParser(interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read(RECIPES / "slip-batch.service")
    service = {key: text.replace("%h", str(home)) for key, text in unit["Service"].items()}
    run(service["ExecStart"], home, Path(service["WorkingDirectory"]))
    assert Store(home / "robots" / "results").runs() == ("logs/a",)
    assert service["SuccessExitStatus"] == "3"


@pytest.mark.long
@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="there is no systemd here")
def test_systemd_accepts_the_units(home: Path) -> None:
    around = os.environ | {"HOME": str(home), "XDG_RUNTIME_DIR": str(home)}
    for name in ("slip-batch.service", "slip-batch.timer"):
        shutil.copy(RECIPES / name, home)
    for name in ("slip-batch.service", "slip-batch.timer"):
        words = ["systemd-analyze", "--user", "verify", str(home / name)]
        checked = subprocess.run(words, env=around, capture_output=True, text=True)  # noqa: PLW1510
        assert checked.returncode == 0, checked.stderr


@pytest.mark.long
@pytest.mark.skipif(not shutil.which("flock"), reason="there is no flock here")
def test_the_crontab_does_the_same_and_never_twice_at_once(home: Path) -> None:
    lines = [line for line in (RECIPES / "slip-batch.cron").read_text().splitlines() if line[0] != "#"]
    assert lines.pop(0) == "SHELL=/bin/bash"
    (nightly, late) = (line.replace("| logger --tag slip-batch", "| cat") for line in lines)
    command = nightly.removeprefix("0 2 * * * ")
    # A bare percent sign ends the command of a crontab.
    assert "%" not in command
    assert late == f"@reboot sleep 300; {command}"
    with (home / "robots" / ".slip-batch.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        run(command, home, home)
    assert not (home / "robots" / "results").exists()
    run(command, home, home)
    assert Store(home / "robots" / "results").runs() == ("logs/a",)

    (home / "robots" / "logs" / "bad.mcap").write_text("no log\n" * 100)
    assert "slip batch failed: journalctl" in run(command, home, home, 1)
    # The same log again is no new failure.
    run(command, home, home)
