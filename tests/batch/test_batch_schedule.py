"""The nightly units: what they run does run, one at a time."""

from __future__ import annotations

import configparser
import fcntl
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from batch_tools import HERE

from pipeline.batch import BatchError, Nightly, parse_clock, print_units
from pipeline.store import Store

if TYPE_CHECKING:
    from pipeline.batch import System

needs_flock = pytest.mark.skipif(not shutil.which("flock"), reason="there is no flock here")


def make_nightly(season: Path, tmp_path: Path) -> Nightly:
    folder = tmp_path / "it's 100% mine"
    folder.mkdir()
    return Nightly(
        program=(sys.executable, "-m", "pipeline"),
        arguments=(str(season / "a.mcap"), "--out", "my results", "--settle", "0"),
        folder=folder,
        lock=folder / "lock",
        hour=3,
        minute=5,
    )


def read_systemd(text: str) -> dict[str, dict[str, str]]:
    """Sections of both units; each key stands once."""
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read_string(text)
    return {name: dict(parser[name]) for name in parser.sections()}


def words_of(unit_line: str) -> list[str]:
    """An ExecStart line as systemd splits it."""
    return [word.replace("%%", "%").replace("$$", "$") for word in shlex.split(unit_line)]


def cron_command(text: str) -> str:
    """The nightly line's command as cron hands it to the shell, telling us instead of the journal."""
    line = next(line for line in text.splitlines() if line.startswith("5 3 * * * "))
    command = line.removeprefix("5 3 * * * ").replace(r"\%", "%")
    return command.replace("| logger --tag slip-batch", "")


def run(command: list[str] | str, folder: Path | None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        cwd=folder,
        shell=isinstance(command, str),
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(HERE.parents[1])},
    )


@needs_flock
@pytest.mark.parametrize("system", ["systemd", "cron"])
def test_what_a_unit_runs_does_the_work_and_never_twice(season: Path, tmp_path: Path, system: System) -> None:
    nightly = make_nightly(season, tmp_path)
    text = print_units(nightly, system)
    if system == "systemd":
        service = read_systemd(text)["Service"]
        assert Path(service["WorkingDirectory"].replace("%%", "%")) == nightly.folder
        command: list[str] | str = words_of(service["ExecStart"])
        folder = nightly.folder
    else:
        command, folder = cron_command(text), tmp_path

    with nightly.lock.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        skipped = run(command, folder)
    assert (skipped.returncode, skipped.stdout) == (0, "")
    assert not (nightly.folder / "my results").exists()

    done = run(command, folder)
    assert done.returncode == 0, done.stderr
    assert Store(nightly.folder / "my results").runs() == ("season/a",)


def test_the_timer_catches_up_and_the_journal_hears(season: Path, tmp_path: Path) -> None:
    nightly = make_nightly(season, tmp_path)
    units = read_systemd(print_units(nightly, "systemd"))
    assert units["Timer"]["OnCalendar"] == "*-*-* 03:05:00"
    assert units["Timer"]["Persistent"] == "true"
    assert units["Service"]["StandardError"] == "journal"
    assert units["Service"]["SuccessExitStatus"] == "3"
    lines = print_units(nightly, "cron").splitlines()
    assert any(line.startswith("@reboot ") for line in lines)
    assert all("logger" in line for line in lines if "flock" in line)


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="there is no systemd here")
def test_systemd_accepts_the_units(season: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    text = print_units(make_nightly(season, tmp_path), "systemd")
    service, timer = text.split("# ~/.config/systemd/user/slip-batch.timer")
    (tmp_path / "slip-batch.service").write_text(service)
    (tmp_path / "slip-batch.timer").write_text(timer)
    for name in ("slip-batch.service", "slip-batch.timer"):
        checked = run(["systemd-analyze", "--user", "verify", str(tmp_path / name)], None)
        assert checked.returncode == 0, checked.stderr


def test_times_of_day_are_read() -> None:
    assert parse_clock("02:30") == (2, 30)
    assert parse_clock("7:05") == (7, 5)
    with pytest.raises(BatchError, match="is not a time of day"):
        parse_clock("24:00")
