"""A writer that is killed or refused leaves the old results or the new ones, whole; writers take turns."""

import errno
import fcntl
import multiprocessing
import os
import random
import re
import resource
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.context import ForkServerContext
from pathlib import Path

import pytest
from disks import mount_disk, remount
from faults import DISK, MEMORY, Fault, arm, draw_faults
from few import few
from store_samples import make_slip, read_seed, write_generation
from store_writer import StartWriter
from verbs import run_slip

from pipeline.core import SlipError
from pipeline.store import Store, StoreError, hold_lock

RUN = "2026/husky"
OLD, NEW = 1, 2


def assert_tidy(store: Store) -> None:
    manifest = store.manifest(RUN)
    assert manifest is not None
    names = {path.name for path in manifest.home.iterdir()}
    assert names >= {manifest.folder.name, "manifest.json", "latest", ".lock"}
    assert all(int(name.partition("-")[2]) <= manifest.number for name in names if name[:11] == "generation-")
    assert not list(store.root.rglob(".tmp-*"))
    assert (manifest.home / "latest").resolve() == manifest.folder


def kill_at(store: Store, start_writer: StartWriter, call: int) -> bool:
    """Whether a writer was killed at that call of the system, the run being whole, and finished later."""
    write_generation(store, RUN, "old", OLD)
    writer = start_writer("die", store.root, RUN, "new", NEW, call)
    is_killed = writer.wait(30) == -signal.SIGKILL
    assert read_seed(store, RUN) in ((OLD, NEW) if is_killed else (NEW,))
    assert store.examine().problems == ()
    write_generation(store, RUN, "new", NEW)
    assert read_seed(store, RUN) == NEW
    assert_tidy(store)
    return is_killed


@pytest.mark.parametrize("call", few(range(1, 22), 5))
def test_killed_at_a_call_of_the_system_the_run_is_whole_and_can_be_finished(
    store: Store, start_writer: StartWriter, call: int
) -> None:
    assert kill_at(store, start_writer, call) or call > 12


@pytest.mark.long
@pytest.mark.parametrize("rounds", [10, 200])
def test_killed_at_random_moments_the_run_is_whole(
    store: Store, start_writer: StartWriter, rounds: int
) -> None:
    chance = random.Random(rounds)  # noqa: S311 - moments, not secrets
    begun = 0
    for _ in range(rounds):
        writer = start_writer("loop", store.root, RUN, begun, 10_000)
        told = [int(writer.stdout.readline()) for _ in range(chance.randint(1, 3))]
        time.sleep(chance.uniform(0.0, 0.03))
        writer.kill()
        told += [int(line) for line in writer.stdout.read().split()]
        assert writer.wait(30) == -signal.SIGKILL
        seed_now = read_seed(store, RUN)
        assert seed_now in (told[-1], told[-1] + 1)
        assert told == list(range(begun, told[-1] + 1))
        assert store.examine().problems == ()
        begun = seed_now + 1
    write_generation(store, RUN, "last", begun)
    assert read_seed(store, RUN) == begun
    assert_tidy(store)


MOST = {MEMORY: 30_000, DISK: 100}
"""More allocations and calls than a generation, a table and a page over all runs take."""
WRITTEN, REFUSED = 0, 3


def write_everything(store: Store, key: str, seed: int) -> None:
    write_generation(store, RUN, key, seed)
    store.write_results_text("index.html", f"{seed}")
    store.prune(1)


def write_under(fault: Fault, root: Path, key: str, seed: int) -> None:
    """In a process of its own: the libraries may well die of what is done to them here."""
    # Panics of polars are long, and are not what is looked at here.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
    try:
        with arm(fault):
            write_everything(Store(root, patience_s=10.0), key, seed)
    except (SlipError, MemoryError):
        sys.exit(REFUSED)


