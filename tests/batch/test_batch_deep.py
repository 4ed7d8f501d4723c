"""Folders nested 1,500 levels deep, among results and logs: one line says where, all else is done."""

from collections.abc import Callable
from pathlib import Path

from batch_tools import batch, counts
from verbs import ask_verb, run_slip

from pipeline.batch import Pruning
from pipeline.store import Store


def test_deep_results_cost_one_line(season: Path, tmp_path: Path, dig: Callable[..., None]) -> None:
    out = tmp_path / "out"
    batch(season / "a.mcap", out)
    dig(out / "runs")
    code, said, told = run_slip("results", "status", "--results", out)
    assert code == 1
    assert "done          1" in said
    assert (said + told).count("levels of folders deep") == 1
    found = ask_verb("results", "verify", out, code=1)
    assert found["runs"] == 1
    assert [problem["code"] for problem in found["files"]] == ["left_out"]
    assert found["files"][0]["path"].startswith(str(out / "runs" / "d"))
    assert found["read"]["files"]["looked_at"] > 10
    pruned = batch(season / "a.mcap", out, pruning=Pruning(quota_bytes=10**12))
    assert counts(pruned) == {"unchanged": 1}
    assert [problem.code for problem in pruned.problems] == ["left_out"]


def test_a_deep_folder_of_logs_costs_one_line(season: Path, tmp_path: Path, dig: Callable[..., None]) -> None:
    dig(season)
    outcome = batch(season, tmp_path / "out")
    assert counts(outcome)["done"] == 4
    (line,) = [line for line in outcome.lines if line.state == "left_out"]
    assert line.path.startswith(str(season / "d"))
    assert "levels of folders deep" in line.reason


def test_a_deep_leftover_is_refused_in_one_line(
    season: Path, tmp_path: Path, dig: Callable[..., None]
) -> None:
    out = tmp_path / "out"
    batch(season / "a.mcap", out)
    home = Store(out).manifests()[0].folder.parent
    (home / ".tmp-1-dead").mkdir()
    dig(home / ".tmp-1-dead")
    outcome = batch(season / "a.mcap", out, force=True)
    (line,) = outcome.lines
    assert (line.state, line.code) == ("failed", "left_out")
