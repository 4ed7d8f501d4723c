"""The small log as bags, for the tests of the room."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mcap_files import JOINTS, payloads, small_truth
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_typestore

if TYPE_CHECKING:
    from pathlib import Path

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE_1 = get_typestore(Stores.ROS1_NOETIC)


def write_db3(folder: Path, *, mode: CompressionMode = CompressionMode.NONE) -> Path:
    """The small log as a folder of rosbag2 with an SQLite file."""
    writer = FolderWriter(folder, version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        for topic, (kind, times, fields) in small_truth()[0].items():
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for time, payload in zip(times.tolist(), payloads(kind, times.size, fields), strict=True):
                writer.write(connection, time, payload)
    return folder


def write_bag(path: Path, form: BagWriter.CompressionFormat | None = None) -> Path:
    """The small log as a bag of ROS 1."""
    writer = BagWriter(path)
    if form is not None:
        writer.set_compression(form)
    with writer:
        for topic, (kind, times, fields) in small_truth()[0].items():
            connection = writer.add_connection(topic, kind, typestore=STORE_1)
            for time, payload in zip(times.tolist(), payloads(kind, times.size, fields), strict=True):
                message = STORE.deserialize_cdr(payload, kind)
                if kind == JOINTS:
                    old = STORE_1.types["std_msgs/msg/Header"]
                    message.header = old(0, message.header.stamp, message.header.frame_id)
                writer.write(connection, time, STORE_1.serialize_ros1(message, kind))
    return path