@pytest.mark.parametrize("rounds", [15, pytest.param(500, marks=pytest.mark.long)])
def test_memory_and_disk_fail_at_any_moment(store: Store, rounds: int) -> None:
    server: ForkServerContext = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(["test_store_kills", "pipeline.store.parquet_tables"])
    write_everything(store, "first", 0)
    outcomes = []
    for seed, fault in enumerate(draw_faults(rounds, most=MOST, seed=rounds)):
        new = (f"key{seed % 3}", seed + 1)
        process = server.Process(target=write_under, args=(fault, store.root, *new), daemon=True)
        process.start()
        process.join(60.0)
        process.kill()
        process.join()
        found = read_seed(store, RUN)
        assert found in {seed, seed + 1}, fault
        assert store.examine().problems == (), fault
        assert (store.root / "index.html").read_text() in {f"{seed}", f"{seed + 1}"}
        if process.exitcode == WRITTEN:
            assert found == seed + 1
        outcomes.append(process.exitcode)
        # Whatever was left, the same again succeeds.
        write_everything(store, *new)
        assert read_seed(store, RUN) == seed + 1
    assert store.examine().problems == ()
    assert not list(store.root.rglob(".tmp-*"))
    assert outcomes.count(REFUSED) > rounds // 3, "faults were met"


@pytest.mark.parametrize(
    ("number", "code", "words"),
    [
        (errno.ENOSPC, "disk_full", "disk of the results is full"),
        (errno.EDQUOT, "quota_used_up", "quota"),
        (errno.EFBIG, "file_limit", "ulimit -f"),
        (errno.EROFS, "read_only", "read-only"),
        (errno.EACCES, "permission_denied", "--results"),
    ],
)
def test_refused_at_every_call_the_run_is_whole_and_one_line_says_what_to_do(
    store: Store, number: int, code: str, words: str
) -> None:
    write_generation(store, RUN, "old", OLD)
    refused = []
    for allowed in range(100):
        try:
            with arm(Fault(DISK, allowed, 0, number)):
                write_generation(store, RUN, "new", NEW)
        except StoreError as error:
            refused.append(error)
        assert read_seed(store, RUN) in (OLD, NEW)
        assert store.examine().problems == ()
    assert {error.code for error in refused} == {code}
    assert all(str(store.root) in error.where and words in str(error) for error in refused)
    assert not any("\n" in str(error) for error in refused)
    assert 10 < len(refused) < 100
    write_generation(store, RUN, "new", NEW)
    assert_tidy(store)


def test_errors_of_the_caller_stay_what_they_are(store: Store) -> None:
    with pytest.raises(FileNotFoundError), store.open_generation(RUN, "new"):
        raise FileNotFoundError(errno.ENOENT, "the log")


def test_a_disk_that_is_really_full_or_read_only(tmp_path: Path) -> None:
    with mount_disk(tmp_path / "disk", "512k") as place:
        store = Store(place / "results")
        write_generation(store, RUN, "old", OLD)
        with pytest.raises(StoreError) as caught, store.open_generation(RUN, "new") as generation:
            generation.write_table("slip", make_slip(RUN, NEW, rows=20_000))
        assert caught.value.code == "disk_full"
        assert read_seed(store, RUN) == OLD
        assert store.examine().problems == ()
        write_generation(store, RUN, "new", NEW)
        remount(place, "ro")
        with pytest.raises(StoreError) as caught:
            write_generation(store, RUN, "newer", NEW + 1)
        assert caught.value.code == "read_only"
        assert read_seed(store, RUN) == NEW
        assert store.query("SELECT count(*) AS n FROM slip")["n"].to_list() == [500]


