"""A bag is analyzed as the MCAP of the same recording is."""

import json
from pathlib import Path

import polars as pl
import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from pipeline.analysis import Options
from pipeline.analysis.analyze import Outcome, analyze_log
from pipeline.batch.recordings import find_recordings
from pipeline.simulate import simulate_case


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A log of a drive, and a folder of rosbag2 with the same messages in SQLite."""
    folder = tmp_path_factory.mktemp("field")
    log = simulate_case("husky_tile", out=folder / "mcap" / "run.mcap", duration_s=30.0)
    return log, write_bag(log, folder / "bag" / "run", CompressionMode.NONE)


def write_bag(log: Path, folder: Path, mode: CompressionMode) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    folder.parent.mkdir(exist_ok=True)
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer, log.open("rb") as stream:
        connections = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            if channel.id not in connections:
                connections[channel.id] = writer.add_connection(channel.topic, schema.name, typestore=store)
            writer.write(connections[channel.id], message.log_time, message.data)
    return folder


def analyze(log: Path, out: Path, *, max_inflated: int | None = None) -> Outcome:
    chosen = {"vehicle": {"preset": "husky_a200"}, "run": {"terrain": "tile"}}
    return analyze_log(log, Options(out=out, overrides=chosen, report=False, max_inflated=max_inflated))


def test_a_bag_gives_the_tables_and_findings_of_the_mcap(logs: tuple[Path, Path], tmp_path: Path) -> None:
    log, bag = (analyze(path, tmp_path / path.parent.name) for path in logs)
    for name in ("commands", "wheels", "poses", "imu", "velocities", "slip", "findings"):
        one, other = (each.manifest.read(name).drop("run", strict=False) for each in (log, bag))
        if name == "findings":
            extra = set(other["id"]) - set(one["id"])
            assert extra == {"log_note", "log_unchecked"}
            other = other.filter(~pl.col("id").is_in(list(extra)))
        assert one.equals(other), name
    versions = bag.summary["provenance"]["versions"]
    assert "rosbags" in versions
    assert "mcap" not in versions
    assert "no checksum" in json.dumps(bag.summary)


def test_a_bag_that_may_inflate_further_is_read_again(logs: tuple[Path, Path], tmp_path: Path) -> None:
    bag = write_bag(logs[0], tmp_path / "bags" / "run", CompressionMode.MESSAGE)
    some, more, again = (
        analyze(bag, tmp_path / "out", max_inflated=most) for most in (500_000, 500_000_000, 500_000_000)
    )
    assert some.manifest.tables["poses"].rows < more.manifest.tables["poses"].rows
    assert more.computed
    assert not again.computed


def test_a_batch_finds_bags(logs: tuple[Path, Path]) -> None:
    top = logs[1].parents[1]
    (top / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
    found = find_recordings([str(top)], settle_s=0.0)
    assert found.recordings == tuple(sorted([*logs, top / "old.bag"]))
    assert find_recordings([str(top)], settle_s=3600.0).growing == (top / "old.bag",)
