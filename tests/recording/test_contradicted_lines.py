"""A line of run.toml that the motion contradicts is named, before the robot is blamed."""

import shutil
from pathlib import Path

import pytest

from pipeline.core import SlipError
from pipeline.recording import LogOptions
from pipeline.recording.log_setup import set_up_log

_SAMPLE = Path(__file__).parents[2] / "data_samples" / "husky_tile.mcap"
_WRONG = (
    ("command", 'unit = "rpm"'),
    ("command", "sign = -1"),
    ("command", "exchanged = true"),
    ("wheels", 'unit = "rpm"'),
    ("wheels", "sign = -1"),
    ("wheels", "exchanged = true"),
    ("pose", 'unit = "mm"'),
    ("imu", 'unit = "deg/s"'),
)


def _configure(folder: Path, text: str) -> Path:
    log = folder / "run.mcap"
    shutil.copy(_SAMPLE, log)
    (folder / "run.toml").write_text(text, encoding="utf-8")
    return log


@pytest.mark.parametrize(("section", "line"), _WRONG)
def test_a_line_that_the_motion_contradicts_is_named(tmp_path: Path, section: str, line: str) -> None:
    log = _configure(tmp_path, f"[{section}]\n{line}\n")
    with pytest.raises(SlipError) as caught:
        set_up_log(log, LogOptions())
    assert caught.value.code == "configuration_contradicted"
    assert f"[{section}] {line} in run.toml contradicts the motion" in caught.value.what


def test_the_line_at_fault_is_named_among_right_ones(tmp_path: Path) -> None:
    log = _configure(tmp_path, '[command]\nunit = "rad/s"\nsign = -1\n\n[pose]\nunit = "m"\n')
    with pytest.raises(SlipError) as caught:
        set_up_log(log, LogOptions())
    assert "[command] sign = -1 in run.toml" in caught.value.what


def test_lines_that_are_right_are_taken(tmp_path: Path) -> None:
    text = '[command]\nunit = "rad/s"\n\n[wheels]\nunit = "rad/s"\n\n[pose]\nunit = "m"\n'
    assert set_up_log(_configure(tmp_path, text), LogOptions()).choice.recording is not None
