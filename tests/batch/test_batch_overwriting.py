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

from pipeline.logs import LogError, RemotePath, Wanted, open_log, read_topics
from pipeline.logs import remote as bucket_room
from pipeline.logs.remote import Info
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
    original = bucket_room.fetch_range
    fetched: list[int] = []

    def fetch(
        store: fsspec.AbstractFileSystem,
        url: str,
        start: int,
        end: int,
        *,
        known: Info,
        look: Callable[[], Info],
    ) -> bytes:
        if len(fetched) == number:
            act()
        fetched.append(end - start)
        return original(store, url, start, end, known=known, look=look)

    monkeypatch.setattr(bucket_room, "fetch_range", fetch)
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
            try:
                numbers = read_numbers(ADDRESS)
            except LogError as error:
                assert error.code == "log_changed"  # noqa: PT017 - either is as promised
            else:
                # Nothing had been read: what the store said before it is simply out of date.
                assert (number, numbers) == (0, {2.0})
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


def test_a_store_that_ignores_the_question_is_not_believed(
    bucket: fsspec.AbstractFileSystem, versions: tuple[bytes, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    upload(bucket, {"log.mcap": versions[0]})
    original = s3fs.S3FileSystem._call_s3

    async def call(self: s3fs.S3FileSystem, method: str, *given: object, **options: object) -> object:
        options.pop("IfMatch", None)
        return await original(self, method, *given, **options)

    monkeypatch.setattr(s3fs.S3FileSystem, "_call_s3", call)
    monkeypatch.setattr(s3fs.S3FileSystem, "call_s3", s3fs.core.sync_wrapper(call))
    assert read_numbers(ADDRESS) == {1.0}
    index = open_log(ADDRESS)
    upload(bucket, {"log.mcap": versions[1]})
    with pytest.raises(LogError) as caught:
        read_numbers(index)
    assert caught.value.code == "log_changed"


def test_stores_without_the_question_are_asked_afterwards(versions: tuple[bytes, bytes]) -> None:
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
    one, other = (Store(tmp_path / name).read("logs/x", "slip") for name in ("out", "here"))
    assert one.equals(other)


def test_the_fetched_bytes_are_those_that_came(
    bucket: fsspec.AbstractFileSystem, season: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    upload(bucket, {"logs/a.mcap": season / "a.mcap", "logs/fleet.toml": b'[run]\nterrain = "field"\n'})
    original = s3fs.S3FileSystem._call_s3
    came: list[int] = []

    async def call(self: s3fs.S3FileSystem, method: str, *given: object, **options: object) -> object:
        reply = await original(self, method, *given, **options)
        if method == "get_object" and options["Key"].endswith(".mcap"):  # type: ignore[attr-defined]
            came.append(reply["ContentLength"])
        return reply

    monkeypatch.setattr(s3fs.S3FileSystem, "_call_s3", call)
    monkeypatch.setattr(s3fs.S3FileSystem, "call_s3", s3fs.core.sync_wrapper(call))
    before = bucket_room.FETCHED.total
    outcome = batch(f"{BUCKET}/logs", tmp_path / "out")
    of_configuration = bucket_room.FETCHED.total - before - sum(came)
    assert 0 < sum(came) <= outcome.lines[0].fetched_bytes
    assert outcome.lines[0].fetched_bytes <= sum(came) + of_configuration
    # What is changed beside the log is computed from what is here: only its index is fetched, and counted.
    upload(bucket, {"logs/fleet.toml": b'[run]\nterrain = "meadow"\n'})
    came.clear()
    again = batch(f"{BUCKET}/logs", tmp_path / "out")
    assert counts(again) == {"done": 1}
    assert again.lines[0].fetched_bytes >= sum(came) > 0
