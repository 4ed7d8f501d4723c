"""Logs and results on an object store: a local S3 server stands in for it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from batch_tools import batch, counts, read_tables

pytest.importorskip("s3fs", reason="the extra s3 is not installed")
pytest.importorskip("moto", reason="moto is not installed")

import fsspec
from moto.server import ThreadedMotoServer

from pipeline.batch.recordings import find_recordings
from pipeline.logs import LogError, RemotePath, Wanted, hash_log, open_log, read_topics, to_location
from pipeline.simulate import simulate_case
from pipeline.store import Store

if TYPE_CHECKING:
    from collections.abc import Iterator

BUCKET = "s3://field"


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    place = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    place.start()
    host, port = place.get_host_and_port()
    yield f"http://{host}:{port}"
    place.stop()


@pytest.fixture
def bucket(server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[fsspec.AbstractFileSystem]:
    """An empty bucket; whoever uses `s3://` in this test, or in a process it starts, gets to it."""
    for name, value in {
        "AWS_ENDPOINT_URL": server,
        "AWS_ACCESS_KEY_ID": "a",
        "AWS_SECRET_ACCESS_KEY": "b",  # noqa: S105 - of a server that lives for a test
        "AWS_DEFAULT_REGION": "us-east-1",
    }.items():
        monkeypatch.setenv(name, value.replace("b", "b"))
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    store = fsspec.filesystem("s3", listings_expiry_time=60)
    store.mkdir(BUCKET)
    yield store
    store.rm(BUCKET, recursive=True)
    fsspec.get_filesystem_class("s3").clear_instance_cache()


def upload(store: fsspec.AbstractFileSystem, files: dict[str, Path | bytes]) -> None:
    for key, content in files.items():
        store.pipe_file(f"{BUCKET}/{key}", content if isinstance(content, bytes) else content.read_bytes())
    store.invalidate_cache()


def test_a_log_is_read_as_if_it_were_here(bucket: fsspec.AbstractFileSystem, season: Path) -> None:
    upload(bucket, {"logs/a.mcap": season / "a.mcap"})
    here, there = open_log(season / "a.mcap"), open_log(f"{BUCKET}/logs/a.mcap")
    assert there.channels == here.channels
    assert str(there.path) == f"{BUCKET}/logs/a.mcap"
    topic = here.channels[0].topic
    wanted = [Wanted(topic)]
    one, other = read_topics(here, wanted), read_topics(there, wanted)
    assert (one.topics[0].log_time == other.topics[0].log_time).all()
    assert one.fetched_bytes == 0
    assert 0 < other.fetched_bytes <= here.size_bytes * 2
    assert other.sha256 == hash_log(there.path)
    assert other.sha256 != one.sha256


def test_only_the_chunks_that_matter_are_fetched(bucket: fsspec.AbstractFileSystem, tmp_path: Path) -> None:
    from pipeline.logs import LogWriter

    path = tmp_path / "cameras.mcap"
    import numpy as np

    stamps = np.arange(1000, dtype=np.int64) * 10**7 + 10**18
    with LogWriter(path, chunk_size=1 << 16) as log:
        log.write_columns("/odom", "nav_msgs/msg/Odometry", stamps, {}, header_time=stamps)
        noise = np.random.default_rng(0).bytes(3_000_000)
        log.write_columns("/text", "std_msgs/msg/String", stamps[:30], {"data": [noise.hex()] * 30})
    upload(bucket, {"cameras.mcap": path})
    data = read_topics(f"{BUCKET}/cameras.mcap", [Wanted("/odom")])
    assert len(data.topics[0]) == 1000
    assert data.fetched_bytes < path.stat().st_size / 20


def test_a_season_in_a_bucket(bucket: fsspec.AbstractFileSystem, season: Path, tmp_path: Path) -> None:
    upload(
        bucket,
        {
            "2026/logs/a.mcap": season / "a.mcap",
            "2026/logs/b.mcap": season / "b.mcap",
            "2026/split/split_0.mcap": season / "c.mcap",
            "2026/split/split_1.mcap": season / "c.mcap",
            "2026/fleet.toml": b'[run]\nterrain = "field"\n',
            "2026/logs/b.toml": b'[run]\nterrain = "lake"\n',
            "2026/notes.txt": b"x",
        },
    )
    found = find_recordings([f"{BUCKET}/2026"], settle_s=0.0)
    assert [str(path) for path in found.recordings] == [
        f"{BUCKET}/2026/logs/a.mcap",
        f"{BUCKET}/2026/logs/b.mcap",
        f"{BUCKET}/2026/split",
    ]
    assert len(find_recordings([f"{BUCKET}/2026/*/[ab].mcap"], settle_s=0.0).recordings) == 2
    out = tmp_path / "out"
    first = batch(f"{BUCKET}/2026", out, executor="local")
    assert counts(first)["done"] == 3
    assert all(line.fetched_bytes > 0 for line in first.lines)
    runs = Store(out).scan("runs").select("run", "terrain", "log").collect()
    assert runs.rows() == [
        ("2026/split", "field", f"{BUCKET}/2026/split"),
        ("logs/a", "field", f"{BUCKET}/2026/logs/a.mcap"),
        ("logs/b", "lake", f"{BUCKET}/2026/logs/b.mcap"),
    ]
    assert counts(batch(f"{BUCKET}/2026", out)) == {"unchanged": 3}
    upload(bucket, {"2026/logs/a.mcap": season / "d.mcap"})
    again = batch(f"{BUCKET}/2026", out)
    assert counts(again) == {"done": 1, "unchanged": 2}


def test_what_is_not_there_is_said(bucket: fsspec.AbstractFileSystem) -> None:
    upload(bucket, {"x": b"y"})
    with pytest.raises(LogError, match="no such object"):
        open_log(f"{BUCKET}/nowhere.mcap")
    with pytest.raises(LogError, match="no such kind of store"):
        open_log("nothing://x/y.mcap")


def test_addresses_survive_what_happens_to_paths() -> None:
    import pickle

    path = RemotePath("s3://bucket/folder/run.mcap")
    assert str(path) == os.fspath(path) == path.as_posix() == "s3://bucket/folder/run.mcap"
    assert str(path.parent / "x") == "s3://bucket/folder/x"
    assert to_location(Path("s3://bucket/folder/run.mcap")) == path
    assert pickle.loads(pickle.dumps(path)) == path  # noqa: S301 - our own
    assert (path.name, path.stem, path.parent.name) == ("run.mcap", "run", "folder")
    assert not isinstance(to_location("/tmp/x"), RemotePath)
