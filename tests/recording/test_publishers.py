"""Two publishers of commands on one topic: found by their turns, and a single one is not accused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_drives import TWIST, draw_drive, extract_drawn, record_cdr, record_twist, stamp_ros, write_drawn

from pipeline.core import Floats
from pipeline.recording.publishers import find_turns


def send(period_s: float, first_s: float, last_s: float, value: float | Floats) -> tuple[Floats, Floats]:
    """Times of messages and their values, shape (n, 2)."""
    times = np.arange(first_s, last_s, period_s)
    return times, np.broadcast_to(value, (times.size, 2)) * np.ones((1, 2))


def mix(*publishers: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    times, asked = (np.concatenate(parts) for parts in zip(*publishers, strict=True))
    order = np.argsort(times, kind="stable")
    return times[order], asked[order]


def test_turns_are_found_where_they_are() -> None:
    for period_s in [0.05, 0.1, 0.23]:
        for other in [0.0, -0.7]:
            ((start, end),) = find_turns(*mix(send(0.1, 0.0, 60.0, 1.0), send(period_s, 20.037, 40.0, other)))
            assert start == pytest.approx(20.0, abs=0.5)
            assert end == pytest.approx(40.0, abs=0.5)


def test_one_publisher_is_not_accused() -> None:
    times = np.arange(0.0, 60.0, 0.1) + np.random.default_rng(1).uniform(0.0, 0.005, 600)
    noise = np.random.default_rng(2).normal(size=(600, 1))
    pressed = np.where(times % 2.0 < 1.0, 1.0, 0.0)[:, None]
    switching = np.where(np.arange(600) % 2, 1.0, -1.0)[:, None]
    for asked in (noise, pressed, np.sin(times)[:, None], switching):
        assert find_turns(times, asked) == []


def test_what_two_publishers_ask_for_by_turns_is_left_out(tmp_path: Path) -> None:
    drive = draw_drive(120.0)
    real = record_twist(drive)
    rows = drive.rows(30.0, 60.0)
    zeros = record_cdr(drive, "/cmd_vel", TWIST, {"linear.x": 0.0 * drive.time}, rows=rows)
    both = replace(
        real,
        times=np.concatenate((real.times, zeros.times + 17_000_000)),
        messages=[*real.messages, *zeros.messages],
    )
    fields = stamp_ros(drive) | drive.pose("pose.") | {"header.frame_id": "map"}
    poses = record_cdr(drive, "/lio/pose", "geometry_msgs/msg/PoseStamped", fields)
    log = write_drawn(tmp_path / "log.mcap", both, poses)
    findings = extract_drawn(log, "findings").to_dicts()
    (text,) = [one["text"] for one in findings if one["id"] == "command_mixed"]
    assert "two publishers send commands on /cmd_vel by turns from 30 to 57 s" in text
    commands = extract_drawn(log, "commands")
    inside = (commands["t"] > 31.0) & (commands["t"] < 56.0)
    assert not commands.filter(inside)["active"].any()
    assert commands.filter((commands["t"] < 29.0) | (commands["t"] > 58.0))["active"].all()
