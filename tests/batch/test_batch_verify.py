"""`slip results verify --repair`: what can be made again is, by the next batch; nothing whole is touched."""

import json
import os
import shutil
from pathlib import Path

import pytest
from batch_tools import batch, counts, read_tables
from store_samples import read_current

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.batch.batch_check import Verification, verify_results
from pipeline.cli import main
from pipeline.store import LOG_NOTES, Store


def verify(out: Path, *, repair: bool = False) -> Verification:
    return verify_results(Store(out), logs=False, notify=print, repair=repair)


def test_what_is_damaged_is_made_again_by_the_next_batch(season: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    batch(season, out)
    whole = read_tables(out)
    assert verify(out).files == ()
    run_dirs = {name: out / "runs" / "season" / name for name in "abcd"}
    next(run_dirs["a"].glob("*/slip.parquet")).write_bytes(b"x")
    (run_dirs["b"] / "manifest.json").write_text("{")
    shutil.rmtree(run_dirs["c"])
    shutil.copytree(run_dirs["a"], run_dirs["c"], symlinks=True)
    (run_dirs["d"] / "manifest.json").unlink()
    # Its manifest tells the log as well.
    Store(out).notes(LOG_NOTES).path_of(str(season / "a.mcap")).write_text('{"state": ')

    found = verify(out, repair=True)
    assert {(problem.run, problem.code) for problem in found.files} == {
        ("season/a", "file_damaged"), ("season/b", "manifest_damaged"), ("season/c", "name_clash"),
        ("season/d", "run_missing"), ("", "note_damaged"),
    }  # fmt: skip
    actions = {repair.subject: repair.action for repair in found.repairs}
    assert {actions[f"season/{name}"] for name in "abcd"} == {"queued"}
    assert all(str(season) in repair.what for repair in found.repairs if "season" in repair.subject)
    # What may still be of use is there until something better is.
    assert read_current(Store(out), "season/a", "aggregates").height

    again = batch(season, out)
    assert counts(again) == {"done": 4}
    assert again.problems == ()
    assert verify(out).files == ()
    tables = read_tables(out)
    for name, content in whole.items():
        if name.endswith(("datasets.parquet", "slip.parquet")):
            assert content in tables.values()
    assert tables["datasets.parquet"] == whole["datasets.parquet"]
    assert counts(batch(season, out)) == {"unchanged": 4}


def test_a_damaged_run_is_made_again_with_its_diagnosis_report_and_figures(
    season: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    log = season / "a.mcap"
    options = Options(out=out, run="season/a", diagnosis=True, figures="svg")
    had = analyze_log(log, options).manifest
    had.path("slip").write_bytes(b"x")
    batch(log, out)
    verify(out, repair=True)
    assert counts(batch(log, out)) == {"done": 1}
    (now,) = Store(out).manifests()
    assert now.folder != had.folder
    assert (set(now.tables), set(now.files)) == (set(had.tables), set(had.files))
    assert {"diagnosis.json", "report.html"} <= set(now.files)
    assert verify(out).files == ()


def test_what_cannot_be_made_again_is_said_and_stays(
    season: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    for name in "cd":
        (season / f"{name}.mcap").unlink()
    batch(season, out)
    home = out / "runs" / "season"
    (home / "b" / "manifest.json").write_text("{")
    (home / "a" / "manifest.json").unlink()
    for name in "ab":
        (season / f"{name}.mcap").unlink()
    before = {path: path.read_bytes() for path in (home / "b").rglob("*.parquet")}

    def ask(*more: str) -> tuple[int, dict[str, list[dict[str, str]]]]:
        try:
            main(["results", "verify", str(out), "--no-logs", "--json", *more])
        except SystemExit as ended:
            return int(ended.code or 0), json.loads(capsys.readouterr().out)
        raise AssertionError("it ends")

    code, said = ask("--repair")
    assert code == 1
    assert [repair["action"] for repair in said["repairs"]] == ["lost", "lost"]
    assert all("gone" in repair["what"] for repair in said["repairs"])
    assert {path: path.read_bytes() for path in (home / "b").rglob("*.parquet")} == before
    assert (home / "b" / "manifest.json").exists()
    code, said = ask()
    assert code == 1
    assert [problem["code"] for problem in said["files"]] == ["run_missing", "manifest_damaged"]
    assert "repairs" not in said


def test_logs_in_the_results_of_a_stranger_are_only_files(season: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    batch(season / "a.mcap", out)
    (season / "a.mcap").unlink()
    os.mkfifo(season / "a.mcap")
    found = verify_results(Store(out), logs=True, notify=print)
    assert [problem.code for problem in found.gone] == ["log_gone"]
