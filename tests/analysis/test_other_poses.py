"""Poses of types other than odometry: of x, y and an angle, of Foxglove, and of fields that are named."""

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from drawn_drives import (
    DrawnDrive,
    DrawnTopic,
    draw_drive,
    extract_drawn,
    read_findings,
    record_cdr,
    record_json,
    record_twist,
    stamp_ros,
    write_drawn,
)

from pipeline.core import SlipError
from pipeline.sources import ConfigurationError

FLAT = "float64 x\nfloat64 y\nfloat64 theta\n"
STAMPED = f"std_msgs/Header header\n{FLAT}"
NESTED = "std_msgs/Header header\ngeometry_msgs/Pose2D pose\n"
MARK = "=" * 80
FLAT_PART = f"{MARK}\nMSG: geometry_msgs/Pose2D\n{FLAT}"
HEADER_PART = (
    f"{MARK}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{MARK}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
SPACE_PART = (
    f"{MARK}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    f"{MARK}\nMSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    f"{MARK}\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
    f"{MARK}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
    f"{MARK}\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
)
FRAME = (
    "builtin_interfaces/Time timestamp\nstring parent_frame_id\nstring child_frame_id\n"
    "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
)
FRAMES = f"foxglove_msgs/FrameTransform[] transforms\n{MARK}\nMSG: foxglove_msgs/FrameTransform\n{FRAME}"


def flat(drive: DrawnDrive, prefix: str = "") -> dict[str, Any]:
    return {f"{prefix}x": drive.x, f"{prefix}y": drive.y, f"{prefix}theta": drive.yaw}


def check_poses(poses: pl.DataFrame, drive: DrawnDrive) -> None:
    """The poses are those that were drawn, in the plane."""
    for axis in "xy":
        np.testing.assert_allclose(poses[axis], getattr(drive, axis), atol=1e-9)
    assert not poses["z"].to_numpy().any()
    heading = 2.0 * np.arctan2(poses["q_z"].to_numpy(), poses["q_w"].to_numpy())
    np.testing.assert_allclose(np.cos(heading - drive.yaw), 1.0)


@pytest.mark.parametrize(
    ("kind", "text", "prefix"),
    [
        ("geometry_msgs/msg/Pose2D", None, ""),
        ("turtlesim/msg/Pose", FLAT, ""),
        ("turtlesim_msgs/msg/Pose", FLAT, ""),
        ("duckietown_msgs/msg/Pose2DStamped", STAMPED + HEADER_PART, ""),
        ("nav_2d_msgs/msg/Pose2DStamped", NESTED + FLAT_PART + HEADER_PART, "pose."),
        ("amrl_msgs/msg/Localization2DMsg", NESTED + FLAT_PART + HEADER_PART, "pose."),
    ],
)
def test_x_y_and_an_angle_are_a_pose(kind: str, text: str | None, prefix: str, tmp_path: Path) -> None:
    drive = draw_drive()
    fields = flat(drive, prefix) | ({} if text in {None, FLAT} else stamp_ros(drive))
    log = write_drawn(
        tmp_path / "run.mcap", record_twist(drive), record_cdr(drive, "/locator", kind, fields, text)
    )
    check_poses(extract_drawn(log), drive)


@pytest.mark.parametrize(
    ("kind", "prefix", "middle"),
    [
        ("geometry_msgs/msg/Pose", "", ("position", "orientation")),
        ("geometry_msgs/msg/TransformStamped", "transform.", ("translation", "rotation")),
    ],
)
def test_a_bare_pose_and_a_transform_on_its_own_topic_are_poses(
    kind: str, prefix: str, middle: tuple[str, str], tmp_path: Path
) -> None:
    drive = draw_drive()
    fields = drive.pose(prefix, middle) | (stamp_ros(drive) if prefix else {})
    topic = record_cdr(drive, "/vicon/robot/robot", kind, fields)
    check_poses(extract_drawn(write_drawn(tmp_path / "run.mcap", record_twist(drive), topic)), drive)


def spell_json(drive: DrawnDrive, kind: str) -> list[dict[str, Any]]:
    """Messages of a type of Foxglove, as it spells them in JSON."""
    messages: list[dict[str, Any]] = []
    half = drive.yaw / 2.0
    for time, x, y, z, w in zip(
        drive.stamps.tolist(), drive.x, drive.y, np.sin(half), np.cos(half), strict=True
    ):
        stamp = {"sec": time // 10**9, "nsec": time % 10**9}
        place, turn = {"x": x, "y": y, "z": 0.0}, {"x": 0.0, "y": 0.0, "z": z, "w": w}
        if kind == "PoseInFrame":
            pose = {"position": place, "orientation": turn}
            messages.append({"timestamp": stamp, "frame_id": "map", "pose": pose})
            continue
        names = {"parent_frame_id": "map", "child_frame_id": "base_link"}
        one = {"timestamp": stamp, **names, "translation": place, "rotation": turn}
        messages.append({"transforms": [one]} if kind == "FrameTransforms" else one)
    return messages


def spell_cdr(drive: DrawnDrive, kind: str) -> DrawnTopic:
    """The same as messages of ROS."""
    if kind == "PoseInFrame":
        text = "builtin_interfaces/Time timestamp\nstring frame_id\ngeometry_msgs/Pose pose\n"
        fields = drive.pose("pose.") | stamp_ros(drive, "timestamp") | {"frame_id": "map"}
    else:
        inner = "transforms[]." if kind == "FrameTransforms" else ""
        text = FRAMES if inner else FRAME
        values = drive.pose("", ("translation", "rotation")) | stamp_ros(drive, "timestamp")
        fields = {f"{inner}{name}": value[:, None] if inner else value for name, value in values.items()}
        names = {"parent_frame_id": "map", "child_frame_id": "base_link"}
        fields |= {f"{inner}{name}": value for name, value in names.items()}
    return record_cdr(drive, "/frames", f"foxglove_msgs/msg/{kind}", fields, text + SPACE_PART)


def spell_protobuf(drive: DrawnDrive, kind: str) -> DrawnTopic:
    """The same in protobuf, encoded by Foxglove's own package."""
    from foxglove import messages as types  # noqa: PLC0415 - heavy

    def make(said: dict[str, Any]) -> Any:  # noqa: ANN401 - of a library without types
        stamp = types.Timestamp(said["timestamp"]["sec"], said["timestamp"]["nsec"])
        if kind == "PoseInFrame":
            pose = types.Pose(
                position=types.Vector3(**said["pose"]["position"]),
                orientation=types.Quaternion(**said["pose"]["orientation"]),
            )
            return types.PoseInFrame(timestamp=stamp, frame_id="map", pose=pose)
        return types.FrameTransform(
            timestamp=stamp,
            parent_frame_id="map",
            child_frame_id="base_link",
            translation=types.Vector3(**said["translation"]),
            rotation=types.Quaternion(**said["rotation"]),
        )

    made = [
        types.FrameTransforms(transforms=[make(said["transforms"][0])])
        if "transforms" in said
        else make(said)
        for said in spell_json(drive, kind)
    ]
    schema = type(made[0]).get_schema()
    encoded = [one.encode() for one in made]
    return DrawnTopic("/frames", schema.name, schema.encoding, schema.data, "protobuf", drive.stamps, encoded)


@pytest.mark.parametrize("kind", ["PoseInFrame", "FrameTransform", "FrameTransforms"])
@pytest.mark.parametrize("encoding", ["json", "cdr", "protobuf"])
def test_poses_and_transforms_of_foxglove_are_read(kind: str, encoding: str, tmp_path: Path) -> None:
    drive = draw_drive()
    topic = {"cdr": spell_cdr, "protobuf": spell_protobuf}.get(
        encoding,
        lambda drive, kind: record_json(drive, "/frames", f"foxglove.{kind}", spell_json(drive, kind)),
    )(drive, kind)
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive), topic)
    check_poses(extract_drawn(log), drive)
    findings = read_findings(log)
    assert ("transforms" in findings) == (kind != "PoseInFrame")


