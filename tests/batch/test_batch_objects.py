"""Logs and results on an object store: a local S3 server stands in for it."""

import os
import pickle
from pathlib import Path

import pytest
from batch_tools import batch, counts, read_tables
from verbs import run_slip

pytest.importorskip("s3fs", reason="the extra s3 is not installed")
pytest.importorskip("moto", reason="moto is not installed")

import fsspec
import numpy as np
from object_store import BUCKET, upload

from pipeline.batch import Pruning
from pipeline.batch.batch_check import verify_results
from pipeline.batch.recordings import find_recordings
from pipeline.logs import LogError, RemotePath, Wanted, hash_log, open_log, read_topics, to_location
from pipeline.logs.writer import LogWriter
from pipeline.store import Partition, Store, StoreError
from pipeline.store import mirror as mirror_room
from pipeline.store.mirror import Mirror


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


def list_published(store: fsspec.AbstractFileSystem, out: str) -> dict[str, bytes]:
    """Every table and text that people read, by its path in the results."""
    store.invalidate_cache()
    start = len(out.removeprefix("s3://")) + 1
    names = [
        name for name in store.find(out) if not name[start:].startswith("batch/") and "/." not in name[start:]
    ]
    return {name[start:]: store.cat_file(name) for name in names}


def test_results_in_a_bucket_are_those_of_a_folder(
    bucket: fsspec.AbstractFileSystem, season: Path, tmp_path: Path
) -> None:
    out = f"{BUCKET}/results"
    batch(season, tmp_path / "here")
    first = batch(season, tmp_path / "mirror", address=out, executor="local")
    assert counts(first) == {"done": 4}
    assert first.problems == ()
    published = list_published(bucket, out)
    assert published == read_tables(tmp_path / "here")

    # Another machine knows nothing but the bucket.
    assert counts(batch(season, tmp_path / "elsewhere", address=out)) == {"unchanged": 4}
    assert not list((tmp_path / "elsewhere").rglob("slip.parquet"))
    mirror = Mirror(out, tmp_path / "elsewhere")
    mirror.pull_index()
    ice = Partition(terrain="ice")
    mirror.pull_tables(["slip"], ice.select(mirror.store.manifests()))
    assert mirror.store.query("SELECT DISTINCT run FROM slip", ice)["run"].to_list() == ["season/d"]
    assert len(list((tmp_path / "elsewhere").rglob("slip.parquet"))) == 1
    assert verify_results(mirror.store, mirror=mirror, logs=False, notify=print).is_clean

    # A stage that changed reuses what another machine computed.
    (season / "a.toml").write_text("[slip]\nlength_scale_m = 2.0\n")
    again = batch(season, tmp_path / "elsewhere", address=out, pruning=Pruning(keep=0))
    assert counts(again) == {"done": 1, "unchanged": 3}
    assert again.removed == 1
    batch(season, tmp_path / "here", pruning=Pruning(keep=0))
    assert list_published(bucket, out) == read_tables(tmp_path / "here")

    damaged = next(name for name in bucket.find(out) if name.endswith("velocities.parquet"))
    bucket.pipe_file(damaged, b"x")
    gone = next(name for name in bucket.find(out) if name.endswith("season/d/manifest.json"))
    bucket.rm(gone)
    mirror.pull_index()
    found = verify_results(mirror.store, mirror=mirror, logs=False, notify=print, repair=True)
    assert [problem.code for problem in found.files] == ["file_damaged"]
    assert {repair.action for repair in found.repairs} == {"queued"}
    mended = batch(season, tmp_path / "elsewhere", address=out)
    assert counts(mended) == {"done": 2, "unchanged": 2}
    mirror.pull_index()
    found = verify_results(mirror.store, mirror=mirror, logs=False, notify=print)
    assert found.files == ()


class FailingStore:
    """Takes so many objects and then no more."""

    def __init__(self, objects: object, allowed: int) -> None:
        self.objects = objects
        self.left = allowed

    def __getattr__(self, name: str) -> object:
        return getattr(self.objects, name)

    def put(self, paths: list[str], addresses: list[str]) -> None:
        for path, address in zip(paths, addresses, strict=True):
            self.put_file(path, address)

    def put_file(self, path: str, address: str) -> None:
        self.pipe_file(address, Path(path).read_bytes())

    def pipe_file(self, address: str, value: bytes) -> None:
        self.left -= 1
        if self.left < 0:
            raise OSError("the network is gone")
        self.objects.pipe_file(address, value)  # type: ignore[attr-defined]


