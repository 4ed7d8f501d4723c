"""Remembered hashes: an unchanged log is not hashed again, a changed one always is."""

import dataclasses
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from pipeline.store import LogIdentities, Store, see_log

OLD_NS = 1_700_000_000_000_000_000


@pytest.fixture
def identities(store: Store) -> LogIdentities:
    return LogIdentities(store)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "run é 1.mcap"
    path.write_bytes(b"before")
    os.utime(path, ns=(OLD_NS, OLD_NS))
    return path


def test_unchanged_log_is_known(identities: LogIdentities, log: Path, store: Store) -> None:
    assert identities.lookup(log) is None
    assert not store.root.exists()
    assert identities.remember(log, "aa", seen=see_log(log))
    assert identities.lookup(log) == "aa"
    assert LogIdentities(store).lookup(log.parent / ".." / log.parent.name / log.name) == "aa"
    assert identities.remember(log, "bb")
    assert identities.lookup(log) == "bb"
    assert store.runs() == ()


def change_size(log: Path) -> None:
    log.write_bytes(b"longer than before")
    os.utime(log, ns=(OLD_NS, OLD_NS))


def change_time(log: Path) -> None:
    os.utime(log, ns=(OLD_NS, OLD_NS + 1))


def change_inode(log: Path) -> None:
    other = log.with_suffix(".new")
    other.write_bytes(b"afters")
    os.utime(other, ns=(OLD_NS, OLD_NS))
    other.replace(log)


def move_away(log: Path) -> None:
    log.rename(log.with_suffix(".moved"))


@pytest.mark.parametrize("change", [change_size, change_time, change_inode, move_away])
def test_changed_log_is_not_known(identities: LogIdentities, log: Path, change: object) -> None:
    assert callable(change)
    identities.remember(log, "aa")
    change(log)
    assert identities.lookup(log) is None


def test_link_that_points_elsewhere_is_not_known(identities: LogIdentities, log: Path) -> None:
    link = log.parent / "latest.mcap"
    link.symlink_to(log)
    identities.remember(link, "aa")
    assert identities.lookup(log) == "aa"
    other = log.parent / "other.mcap"
    other.write_bytes(b"before")
    os.utime(other, ns=(OLD_NS, OLD_NS))
    link.unlink()
    link.symlink_to(other)
    assert identities.lookup(link) is None


def test_log_that_changed_while_it_was_read_is_not_remembered(identities: LogIdentities, log: Path) -> None:
    seen = see_log(log)
    change_time(log)
    assert not identities.remember(log, "aa", seen=seen)
    assert identities.lookup(log) is None


def test_log_that_was_just_written_is_not_remembered(identities: LogIdentities, log: Path) -> None:
    seen = see_log(log)
    fresh = dataclasses.replace(seen, seen_ns=seen.mtime_ns + 1_000_000)
    assert not identities.remember(log, "aa", seen=fresh)
    assert identities.lookup(log) is None


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b'{"sha256": "bb"}', b"\xff", b'{"path": '])
def test_damaged_entry_costs_a_hash(
    identities: LogIdentities, log: Path, store: Store, content: bytes
) -> None:
    identities.remember(log, "aa")
    (entry,) = (store.root / "identities").rglob("*.json")
    entry.write_bytes(content)
    assert identities.lookup(log) is None
    identities.remember(log, "aa")
    assert identities.lookup(log) == "aa"


def test_failing_to_remember_is_no_error(identities: LogIdentities, log: Path, store: Store) -> None:
    store.root.write_text("a file where the folder should be")
    assert not identities.remember(log, "aa")
    assert not identities.remember(log.parent / "absent.mcap", "aa")
    assert identities.lookup(log) is None


def test_many_writers_at_once(identities: LogIdentities, tmp_path: Path, store: Store) -> None:
    logs = [tmp_path / f"{number}.mcap" for number in range(40)]
    for path in logs:
        path.write_bytes(b"")

    def remember_and_look(number: int) -> bool:
        path = logs[number % 40]
        identities.remember(path, path.stem)
        return identities.lookup(path) == path.stem

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(remember_and_look, range(400)))
    assert not list(store.root.rglob(".tmp-*"))


def test_a_part_that_grows_makes_a_split_recording_unknown(identities: LogIdentities, tmp_path: Path) -> None:
    recording = tmp_path / "split"
    recording.mkdir()
    for number in range(2):
        (recording / f"split_{number}.mcap").write_bytes(b"part")
    assert identities.remember(recording, "aa")
    assert identities.lookup(recording) == "aa"
    with (recording / "split_1.mcap").open("ab") as part:
        part.write(b"more")
    assert identities.lookup(recording) is None


def test_a_part_of_a_split_recording_that_changed_is_noticed(
    identities: LogIdentities, tmp_path: Path
) -> None:
    recording = tmp_path / "split"
    recording.mkdir()
    for name, moment in (("split_0.mcap", 1_000_000_000), ("split_1.mcap", 2_000_000_000)):
        (recording / name).write_bytes(b"first")
        os.utime(recording / name, ns=(moment, moment))
    assert identities.remember(recording, "aa")
    assert identities.lookup(recording) == "aa"
    # In place, of the same size, and older than the other part: the folder and the latest time stay the same.
    (recording / "split_0.mcap").write_bytes(b"other")
    os.utime(recording / "split_0.mcap", ns=(500_000_000, 500_000_000))
    assert identities.lookup(recording) is None