TRACKED = "float64 px\nfloat64 py\nfloat64 bearing_deg\nfloat64[2] place\nfloat64 angle\n"


def write_tracked(folder: Path) -> tuple[Path, DrawnDrive]:
    """A log whose pose is in fields of a type that nobody knows."""
    drive = draw_drive()
    fields = {
        "px": drive.x,
        "py": drive.y,
        "bearing_deg": np.degrees(drive.yaw),
        "place": np.stack((drive.x, drive.y), axis=1),
        "angle": drive.yaw,
    }
    tracker = record_cdr(drive, "/tracker", "lab_msgs/msg/Tracked", fields, TRACKED)
    return write_drawn(folder / "run.mcap", record_twist(drive), tracker), drive


@pytest.mark.parametrize(
    "names", [("px", "py", "bearing_deg"), ("place[0]", "place[1]", "angle")], ids=["degrees", "elements"]
)
def test_three_fields_of_a_topic_are_a_pose(names: tuple[str, str, str], tmp_path: Path) -> None:
    log, drive = write_tracked(tmp_path)
    keys = zip(("x", "y", "yaw"), names, strict=True)
    lines = [f'{key} = "/tracker.{name}"' for key, name in keys]
    (tmp_path / "run.toml").write_text("\n".join(["[pose]", *lines]), encoding="utf-8")
    check_poses(extract_drawn(log), drive)


