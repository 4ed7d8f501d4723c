"""A log as a robot records it, for the reader's benchmark: small messages among images and clouds."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from pipeline.logs import definition_text
from pipeline.logs.schema import parse_msg
from pipeline.logs.writer import Given, encode_rows

IMAGE = """std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
"""
START_NS = 1_700_000_000_000_000_000
SMALL = (
    ("/imu/data", "sensor_msgs/msg/Imu", 100.0),
    ("/joint_states", "sensor_msgs/msg/JointState", 50.0),
    ("/odom", "nav_msgs/msg/Odometry", 50.0),
    ("/odometry/filtered", "nav_msgs/msg/Odometry", 50.0),
    ("/tf", "tf2_msgs/msg/TFMessage", 50.0),
    ("/cmd_vel", "geometry_msgs/msg/Twist", 50.0),
    ("/left_drive/velocity", "std_msgs/msg/Float64", 50.0),
    ("/right_drive/velocity", "std_msgs/msg/Float64", 50.0),
)
LARGE = (("/camera/image_raw", 640, 480, 3), ("/lidar/image", 1024, 64, 8))
LARGE_HZ = 1.17


def payloads_of(type_name: str, text: str, rows: int, fields: Mapping[str, Given]) -> list[bytes]:
    """Serialized messages."""
    return encode_rows(parse_msg(type_name, text), rows, fields, where=type_name)


def small_fields(type_name: str, time: NDArray[np.int64], rng: np.random.Generator) -> dict[str, Given]:
    """Values that look like a drive: smooth with noise."""
    rows = time.size
    wave = np.sin(np.arange(rows) * 0.01)
    stamp: dict[str, Given] = {
        "header.stamp.sec": time // 10**9,
        "header.stamp.nanosec": time % 10**9,
        "header.frame_id": "base_link",
    }
    noise = rng.normal(scale=0.01, size=(rows, 4))
    if type_name.endswith("Imu"):
        return {**stamp, "angular_velocity.z": wave + noise[:, 0], "linear_acceleration.x": noise[:, 1]}
    if type_name.endswith("JointState"):
        names = ["front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel"]
        speed = 5.0 * wave[:, None] + noise
        return {**stamp, "name": names, "position": np.cumsum(speed, axis=0) * 0.01, "velocity": speed}
    if type_name.endswith("Odometry"):
        pose: dict[str, Given] = {"pose.pose.position.x": np.cumsum(wave), "pose.pose.orientation.w": 1.0}
        return {**stamp, "child_frame_id": "base_link", **pose, "twist.twist.linear.x": wave + noise[:, 0]}
    if type_name.endswith("TFMessage"):
        frames = ("base_link", "front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel")
        several = len(frames)
        names = {f"transforms[].{key}": repeat(value, rows, several) for key, value in stamp.items()}
        return {
            **names,
            "transforms[].child_frame_id": [list(frames)] * rows,
            "transforms[].transform.rotation.z": np.repeat(noise[:, :1], several, axis=1),
            "transforms[].transform.rotation.w": np.ones((rows, several)),
        }
    if type_name.endswith("Twist"):
        return {"linear.x": wave, "angular.z": noise[:, 0]}
    return {"data": wave + noise[:, 0]}


def repeat(value: Given, rows: int, several: int) -> Given:
    """The same value for all transforms of a message."""
    if isinstance(value, str):
        return [[value] * several] * rows
    return np.repeat(np.asarray(value)[:, None], several, axis=1)


def write_log(path: Path, duration_s: float, *, crc: bool = True) -> dict[str, int]:
    """Write the log with the official writer, zstd, and return messages by topic."""
    rng = np.random.default_rng(7)
    messages: list[tuple[int, str, bytes]] = []
    for topic, kind, rate in SMALL:
        time = START_NS + (np.arange(int(duration_s * rate)) * (1e9 / rate)).astype(np.int64)
        text = definition_text(kind) or ""
        encoded = payloads_of(kind, text, time.size, small_fields(kind, time, rng))
        messages += zip(time.tolist(), [topic] * time.size, encoded, strict=True)
    counts: dict[str, int] = {}
    frames = {topic: _frames(width, height, depth, rng) for topic, width, height, depth in LARGE}
    for number in range(int(duration_s * LARGE_HZ)):
        messages += [(START_NS + int(number / LARGE_HZ * 1e9) + 1, topic, b"") for topic in frames]
    messages.sort(key=lambda each: each[0])
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, enable_crcs=crc)
        writer.start(profile="ros2", library="bench")
        channels = _register(writer)
        for number, (time, topic, payload) in enumerate(messages):
            counts[topic] = counts.get(topic, 0) + 1
            data = payload or frames[topic][number % len(frames[topic])]
            writer.add_message(channels[topic], time, data, time, number)
        writer.finish()
    return counts


def _frames(width: int, height: int, depth: int, rng: np.random.Generator) -> list[bytes]:
    """A few images whose low bits are noise, as a camera's are: zstd leaves about two thirds of them."""
    text = IMAGE + "=" * 80 + "\nMSG: std_msgs/Header\n" + (definition_text("std_msgs/msg/Header") or "")
    row = (np.linspace(0, 40, width)[None, :, None] + np.arange(depth)).astype(np.uint8)
    images = []
    for _ in range(8):
        noise = rng.integers(0, 16, size=(height, width, depth), dtype=np.uint8)
        pixels = (row + noise).reshape(1, -1)
        fields: dict[str, Given] = {"height": height, "width": width, "encoding": "rgb8", "data": pixels}
        images += payloads_of("sensor_msgs/msg/Image", text, 1, fields)
    return images


def _register(writer: Writer) -> dict[str, int]:
    channels: dict[str, int] = {}
    image = IMAGE + "=" * 80 + "\nMSG: std_msgs/Header\n" + (definition_text("std_msgs/msg/Header") or "")
    kinds = [(topic, kind, definition_text(kind) or "") for topic, kind, _ in SMALL]
    kinds += [(topic, "sensor_msgs/msg/Image", image) for topic, *_ in LARGE]
    for topic, kind, text in kinds:
        schema = writer.register_schema(kind, "ros2msg", text.encode())
        channels[topic] = writer.register_channel(topic, "cdr", schema)
    return channels


def write_metadata(path: Path, counts: Mapping[str, int]) -> None:
    """The ``metadata.yaml`` of rosbag2 beside the log, which rosbags needs."""
    kinds = {topic: kind for topic, kind, _ in SMALL} | {
        topic: "sensor_msgs/msg/Image" for topic, *_ in LARGE
    }
    topics = "".join(
        f"    - topic_metadata:\n        name: {topic}\n        type: {kinds[topic]}\n"
        "        serialization_format: cdr\n        offered_qos_profiles: ''\n"
        f"      message_count: {count}\n"
        for topic, count in counts.items()
    )
    path.with_name("metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n"
        f"  relative_file_paths:\n    - {path.name}\n"
        "  duration:\n    nanoseconds: 1\n"
        f"  starting_time:\n    nanoseconds_since_epoch: {START_NS}\n"
        f"  message_count: {sum(counts.values())}\n"
        f"  topics_with_message_count:\n{topics}"
        "  compression_format: ''\n  compression_mode: ''\n"
    )
