"""Recorders whose clock stands, or is at an end of 64 bits: stamps serve, or one line refuses the log."""

import json
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from drawn_motion import draw
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_typestore
from verbs import run_slip
from written_logs import write_log

LARGEST = 2**64 - 1
STEPS = st.sampled_from([0, 1, 1000, 5_000_000, -5_000_000])
NEAR = st.integers(0, 2000)
LONGEST = 10_000
"""More messages than a log here has."""
RESTAMPED = settings(
    max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
OFFSETS = (
    st.sampled_from([0, 2**31, 2**53, 2**62])
    | st.builds(lambda n: 2**63 - n, NEAR)
    | st.builds(lambda n: 2**63 + n, NEAR)
    | st.builds(lambda n: 2**64 - 1 - n, NEAR)
)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Path]:
    """A drive whose commands have stamps, and the same without."""
    folder = tmp_path_factory.mktemp("clocks")
    drive = draw(3, 40.0)
    names = {True: "stamped.mcap", False: "plain.mcap"}
    return {
        stamped: write_log(folder / name, drive, is_measured=False, command_ahead_s=0.0 if stamped else None)
        for stamped, name in names.items()
    }


def restamp(source: Path, target: Path, offset: int, step: int) -> None:
    """The log with other log times; where they would leave 64 bits, the last one repeats."""
    with source.open("rb") as opened, target.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 14)
        writer.start(profile="ros2")
        channels: dict[int, int] = {}
        for number, (schema, channel, message) in enumerate(make_reader(opened).iter_messages()):
            if channel.id not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, kind)
            time = min(max(offset + step * number, 0), LARGEST)
            writer.add_message(channels[channel.id], time, message.data, time, sequence=number)
        writer.finish()


def analyze(log: Path) -> tuple[int, float, str]:
    """Exit code, median slip modulus from commands, and the last line that is said."""
    results = log.parent / "results"
    words = ("--no-report", "--no-diagnosis", "--force", "--json", "--results", str(results))
    code, out, err = run_slip("analyze", str(log), "--vehicle", "husky_a200", *words)
    runs = json.loads(out).get("runs") or [{}]
    by_input = runs[0].get("by_input") or {}
    return code, by_input.get("command", {}).get("median_modulus", np.nan), err.strip().rpartition("\n")[2]


@RESTAMPED
@given(OFFSETS, STEPS)
@example(2**63 - 500, 1)
@example(LARGEST, 0)
@example(2**64 - 500, 1)
@example(2**62, -5_000_000)
def test_stamps_serve_where_the_recorders_clock_does_not(
    logs: dict[bool, Path], tmp_path: Path, offset: int, step: int
) -> None:
    log = tmp_path / "log.mcap"
    restamp(logs[True], log, offset, step)
    code, modulus, last = analyze(log)
    if step < 0 and offset + LONGEST * step < 2**62:
        # A clock that runs backward, some of its times where clocks may be.
        assert code in {0, 1, 3}, last
    else:
        assert code == 0, last
        assert modulus == pytest.approx(analyze(logs[True])[1], rel=0.1)


@RESTAMPED
@given(OFFSETS, STEPS)
@example(2**63 - 500, 1)
@example(2**63 - 500, 5_000_000)
@example(0, 0)
def test_commands_without_a_clock_are_refused_in_one_line(
    logs: dict[bool, Path], tmp_path: Path, offset: int, step: int
) -> None:
    log = tmp_path / "log.mcap"
    restamp(logs[False], log, offset, step)
    code, modulus, last = analyze(log)
    if step == 0 or min(offset, offset + LONGEST * step) >= 2**62:
        assert code == 1
        assert "the log times of /cmd_vel stand still, and it has no other clock" in last
    elif step > 0:
        assert code == 0, last
        assert modulus == pytest.approx(analyze(logs[False])[1], rel=0.2)


@pytest.mark.parametrize("offset", [2**62 + 1, 2**63 + 7, LARGEST - 10**6])
def test_a_clock_after_2116_is_told_as_a_clock_and_not_as_damage(
    logs: dict[bool, Path], tmp_path: Path, offset: int
) -> None:
    log = tmp_path / "log.mcap"
    restamp(logs[True], log, offset, 1)
    code, out, _ = run_slip("inspect", str(log))
    assert code == 0
    assert "the recorder's clock is not set: it shows times after the year 2116" in out
    assert "complete" in out
    assert "damage" not in out


@pytest.mark.parametrize("first", [-(2**63), -1, 2**63 - 5000])
@pytest.mark.parametrize("stamped", [True, False])
def test_a_bag_with_times_at_the_ends_of_64_bits(
    logs: dict[bool, Path], tmp_path: Path, first: int, *, stamped: bool
) -> None:
    writer = FolderWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3)
    store, connections = get_typestore(Stores.ROS2_HUMBLE), {}
    with logs[stamped].open("rb") as opened, writer:
        for schema, channel, message in make_reader(opened).iter_messages():
            if channel.topic not in connections:
                added = writer.add_connection(channel.topic, schema.name, typestore=store)
                connections[channel.topic] = added
            writer.write(connections[channel.topic], message.log_time, message.data)
    (bag,) = (tmp_path / "bag").glob("*.db3")
    with sqlite3.connect(bag) as base:
        base.execute("UPDATE messages SET timestamp = ? + id", (first,))
    base.close()
    (tmp_path / "bag" / "metadata.yaml").unlink()
    code, modulus, last = analyze(bag)
    if stamped:
        assert code == 0, last
        assert modulus == pytest.approx(analyze(logs[True])[1], rel=0.1)
    elif first != -1:
        assert code == 1
        assert "the log times of /cmd_vel stand still" in last
