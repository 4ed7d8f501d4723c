"""Poisoned logs cost themselves and nothing else, and are named."""

import shutil
from pathlib import Path

from batch_tools import batch, counts, read_tables
from batch_works import work_poisoned

KINDS = ("raises", "panics", "hangs", "holds", "eats", "dies", "leaves", "unpicklable")
LIMITS = {"executor": "local", "timeout_s": 3.0, "memory_bytes": 700_000_000}


def test_each_kind_of_poison_is_named_and_the_others_are_done(season: Path, tmp_path: Path) -> None:
    for name in "cd":
        (season / f"{name}.mcap").unlink()
    batch(season, tmp_path / "clean")
    for number, kind in enumerate(KINDS):
        # Every one a content of its own, or they would be copies.
        (season / f"{kind}.mcap").write_bytes((season / "a.mcap").read_bytes() + bytes(number + 1))

    outcome = batch(season, tmp_path / "out", work=work_poisoned, **LIMITS)
    assert counts(outcome) == {"done": 2, "failed": 3, "quarantined": 5}
    found = {Path(line.path).stem: (line.state, line.code) for line in outcome.lines}
    assert {kind: found[kind] for kind in KINDS} == {
        "raises": ("failed", "unexpected_error"),
        "panics": ("failed", "unexpected_error"),
        "hangs": ("quarantined", "timed_out"),
        "holds": ("quarantined", "timed_out"),
        "eats": ("quarantined", "out_of_memory"),
        "dies": ("quarantined", "worker_died"),
        "leaves": ("quarantined", "worker_died"),
        "unpicklable": ("failed", "unexpected_error"),
    }
    reasons = {Path(line.path).stem: line.reason for line in outcome.lines}
    assert "poison" in reasons["raises"]
    assert "3 s" in reasons["hangs"]
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

    # The quarantined ones are left alone with the same limits; the others have another chance.
    again = batch(season, tmp_path / "out", **LIMITS)
    assert counts(again)["quarantined"] == 5
    assert {Path(line.path).stem for line in again.lines if line.state == "quarantined"} == {
        "hangs", "holds", "eats", "dies", "leaves",
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


def test_a_log_that_gets_more_time_or_memory_leaves_the_quarantine(season: Path, tmp_path: Path) -> None:
    (season / "hangs.mcap").write_bytes((season / "a.mcap").read_bytes() + b"1")
    (season / "eats.mcap").write_bytes((season / "a.mcap").read_bytes() + b"2")
    (season / "dies.mcap").write_bytes((season / "a.mcap").read_bytes() + b"3")
    for name in "abcd":
        (season / f"{name}.mcap").unlink()
    out = tmp_path / "out"
    assert counts(batch(season, out, work=work_poisoned, **LIMITS)) == {"quarantined": 3}
    assert counts(batch(season, out, **(LIMITS | {"timeout_s": 2.0}))) == {"quarantined": 3}
    longer = batch(season, out, **(LIMITS | {"timeout_s": 60.0}))
    done = {Path(line.path).stem for line in longer.lines if line.state != "quarantined"}
    assert done == {"hangs"}
    larger = batch(season, out, **(LIMITS | {"memory_bytes": 3_000_000_000}))
    left = [line for line in larger.lines if line.state == "quarantined"]
    assert [Path(line.path).stem for line in left] == ["dies"]
