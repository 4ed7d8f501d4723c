"""A season from the outside: what is done, what is left alone, what becomes of whom."""

import hashlib
import os
import re
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest
from batch_tools import Watch, ask, batch, counts, read_tables

from pipeline.analysis.analyze import analyze_log, update_datasets
from pipeline.analysis.work import VERSIONS
from pipeline.batch import Pruning, Shard, batch_plan
from pipeline.batch.batch_check import read_status, verify_results
from pipeline.batch.batch_run import run_batch
from pipeline.store import LOG_STATES, Store, find_log, list_old


def hash_all(folder: Path) -> dict[str, str]:
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.rglob("*.mcap")}


def test_a_season_with_good_and_bad_logs(season: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    whole = (season / "a.mcap").read_bytes()
    (season / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    (season / "text.mcap").write_text("this is no recording\n" * 10)
    shutil.copy(season / "b.mcap", season / "copy.mcap")
    before = hash_all(season)
    for path in season.glob("*.mcap"):
        path.chmod(0o444)

    first = batch(season, out)
    assert counts(first) == {"done": 4, "lossy": 1, "failed": 1, "copy": 1}
    by_name = {Path(line.path).stem: line for line in first.lines}
    assert (by_name["text"].code, by_name["text"].run) == ("not_mcap", "season/text")
    assert "MCAP" in by_name["text"].reason
    assert "cut" in by_name["cut"].reason
    assert by_name["copy"].run == "season/b"
    assert first.has_failed
    assert first.has_losses
    assert first.problems == ()
    assert hash_all(season) == before

    tables = read_tables(out)
    watch = Watch()
    second = run_batch(ask(season, out), watch)
    assert counts(second) == {"unchanged": 4, "lossy": 1, "failed": 1, "copy": 1}
    assert watch.plans == [(0, 7)]
    assert not second.has_failed, "what is dead and unchanged does not fail every night"
    assert second.has_losses
    assert read_tables(out) == tables

    status = read_status(Store(out))
    assert status.counts == dict.fromkeys(LOG_STATES, 0) | {"done": 4, "lossy": 1, "failed": 1, "copy": 1}
    assert status.runs == 5
    (season / "text.mcap").rename(tmp_path / "text.mcap")
    assert read_status(Store(out)).counts["failed"] == 0
    (tmp_path / "text.mcap").rename(season / "text.mcap")
    assert verify_results(Store(out), logs=True, notify=print).is_clean


def test_the_bytes_are_those_of_one_log_after_the_other(season: Path, tmp_path: Path) -> None:
    outcome = batch(season, tmp_path / "many", executor="local")
    assert counts(outcome) == {"done": 4}, [line.reason for line in outcome.lines]
    one = ask(season, tmp_path / "one").options
    for log in sorted(season.glob("*.mcap")):
        analyze_log(log, one)
    update_datasets(Store(one.out))
    many = read_tables(tmp_path / "many")
    assert "index.html" in many
    assert many == read_tables(tmp_path / "one")


def test_only_what_a_change_touches_is_done_again(
    season: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    batch(season, out)
    files = {path.stem: read_files(out, f"season/{path.stem}") for path in season.glob("*.mcap")}

    (season / "a.toml").write_text("[slip]\nlength_scale_m = 2.0\n")
    (season / "b.toml").write_text("[velocity]\nrate_hz = 20.0\n")
    again = batch(season, out)
    lines = {Path(line.path).stem: line.state for line in again.lines}
    # What is said in a file and was the default anyway changes no key.
    assert lines == {"a": "done", "b": "unchanged", "c": "unchanged", "d": "unchanged"}
    changed = read_files(out, "season/a")
    assert changed["velocities.parquet"] == files["a"]["velocities.parquet"]
    assert changed["slip.parquet"] != files["a"]["slip.parquet"]

    monkeypatch.setattr("pipeline.batch.batch_plan._fingerprint_program", lambda: "a newer version")
    assert counts(batch(season, out)) == {"unchanged": 4}


def read_files(out: Path, run: str) -> dict[str, bytes]:
    manifest = Store(out).manifest(run)
    assert manifest is not None
    return {path.name: path.read_bytes() for path in manifest.folder.iterdir()}


def test_a_new_version_of_a_stage_is_noticed(
    monkeypatch: pytest.MonkeyPatch, season: Path, tmp_path: Path
) -> None:
    hasher = batch_plan.Fingerprinter(ask(season, tmp_path).options)
    before = hasher.find_fingerprint(season / "a.mcap")
    monkeypatch.setattr(batch_plan, "VERSIONS", dict(VERSIONS) | {"slip": 99})
    batch_plan._fingerprint_program.cache_clear()
    try:
        after = batch_plan.Fingerprinter(ask(season, tmp_path).options).find_fingerprint(season / "a.mcap")
    finally:
        batch_plan._fingerprint_program.cache_clear()
    assert before != after


def test_a_changed_log_takes_the_place_of_the_old_one(season: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (season / "d.mcap").rename(tmp_path / "new.mcap")
    batch(season, out)
    (season / "c.mcap").write_bytes((tmp_path / "new.mcap").read_bytes())
    outcome = batch(season, out)
    assert {Path(line.path).stem: (line.state, line.run) for line in outcome.lines}["c"] == (
        "done",
        "season/c",
    )
    manifest = Store(out).manifest("season/c")
    assert manifest is not None
    assert len(list_old(manifest)) == 1


def test_a_batch_says_once_whom_it_waits_for(season: Path, tmp_path: Path) -> None:
    watch, request = Watch(), ask(season / "a.mcap", tmp_path / "out")
    with ExitStack() as claim, ThreadPoolExecutor(1) as pool:
        assert claim.enter_context(Store(tmp_path / "out").claim("season/a")) == ""
        outcome = pool.submit(run_batch, request, watch)
        deadline = time.monotonic() + 20.0
        while not watch.waits and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.6)
        claim.close()
    (line,) = outcome.result().lines
    ((log, said),) = watch.waits
    assert (log, line.state, line.waited_for) == ("season/a", "done", said)
    assert re.fullmatch(rf"process {os.getpid()} on .+ \(since \d{{4}}-\d\d-\d\d \d\d:\d\d\)", said)


def test_a_moved_log_is_the_same_run_and_counts_once(season: Path, tmp_path: Path) -> None:
    out, moved = tmp_path / "out", tmp_path / "moved"

    def count(logs: Path) -> dict[str, int]:
        batch(logs, out)
        return {state: number for state, number in read_status(Store(out)).counts.items() if number}

    assert count(season) == {"done": 4}
    season.rename(moved)
    for _ in range(2):
        assert count(moved) == {"done": 4}
    # Where the old ones are back as well, the first by name is the log of the run, whatever was before.
    shutil.copytree(moved, season)
    both = tmp_path / "both"
    both.mkdir()
    season.rename(both / "season")
    moved.rename(both / "moved")
    for _ in range(2):
        assert count(both) == {"done": 4, "copy": 4}
    states = {str(Path(one.log.path).relative_to(both)): one.state for one in read_status(Store(out)).entries}
    assert {states[f"moved/{name}.mcap"] for name in "abcd"} == {"done"}
    # Of a log that is gone the copy takes the run; without one it is gone, and not done.
    shutil.rmtree(both / "moved")
    assert count(both) == {"done": 4}
    (both / "season" / "a.mcap").unlink()
    for _ in range(2):
        assert count(both) == {"done": 3, "gone": 1}
    assert Store(out).runs() == tuple(f"season/{name}" for name in "abcd")


def test_logs_of_one_name_get_runs_of_their_own(season: Path, tmp_path: Path) -> None:
    other = season / "elsewhere" / "season"
    other.mkdir(parents=True)
    (season / "d.mcap").rename(other / "a.mcap")
    outcome = batch(season, tmp_path / "out")
    runs = [line.run for line in outcome.lines]
    assert runs == [f"{tmp_path.name}/season/a", "season/b", "season/c", "elsewhere/season/a"]
    assert Store(tmp_path / "out").runs() == tuple(sorted(runs))


def test_rotated_logs_keep_their_results(season: Path, tmp_path: Path) -> None:
    """Each night run.mcap is new, and what was there moves on; nothing is computed twice."""
    out, field = tmp_path / "out", tmp_path / "field"
    field.mkdir()
    runs: dict[str, str] = {}
    for night, name in enumerate("abc"):
        for age in range(night, 0, -1):
            older = f".{age - 1}" if age > 1 else ""
            (field / f"run{older}.mcap").rename(field / f"run.{age}.mcap")
        shutil.copy(season / f"{name}.mcap", field / "run.mcap")
        outcome = batch(field, out)
        assert counts(outcome) == {"done": 1} | ({"unchanged": night} if night else {})
        made = {Path(line.path).name: line.run for line in outcome.lines}
        assert len(set(made.values())) == night + 1
        for path, run in made.items():
            sha256 = hashlib.sha256((field / path).read_bytes()).hexdigest()
            assert runs.setdefault(sha256, run) == run
    assert verify_results(Store(out), logs=True, notify=print).is_clean
    assert find_log("field/run", out) == field / "run.2.mcap"
    page = (out / "index.html").read_text()
    assert all(f'<p class="path">{field}/{name}.mcap</p>' in page for name in ("run", "run.1", "run.2"))


def test_shards_share_the_logs_and_leave_what_one_machine_would(season: Path, tmp_path: Path) -> None:
    batch(season, tmp_path / "one")
    shards = [batch(season, tmp_path / "many", shard=Shard(number=i, count=3), jobs=1) for i in (1, 2, 3)]
    worked = [line.run for outcome in shards for line in outcome.lines if line.state == "done"]
    assert len(worked) == len(set(worked)) == 4
    assert read_tables(tmp_path / "many") == read_tables(tmp_path / "one")


def test_old_generations_go_when_the_disk_needs_the_room(season: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for rate in (20.0, 10.0, 5.0):
        (season / "run.toml").write_text(f"[velocity]\nrate_hz = {rate}\n")
        batch(season, out)
    assert read_status(Store(out)).old_generations == 8
    assert batch(season, out, pruning=Pruning(keep=1)).removed == 4
    outcome = batch(season, out, pruning=Pruning(keep=1, quota_bytes=1000))
    assert outcome.removed == 4
    assert [problem.code for problem in outcome.problems] == ["over_quota"]
    assert outcome.has_failed
    assert len(Store(out).runs()) == 4
    assert Store(out).examine().problems == ()


def test_verification_names_what_changed(season: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    batch(season, out)
    with (season / "a.mcap").open("r+b") as log:
        log.seek(1000)
        log.write(b"\xff\xff\xff")
    (season / "b.mcap").unlink()
    manifest = Store(out).manifest("season/c")
    assert manifest is not None
    manifest.path("slip").write_bytes(b"other")
    found = verify_results(Store(out), logs=True, notify=print)
    assert [(problem.run, problem.code) for problem in found.logs] == [("season/a", "log_changed")]
    assert [(problem.run, problem.code) for problem in found.gone] == [("season/b", "log_gone")]
    assert [(problem.run, problem.code) for problem in found.files] == [("season/c", "file_damaged")]
    assert not found.is_clean


def test_a_damaged_manifest_is_said_and_costs_one_run(season: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    batch(season, out)
    (out / "runs" / "season" / "a" / "manifest.json").write_text("{")
    outcome = batch(season, out)
    assert outcome.has_failed
    assert [problem.code for problem in outcome.problems] == ["manifest_damaged"]
    lines = {Path(line.path).stem: (line.state, line.code) for line in outcome.lines}
    assert lines["a"] == ("failed", "manifest_damaged")
    assert lines["b"] == ("unchanged", "")
