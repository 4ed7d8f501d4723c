"""Older layouts of known types are read by the definition in the log; Foxglove's types of motion are read."""

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_drives import (
    DrawnDrive,
    draw_drive,
    extract_drawn,
    record_cdr,
    record_json,
    record_twist,
    write_drawn,
)
from mcap_files import START

from pipeline.logs import LogError, Wanted, open_log, read_topics
from pipeline.sources.message_types import find_type, list_layouts

ODOMETRY, LOCAL = (f"px4_msgs/msg/Vehicle{name}" for name in ("Odometry", "LocalPosition"))
TO_1_13 = (
    "uint64 timestamp\nuint64 timestamp_sample\nuint8 local_frame\n"
    "float32 x\nfloat32 y\nfloat32 z\nfloat32[4] q\n"
)
TO_1_10 = "uint64 timestamp\nfloat32 x\nfloat32 y\nfloat32 z\nfloat32[4] q\nfloat32[4] q_offset\n"
LOCAL_1_10 = "uint64 timestamp\nbool xy_valid\nfloat32 x\nfloat32 y\nfloat32 z\nfloat32 yaw\n"


def spell_older(drive: DrawnDrive, *, has_sample: bool) -> dict[str, Any]:
    """North, east, down in x, y and z, with the body's attitude in them."""
    half, zero = (np.pi / 2.0 - drive.yaw) / 2.0, np.zeros(drive.time.size)
    stamp = np.round(drive.time * 1e6).astype(np.int64) + 35_000_000
    fields = {"x": drive.y, "y": drive.x, "z": zero, "timestamp": stamp}
    fields["q"] = np.stack((np.cos(half), zero, zero, np.sin(half)), axis=1)
    return fields | ({"timestamp_sample": stamp} if has_sample else {})


@pytest.mark.parametrize("definition", [TO_1_13, TO_1_10], ids=["to 1.13", "to 1.10"])
def test_an_older_layout_is_read_as_the_present_one(definition: str, tmp_path: Path) -> None:
    drive = draw_drive()
    fields = spell_older(drive, has_sample="sample" in definition)
    topic = record_cdr(drive, "/fmu/vehicle_odometry/out", ODOMETRY, fields, definition)
    poses = extract_drawn(write_drawn(tmp_path / "run.mcap", record_twist(drive), topic))
    np.testing.assert_allclose(poses["x"], drive.x, atol=1e-5)
    np.testing.assert_allclose(poses["y"], drive.y, atol=1e-5)


def test_a_heading_is_read_under_the_name_that_it_had(tmp_path: Path) -> None:
    drive = draw_drive()
    fields = spell_older(drive, has_sample=False)
    fields["yaw"] = np.pi / 2.0 - drive.yaw
    del fields["q"]
    topic = record_cdr(drive, "/fmu/out/vehicle_local_position", LOCAL, fields, LOCAL_1_10)
    poses = extract_drawn(write_drawn(tmp_path / "run.mcap", record_twist(drive), topic))
    np.testing.assert_allclose(poses["x"], drive.x, atol=1e-5)
    turned = (poses["q_w"].to_numpy() + 1j * poses["q_z"].to_numpy()) ** 2
    np.testing.assert_allclose(turned, np.exp(1j * drive.yaw), atol=1e-5)


def test_a_layout_that_is_not_known_is_called_another_version(tmp_path: Path) -> None:
    drive = draw_drive(3.0)
    topic = record_cdr(drive, "/odometry", ODOMETRY, {"place": drive.x}, "uint64 timestamp\nfloat32 place\n")
    log = write_drawn(tmp_path / "run.mcap", topic)
    fields = ("position[0]", "timestamp_sample")
    wanted = Wanted("/odometry", fields, layouts=list_layouts(ODOMETRY, fields))
    with pytest.raises(LogError, match="another version of px4_msgs") as raised:
        read_topics(log, [wanted])
    assert "place" in raised.value.hint
    assert "run.toml" in raised.value.hint


def test_every_older_layout_has_what_the_present_one_has() -> None:
    for name in ("px4_msgs/VehicleOdometry", "px4_msgs/VehicleLocalPosition"):
        pose = find_type(name).pose
        assert pose is not None
        fields = [*pose.position, *pose.orientation, *filter(None, [pose.angle])]
        layouts = list_layouts(name, fields)
        assert len(layouts) == 1 + len(find_type(name).older)
        assert all(set(layout) == set(fields) for layout in layouts)
    assert list_layouts("lab_msgs/Unknown", ["x"]) == ()


