"""A log is read once for all who ask, and a log without a pose is asked the same questions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_motion import draw, sides
from written_logs import write_log

from pipeline.analysis import Options
from pipeline.core import Floats
from pipeline.logs import LogData, open_log, read_topics
from pipeline.recording import LogColumns
from pipeline.recording.log_setup import set_up_log
from pipeline.recording.readings import Held


@pytest.fixture
def data(tmp_path: Path) -> LogData:
    return read_topics(open_log(write_log(tmp_path / "log.mcap", draw(1, 20.0))), [])


def test_what_was_made_of_equal_arguments_is_not_made_again(data: LogData) -> None:
    asked = list[float]()

    def double(values: Floats, held: tuple[float, str]) -> Floats:
        asked.append(held[0])
        return 2.0 * values

    log, values = LogColumns(data), np.array([1.0, np.nan])
    first = log.once(double, values, (1.0, "x"))
    assert log.once(double, values.copy(), (1.0, "x")) is first
    changed = log.once(double, values + 1.0, (1.0, "x"))
    assert changed[0] == 4.0
    log.once(double, values, (2.0, "x"))
    assert asked == [1.0, 1.0, 2.0]


def test_results_of_many_candidates_do_not_fill_the_memory(data: LogData) -> None:
    asked = list[float]()
    log = LogColumns(data)
    for number in [*range(50), 0]:
        log.once(asked.append, float(number))
    assert asked == [*range(50), 0]


def test_the_clock_of_a_command_is_found_where_no_pose_is_recorded(tmp_path: Path) -> None:
    """It was read by its time of recording, and written into tables by its stamps."""
    drive = draw(52)
    nowhere = replace(drive, rows=slice(0, 0), place=drive.place[:0], yaw=drive.yaw[:0])
    # Sides on one topic with stamps of their own.
    joints = {
        f"{side}_wheel": Held(one.times, one.values)
        for side, one in zip(("left", "right"), (sides(drive).first, sides(drive).second), strict=True)
    }
    log = write_log(tmp_path / "log.mcap", nowhere, joints=joints, command_ahead_s=0.5)
    setup = set_up_log(log, Options(out=tmp_path))
    assert setup.is_drive_alone
    assert setup.configuration.command.time == "log"
    assert "command_corrected" in {one.id for one in setup.choice.findings}