def test_the_fields_of_a_pose_name_the_robot(tmp_path: Path) -> None:
    drive = draw_drive()
    topics = [
        one
        for robot in ("robot1", "robot2")
        for one in (
            record_twist(drive, f"/{robot}/cmd_vel"),
            record_cdr(drive, f"/{robot}/pose", "geometry_msgs/msg/PoseStamped", drive.pose("pose.")),
        )
    ]
    tracker = record_cdr(drive, "/robot2/tracker", "lab_msgs/msg/Tracked", flat(drive), FLAT)
    log = write_drawn(tmp_path / "run.mcap", *topics, tracker)
    with pytest.raises(SlipError, match="several robots"):
        extract_drawn(log)
    names = {"x": "x", "y": "y", "yaw": "theta"}
    pose = {key: f"/robot2/tracker.{name}" for key, name in names.items()}
    check_poses(extract_drawn(log, pose=pose), drive)


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        ({"x": "/tracker.px", "y": "/tracker.py"}, "needs x, y and yaw, and pose.yaw is not given"),
        (
            {"x": "/tracker.px", "y": "/tracker.py", "yaw": "/cmd_vel.angular.z"},
            "/tracker and /cmd_vel are several",
        ),
        ({"x": "/tracker", "y": "/tracker.py", "yaw": "/tracker.angle"}, "'/tracker' without a field"),
        (
            {"x": "/tracker.px", "y": "/tracker.py", "yaw": "/tracker.angle", "topic": "/cmd_vel"},
            "pose.topic is '/cmd_vel'",
        ),
        ({"x": "/tracker.px", "y": "/tracker.py", "yaw": "/away.angle"}, "'/away' configured as pose.yaw"),
        ({"x": "/tracker.px", "y": "/tracker.py", "yaw": "/tracker.heading"}, "not a field heading"),
    ],
)
def test_fields_that_are_no_pose_are_refused(pose: dict[str, str], said: str, tmp_path: Path) -> None:
    log, _ = write_tracked(tmp_path)
    with pytest.raises(SlipError, match=said) as caught:
        extract_drawn(log, pose=pose)
    assert "\n" not in str(caught.value)
    if "heading" not in said:
        assert isinstance(caught.value, ConfigurationError)


def record_unknown(drive: DrawnDrive, spelling: str) -> DrawnTopic:
    """Poses of a type that nobody knows."""
    if spelling == "json":
        rows = zip(drive.x, drive.y, drive.yaw, strict=True)
        messages = [
            {"state": {"pos_x": x, "pos_y": y}, "yaw_rate": 0.1, "heading": yaw} for x, y, yaw in rows
        ]
        return record_json(drive, "/tracker", "Tracked", messages)
    if spelling == "place":
        fields = {"position.x": drive.x, "position.y": drive.y}
        text = f"geometry_msgs/Point position\n{MARK}\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\n"
        return record_cdr(drive, "/tracker", "lab_msgs/msg/Tracked", fields, text)
    return record_cdr(drive, "/tracker", "lab_msgs/msg/Tracked", flat(drive), FLAT)