def test_copies_where_links_are_impossible(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    first = write_generation(store, RUN, "old", OLD)

    def refuse(*_: object) -> None:
        raise OSError(errno.EXDEV, os.strerror(errno.EXDEV))

    monkeypatch.setattr(os, "link", refuse)
    with store.open_generation(RUN, "new") as generation:
        generation.reuse_table("slip")
        second = generation.commit({})
    assert second.path("slip").read_bytes() == first.path("slip").read_bytes()
    assert second.path("slip").stat().st_ino != first.path("slip").stat().st_ino


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs /proc to name what was synced")
def test_everything_is_on_the_disk_before_it_is_pointed_to(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[str, str]] = []
    sync, replace = os.fsync, os.replace

    def note_sync(descriptor: int) -> None:
        calls.append(("sync", Path(f"/proc/self/fd/{descriptor}").readlink().name))
        sync(descriptor)

    def note_replace(source: Path, target: Path) -> None:
        calls.append(("replace", Path(target).name))
        replace(source, target)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(os, "replace", note_replace)
    manifest = write_generation(store, RUN, "key", NEW)
    pointed = calls.index(("replace", "manifest.json"))
    synced = [name for kind, name in calls[:pointed] if kind == "sync"]
    wanted = {path.name for path in manifest.folder.iterdir()} | {manifest.folder.name, manifest.home.name}
    assert wanted <= set(synced)
    assert synced[-1].startswith(".tmp-")
    assert ("sync", manifest.home.name) in calls[pointed:]


def test_a_write_that_the_system_stopped_is_told_as_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = Path(__file__).parents[2] / "data_samples" / "husky_tile.mcap"
    words = ("analyze", log, "--no-diagnosis", "--results")
    assert run_slip(*words, tmp_path / "whole")[0] == 0
    # Python and Numba keep what they compile, and do not notice that it is cut.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in (1 << 10, 1 << 13, 60 << 10, 400 << 10):
        results = tmp_path / str(size)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, usual[1]))
        try:
            code, _, err = run_slip(*words, results)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, usual)
        last = err.strip().splitlines()[-1]
        assert code == 1, last
        assert "the file would exceed its limit on the size of files" in last
        assert not list(results.rglob("manifest.json"))
        assert not list(results.rglob(".tmp-*"))


def test_writers_of_one_run_take_turns_and_readers_see_whole_runs(
    store: Store, start_writer: StartWriter
) -> None:
    writers = [start_writer("loop", store.root, RUN, start, 15) for start in (1000, 2000)]
    seen = set()
    while any(writer.poll() is None for writer in writers):
        try:
            seen.add(read_seed(store, RUN))
        except (StoreError, FileNotFoundError) as error:
            # The writers prune: a generation may go between the manifest and its files, but never change.
            assert getattr(error, "code", "file_missing") == "file_missing"  # noqa: PT017 - often there is none
        assert store.examine().problems == ()
    assert [writer.wait() for writer in writers] == [0, 0]
    assert read_seed(store, RUN) in (1014, 2014)
    assert len(seen - {None}) > 1


def test_writers_of_different_runs_do_not_wait(store: Store) -> None:
    jobs = [(f"folder/run{number % 4}", f"key{number}", number) for number in range(24)]
    with store.open_generation("one", "k"), ThreadPoolExecutor(6) as pool:
        list(pool.map(lambda job: write_generation(store, *job), jobs))
    assert store.runs() == tuple(f"folder/run{number}" for number in range(4))
    assert [manifest.number for manifest in store.manifests()] == [6] * 4


@pytest.mark.parametrize("kind", ["hold", "hold_with_child"])
def test_waiting_ends_with_the_name_of_the_holder_and_death_releases(
    store: Store, start_writer: StartWriter, kind: str
) -> None:
    holder = start_writer(kind, store.root, RUN)
    child = int(holder.stdout.readline())
    hasty = Store(store.root, patience_s=0.1)
    try:
        with pytest.raises(StoreError, match=f"process {holder.pid} on") as caught:
            write_generation(hasty, RUN, "new", 1)
        assert caught.value.code == "locked"
        (told,) = store.list_writers().items()
        assert told[0] == RUN
        assert re.fullmatch(rf"process {holder.pid} on \S+ \(since 20[\d: -]+\)", told[1])
        holder.kill()
        holder.wait()
        # What the dead one noted is still there, and nobody is told that it writes.
        assert (store.root / "runs" / RUN / ".lock").read_bytes()
        assert store.list_writers() == {}
        # A child that outlives a killed writer does not keep its lock.
        write_generation(hasty, RUN, "new", 1)
        manifest = store.manifest(RUN)
        assert store.find_writer(manifest) == ""
        with hold_lock(manifest.home / ".lock", patience_s=0.0):
            assert [store.find_writer(manifest)] == [*store.list_writers().values()]
    finally:
        if child:
            os.kill(child, signal.SIGKILL)
    assert read_seed(store, RUN) == 1
    assert_tidy(store)


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
    # It says who holds it, and nothing when nobody does: folders of equal runs are equal.
    assert path.read_bytes() == b""
