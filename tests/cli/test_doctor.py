"""`slip doctor`: one line for each look, and what to do about what is wrong."""

from __future__ import annotations

import json
import shutil
import tempfile
from importlib import metadata
from typing import TYPE_CHECKING, NoReturn

import pytest
from verbs import run_program, run_verb

from pipeline.core import machine_code

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Break = Callable[[pytest.MonkeyPatch], None]

NAMES = [
    "Python", "packages", "extras", "compiled loops", "Chromium", "disk", "permission", "locale", "time zone",
]  # fmt: skip


def refuse(*_: object, **__: object) -> NoReturn:
    raise PermissionError(13, "Permission denied")


def lack(name: str) -> str:
    if name == "scipy":
        raise metadata.PackageNotFoundError(name)
    return "0.1" if name == "numpy" else "999"


def give_no_room(_: Path) -> shutil._ntuple_diskusage:
    return shutil._ntuple_diskusage(10, 9, 1)


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loops that are kept; what takes seconds is looked at once, below."""
    monkeypatch.setattr(machine_code, "compile_loops", lambda: 1)
    monkeypatch.setattr(machine_code, "list_caches", lambda: {"/cache"})


def test_a_whole_installation_has_no_problem_and_a_line_for_each_look(tmp_path: Path) -> None:
    done = run_program("doctor", "--results", tmp_path / "season", "--json")
    assert done.returncode == 0, done.stdout
    found = json.loads(done.stdout)
    assert found["ok"]
    assert [check["name"] for check in found["checks"]] == NAMES
    assert {check["state"] for check in found["checks"]} <= {"ok", "optional"}
    assert "kept in" in found["checks"][3]["text"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize(
    ("harm", "name", "words"),
    [
        (
            lambda patch: patch.setattr(metadata, "version", lack),
            "packages",
            ["scipy is missing", "numpy is 0.1, older than 2", "Install slip again"],
        ),
        (
            lambda patch: patch.setattr(machine_code, "list_caches", set),
            "compiled loops",
            ["run as Python", "Unset NUMBA_DISABLE_JIT"],
        ),
        (
            lambda patch: patch.setattr(machine_code, "list_caches", lambda: {None}),
            "compiled loops",
            ["every process compiles 1 loops", "NUMBA_CACHE_DIR"],
        ),
        (
            lambda patch: patch.setattr(shutil, "disk_usage", give_no_room),
            "disk",
            ["0.0 GB free", "another disk with --results"],
        ),
        (
            lambda patch: patch.setattr(tempfile, "TemporaryFile", refuse),
            "permission",
            ["cannot be written to: Permission denied", "--results"],
        ),
        (
            lambda patch: patch.setenv("TZ", "Mars/Base"),
            "time zone",
            ["TZ=Mars/Base is not known", "Europe/"],
        ),
        (
            lambda patch: patch.setattr("sys.getfilesystemencoding", lambda: "ascii"),
            "locale",
            ["LC_ALL=C.UTF-8"],
        ),
    ],
)
def test_what_is_wrong_is_said_with_what_to_do(
    harm: Break, name: str, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        harm(patch)
        done = run_verb("doctor", cwd=tmp_path)
    assert done.returncode == 1
    lines = done.stdout.splitlines()
    assert len(lines) == len(NAMES)
    (line,) = [line for line in lines if line.startswith("problem")]
    assert line.split("  ", 1)[1].strip().startswith(name)
    for word in words:
        assert word in line


@pytest.mark.usefixtures("compiled")
def test_a_browser_is_optional(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    done = run_verb("doctor", "--results", tmp_path)
    assert done.returncode == 0
    assert (
        "optional  Chromium        not found; reports and figures do without it. For pictures" in done.stdout
    )
