"""The diagnosis inside an analysis: what is missing is said, kept, and not looked for twice."""

import json
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import Outcome, analyze_log
from pipeline.estimation import Input, stored_diagnosis
from pipeline.estimation.estimation_data import prepare_data
from pipeline.estimation.recordings import load_recording
from pipeline.results import RunDiagnosis, read_result
from pipeline.simulate import make_scenario, simulate_case, simulate_run, write_log
from pipeline.words.objects import diagnosis_as_json


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
    stored = read_result(json.loads(outcome.manifest.path("diagnosis.json").read_text()), RunDiagnosis)

    assert diagnosis_as_json(stored) == outcome.summary["diagnosis"]
    rungs = ladder.filter(pl.col("kind") == "rung")
    assert rungs["added"].to_list() == ["", "effective_track"]
    assert rungs["r_mrmse"][1] < 0.3 * rungs["r_mrmse"][0]


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


def test_slow_poses_are_the_reason_where_nothing_can_be_diagnosed(tmp_path: Path) -> None:
    scenario = make_scenario("ideal_husky", duration_s=60.0)
    scenario = replace(scenario, pose=replace(scenario.pose, rate_hz=1.0, update_hz=1.0))
    write_log(simulate_run(scenario), tmp_path / "slow.mcap")
    diagnosis = analyze(tmp_path / "slow.mcap", tmp_path / "out").summary["diagnosis"]

    assert diagnosis["effects"] == []
    (said,) = [finding["text"] for finding in diagnosis["findings"] if finding["id"] == "slow_poses"]
    assert "its poses come at 1 Hz: at least 4 Hz are needed" in said
    assert "Drive longer" not in said


def test_a_new_effect_asks_for_a_new_diagnosis(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "models" / "effects"
    folder.mkdir(parents=True)
    monkeypatch.setattr(stored_diagnosis, "__file__", str(tmp_path / "estimation" / "stored_diagnosis.py"))
    (folder / "drive_lag.py").touch()
    before = stored_diagnosis.key_diagnosis({"slip": "key"})
    assert stored_diagnosis.key_diagnosis({"slip": "key"}) == before
    (folder / "new_effect.py").touch()
    assert stored_diagnosis.key_diagnosis({"slip": "key"}) != before


def test_a_diagnosis_does_not_depend_on_the_rate_of_the_slip_table(samples: Path, tmp_path: Path) -> None:
    """Rows of a slow table lie next to each other, and are no holes of the drive."""
    counts = []
    for rate in (20, 2):
        options = Options(
            out=tmp_path / str(rate),
            report=False,
            diagnosis=False,
            overrides={"velocity": {"rate_hz": rate}},
        )
        manifest = analyze_log(samples / "husky_tile.mcap", options).manifest
        vehicle, recording = stored_diagnosis.read_recording(manifest)
        counts.append(
            prepare_data([load_recording(recording, vehicle)], vehicle, Input.COMMAND).whole.run.size
        )
    assert counts[1] == pytest.approx(counts[0], rel=0.02)
