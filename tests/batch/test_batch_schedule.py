"""The nightly units: what they run does run, one at a time."""

import configparser
import fcntl
import os
import re
import shlex
import shutil
import subprocess
import sys
import types
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from batch_tools import HERE

from pipeline.batch import BatchError
from pipeline.batch.schedule import Nightly, System, parse_clock, print_units
from pipeline.store import Store

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


def run(command: list[str] | str, folder: Path | None, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        cwd=folder,
        shell=isinstance(command, str),
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(HERE.parents[1])} | variables,
    )


def split_units(text: str) -> dict[str, str]:
    """Each unit by the name of the file that it says to go to."""
    _, *parts = re.split(r"^# ~/\.config/systemd/user/(\S+)$", text, flags=re.MULTILINE)
    return dict(zip(parts[::2], parts[1::2], strict=True))


def play_airflow(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a DAG: a stand-in for Airflow calls its tasks at once."""
    asked: dict[str, object] = {}

    def dag(**options: object) -> object:
        asked.update(options)
        return lambda body: body

    airflow = types.ModuleType("airflow")
    decorators = types.ModuleType("airflow.decorators")
    decorators.dag = dag  # type: ignore[attr-defined]
    decorators.task = lambda **_options: lambda body: body  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "airflow", airflow)
    monkeypatch.setitem(sys.modules, "airflow.decorators", decorators)
    exec(compile(text, "slip_batch.py", "exec"), {"__name__": "slip_batch"})  # noqa: S102 - what Airflow does
    assert asked["schedule"] == "5 3 * * *"
    assert asked["max_active_runs"] == 1


def read_actions(text: str) -> str:
    """The script that a runner of GitHub gives to the shell: expressions are put in their places before."""
    job = yaml.safe_load(text)["jobs"]["batch"]
    (step,) = job["steps"]
    script: str = step["run"]
    return re.sub(r"\$\{\{ '([^']*)' \}\}", lambda match: match[1], script)


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
    nightly = replace(make_nightly(season, tmp_path), notify=NOTIFY)
    units = split_units(print_units(nightly, "systemd"))
    assert set(units) == {"slip-batch.service", "slip-batch.timer", "slip-batch-died.service"}
    for name, text in units.items():
        (tmp_path / name).write_text(text)
    for name in units:
        checked = run(["systemd-analyze", "--user", "verify", str(tmp_path / name)], None)
        assert checked.returncode == 0, checked.stderr


@needs_flock
@pytest.mark.parametrize("system", ["airflow", "github"])
def test_other_schedulers_run_the_same(
    season: Path, tmp_path: Path, system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    nightly = make_nightly(season, tmp_path)
    text = print_units(nightly, system)
    if system == "airflow":
        monkeypatch.setenv("PYTHONPATH", str(HERE.parents[1]))
        play_airflow(text, monkeypatch)
    else:
        done = run(["sh", "-e", "-c", read_actions(text)], tmp_path)
        assert done.returncode == 0, done.stderr
    assert Store(nightly.folder / "my results").runs() == ("season/a",)


@needs_flock
@pytest.mark.parametrize(("code", "fails"), [(0, False), (3, False), (1, True)])
def test_losses_do_not_fail_a_job_and_failures_do(
    code: int,
    fails: bool,  # noqa: FBT001
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    nightly = end_with(code, tmp_path)
    assert (
        bool(run(["sh", "-e", "-c", read_actions(print_units(nightly, "github"))], None).returncode) is fails
    )
    if fails:
        with pytest.raises(RuntimeError, match=f"exit code {code}"):
            play_airflow(print_units(nightly, "airflow"), monkeypatch)
    else:
        play_airflow(print_units(nightly, "airflow"), monkeypatch)


NOTIFY = 'cat >> "told of $SLIP_SUBJECT"'
DIED = "told of slip batch was ended before it could say anything"


def end_with(code: int | str, folder: Path) -> Nightly:
    """A program that does nothing but end with this code, or be killed."""
    return Nightly(
        program=("/bin/sh", "-c", f"exit {code}" if isinstance(code, int) else f"kill -{code} $$"),
        arguments=(),
        folder=folder,
        lock=folder / "lock",
        hour=3,
        minute=5,
        notify=NOTIFY,
    )


@needs_flock
@pytest.mark.parametrize("code", [0, 1, 3, 2, "KILL"])
def test_a_batch_that_could_say_nothing_is_told_all_the_same(code: int | str, tmp_path: Path) -> None:
    nightly = end_with(code, tmp_path)
    run(cron_command(print_units(nightly, "cron")), tmp_path)
    is_dead = code in (2, "KILL")
    assert (tmp_path / DIED).exists() is is_dead

    units = split_units(print_units(nightly, "systemd"))
    assert "OnFailure=slip-batch-died.service" in units["slip-batch.service"]
    service = read_systemd(units["slip-batch-died.service"])["Service"]
    # systemd starts it after every failure: not after 0 and 3.
    condition = run(words_of(service["ExecCondition"]), tmp_path, MONITOR_EXIT_STATUS=str(code))
    if code not in (0, 3):
        assert (condition.returncode == 0) is is_dead
    (tmp_path / DIED).unlink(missing_ok=True)
    variables = re.findall(r"^Environment=(.*)$", units["slip-batch-died.service"], flags=re.MULTILINE)
    set_to = dict(shlex.split(one)[0].split("=", 1) for one in variables)
    assert run(words_of(service["ExecStart"]), tmp_path, **set_to).returncode == 0
    assert (tmp_path / DIED).exists()


def test_without_anybody_to_tell_there_is_no_unit_for_it(season: Path, tmp_path: Path) -> None:
    text = print_units(make_nightly(season, tmp_path), "systemd")
    assert set(split_units(text)) == {"slip-batch.service", "slip-batch.timer"}
    assert "OnFailure" not in text


def test_times_of_day_are_read() -> None:
    assert parse_clock("02:30") == (2, 30)
    assert parse_clock("7:05") == (7, 5)
    with pytest.raises(BatchError, match="is not a time of day"):
        parse_clock("24:00")
