"""Folders of any depth are looked through without recursion, and within bounds."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.core import untrusted
from pipeline.core.untrusted import MOST_LEVELS, walk_files


def walk_all(top: Path) -> tuple[list[str], list[str]]:
    skipped: list[str] = []
    found = [entry.name for entry in walk_files(top, lambda place, why: skipped.append(f"{place}: {why}"))]
    return sorted(found), skipped


def test_what_is_too_deep_is_said_and_the_rest_is_found(tmp_path: Path, dig: Callable[..., None]) -> None:
    (tmp_path / "beside").mkdir()
    (tmp_path / "beside" / "file").write_text("x")
    dig(tmp_path)
    found, skipped = walk_all(tmp_path)
    assert found == ["file"]
    (line,) = skipped
    assert line.startswith(f"{tmp_path}{'/d' * (MOST_LEVELS + 1)}: it is more than 100 levels")


def test_as_many_levels_as_there_may_be_are_looked_through(tmp_path: Path, dig: Callable[..., None]) -> None:
    dig(tmp_path, MOST_LEVELS)
    assert walk_all(tmp_path) == (["deepest"], [])


def test_more_entries_than_there_may_be_are_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(untrusted, "MOST_ENTRIES", 5)
    for name in "abc":
        (tmp_path / name).mkdir()
        for number in range(4):
            (tmp_path / name / f"{name}{number}").write_text("x")
    found, skipped = walk_all(tmp_path)
    assert len(found) == 4
    assert len(skipped) == 1
    assert "more than 5 files and folders" in skipped[0]


def test_links_are_not_followed(tmp_path: Path) -> None:
    (tmp_path / "round").symlink_to(tmp_path, target_is_directory=True)
    (tmp_path / "nowhere").symlink_to("gone")
    assert walk_all(tmp_path) == (["nowhere", "round"], [])
