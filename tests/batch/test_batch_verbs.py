"""The verbs as scripts use them: JSON, exit codes, one clear line."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from batch_tools import batch

from pipeline.batch.season import Line
from pipeline.cli import main
from pipeline.cli.screen import LineWatch


def slip(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as caught:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return int(caught.value.code or 0), out, err


INLINE = ("--executor", "inline", "--settle", "0")


def test_batch_tells_what_became_of_every_log(
    capsys: pytest.CaptureFixture[str], season: Path, tmp_path: Path
) -> None:
    (season / "a.mcap").write_text("no recording")
    whole = (season / "b.mcap").read_bytes()
    (season / "b.mcap").write_bytes(whole[: len(whole) // 2])
    out = tmp_path / "out"
    code, text, err = slip(capsys, "batch", season, "--out", out, *INLINE, "--json")
    answer = json.loads(text)
    assert (code, err) == (1, "")
    assert {state: answer[state] for state in ("done", "unchanged", "lossy", "failed", "quarantined")} == {
        "done": 2, "unchanged": 0, "lossy": 1, "failed": 1, "quarantined": 0,
    }  # fmt: skip
    assert [(Path(log["path"]).stem, log["state"], bool(log["reason"])) for log in answer["logs"]] == [
        ("a", "failed", True), ("b", "lossy", True), ("c", "done", False), ("d", "done", False),
    ]  # fmt: skip

    (season / "a.mcap").unlink()
    code, text, err = slip(capsys, "batch", season, "--out", out, *INLINE)
    assert code == 3
    assert text.splitlines()[:3] == ["done               0", "unchanged          3", "with losses        0"]
    assert str(season / "b.mcap") in text
    assert err == "0 logs to work on (0.0 MB), 3 already done\n"

    (season / "b.mcap").unlink()
    assert slip(capsys, "batch", season, "--out", out, *INLINE, "--quiet") == (0, "", "")


def test_batch_names_copies(capsys: pytest.CaptureFixture[str], season: Path, tmp_path: Path) -> None:
    (season / "z.mcap").write_bytes((season / "a.mcap").read_bytes())
    text = slip(capsys, "batch", season, "--out", tmp_path / "out", *INLINE)[1]
    assert "copies, counted once" in text
    assert f"{season / 'z.mcap'}\n      the same content as season/a" in text


def test_a_name_that_begins_with_a_dash_goes_behind_two(
    capsys: pytest.CaptureFixture[str], season: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (season / "a.mcap").rename(season / "-a.mcap")
    monkeypatch.chdir(season)
    assert slip(capsys, "batch", "-a.mcap", "--out", tmp_path / "out", *INLINE)[0] == 2
    assert slip(capsys, "batch", "--out", tmp_path / "out", *INLINE, "--", "-a.mcap")[0] == 0
    assert "--" in slip(capsys, "batch", "--help")[1].split("dash")[0][-60:]


def test_estimates_do_without_sizes() -> None:
    watch = LineWatch()
    watch.plan(4, 0, 1000)
    watch.notify(Line(path="empty", state="failed"), 0)
    assert 0.0 <= watch.estimate_rest() < 10.0
    watch.notify(Line(path="large", state="done"), 1000)
    assert watch.estimate_rest() == 0.0


def test_progress_has_an_estimate(capsys: pytest.CaptureFixture[str], season: Path, tmp_path: Path) -> None:
    _, _, err = slip(capsys, "batch", season, "--out", tmp_path / "out", *INLINE)
    lines = err.splitlines()
    assert lines[0].startswith("4 logs to work on")
    assert lines[1].startswith("[1/4] season/")
    assert lines[1].endswith(" left")
    assert "left" not in lines[4]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("batch",), "no log is given"),
        (("batch", "nowhere"), "no such file or folder"),
        (("batch", "."), "there is no recording in it. Recordings are files that end in .mcap"),
        (("batch", "*.bag"), "*.bag: there is no recording in it"),
        (("check", ".", "."), "there is no recording in it. Recordings are files that end in .mcap"),
        (("results", "status", "nowhere"), "there are no results"),
        (("results", "verify", "nowhere"), "there are no results"),
        (("results", "query", "SELECT * FROM runs", "--out", "nowhere"), "there are no results"),
        (("batch", "--prune", "--out", "nowhere"), "there are no results"),
        (("batch", "x", "--quota", "1GB"), "--quota does nothing by itself"),
        (("batch", "x", "--shard", "0/4"), "is not a shard"),
        (("batch", "x", "--memory", "lots"), "is not a size"),
        (("batch", "x", "--memory", "1"), "a worker does not start within a memory limit of '1'"),
        (("batch", "x", "--max-inflated", "9" * 400), "is not a size"),
        (("batch", "x", "--prune", "--quota", "much"), "is not a size"),
        (("batch", "schedule", "x", "--at", "noon"), "is not a time of day"),
    ],
)
def test_what_cannot_be_meant_gets_one_line(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    arguments: tuple[str, ...],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = slip(capsys, *arguments)
    assert (code, out) == (1, "")
    assert words in err
    assert len(err.splitlines()) == 1


def test_status_verify_and_query_look_without_logs(
    capsys: pytest.CaptureFixture[str], season: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    batch(season, out)
    code, text, _ = slip(capsys, "results", "status", out, "--json")
    status = json.loads(text)
    assert (code, status["done"], status["runs"], status["failed"]) == (0, 4, 4, 0)
    assert {log["state"] for log in status["logs"]} == {"done"}
    assert "done          4" in slip(capsys, "results", "status", "--out", out)[1]

    code, text, _ = slip(capsys, "results", "verify", out, "--json")
    found = json.loads(text)
    read = found.pop("read")
    nothing: dict[str, object] = {key: [] for key in ("files", "logs", "gone", "remote")}
    unchecked = ["datasets.parquet", "index.html"]
    assert (code, found) == (0, {"runs": 4, "unchecked": unchecked, **nothing})
    assert read["logs"] == {"looked_at": 4, "all": 4}
    assert read["files"]["looked_at"] == read["files"]["all"] > 50
    next(out.rglob("slip.parquet")).write_bytes(b"x")
    code, text, _ = slip(capsys, "results", "verify", out, "--no-logs", "--quiet")
    assert (code, text) == (1, "")

    sql = "SELECT vehicle, count(*) AS runs FROM runs GROUP BY vehicle ORDER BY vehicle"
    answer = json.loads(slip(capsys, "results", "query", sql, "--out", out, "--json")[1])
    assert answer == {
        "columns": ["vehicle", "runs"],
        "rows": [{"vehicle": "husky_a200", "runs": 3}, {"vehicle": "warthog", "runs": 1}],
    }
    csv = slip(
        capsys, "results", "query", "SELECT run FROM runs", "--out", out, "--terrain", "ice", "--to", "csv"
    )[1]
    assert csv == "run\nseason/d\n"
    code, _, err = slip(capsys, "results", "query", "SELECT nothing FROM runs", "--out", out)
    assert code == 1
    assert "the query cannot be answered" in err


def test_schedule_prints_units_of_this_folder(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, _ = slip(
        capsys,
        "batch",
        "schedule",
        "logs",
        "--out",
        "results",
        "--jobs",
        "4",
        "--print",
        "systemd",
        "--at",
        "01:30",
    )
    assert code == 0
    assert f"WorkingDirectory={tmp_path}" in out
    assert f"{sys.executable} -P -m pipeline batch run logs --results results --jobs 4\n" in out
    assert "OnCalendar=*-*-* 01:30:00" in out