def test_a_run_is_published_whole_or_not_at_all(
    bucket: fsspec.AbstractFileSystem, season: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = f"{BUCKET}/results"
    log = season / "a.mcap"
    opened = mirror_room._open_objects
    for allowed in (0, 1, 5):
        with monkeypatch.context() as patch:
            patch.setattr(mirror_room, "_open_objects", lambda url, n=allowed: FailingStore(opened(url), n))
            outcome = batch(log, tmp_path / f"mirror{allowed}", address=out)
        assert outcome.has_failed
        assert outcome.lines[0].code in {"store_unreachable", ""}
        mirror = Mirror(out, tmp_path / "reader")
        mirror.pull_index()
        assert mirror.examine().problems == ()
    assert not batch(log, tmp_path / "last", address=out).has_failed
    batch(log, tmp_path / "here")
    assert list_published(bucket, out) == read_tables(tmp_path / "here")


def test_a_bucket_that_is_not_there_is_said(
    bucket: fsspec.AbstractFileSystem, season: Path, tmp_path: Path
) -> None:
    del bucket
    with pytest.raises(StoreError) as caught:
        Mirror("nothing://x/y", tmp_path)
    assert caught.value.code == "no_object_store"
    outcome = batch(season / "a.mcap", tmp_path / "mirror", address="s3://nowhere/results")
    assert outcome.lines[0].code == "store_unreachable"


def test_a_store_without_credentials_or_out_of_reach_is_said_in_one_line(
    bucket: fsspec.AbstractFileSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value, why in (
        ("AWS_ENDPOINT_URL", "http://127.0.0.1:9", "Could not connect"),
        ("AWS_ACCESS_KEY_ID", "", "credentials"),
    ):
        monkeypatch.setenv(name, value)
        monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
        type(bucket).clear_instance_cache()
        with pytest.raises(StoreError, match=why) as caught:
            Mirror(f"{BUCKET}/results", tmp_path).pull_index()
        assert caught.value.code == "store_unreachable"
        assert len(str(caught.value).splitlines()) == 1
        assert "AWS_ACCESS_KEY_ID" in caught.value.hint


def test_what_has_not_changed_is_not_fetched_again(bucket: fsspec.AbstractFileSystem, tmp_path: Path) -> None:
    upload(bucket, {"results/index.html": b"old", "results/map.html": b"old"})
    mirror = Mirror(f"{BUCKET}/results", tmp_path)
    mirror.pull_index()
    before = {path.name: path.stat().st_ino for path in tmp_path.iterdir()}
    upload(bucket, {"results/map.html": b"new"})
    mirror.pull_index()
    after = {path.name: path.stat().st_ino for path in tmp_path.iterdir()}
    assert {name for name in before if before[name] == after[name]} == {"index.html"}
    assert (tmp_path / "map.html").read_bytes() == b"new"


def test_a_bucket_of_a_stranger_writes_nothing_outside_of_its_mirror(
    bucket: fsspec.AbstractFileSystem,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    home = tmp_path / "home"
    home.mkdir()
    (home / ".bashrc").write_text("precious")
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / ".cache"))
    monkeypatch.setenv("HOME", str(home))
    # Of the mirror in ~/.cache/slip/results/<hash> everything above is within reach.
    upload(
        bucket,
        {
            "results/batch/logs/../../../../../../.bashrc": b"evil",
            "results/runs/../../../../../.config/manifest.json": b"evil",
        },
    )
    out = f"{BUCKET}/results"
    for arguments in (
        ("results", "status", out),
        ("results", "verify", out),
        ("results", "query", "SELECT 1", "--results", out),
    ):
        code, _, told = run_slip(*arguments)
        assert code == 1
        said = told.splitlines()
        assert len(said) == 1
        assert out in said[0]
    found = {path.relative_to(home).as_posix() for path in home.rglob("*") if path.is_file()}
    assert found == {".bashrc"}
    assert (home / ".bashrc").read_text() == "precious"
