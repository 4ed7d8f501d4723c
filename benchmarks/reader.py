"""How fast topics are read out of a large log, against other readers and the bound, in one table.

Writes a log of about 1.2 GB (zstd, chunk checksums) with 420 000 small messages among images, then lets every
reader read the same eight topics, each in a process of its own. The bound reads every chunk, inflates it and
(with checksum) verifies it, nothing else. Exit code 1 when values differ.
"""

import argparse
import json
import os
import resource
import subprocess
import tempfile
import time
import zlib
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from measuring import RUNNER

Checks = dict[str, float]


def topics() -> list[str]:
    """The topics that every reader reads."""
    from reader_log import SMALL  # noqa: PLC0415 - a reader's process imports nothing of the others

    return [topic for topic, _, _ in SMALL]


def read_with_ours(path: Path, threads: int, sha256: str | None = "known") -> Checks:
    """Columns of every field."""
    from pipeline.logs import Wanted, open_log, read_topics  # noqa: PLC0415 - see topics

    data = read_topics(open_log(path), [Wanted(topic) for topic in topics()], threads=threads, sha256=sha256)
    odometry, joints, imu = data.of("/odom")[0], data.of("/joint_states")[0], data.of("/imu/data")[0]
    return {
        "messages": sum(len(columns) for columns in data.topics),
        "odometry": float(odometry.fields["pose.pose.position.x"].sum()),
        "joints": float(joints.fields["velocity"].values.sum()),
        "imu": float(imu.fields["angular_velocity.z"].sum()),
        "losses": len(data.losses),
    }


def read_with_official(path: Path) -> Checks:
    """The decoded messages of mcap + mcap-ros2-support."""
    from mcap.reader import make_reader  # noqa: PLC0415 - see topics
    from mcap_ros2.decoder import DecoderFactory  # noqa: PLC0415 - see topics

    found: Checks = {"messages": 0, "odometry": 0.0, "joints": 0.0, "imu": 0.0, "losses": 0}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(topics=topics()):
            add_message(found, channel.topic, message)
    return found


