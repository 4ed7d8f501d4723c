"""Loops that are compiled at set-up are not compiled again when they are called."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from pipeline.core import machine_code
from pipeline.core.machine_code import Loop
from pipeline.models.filters import _lag

MAKEFILE = Path(__file__).parents[2] / "Makefile"
CALL = """
import sys
import numpy as np
from pipeline.estimation.state import _sum_costs
from pipeline.models.filters import _lag
from pipeline.run.windows import average_spans
ones, first, rows = np.ones(9), np.zeros(3, dtype=np.int64), np.ones((4, 3))
_lag(ones, ones, 0.3, 0.02, np.empty(9))
average_spans(ones, 0.02, first, np.zeros(3), first + 5, np.zeros(3), np.ones(3))
_sum_costs(rows, rows, rows, np.zeros(4))
assert "numba" not in sys.modules
"""


def _run(cache: Path, *command: str | Path) -> set[str]:
    """What is kept of compiled loops after a command."""
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_DISABLE_JIT"}
    done = [sys.executable, *map(str, command)]
    subprocess.run(done, env=environment | {"NUMBA_CACHE_DIR": str(cache)}, check=True, capture_output=True)
    return {path.name for path in cache.rglob("*.o")}


@pytest.mark.long
def test_what_set_up_compiles_is_what_a_diagnosis_calls(samples: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    (compile_all,) = re.findall(r'-c "(.*compile_every_loop.*)"', MAKEFILE.read_text())
    compiled = _run(cache, "-c", compile_all)
    assert len(compiled) > 10
    assert _run(cache, "-c", CALL) == compiled
    log, out = samples / "husky_tile.mcap", tmp_path / "out"
    assert _run(cache, "-m", "pipeline", "diagnose", log, "--out", out, "--quiet") == compiled


def test_machine_code_that_is_damaged_is_made_anew(tmp_path: Path) -> None:
    code = "import numpy as np; from pipeline.models.filters import _follow as f; o = np.empty(2); "
    code += "f(np.array([0.0, 1.0]), np.array([0.0, np.nan]), 0.25, o); print(o[1])"
    (name,) = _run(tmp_path, "-c", code)
    whole = (tmp_path / name).read_bytes()
    for damaged in (b"", whole[:-9], whole[:200] + b"\0\0\0\0" + whole[204:]):
        (tmp_path / name).write_bytes(damaged)
        assert _run(tmp_path, "-c", code) == {name}
        assert (tmp_path / name).read_bytes() == whole


def test_arrays_that_the_machine_code_would_misread_are_refused() -> None:
    ones = np.ones(8)
    for wrong in (ones[::2], ones.astype(np.float32), ones.reshape(2, 4), ones.astype(int)):
        with pytest.raises(TypeError, match="argument 1 of _lag is no C-contiguous array of float64"):
            _lag(wrong, ones, 0.3, 0.02, np.empty(8))


def _double(values: np.ndarray) -> None:
    for place in range(values.size):
        values[place] *= 2.0


def _twice(value: float) -> float:
    return 2.0 * value


def test_python_in_place_of_machine_code_gives_other_loops_what_they_call_it_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert Loop(_twice, "")(1.5) == 3.0


@pytest.fixture
def loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Loop[[np.ndarray]]:
    """A loop that doubles numbers, whose machine code is kept in `tmp_path`."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.delenv("NUMBA_DISABLE_JIT", raising=False)
    monkeypatch.setattr(machine_code, "_compile", lambda *_: b"compiled")
    return Loop(_double, "float64[:]")


def test_whoever_may_read_the_program_may_read_its_machine_code(loop: Loop[[np.ndarray]]) -> None:
    mask = os.umask(0o022)
    try:
        loop.make_object()
    finally:
        os.umask(mask)
    path = loop.find_object()
    assert path is not None
    assert path.stat().st_mode & 0o777 == 0o644


def test_where_machine_code_can_neither_be_read_nor_kept_it_is_made_each_time(
    loop: Loop[[np.ndarray]], tmp_path: Path
) -> None:
    loop.make_object()
    path = loop.find_object()
    assert path is not None
    path.unlink()
    path.mkdir()
    assert loop.make_object() == b"compiled"
    assert loop.find_object() is None
    assert list(tmp_path.iterdir()) == [path]


def test_damaged_machine_code_does_not_hide_a_whole_copy(
    loop: Loop[[np.ndarray]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = [tmp_path / "first", tmp_path / "second"]
    monkeypatch.setattr(loop, "_list_folders", lambda: iter(folders[1:]))
    loop.make_object()
    folders[0].mkdir()
    kept = loop.find_object()
    assert kept is not None
    (folders[0] / kept.name).write_bytes(b"damaged")
    monkeypatch.setattr(loop, "_list_folders", lambda: iter(folders))
    assert loop.find_object() == kept


def _keep(folder: Path, name: str, days: float) -> str:
    """A file that was used last so many days ago; its name."""
    path = folder / name
    path.write_bytes(b"older")
    used = time.time() - days * 86400.0
    os.utime(path, (used, used))
    return name


def test_machine_code_of_no_present_loop_is_deleted_a_month_after_its_last_use(
    loop: Loop[[np.ndarray]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    another = Loop(_twice, "float64")
    monkeypatch.setattr(machine_code, "_loops", [loop, another])
    ours, digest = "test_core_loops", "0123456789abcdef"
    for gone in (f"{ours}._double-{digest}.o", f"{ours}._renamed-{digest}.o"):
        _keep(tmp_path, gone, 31.0)
    kept = {
        _keep(tmp_path, another.file_name, 400.0),
        _keep(tmp_path, f"{ours}._double-{digest[::-1]}.o", 29.0),
        _keep(tmp_path, f"elsewhere._double-{digest}.o", 400.0),
        _keep(tmp_path, f"{ours}._double-1.py311.nbc", 400.0),
    }
    loop.make_object()
    assert {path.name for path in tmp_path.iterdir()} == {loop.file_name, *kept}


def test_machine_code_that_is_run_counts_as_used(loop: Loop[[np.ndarray]], tmp_path: Path) -> None:
    loop.make_object()
    path = tmp_path / loop.file_name
    os.utime(path, (0.0, 0.0))
    loop.make_object()
    assert time.time() - path.stat().st_mtime < 3600.0


@pytest.mark.parametrize("error", [PermissionError, FileNotFoundError])
def test_older_machine_code_that_cannot_be_deleted_or_is_already_gone_is_no_matter(
    loop: Loop[[np.ndarray]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[OSError]
) -> None:
    """A folder that others own, and another process that was faster."""
    tried = []

    def refuse(path: Path, **_: object) -> None:
        tried.append(path.name)
        raise error

    monkeypatch.setattr(machine_code, "_loops", [loop])
    monkeypatch.setattr(Path, "unlink", refuse)
    older = _keep(tmp_path, "test_core_loops._double-0123456789abcdef.o", 31.0)
    assert loop.make_object() == b"compiled"
    assert tried == [older]
    assert loop.find_object() == tmp_path / loop.file_name


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives a file to somebody else")
def test_machine_code_that_somebody_else_wrote_is_not_run(loop: Loop[[np.ndarray]]) -> None:
    loop.make_object()
    path = loop.find_object()
    assert path is not None
    os.chown(path, 12345, 12345)
    assert loop.find_object() is None
    loop.make_object()
    assert path.stat().st_uid == 0
