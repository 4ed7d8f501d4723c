"""Model against measurement per time step: the model columns of table `slip` after a diagnosis."""

import json
import shutil
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from verbs import run_verb

from pipeline.analysis import Options
from pipeline.analysis.analyze import Outcome, analyze_log
from pipeline.store import Store
from pipeline.store.parquet_tables import read_facts

COLUMNS = ["model_x", "model_y", "model_w", "residual_modulus"]


def analyze(log: Path, out: Path, **options: object) -> Outcome:
    return analyze_log(log, Options(out=out, **{"report": False, "diagnosis": True, **options}))


@pytest.fixture(scope="session")
def log(stored_run: Path) -> Path:
    """A Husky that turns too little and answers late."""
    return stored_run / "field" / "wide.mcap"


@pytest.fixture(scope="module")
def known(log: Path, stored_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """That log, analyzed with a diagnosis."""
    results = tmp_path_factory.mktemp("known") / "results"
    return analyze(log, Path(shutil.copytree(stored_run / "results", results, symlinks=True)))


def test_the_model_that_was_judged_stands_beside_the_measurement(known: Outcome) -> None:
    slip = known.manifest.read("slip")
    (rung, *_) = reversed(known.summary["diagnosis"]["ladder"])
    assert set(rung["effects"]) == {"drive_lag", "effective_track"}
    # Gaps of the recording alone have no model.
    assert slip["model_x"].null_count() < 0.02 * slip.height

    for name in ("command", "measured"):
        part = slip.filter(pl.col("input") == name, ~pl.col("suspect")).drop_nulls(COLUMNS)
        model, measured = (
            part.select(f"{kind}_{axis}" for axis in "xyw").to_numpy() for kind in ("model", "v")
        )
        length = known.summary["length_scale_m"]
        own = np.sqrt(np.sum(((model - measured) * (1.0, 1.0, length)) ** 2, axis=1))
        assert part["residual_modulus"].to_numpy() == pytest.approx(own, abs=1e-9)
        assert np.median(own) < 0.5 * part["modulus"].to_numpy().mean()
        told = known.summary["by_input"][name]
        assert told["median_residual_modulus"] == pytest.approx(np.median(own), abs=1e-6)
        assert told["median_residual_modulus"] < told["median_modulus"]


def test_the_model_velocity_is_that_of_its_physics(known: Outcome) -> None:
    """A first-order lag of the ideal velocity, its yaw rate over the track factor, computed here again."""
    numbers = {
        effect["id"]: next(iter(effect["parameters"].values()))["value"]
        for effect in known.summary["diagnosis"]["effects"]
    }
    slip = known.manifest.read("slip").filter(pl.col("input") == "command").drop_nulls(COLUMNS)
    checked = 0
    for part in slip.partition_by("segment"):
        times = part["t"].to_numpy()
        fine = np.arange(times[0], times[-1], 0.002)
        held = np.maximum(np.searchsorted(times, fine, side="right") - 1, 0)
        ideal = part.select("f_x", "f_w").to_numpy()[held]
        follows = np.zeros_like(ideal)
        share = 0.002 / numbers["drive_lag"]
        for index in range(1, fine.size):
            follows[index] = follows[index - 1] + share * (ideal[index - 1] - follows[index - 1])
        follows[:, 1] /= numbers["effective_track"]
        late = (times > times[0] + 2.0) & (times < times[-1])
        own = np.column_stack([np.interp(times[late], fine, column) for column in follows.T])
        told = part.select("model_x", "model_w").to_numpy()[late]
        # Commands arrive between the steps of the grid: up to one step of 0.05 s of a lag of 0.3 s.
        assert np.sqrt(np.mean((own - told) ** 2)) < 0.15 * np.sqrt(np.mean((ideal[0] - told) ** 2))
        assert np.quantile(np.abs(own - told), 0.9) < 0.04
        checked += int(late.sum())
    assert checked > 1000


def test_a_new_look_and_the_results_as_a_whole_keep_it(known: Outcome, log: Path, tmp_path: Path) -> None:
    results = next(folder for folder in known.manifest.folder.parents if (folder / "runs").is_dir())
    before = known.manifest.read("slip")
    count = before.height - before["model_x"].null_count()
    asked = "SELECT count(model_x) AS model, count(residual_modulus) AS residual FROM slip"
    told = run_verb("results", "query", asked, "--results", results, "--json")
    assert json.loads(told.stdout)["rows"] == [{"model": count, "residual": count}]

    assert run_verb("results", "stage", "slip", log, "--results", results).returncode == 0
    assert analyze(log, results).computed == ()
    assert analyze(log, results, report=True).manifest.read("slip").equals(before)

    run = known.manifest.run
    done = run_verb("export", run, "--to", "csv", "--results", results, "--file", tmp_path / "csv")
    assert done.returncode == 0
    exported = pl.read_csv(tmp_path / "csv" / "slip.csv")
    assert exported["residual_modulus [m/s]"].to_list() == before["residual_modulus"].to_list()


def test_without_a_diagnosis_there_is_no_model(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = analyze(log, tmp_path, diagnosis=False)
    assert plain.manifest.read("slip")["model_x"].null_count() == plain.manifest.read("slip").height

    diagnosed = analyze(log, tmp_path)
    assert diagnosed.computed == ("diagnosis",)
    assert (
        diagnosed.manifest.read("slip")["model_x"].null_count()
        < 0.02 * diagnosed.manifest.read("slip").height
    )
    # The generation before stays as it was.
    assert plain.manifest.read("slip")["model_x"].null_count() == plain.manifest.read("slip").height

    # A diagnosis of an older version goes, and its model with it.
    monkeypatch.setattr("pipeline.estimation.stored_diagnosis.VERSION", 10_000)
    without = analyze(log, tmp_path, diagnosis=False, report=True)
    assert "diagnosis.json" not in without.manifest.files
    assert (
        without.manifest.read("slip")["residual_modulus"].null_count() == without.manifest.read("slip").height
    )
    assert without.summary["by_input"]["command"]["median_residual_modulus"] is None


def test_a_diagnosis_of_stored_results_fills_them(known: Outcome, log: Path, tmp_path: Path) -> None:
    plain = analyze(log, tmp_path, diagnosis=False, report=True)
    told = run_verb("diagnose", plain.manifest.run, "--results", tmp_path, "--json")
    assert told.returncode == 0
    filled = Store(tmp_path).manifest(plain.manifest.run)
    assert filled is not None
    assert filled.read("slip").select(COLUMNS).equals(known.manifest.read("slip").select(COLUMNS))
    assert filled.read_json("summary.json")["by_input"] == known.summary["by_input"]
    assert {*filled.files} == {*plain.manifest.files}
    assert read_facts(filled.path("slip")) == read_facts(plain.manifest.path("slip"))
    assert run_verb("results", "verify", "--results", tmp_path).returncode == 0
    # The next look finds the answer that was kept.
    again = run_verb("diagnose", plain.manifest.run, "--results", tmp_path, "--json")
    assert json.loads(again.stdout) == json.loads(told.stdout)
    assert Store(tmp_path).manifest(plain.manifest.run) == filled
