"""Commands that are stamped at another time than they were sent."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_motion import LAG, Drive, draw
from written_logs import write_log

from pipeline.analysis import Options
from pipeline.recording import Finding
from pipeline.recording.log_setup import LogSetup, set_up_log
from pipeline.recording.readings import Held
from pipeline.words import format_finding


def stamp(drive: Drive, late_s: float) -> np.ndarray:
    """The commands as they are recorded later than they were sent, or earlier."""
    return np.asarray(np.roll(drive.asked, round(late_s * 100.0), axis=0))


def set_up(log: Path, line: str = "") -> LogSetup:
    (log.parent / "line.toml").write_text(f"[command]\n{line}")
    return set_up_log(log, Options(out=log.parent, config=log.parent / "line.toml"))


def find(setup: LogSetup) -> Finding | None:
    """The finding on times of the command; None without one."""
    return next((one for one in setup.choice.findings if "late_s" in format_finding(one)), None)


def test_of_a_command_that_acts_at_once_nothing_is_said(tmp_path: Path) -> None:
    assert find(set_up(write_log(tmp_path / "log.mcap", draw(50)))) is None


def test_a_dead_time_and_early_stamps_are_told_as_one(tmp_path: Path) -> None:
    drive = draw(50)
    setup = set_up(write_log(tmp_path / "log.mcap", drive, asked=stamp(drive, -0.3)))
    told = find(setup)
    assert told.id == "command_delay"
    assert told.value == pytest.approx(0.3, abs=0.06)
    assert setup.configuration.command.late_s is None


@pytest.mark.parametrize("beside", ["wheels", "poses"])
@pytest.mark.parametrize("late_s", [0.2, 1.0])
def test_stamps_after_what_they_do_are_corrected(late_s: float, beside: str, tmp_path: Path) -> None:
    drive, asked = draw(51), stamp(draw(51), late_s)
    log = tmp_path / "log.mcap"
    write_log(log, drive, asked=asked, wheel_topic="/{}_wheel/measured", is_measured=beside == "wheels")
    setup = set_up(log)
    assert setup.configuration.command.late_s == pytest.approx(late_s, abs=0.06)
    told = find(setup)
    assert told.id == "command_corrected"
    # What the user says is taken.
    assert set_up(log, "late_s = 0").configuration.command.late_s == 0.0
    given = set_up(log, f"late_s = {late_s}")
    assert find(given) is None
    (seen,) = (one for one in given.choice.recording.evidence if one.role == "command")
    assert seen.late_s == pytest.approx(LAG, abs=0.1)


def test_of_two_clocks_either_may_be_wrong(tmp_path: Path) -> None:
    """Poses come later than both, and do not tell which of them is."""
    drive = draw(52)
    at = np.maximum(np.arange(drive.rows.size) - 9, 0)
    left, right = drive.wheels()
    joints = {f"{side}_wheel": Held(drive.time, speed) for side, speed in (("left", left), ("right", right))}
    late = replace(drive, place=drive.place[at], yaw=drive.yaw[at])
    log = write_log(tmp_path / "log.mcap", late, asked=stamp(drive, 0.4), joints=joints, command_ahead_s=0.0)
    setup = set_up(log)
    told = find(setup)
    assert told.id == "command_late"
    assert setup.configuration.command.late_s is None
