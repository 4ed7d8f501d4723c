"""A disk that refuses: one clear error, nothing half visible, and the same command works afterwards."""

import errno
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from store_samples import make_slip, read_seed, write_generation
from verbs import run_slip

from pipeline.store import Store, StoreError

RUN = "2026/husky"
OLD, NEW = 1, 2


class FailingDisk:
    """Lets the system calls of `os` fail from the ``allowed``-th on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, code: int, allowed: int) -> None:
        self.left = allowed
        self.code = code
        for name in ("fsync", "mkdir", "rename", "replace", "link"):
            monkeypatch.setattr(os, name, self.wrap(getattr(os, name)))

    def wrap(self, call):  # noqa: ANN001, ANN201 - any system call
        def failing(*arguments, **named):  # noqa: ANN002, ANN003, ANN202
            self.left -= 1
            if self.left < 0:
                raise OSError(self.code, os.strerror(self.code))
            return call(*arguments, **named)

        return failing


def catch_refusal(store: Store) -> StoreError | None:
    try:
        write_generation(store, RUN, "new", NEW)
    except StoreError as error:
        return error
    return None


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (errno.ENOSPC, "disk_full"),
        (errno.EDQUOT, "quota_used_up"),
        (errno.EFBIG, "file_limit"),
        (errno.EROFS, "read_only"),
        (errno.EACCES, "permission_denied"),
    ],
)
def test_refused_at_every_system_call_the_run_is_whole(
    store: Store, monkeypatch: pytest.MonkeyPatch, number: int, code: str
) -> None:
    write_generation(store, RUN, "old", OLD)
    refused = 0
    for allowed in range(100):
        with monkeypatch.context() as patch:
            FailingDisk(patch, number, allowed)
            error = catch_refusal(store)
        if error is None:
            break
        refused += 1
        assert error.code == code
        assert str(store.root) in error.where
        assert read_seed(store, RUN) in (OLD, NEW)
        assert store.examine().problems == ()
    assert refused > 10
    write_generation(store, RUN, "new", NEW)
    assert read_seed(store, RUN) == NEW
    assert not list(store.root.rglob(".tmp-*"))


def test_message_of_a_full_disk_says_what_where_and_what_to_do(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    FailingDisk(monkeypatch, errno.ENOSPC, 12)
    with pytest.raises(StoreError) as caught:
        write_generation(store, RUN, "new", NEW)
    message = str(caught.value)
    assert "\n" not in message
    assert "disk of the results is full" in message
    assert "--results" in message


def test_errors_of_the_caller_stay_what_they_are(store: Store) -> None:
    with pytest.raises(FileNotFoundError), store.open_generation(RUN, "new"):
        raise FileNotFoundError(errno.ENOENT, "the log")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 512 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=512k", "tmpfs", str(place)]
    try:
        mounted = subprocess.run(mount, capture_output=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount command")
    if mounted.returncode:
        pytest.skip("mounting a small disk is not allowed here")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def test_really_full_disk(small_disk: Path) -> None:
    store = Store(small_disk / "results")
    write_generation(store, RUN, "old", OLD)
    with pytest.raises(StoreError) as caught, store.open_generation(RUN, "new") as generation:
        generation.write_table("slip", make_slip(RUN, NEW, rows=20_000))
    assert caught.value.code == "disk_full"
    assert read_seed(store, RUN) == OLD
    assert store.examine().problems == ()
    write_generation(store, RUN, "new", NEW)
    assert read_seed(store, RUN) == NEW


def test_really_read_only_disk(small_disk: Path) -> None:
    store = Store(small_disk / "results")
    write_generation(store, RUN, "old", OLD)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with pytest.raises(StoreError) as caught:
        write_generation(store, RUN, "new", NEW)
    assert caught.value.code == "read_only"
    assert read_seed(store, RUN) == OLD
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
    sync, rename, replace = os.fsync, os.rename, os.replace

    def note_sync(descriptor: int) -> None:
        calls.append(("sync", Path(f"/proc/self/fd/{descriptor}").readlink().name))
        sync(descriptor)

    def note_rename(source: Path, target: Path) -> None:
        calls.append(("rename", Path(target).name))
        rename(source, target)

    def note_replace(source: Path, target: Path) -> None:
        calls.append(("replace", Path(target).name))
        replace(source, target)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(os, "rename", note_rename)
    monkeypatch.setattr(os, "replace", note_replace)
    manifest = write_generation(store, RUN, "key", NEW)

    published, pointed = calls.index(("rename", "key")), calls.index(("replace", "manifest.json"))
    synced = {name for kind, name in calls[:published] if kind == "sync"}
    assert {path.name for path in manifest.folder.iterdir()} <= synced
    assert any(name.startswith(".tmp-") for name in synced)
    home = manifest.folder.parent.name
    assert ("sync", home) in calls[published:pointed]
    assert ("sync", home) in calls[pointed:]
    assert calls[pointed - 1][0] == "sync"
    assert calls[pointed - 1][1].startswith(".tmp-")


def test_published_generation_stays_when_its_manifest_cannot_be_looked_at(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: Path) -> bytes:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with store.open_generation(RUN, "key") as generation:
        generation.write_text("summary.json", "whole")
        manifest = generation.commit({})
        monkeypatch.setattr(Path, "read_bytes", refuse)
    monkeypatch.undo()
    assert store.manifest(RUN) == manifest
    assert manifest.path("summary.json").read_text() == "whole"


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
        assert "ulimit -f" in last
        assert not list(results.rglob("manifest.json"))
        assert not list(results.rglob(".tmp-*"))


def test_a_file_that_is_too_large_to_read_is_told_as_that(store: Store) -> None:
    path = store.write_results_text("note.txt", "")
    with path.open("r+b") as file:
        file.truncate(40 << 20)
    with pytest.raises(StoreError, match="it has more than 32 MB") as caught:
        store.edit_results_text("note.txt", str.upper)
    assert caught.value.code == "too_large"
