"""Remembered hashes: an unchanged log is not hashed again, a changed one always is."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.store import LogIdentities, Store, see_log

OLD_NS = 1_700_000_000_000_000_000


@pytest.fixture
def identities(store: Store) -> LogIdentities:
    return LogIdentities(store)


def remember(identities: LogIdentities, path: Path, sha256: str = "aa") -> str | None:
    """What is known of a log after it was read."""
    identities.remember(path, sha256, seen=see_log(path))
    return identities.lookup(path)


def write(path: Path, content: bytes, at_ns: int = OLD_NS) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    os.utime(path, ns=(at_ns, at_ns))
    return path


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write(tmp_path / "run é 1.mcap", b"before")


@pytest.fixture
def split(tmp_path: Path) -> Path:
    """A recording in two parts."""
    write(tmp_path / "split" / "split_0.mcap", b"first", OLD_NS)
    folder = write(tmp_path / "split" / "split_1.mcap", b"first", OLD_NS + 10**9).parent
    os.utime(folder, ns=(OLD_NS, OLD_NS))
    return folder


def test_unchanged_log_is_known(identities: LogIdentities, log: Path, split: Path, store: Store) -> None:
    assert identities.lookup(log) is None
    assert not store.root.exists()
    for path in (log, split):
        assert remember(identities, path) == "aa"
    assert LogIdentities(store).lookup(log.parent / ".." / log.parent.name / log.name) == "aa"
    assert remember(identities, log, "bb") == "bb"


def change_inode(log: Path) -> None:
    write(log.with_suffix(".new"), b"afters").replace(log)


def turn_link(log: Path) -> None:
    """Another log of the same size and time, to which a link of this name leads."""
    log.unlink()
    log.symlink_to(write(log.with_suffix(".other"), b"before"))


CHANGES: dict[str, Callable[[Path], object]] = {
    "size": lambda log: write(log, b"longer than before"),
    "time": lambda log: os.utime(log, ns=(OLD_NS, OLD_NS + 1)),
    "inode": change_inode,
    "moved": lambda log: log.rename(log.with_suffix(".moved")),
    "link": turn_link,
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_changed_log_is_not_known(
    identities: LogIdentities, log: Path, change: Callable[[Path], object]
) -> None:
    seen = see_log(log)
    assert remember(identities, log) == "aa"
    change(log)
    assert identities.lookup(log) is None
    # Nor is it remembered where it changed while it was read.
    identities.remember(log, "aa", seen=seen)
    assert identities.lookup(log) is None


def test_log_that_was_just_written_is_not_remembered(identities: LogIdentities, log: Path) -> None:
    seen = see_log(log)
    identities.remember(log, "aa", seen=replace(seen, seen_ns=seen.mtime_ns + 1_000_000))
    assert identities.lookup(log) is None


@pytest.mark.parametrize(("content", "at_ns"), [(b"more of it", OLD_NS), (b"other", OLD_NS - 10**9)])
def test_a_part_of_a_split_recording_that_changed_is_noticed(
    identities: LogIdentities, split: Path, content: bytes, at_ns: int
) -> None:
    """In place; the second also of the same size and older: the folder and the latest time stay the same."""
    assert remember(identities, split) == "aa"
    write(split / "split_0.mcap", content, at_ns)
    assert identities.lookup(split) is None


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b'{"sha256": "bb"}', b"\xff", b'{"path": '])
def test_damaged_entry_costs_a_hash(
    identities: LogIdentities, log: Path, store: Store, content: bytes
) -> None:
    remember(identities, log)
    (entry,) = (store.root / "identities").rglob("*.json")
    entry.write_bytes(content)
    assert identities.lookup(log) is None
    assert remember(identities, log) == "aa"


def test_failing_to_remember_is_no_error(identities: LogIdentities, log: Path, store: Store) -> None:
    store.root.write_text("a file where the folder should be")
    assert remember(identities, log) is None


def test_many_writers_at_once(identities: LogIdentities, tmp_path: Path, store: Store) -> None:
    logs = [write(tmp_path / f"{number}.mcap", b"") for number in range(40)]

    def remember_and_look(number: int) -> bool:
        path = logs[number % 40]
        return remember(identities, path, path.stem) == path.stem

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(remember_and_look, range(400)))
    assert not list(store.root.rglob(".tmp-*"))
