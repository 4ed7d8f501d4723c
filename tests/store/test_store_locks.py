"""One writer a run at a time; different runs do not wait for each other; death releases."""

import errno
import fcntl
import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from store_samples import read_seed, write_generation
from store_writer import StartWriter

from pipeline.store import Store, StoreError
from pipeline.store.files import hold_lock

RUN = "husky"


def test_writers_of_one_run_take_turns(store: Store, start_writer: StartWriter) -> None:
    writers = [start_writer("loop", store.root, RUN, start, 15) for start in (1000, 2000)]
    seen = set()
    while any(writer.poll() is None for writer in writers):
        seen.add(read_seed_or_retry(store))
    assert [writer.wait() for writer in writers] == [0, 0]
    assert read_seed(store, RUN) in (1014, 2014)
    assert len(seen - {None}) > 1
    assert store.examine().problems == ()


def read_seed_or_retry(store: Store) -> int | None:
    try:
        return read_seed(store, RUN)
    except (StoreError, FileNotFoundError) as error:
        # The writers prune: a generation may go between the manifest and its files, but never change.
        if isinstance(error, StoreError) and error.code != "file_missing":
            raise
        return None


def test_writers_of_different_runs_do_not_wait(store: Store) -> None:
    with store.open_generation("one", "k"):
        begun = time.monotonic()
        write_generation(store, "two", "k", 1)
        assert time.monotonic() - begun < 5.0
    assert store.runs() == ("two",)


def test_many_writers_of_many_runs(store: Store) -> None:
    jobs = [(f"folder/run{number % 4}", f"key{number}", number) for number in range(24)]
    with ThreadPoolExecutor(6) as pool:
        list(pool.map(lambda job: write_generation(store, *job), jobs))
    assert store.runs() == tuple(f"folder/run{number}" for number in range(4))
    for run in store.runs():
        manifest = store.manifest(run)
        assert manifest is not None
        assert len(manifest.earlier) == 5
        read_seed(store, run)


def test_waiting_ends_with_the_name_of_the_holder_and_death_releases(
    store: Store, start_writer: StartWriter
) -> None:
    holder = start_writer("hold", store.root, RUN)
    assert holder.stdout.readline() == "ready\n"
    hasty = Store(store.root, patience_s=0.1)
    with pytest.raises(StoreError, match=f"process {holder.pid} on") as caught:
        write_generation(hasty, RUN, "new", 1)
    assert caught.value.code == "locked"

    holder.kill()
    holder.wait()
    write_generation(hasty, RUN, "new", 1)
    assert read_seed(store, RUN) == 1
    assert not list((store.root / "runs" / RUN).glob(".tmp-*"))


def test_a_child_that_outlives_a_killed_writer_does_not_keep_its_lock(
    store: Store, start_writer: StartWriter
) -> None:
    holder = start_writer("hold_with_child", store.root, RUN)
    child = int(holder.stdout.readline())
    try:
        holder.kill()
        holder.wait()
        write_generation(Store(store.root, patience_s=0.1), RUN, "new", 1)
        os.kill(child, 0)  # still there
    finally:
        os.kill(child, signal.SIGKILL)
    assert read_seed(store, RUN) == 1


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS], ids=errno.errorcode.get)
def test_a_file_system_without_locks_is_refused_in_one_line(
    code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(StoreError) as caught, hold_lock(tmp_path / "lock", patience_s=0.0):
        pytest.fail("two writers would write at once")
    assert caught.value.code == "no_locks"
    assert len(str(caught.value).splitlines()) == 1


def test_the_file_stays_and_a_thread_other_than_the_one_that_locked_may_let_go(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    held = hold_lock(path, patience_s=0.0)
    held.__enter__()
    with ThreadPoolExecutor(1) as pool:
        pool.submit(held.__exit__, None, None, None).result()
    inode = path.stat().st_ino
    with hold_lock(path, patience_s=0.0):
        assert path.stat().st_ino == inode
        assert f"process {os.getpid()} on" in path.read_text()