@pytest.mark.parametrize(
    ("spelling", "said"),
    [
        ("flat", 'pose = {x = "/tracker.x", y = "/tracker.y", yaw = "/tracker.theta"}'),
        ("json", 'pose = {x = "/tracker.state.pos_x", y = "/tracker.state.pos_y", yaw = "/tracker.heading"}'),
        ("place", "/tracker has positions (position.x, position.y)"),
    ],
)
def test_a_log_without_a_known_pose_names_fields_that_look_like_one(
    spelling: str, said: str, tmp_path: Path
) -> None:
    drive = draw_drive()
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive), record_unknown(drive, spelling))
    with pytest.raises(SlipError) as caught:
        extract_drawn(log)
    assert caught.value.code == "no_pose"
    assert said in str(caught.value)
    assert "None of its topics" not in str(caught.value)
    if "pose = " in said:
        (tmp_path / "run.toml").write_text(said, encoding="utf-8")
        check_poses(extract_drawn(log), drive)


def test_commands_and_goals_do_not_look_like_poses(tmp_path: Path) -> None:
    drive = draw_drive()
    goal = record_cdr(drive, "/goal", "lab_msgs/msg/Tracked", flat(drive), FLAT)
    with pytest.raises(SlipError, match="None of its topics holds poses"):
        extract_drawn(write_drawn(tmp_path / "run.mcap", record_twist(drive), goal))


def record_frames(drive: DrawnDrive, frames: dict[str, float], parent: str = "map") -> DrawnTopic:
    """Transforms of frames that do a share of the drive."""
    inner = "transforms[]."
    poses = [
        {
            f"{inner}{name}": value * share if name.endswith(("x", "y")) else value
            for name, value in given.items()
        }
        for share in frames.values()
        for given in [drive.pose("transform.", ("translation", "rotation"))]
    ]
    columns = {name: np.stack([pose[name] for pose in poses], axis=1) for name in poses[0]}
    count = len(frames)
    stamps = {
        f"{inner}{name}": np.repeat(value[:, None], count, 1) for name, value in stamp_ros(drive).items()
    }
    names = {f"{inner}header.frame_id": [parent] * count, f"{inner}child_frame_id": list(frames)}
    return record_cdr(drive, "/tf", "tf2_msgs/msg/TFMessage", columns | stamps | names)


def test_the_only_frame_that_moves_is_the_vehicle(tmp_path: Path) -> None:
    drive = draw_drive()
    frames = record_frames(drive, {"car_rear_axle": 1.0, "dock": 0.0, "odom_combined": 0.2})
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive), frames)
    check_poses(extract_drawn(log), drive)
    said = read_findings(log)["vehicle_frame"]
    assert said.startswith("no frame is called base_link: car_rear_axle, the only one that moves, is taken")
    assert "[pose] frames" in said
    assert "vehicle_frame" not in read_findings(log, pose={"frames": ["map", "car_rear_axle"]})


def test_of_several_frames_that_move_the_one_of_the_namespace_is_the_vehicle(tmp_path: Path) -> None:
    drive = draw_drive()
    frames = record_frames(drive, {"robot1/axle": 1.0, "robot2/axle": 0.5})
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive, "/robot1/cmd_vel"), frames)
    check_poses(extract_drawn(log), drive)
    assert "robot1/axle, the only one that moves in its namespace" in read_findings(log)["vehicle_frame"]


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        ({"car": 1.0, "truck": 0.5}, r"several frames move \(car and truck\)"),
        ({"dock": 0.0}, "no frame moves"),
    ],
)
def test_without_one_frame_that_moves_the_frames_are_listed(
    frames: dict[str, float], said: str, tmp_path: Path
) -> None:
    drive = draw_drive()
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive), record_frames(drive, frames))
    with pytest.raises(SlipError, match=said) as caught:
        extract_drawn(log)
    assert caught.value.code == "no_base_frame"
    assert "Known frames: " in caught.value.hint
