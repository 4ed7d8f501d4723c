"""Logs on an object store: a local S3 server stands in for it."""

import os
import pickle
from pathlib import Path

import pytest
from batch_tools import batch, counts
from verbs import run_slip

pytest.importorskip("s3fs", reason="the extra s3 is not installed")
pytest.importorskip("moto", reason="moto is not installed")

import fsspec
import numpy as np
from object_store import BUCKET, upload

from pipeline.batch.batch_check import verify_results
from pipeline.batch.recordings import find_recordings
from pipeline.logs import LogError, RemotePath, Wanted, hash_log, open_log, read_topics, to_location
from pipeline.logs.writer import LogWriter
from pipeline.store import Store


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
    path = tmp_path / "cameras.mcap"
    stamps = np.arange(1000, dtype=np.int64) * 10**7 + 10**18
    noise = np.random.default_rng(0)
    with LogWriter(path, chunk_size=1 << 16) as log:
        log.write_columns("/odom", "nav_msgs/msg/Odometry", stamps, {}, header_time=stamps)
        texts = [noise.bytes(50_000).hex() for _ in range(100)]
        log.write_columns("/text", "std_msgs/msg/String", stamps[-100:] + 10**10, {"data": texts})
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
            "2026/split/metadata.yaml": b"relative_file_paths:\n  - split_0.mcap\n  - split_1.mcap\n",
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
    # The addresses stand in the results by now: whoever verifies them says whether they are asked.
    asked = verify_results(Store(out), logs=True, notify=print, follow_remote=True)
    assert (asked.is_clean, asked.remote, asked.read_logs.looked_at) == (True, (), 3)
    upload(bucket, {"2026/logs/b.mcap": season / "d.mcap"})
    found = verify_results(Store(out), logs=True, notify=print)
    assert (found.is_clean, len(found.remote)) == (True, 3)
    RemotePath(f"{BUCKET}/2026/logs").refresh()
    found = verify_results(Store(out), logs=True, notify=print, follow_remote=True)
    assert [(problem.run, problem.code) for problem in found.logs] == [("logs/b", "log_changed")]


def test_what_is_not_there_is_said(bucket: fsspec.AbstractFileSystem) -> None:
    upload(bucket, {"x": b"y"})
    with pytest.raises(LogError, match="no such object"):
        open_log(f"{BUCKET}/nowhere.mcap")
    with pytest.raises(LogError, match="nothing:// addresses are not read"):
        open_log("nothing://x/y.mcap")


def test_addresses_survive_what_happens_to_paths() -> None:
    path = RemotePath("s3://bucket/folder/run.mcap")
    assert str(path) == os.fspath(path) == path.as_posix() == "s3://bucket/folder/run.mcap"
    assert str(path.parent / "x") == "s3://bucket/folder/x"
    assert to_location(Path("s3://bucket/folder/run.mcap")) == path
    assert pickle.loads(pickle.dumps(path)) == path  # noqa: S301 - our own
    assert (path.name, path.stem, path.parent.name) == ("run.mcap", "run", "folder")
    assert not isinstance(to_location("/data/x"), RemotePath)


def test_a_store_without_credentials_or_out_of_reach_is_said_in_one_line(
    bucket: fsspec.AbstractFileSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value, why in (
        ("AWS_ENDPOINT_URL", "http://127.0.0.1:9", "Could not connect"),
        ("AWS_ACCESS_KEY_ID", "", "credentials"),
    ):
        monkeypatch.setenv(name, value)
        monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
        type(bucket).clear_instance_cache()
        with pytest.raises(LogError, match=why) as caught:
            open_log(f"{BUCKET}/logs/a.mcap")
        assert caught.value.code == "log_unreachable"
        assert len(str(caught.value).splitlines()) == 1
        assert "AWS_ACCESS_KEY_ID" in caught.value.hint


@pytest.mark.parametrize(
    "verb",
    [
        ("analyze", "a.mcap", "--results"),
        ("batch", "logs", "--results"),
        ("results", "status", "--results"),
        ("results", "query", "SELECT 1", "--results"),
    ],
)
def test_results_are_kept_in_a_folder_and_copied_by_the_tool_of_the_store(
    verb: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, said = run_slip(*verb, f"{BUCKET}/results")
    assert code == 1
    assert "results are in a folder of this machine" in said
    assert "aws s3 sync" in said
    assert list(tmp_path.iterdir()) == []