def test_a_database_without_definitions_names_the_version(tmp_path: Path) -> None:
    drive = draw_drive()
    older = record_cdr(drive, "/odometry", ODOMETRY, spell_older(drive, has_sample=True), TO_1_13)
    path = tmp_path / "run.db3"
    with sqlite3.connect(path) as base:
        base.execute("create table topics (id, name, type, serialization_format, offered_qos_profiles)")
        base.execute("create table messages (id, topic_id, timestamp, data)")
        for number, one in enumerate((record_twist(drive), older)):
            base.execute("insert into topics values (?, ?, ?, 'cdr', '')", (number, one.topic, one.kind))
            rows = [(number, time, data) for time, data in zip(one.times.tolist(), one.messages, strict=True)]
            base.executemany("insert into messages (topic_id, timestamp, data) values (?, ?, ?)", rows)
    (loss,) = read_topics(open_log(path), [Wanted("/odometry")]).losses
    assert loss.kind == "other_version"
    assert "another version of px4_msgs" in loss.text
    assert "MCAP" in loss.text


def spell_time(drive: DrawnDrive) -> list[dict[str, int]]:
    return [{"sec": one // 10**9, "nsec": one % 10**9} for one in drive.stamps.tolist()]


RADIUS_M = 6_378_137.0


@pytest.mark.parametrize("kind", ["LocationFix", "LocationFixes"])
def test_fixes_of_foxglove_are_places(kind: str, tmp_path: Path) -> None:
    drive = draw_drive()
    at = [
        {"timestamp": time, "frame_id": "gps", "latitude": 40.0 + lat, "longitude": lon, "altitude": 600.0}
        for time, lat, lon in zip(
            spell_time(drive),
            np.degrees(drive.y / RADIUS_M).tolist(),
            np.degrees(drive.x / RADIUS_M / np.cos(np.radians(40.0))).tolist(),
            strict=True,
        )
    ]
    said = at if kind == "LocationFix" else [{"fixes": [one, one]} for one in at]
    topic = record_json(drive, "/location", f"foxglove.{kind}", said)
    poses = extract_drawn(write_drawn(tmp_path / "run.mcap", record_twist(drive), topic))
    x, y = (poses[name].to_numpy() - poses[name][0] for name in ("x", "y"))
    path = np.hypot(np.diff(x), np.diff(y)).sum()
    assert path == pytest.approx(np.hypot(np.diff(drive.x), np.diff(drive.y)).sum(), rel=0.01)


def test_odometry_and_joints_of_foxglove_are_read(tmp_path: Path) -> None:
    drive = draw_drive()
    half = drive.yaw / 2.0
    odometry = [
        {
            "timestamp": time,
            "frame_id": "odom",
            "body_frame_id": "base_link",
            "pose": {
                "position": {"x": x, "y": y, "z": 0.0},
                "orientation": {"x": 0.0, "y": 0.0, "z": z, "w": w},
            },
        }
        for time, x, y, z, w in zip(
            spell_time(drive),
            drive.x.tolist(),
            drive.y.tolist(),
            np.sin(half).tolist(),
            np.cos(half).tolist(),
            strict=True,
        )
    ]
    sides = [(drive.speed + sign * 0.25 * drive.turn) / 0.1 for sign in (-1.0, 1.0)]
    joints = [
        {
            "timestamp": time,
            "joints": [{"name": "left_wheel", "velocity": left}, {"name": "right_wheel", "velocity": right}],
        }
        for time, left, right in zip(spell_time(drive), *(one.tolist() for one in sides), strict=True)
    ]
    log = write_drawn(
        tmp_path / "run.mcap",
        record_json(drive, "/lidar_odometry", "foxglove.Odometry", odometry),
        record_json(drive, "/joints", "foxglove.JointStates", joints),
    )
    np.testing.assert_allclose(extract_drawn(log)["x"], drive.x, atol=1e-9)
    np.testing.assert_allclose(extract_drawn(log, "wheels")["left"], sides[0], atol=1e-9)
    assert int(extract_drawn(log)["stamp"][0]) == START
