"""An object that is overwritten while it is read: one version or none, never both."""

from pathlib import Path

import numpy as np
import pytest
from batch_tools import batch, counts

pytest.importorskip("s3fs", reason="the extra s3 is not installed")
pytest.importorskip("moto", reason="moto is not installed")

from collections.abc import Callable

import fsspec
import s3fs
from object_store import BUCKET, upload
from store_samples import read_current

from pipeline.logs import LogError, RemotePath, Wanted, open_log, read_topics
from pipeline.logs.remote import RemoteSource
from pipeline.logs.writer import LogWriter
from pipeline.store import Store

ADDRESS = f"{BUCKET}/log.mcap"
ROWS = 600
STRETCHES = 4


def write_log(path: Path, value: float) -> Path:
    """A log of several ranges whose every number is the value; any two have the same layout."""
    with LogWriter(path, chunk_size=1 << 14, compression="") as log:
        for stretch in range(STRETCHES):
            stamps = np.arange(ROWS, dtype=np.int64) * 10**6 + (10**18 + stretch * 10**11)
            log.write_columns("/number", "std_msgs/msg/Float64", stamps, {"data": np.full(ROWS, value)})
            texts = ["x" * (1 << 15)] * 3
            log.write_columns("/text", "std_msgs/msg/String", stamps[-3:] + 10**9, {"data": texts})
    return path


@pytest.fixture
def versions(tmp_path: Path) -> tuple[bytes, bytes]:
    old, new = (write_log(tmp_path / f"{value}.mcap", value).read_bytes() for value in (1.0, 2.0))
    assert len(old) == len(new)
    return old, new


def read_numbers(path: object) -> set[float]:
    data = read_topics(path, [Wanted("/number")], threads=1)  # type: ignore[arg-type]
    assert not data.losses
    column = data.topics[0].fields["data"]
    assert len(column) == ROWS * STRETCHES
    return set(np.asarray(column).tolist())


def act_before_range(monkeypatch: pytest.MonkeyPatch, number: int, act: Callable[[], None]) -> list[int]:
    """Do something right before the range of that number is fetched; the ranges so far."""
    original = RemoteSource._fetch
    fetched: list[int] = []

    def fetch(source: RemoteSource, start: int, end: int) -> bytes:
        if len(fetched) == number:
            act()
        fetched.append(end - start)
        return original(source, start, end)

    monkeypatch.setattr(RemoteSource, "_fetch", fetch)
    return fetched


def test_no_two_versions_are_ever_mixed(
    bucket: fsspec.AbstractFileSystem, versions: tuple[bytes, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    old, new = versions
    upload(bucket, {"log.mcap": old})
    with monkeypatch.context() as patch:
        seen: list[int] = act_before_range(patch, -1, lambda: None)
        assert read_numbers(ADDRESS) == {1.0}
        ranges = len(seen)
    assert ranges >= STRETCHES + 3
    for number in range(ranges):
        upload(bucket, {"log.mcap": old})
        RemotePath(ADDRESS).refresh()
        with monkeypatch.context() as patch:
            act_before_range(patch, number, lambda: upload(bucket, {"log.mcap": new}))
            with pytest.raises(LogError) as caught:
                read_numbers(ADDRESS)
        assert caught.value.code == "log_changed"
        assert read_numbers(ADDRESS) == {2.0}


def test_what_was_opened_is_what_is_read(
    bucket: fsspec.AbstractFileSystem, versions: tuple[bytes, bytes]
) -> None:
    upload(bucket, {"log.mcap": versions[0]})
    index = open_log(ADDRESS)
    upload(bucket, {"log.mcap": versions[1]})
    with pytest.raises(LogError) as caught:
        read_numbers(index)
    assert caught.value.code == "log_changed"
    assert read_numbers(open_log(ADDRESS)) == {2.0}


def test_stores_without_tags_are_told_apart_by_their_times(versions: tuple[bytes, bytes]) -> None:
    import fsspec  # noqa: PLC0415 - only here without a bucket

    store = fsspec.filesystem("memory")
    store.pipe_file("/field/log.mcap", versions[0])
    assert read_numbers("memory://field/log.mcap") == {1.0}
    index = open_log("memory://field/log.mcap")
    store.pipe_file("/field/log.mcap", versions[1])
    with pytest.raises(LogError) as caught:
        read_numbers(index)
    assert caught.value.code == "log_changed"
    store.rm("/field", recursive=True)


def test_a_batch_reads_an_overwritten_object_again(
    bucket: fsspec.AbstractFileSystem, season: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    upload(bucket, {"logs/x.mcap": season / "a.mcap"})
    act_before_range(monkeypatch, 2, lambda: upload(bucket, {"logs/x.mcap": season / "b.mcap"}))
    assert counts(batch(f"{BUCKET}/logs", tmp_path / "out")) == {"done": 1}
    (season / "logs").mkdir()
    (season / "b.mcap").rename(season / "logs" / "x.mcap")
    batch(season / "logs", tmp_path / "here")
    one, other = (read_current(Store(tmp_path / name), "logs/x", "slip") for name in ("out", "here"))
    assert one.equals(other)


def test_the_fetched_bytes_are_those_that_came(
    bucket: fsspec.AbstractFileSystem, versions: tuple[bytes, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    upload(bucket, {"log.mcap": versions[0]})
    original = s3fs.S3FileSystem._call_s3
    came: list[int] = []

    async def call(self: s3fs.S3FileSystem, method: str, *given: object, **options: object) -> object:
        reply = await original(self, method, *given, **options)
        if method == "get_object":
            came.append(reply["ContentLength"])
        return reply

    monkeypatch.setattr(s3fs.S3FileSystem, "_call_s3", call)
    data = read_topics(ADDRESS, [Wanted("/number")])
    assert 0 < data.fetched_bytes == sum(came)
