"""A disk that refuses: one clear line, nothing half visible, and the same command goes on afterwards."""

import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from batch_tools import batch, counts, read_tables
from disks import mount_disk, remount

from pipeline.store import Store, StoreError


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Too small for the tables of four logs."""
    with mount_disk(tmp_path / "disk", "400k") as place:
        yield place


def test_a_full_disk_stops_the_batch_and_more_room_lets_it_go_on(
    season: Path, small_disk: Path, tmp_path: Path
) -> None:
    out = small_disk / "out"
    outcome = batch(season, out)
    states = [line.state for line in outcome.lines]
    assert "failed" in states
    full = next(line for line in outcome.lines if line.state == "failed")
    assert full.code == "disk_full"
    assert "--results" in full.hint
    assert Store(out).examine().problems == ()
    assert outcome.has_failed

    remount(small_disk, "size=64m")
    assert "failed" not in counts(batch(season, out))
    batch(season, tmp_path / "clean")
    assert read_tables(out) == read_tables(tmp_path / "clean")


def test_a_read_only_target_is_said_before_the_work(season: Path, small_disk: Path) -> None:
    remount(small_disk, "ro")
    with pytest.raises(StoreError) as caught:
        batch(season, small_disk / "out")
    assert caught.value.code == "read_only"


def test_a_forbidden_target_is_said_before_the_work(
    season: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    if os.geteuid():
        out.chmod(0o500)
    else:
        # Nothing is forbidden to root: the system's answer is put in its mouth.
        opened = os.open

        def refuse(path: str, flags: int, *rest: int) -> int:
            if flags & os.O_CREAT and str(path).startswith(str(out)):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
            return opened(path, flags, *rest)

        monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(StoreError) as caught:
        batch(season, out)
    assert caught.value.code == "permission_denied"
    assert str(out) in caught.value.where


def test_a_file_in_the_place_of_the_results_is_named(season: Path, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a list of things to do")
    with pytest.raises(StoreError) as caught:
        batch(season, tmp_path / "out")
    assert caught.value.code == "not_a_folder"
    assert str(tmp_path / "out") in caught.value.where
    assert "--results" in caught.value.hint
