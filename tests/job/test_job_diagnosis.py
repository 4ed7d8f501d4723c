"""The diagnosis inside an analysis: what is missing is said, kept, and not looked for twice."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest

from pipeline.job import Options, run_results
from pipeline.job.analyze import Outcome, analyze_log
from pipeline.models import find_effect
from pipeline.simulate import simulate_case


def analyze(log: Path, out: Path, **options: object) -> Outcome:
    return analyze_log(log, Options(out=out, **{"report": False, "diagnosis": True, **options}))


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> tuple[Outcome, Path, Path]:
    """A log with a wide effective track, analyzed."""
    folder = tmp_path_factory.mktemp("wide")
    log = simulate_case(
        "ideal_husky", {"effective_track": {"k": 1.7}}, out=folder / "wide.mcap", duration_s=90.0
    )
    return analyze(log, folder / "out"), log, folder / "out"


def test_an_analysis_names_what_is_missing(wide: tuple[Outcome, Path, Path]) -> None:
    outcome, _, _ = wide
    diagnosis = outcome.summary["diagnosis"]

    assert [effect["id"] for effect in diagnosis["effects"]] == ["effective_track"]
    width = diagnosis["effects"][0]["parameters"]["k"]
    assert width["low"] <= 1.7 <= width["high"]
    assert width["unit"] == "1"
    assert outcome.computed[-1] == "diagnosis"


def test_the_ladder_and_the_diagnosis_are_kept(wide: tuple[Outcome, Path, Path]) -> None:
    outcome, _, _ = wide
    ladder = outcome.manifest.read("ladder")
    stored = json.loads(outcome.manifest.path("diagnosis.json").read_text())

    assert stored == outcome.summary["diagnosis"]
    rungs = ladder.filter(pl.col("kind") == "rung")
    assert rungs["added"].to_list() == ["", "effective_track"]
    assert rungs["r_mrmse"][1] < 0.3 * rungs["r_mrmse"][0]


def test_the_budget_and_the_estimates_are_those_of_the_diagnosis(wide: tuple[Outcome, Path, Path]) -> None:
    outcome, _, _ = wide
    diagnosis = outcome.summary["diagnosis"]
    budget = outcome.manifest.read("budget")
    for told in diagnosis["budget"]:
        own = budget.filter(pl.col("input") == told["input"], pl.col("quantity") == told["quantity"])
        assert own["share"].sum() == pytest.approx(1.0, abs=1e-4)
        assert own["mean_square"].sum() == pytest.approx(told["total"], rel=1e-4)
        assert own.filter(pl.col("kind") == "effect")["name"].to_list() == [
            share["effect"] for share in told["shares"]
        ]
    ideal = diagnosis["ladder"][0]
    (position,) = [
        told["total"]
        for told in diagnosis["budget"]
        if (told["input"], told["quantity"]) == (diagnosis["input"], "position")
    ]
    assert position == pytest.approx(ideal["t_mrmse_m"] ** 2, rel=1e-4)
    (line,) = [text for label, text in diagnosis["lines"] if label == "budget"]
    assert "effective_track" in line

    estimates = outcome.manifest.read("estimates")
    named = estimates.filter("named", pl.col("input") == diagnosis["input"])
    assert named["effect"].to_list() == ["effective_track"]
    assert named["value"].item() == pytest.approx(
        diagnosis["effects"][0]["parameters"]["k"]["value"], rel=1e-5
    )
    quiet = estimates.filter(~pl.col("named"))
    neutral = {name: find_effect(name)().parameters[0].neutral for name in quiet["effect"].unique().to_list()}
    off = quiet.with_columns(
        pl.col("effect").replace_strict(neutral, return_dtype=pl.Float64).alias("neutral")
    )
    z = (off["value"] - off["neutral"]) / off["standard_error"]
    assert quiet.height > 5
    assert z.abs().median() < 2.0


def test_a_diagnosis_is_not_made_twice(wide: tuple[Outcome, Path, Path]) -> None:
    outcome, log, out = wide

    assert analyze(log, out).computed == ()
    assert analyze(log, out, diagnosis=False).manifest.folder == outcome.manifest.folder
    with_report = analyze(log, out, report=True)
    assert with_report.computed == ()
    assert "effective_track" in with_report.manifest.path("report.html").read_text()


def test_a_log_too_short_to_diagnose_has_its_slip(tmp_path: Path) -> None:
    log = simulate_case("ideal_husky", out=tmp_path / "short.mcap", duration_s=6.0)
    outcome = analyze(log, tmp_path / "out")

    assert outcome.summary["median_modulus"] is not None
    diagnosis = outcome.summary["diagnosis"]
    assert diagnosis["effects"] == []
    assert diagnosis["findings"]


def test_a_vehicle_that_does_not_move_gets_no_name(tmp_path: Path) -> None:
    log = simulate_case("husky_in_the_air", out=tmp_path / "air.mcap", duration_s=60.0)
    diagnosis = analyze(log, tmp_path / "out").summary["diagnosis"]

    assert diagnosis["effects"] == []
    assert diagnosis["undecided"] == []
    assert "not_moving" in [finding["id"] for finding in diagnosis["findings"]]


def test_a_new_effect_asks_for_a_new_diagnosis(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "models" / "effects"
    folder.mkdir(parents=True)
    monkeypatch.setattr(run_results, "__file__", str(tmp_path / "job" / "run_results.py"))
    (folder / "drive_lag.py").touch()
    before = run_results.key_diagnosis({"slip": "key"})
    assert run_results.key_diagnosis({"slip": "key"}) == before
    (folder / "new_effect.py").touch()
    assert run_results.key_diagnosis({"slip": "key"}) != before
