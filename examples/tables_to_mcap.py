"""Write an MCAP log of a folder of text tables; here of a session of FoMo (arXiv:2603.08433).

    python examples/tables_to_mcap.py red_2025-10-14-11-41 session.mcap
    slip analyze session.mcap --vehicle warthog

For another data set, change TABLES: each file is a topic, each row a message at its time.
"""

import csv
import sys
from pathlib import Path
from typing import Any

from mcap_ros2.writer import Writer
from rosbags.typesys import Stores, get_typestore

VECTOR, ANGLE = "xyz", "xyzw"
IMU = {f"angular_velocity.{axis}": f"a{axis}" for axis in VECTOR}
IMU |= {f"linear_acceleration.{axis}": f"l{axis}" for axis in VECTOR}
POSE = {f"pose.orientation.{axis}": f"q{axis}" for axis in ANGLE}
ODOMETRY = {f"pose.pose.position.{axis}": f"p{axis}" for axis in VECTOR}
ODOMETRY |= {f"pose.{path}": name for path, name in POSE.items()}
ODOMETRY |= {"twist.twist.linear.x": "tlx", "twist.twist.linear.y": "tly", "twist.twist.angular.z": "taz"}
POSE |= {f"pose.position.{axis}": axis for axis in VECTOR}
TWIST = {"linear.x": "lx", "angular.z": "az"}
BASE = "/warthog/platform"
# File, topic, message type, column of the time and how many a second, frames, and the column of each field.
TABLES = [
    ("gt.txt", "/ppk_gnss/pose", "geometry_msgs/msg/PoseStamped", "t", 1, ("map",), POSE),
    ("odom.csv", f"{BASE}/odom", "nav_msgs/msg/Odometry", "t", 1e6, ("odom", "base_link"), ODOMETRY),
    ("vectornav.csv", "/vectornav/data_raw", "sensor_msgs/msg/Imu", "t", 1e6, ("vectornav",), IMU),
    ("xsens.csv", "/xsens/data_raw", "sensor_msgs/msg/Imu", "t", 1e6, ("xsens",), IMU),
    ("metadata/cmd_velocity.csv", f"{BASE}/cmd_vel", "geometry_msgs/msg/Twist", "timestamp", 1e6, (), TWIST),
]
for side in ("left", "right"):
    for file, topic in (("cmd_velocity", "cmd_velocity"), ("velocity", "status/velocity")):
        one = (f"metadata/{file}_{side}.csv", f"{BASE}/motor/{side}/{topic}", "std_msgs/msg/Float64")
        TABLES.append((*one, "timestamp", 1e6, (), {"data": "value"}))


def write_log(folder: Path, path: Path) -> None:
    """Write the tables of a folder that are there as one log."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    with path.open("wb") as stream:
        writer = Writer(stream)
        for file, topic, kind, clock, per_second, frames, fields in TABLES:
            if not (folder / file).is_file():
                continue
            schema = writer.register_msgdef(kind, types.generate_msgdef(kind, ros_version=2)[0])
            lines = (folder / file).read_text("utf-8-sig").splitlines()
            if file.endswith(".txt"):  # poses in the format of TUM
                lines = [
                    "t,x,y,z,qx,qy,qz,qw",
                    *(",".join(line.split()) for line in lines if line[:1] != "#"),
                ]
            names, *rows = csv.reader(lines)
            for row in rows:
                # The first column of a name counts: some files name columns twice.
                value = {name: row[names.index(name)] for name in (clock, *fields.values())}
                time_ns = round(float(value[clock]) / per_second * 1e6) * 1000
                message: dict[str, Any] = {}
                for field, column in fields.items():
                    put(message, field, float(value[column]))
                for field, frame in zip(("header.frame_id", "child_frame_id"), frames, strict=False):
                    put(message, field, frame)
                if frames:
                    put(message, "header.stamp.sec", time_ns // 10**9)
                    put(message, "header.stamp.nanosec", time_ns % 10**9)
                writer.write_message(topic, schema, message, log_time=time_ns, publish_time=time_ns)
        writer.finish()


def put(message: dict[str, Any], path: str, value: object) -> None:
    """Set a field within a message."""
    *inner, name = path.split(".")
    for part in inner:
        message = message.setdefault(part, {})
    message[name] = value


if __name__ == "__main__":
    write_log(Path(sys.argv[1]), Path(sys.argv[2]))
