"""Poisoned logs cost themselves and nothing else, and are named."""

from __future__ import annotations

import multiprocessing
import multiprocessing.spawn
import shutil
import time
from pathlib import Path

import pytest
from batch_tools import batch, counts, read_tables
from batch_works import work_poisoned
from pebble.pool.process import PoolManager

from pipeline.batch import BatchError
from pipeline.batch.batch_work import Settings, Task
from pipeline.batch.season import open_executor
from pipeline.job import Options
from pipeline.store import LogSighting

KINDS = ("raises", "panics", "hangs", "eats", "dies", "leaves", "unpicklable")
LIMITS = {"executor": "local", "timeout_s": 4.0, "memory_bytes": 700_000_000}


def test_each_kind_of_poison_is_named_and_the_others_are_done(season: Path, tmp_path: Path) -> None:
    for name in "cd":
        (season / f"{name}.mcap").unlink()
    batch(season, tmp_path / "clean")
    for number, kind in enumerate(KINDS):
        # Every one a content of its own, or they would be copies.
        (season / f"{kind}.mcap").write_bytes((season / "a.mcap").read_bytes() + bytes(number + 1))

    outcome = batch(season, tmp_path / "out", work=work_poisoned, **LIMITS)
    assert counts(outcome) == {"done": 2, "failed": 3, "quarantined": 4}
    found = {Path(line.path).stem: (line.state, line.code) for line in outcome.lines}
    assert {kind: found[kind] for kind in KINDS} == {
        "raises": ("failed", "unexpected_error"),
        "panics": ("failed", "unexpected_error"),
        "hangs": ("quarantined", "timed_out"),
        "eats": ("quarantined", "out_of_memory"),
        "dies": ("quarantined", "worker_died"),
        "leaves": ("quarantined", "worker_died"),
        "unpicklable": ("failed", "unexpected_error"),
    }
    reasons = {Path(line.path).stem: line.reason for line in outcome.lines}
    assert "poison" in reasons["raises"]
    assert "4 s" in reasons["hangs"]
    assert "GB" in reasons["eats"]
    assert "signal 11" in reasons["dies"]
    assert "exit code 7" in reasons["leaves"]
    made, clean = (read_tables(tmp_path / name) for name in ("out", "clean"))
    # The catalogue alone tells of the logs that came to nothing.
    catalogue = made.pop("index.html").decode()
    quarantined = [kind for kind in KINDS if found[kind][0] == "quarantined"]
    assert [kind for kind in quarantined if f"{kind}.mcap" not in catalogue] == []
    assert clean.pop("index.html")
    assert made == clean

    # The quarantined ones are left alone; the others have another chance.
    again = batch(season, tmp_path / "out")
    assert counts(again)["quarantined"] == 4
    assert {Path(line.path).stem for line in again.lines if line.state == "quarantined"} == {
        "hangs", "eats", "dies", "leaves",
    }  # fmt: skip
    retried = batch(season, tmp_path / "out", retries_quarantined=True)
    assert "quarantined" not in counts(retried)


def test_a_log_that_changed_leaves_the_quarantine(season: Path, tmp_path: Path) -> None:
    log = season / "dies.mcap"
    shutil.copy(season / "a.mcap", log)
    (season / "a.mcap").unlink()
    assert counts(batch(log, tmp_path / "out", work=work_poisoned, **LIMITS)) == {"quarantined": 1}
    log.write_bytes((season / "b.mcap").read_bytes())
    assert counts(batch(log, tmp_path / "out")) == {"done": 1}


def test_a_death_is_understood_however_late_its_pool_hears_of_the_task(
    season: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in "cd":
        (season / f"{name}.mcap").unlink()
    (season / "a.mcap").rename(season / "dies.mcap")
    hear = PoolManager.process_next_message

    def hear_late(manager: PoolManager, timeout: float) -> None:
        # The loop that looks for dead processes comes round several times meanwhile.
        time.sleep(0.4)
        hear(manager, timeout)

    monkeypatch.setattr(PoolManager, "process_next_message", hear_late)
    outcome = batch(season, tmp_path / "out", work=work_poisoned, **LIMITS | {"timeout_s": 60.0})
    assert counts(outcome) == {"done": 1, "quarantined": 1}
    (line,) = (line for line in outcome.lines if line.state == "quarantined")
    assert (Path(line.path).stem, line.code) == ("dies", "worker_died")
    assert "signal 11" in line.reason


def test_processes_that_cannot_be_started_cost_no_log(
    season: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(multiprocessing.spawn, "_python_exe", b"/bin/false")
    with pytest.raises(BatchError) as caught:
        batch(season, tmp_path / "out", **LIMITS)
    assert caught.value.code == "no_workers"
    monkeypatch.undo()
    assert counts(batch(season, tmp_path / "out")) == {"done": 4}


def test_a_worker_that_died_is_known_although_the_next_log_was_offered_to_it(tmp_path: Path) -> None:
    settings = Settings(jobs=1, timeout_s=60.0, memory_bytes=1 << 40, work=work_poisoned)
    executor = open_executor("local", settings)
    try:
        tasks = [
            Task(path=tmp_path / f"{name}.mcap", log=unseen(name), basis="", options=Options(out=tmp_path))
            for name in ("dies", "raises")
        ]
        first = executor.submit(tasks[0])
        error = first.exception(timeout=60.0)
        assert error is not None
        second = executor.submit(tasks[1])
        assert executor.blame(tasks[0], error).code == "worker_died"
        assert second.result(timeout=60.0).entry.code == "unexpected_error"
    finally:
        executor.close()


def test_a_process_that_starts_is_not_judged_by_the_memory_of_its_parent(tmp_path: Path) -> None:
    executor = open_executor("local", Settings(jobs=1, timeout_s=60.0, memory_bytes=1, work=work_poisoned))
    try:
        # Any process exceeds this limit, and starts nevertheless.
        options = Options(out=tmp_path)
        task = Task(path=tmp_path / "hangs.mcap", log=unseen("hangs"), basis="", options=options)
        error = executor.submit(task).exception(timeout=60.0)
        assert isinstance(error, Exception)
        assert executor.blame(task, error).code == "out_of_memory"
    finally:
        executor.close()


def unseen(name: str) -> LogSighting:
    return LogSighting(path=name, size=0, mtime_ns=0, inode=0, seen_ns=0)