def read_with_rosbags(path: Path) -> Checks:
    """The decoded messages of rosbags."""
    from rosbags.highlevel import AnyReader  # noqa: PLC0415 - see topics
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - see topics

    found: Checks = {"messages": 0, "odometry": 0.0, "joints": 0.0, "imu": 0.0, "losses": 0}
    with AnyReader([path.parent], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        wanted = [each for each in reader.connections if each.topic in topics()]
        for connection, _, raw in reader.messages(connections=wanted):
            add_message(found, connection.topic, reader.deserialize(raw, connection.msgtype))
    return found


def add_message(found: Checks, topic: str, message: object) -> None:
    """Add one decoded message to the sums that are compared."""
    found["messages"] += 1
    if topic == "/odom":
        found["odometry"] += message.pose.pose.position.x  # type: ignore[attr-defined]
    elif topic == "/joint_states":
        found["joints"] += sum(message.velocity)  # type: ignore[attr-defined]
    elif topic == "/imu/data":
        found["imu"] += message.angular_velocity.z  # type: ignore[attr-defined]


def read_bound(path: Path, *, crc: bool) -> Checks:
    """Read and inflate every chunk, on one thread."""
    import zstandard  # noqa: PLC0415 - see topics
    from mcap.reader import make_reader  # noqa: PLC0415 - see topics

    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        if summary is None:
            raise SystemExit("the log has no summary")
        inflater = zstandard.ZstdDecompressor()
        for chunk in summary.chunk_indexes:
            start = chunk.chunk_start_offset + chunk.chunk_length - chunk.compressed_size
            stored = os.pread(stream.fileno(), chunk.compressed_size, start)
            records = inflater.decompress(stored, max_output_size=chunk.uncompressed_size)
            if crc:
                zlib.crc32(records)
    return {}


READERS: dict[str, Callable[[Path], Checks]] = {
    "ours, 2 threads": lambda path: read_with_ours(path, 2),
    "ours, 1 thread": lambda path: read_with_ours(path, 1),
    "ours, 2 threads, SHA-256 beside": lambda path: read_with_ours(path, 2, None),
    "bound: read + inflate + CRC": lambda path: read_bound(path, crc=True),
    "bound: read + inflate": lambda path: read_bound(path, crc=False),
    "rosbags": read_with_rosbags,
    "mcap + mcap-ros2-support": read_with_official,
}


MODULES = {
    "ours": ("pipeline.logs", "reader_log"),
    "bound": ("mcap.reader", "zstandard", "reader_log"),
    "rosbags": ("rosbags.highlevel", "rosbags.typesys", "reader_log"),
    "mcap + mcap-ros2-support": ("mcap.reader", "mcap_ros2.decoder", "reader_log"),
}
"""What each reader imports before the clock starts."""


def measure_here(name: str, path: Path) -> None:
    """Read once in this process; print wall and CPU [s], peak memory [MB] and the sums as JSON.

    Importing is not measured.
    """
    for module in MODULES[name.split(":", maxsplit=1)[0].split(",", maxsplit=1)[0]]:
        import_module(module)
    before = time.perf_counter(), time.process_time()
    checks = READERS[name](path)
    wall, cpu = time.perf_counter() - before[0], time.process_time() - before[1]
    peak = peak_memory_mb()
    print(json.dumps({"wall_s": wall, "cpu_s": cpu, "peak_mb": peak, "checks": checks}))


def peak_memory_mb() -> float:
    """Highest resident memory of this process; ``ru_maxrss`` would count the process that started it."""
    status = Path("/proc/self/status")
    if status.exists():
        (line,) = [line for line in status.read_text().splitlines() if line.startswith("VmHWM")]
        return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(name: str, path: Path, repeat: int) -> dict[str, object]:
    """Best wall and CPU of several processes, highest memory."""
    runs = []
    for _ in range(repeat):
        command = [*RUNNER, "reader", "--only", name, "--keep", str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            reason = done.stderr.strip().splitlines()[-1]
            return {"reader": name, "error": reason}
        runs.append(json.loads(done.stdout))
    return {
        "reader": name,
        "wall_s": min(run["wall_s"] for run in runs),
        "cpu_s": min(run["cpu_s"] for run in runs),
        "peak_mb": max(run["peak_mb"] for run in runs),
        "checks": runs[0]["checks"],
    }


def judge(rows: dict[str, dict[str, object]]) -> list[str]:
    """Values that differ between readers; prints how fast ours is."""
    two, one = rows["ours, 2 threads"], rows["ours, 1 thread"]
    bound, official = rows["bound: read + inflate + CRC"], rows["mcap + mcap-ros2-support"]
    broken = []
    speedup = number(official, "wall_s") / number(two, "wall_s")
    share = number(one, "cpu_s") / number(bound, "cpu_s")
    print(f"\nours on 2 threads is {speedup:.1f} times faster than mcap + mcap-ros2-support")
    print(f"ours on 1 thread takes {share:.2f} times the CPU of the bound")
    for row in rows.values():
        for key, value in (row.get("checks") or {}).items():  # type: ignore[attr-defined]
            expected = official["checks"][key]  # type: ignore[index]
            if abs(value - expected) > 1e-9 * max(1.0, abs(expected)):
                broken.append(f"{row['reader']}: {key} is {value}, not {expected}")
    return broken


def number(row: dict[str, object], key: str) -> float:
    """A measured number; an error message ends the run."""
    value = row.get(key)
    if not isinstance(value, float):
        raise SystemExit(f"{row['reader']}: {row.get('error')}")
    return value


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, default=935.0, help="length of the generated drive")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--keep", type=Path, help="write the log there, or use it when it is there")
    parser.add_argument("--json", type=Path, help="also write the table there")
    parser.add_argument("--only", choices=list(READERS), help=argparse.SUPPRESS)


def run(given: argparse.Namespace) -> int:
    """Generate the log, measure every reader, print the table."""
    if given.only:
        measure_here(given.only, given.keep)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        path = given.keep or Path(folder) / "drive_0.mcap"
        if not path.exists():
            from reader_log import write_log, write_metadata  # noqa: PLC0415 - see topics

            write_metadata(path, write_log(path, given.seconds))
        print(f"{path.stat().st_size / 1e9:.2f} GB, best of {given.repeat}\n")
        print(f"{'reader':34s} {'wall s':>8s} {'CPU s':>8s} {'peak MB':>8s}")
        rows: dict[str, dict[str, object]] = {}
        for name in READERS:
            peer = name.startswith(("mcap", "rosbags"))
            row = rows[name] = measure(name, path, 1 if peer else given.repeat)
            if "error" in row:
                print(f"{name:34s} {row['error']}")
            else:
                print(f"{name:34s} {row['wall_s']:8.2f} {row['cpu_s']:8.2f} {row['peak_mb']:8.0f}")
        broken = judge(rows)
    if given.json:
        given.json.write_text(json.dumps(list(rows.values()), indent=1) + "\n")
    for line in broken:
        print(f"differs: {line}")
    return 1 if broken else 0
