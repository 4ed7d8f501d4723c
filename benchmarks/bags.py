"""What reading a bag takes beside reading the same messages from MCAP: time, processor, memory.

The log of `reader.py` is written as MCAP (zstd), as an SQLite file of rosbag2 and as a bag of ROS 1 (lz4);
the same eight topics are read from each, on two threads, each time in a process of its own. Exit code 1 when
values differ.
"""

import argparse
import tempfile
from pathlib import Path

from mcap.reader import make_reader
from reader import measure, number
from reader_log import write_log
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

READER = "ours, 2 threads"


def convert(log: Path, folder: Path) -> dict[str, Path]:
    """The same messages in other files, by what they are called in the table."""
    store, old = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
    old.register(
        get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage")
    )
    bag = BagWriter(folder / "run.bag")
    bag.set_compression(BagWriter.CompressionFormat.LZ4)
    database = FolderWriter(folder / "run", version=9, storage_plugin=StoragePlugin.SQLITE3)
    connections = {}
    with bag, database, log.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            kind = schema.name if schema else ""
            if channel.topic not in connections:
                connections[channel.topic] = (
                    bag.add_connection(channel.topic, kind, typestore=old),
                    database.add_connection(channel.topic, kind, typestore=store),
                )
            one, other = connections[channel.topic]
            bag.write(one, message.log_time, store.cdr_to_ros1(message.data, kind))
            database.write(other, message.log_time, message.data)
    (file,) = (folder / "run").glob("*.db3")
    return {"rosbag2 SQLite file": file, "ROS 1 bag, lz4": folder / "run.bag"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, default=935.0, help="length of the generated drive")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--keep", type=Path, help="keep the files there, or use what is there")


def run(given: argparse.Namespace) -> int:
    """Write the files, read each, print the table."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.keep or Path(temporary)
        log = folder / "drive_0.mcap"
        if not log.exists():
            write_log(log, given.seconds)
        files = {"MCAP, zstd": log, **convert(log, Path(temporary))}
        print(f"{'file':24s} {'GB':>6s} {'wall s':>8s} {'CPU s':>8s} {'peak MB':>8s}")
        checks = []
        for name, path in files.items():
            row = measure(READER, path, given.repeat)
            size = path.stat().st_size / 1e9
            times = " ".join(f"{number(row, key):8.2f}" for key in ("wall_s", "cpu_s"))
            print(f"{name:24s} {size:6.2f} {times} {number(row, 'peak_mb'):8.0f}")
            checks.append(row["checks"])
    return int(any(each != checks[0] for each in checks))
