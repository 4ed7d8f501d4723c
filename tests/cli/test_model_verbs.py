"""The model verbs: what a model is fed with, and an error that rises is said to rise."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import pytest

from pipeline.cli import main
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.simulate import simulate_case

RUN = "field/lagging"
ERRORS = ("t_mrmse_m", "r_mrmse_rad")


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a Husky whose wheels lag behind its commands."""
    folder = tmp_path_factory.mktemp("lagging")
    log = folder / "field" / "lagging.mcap"
    simulate_case("ideal_husky", {"drive_lag": {"tau": 0.3}}, out=log, duration_s=40.0)
    analyze_log(log, Options(out=folder / "results", report=False))
    return folder / "results"


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "husky.toml"
    slip("model", "new", path, "--vehicle", "husky_a200", "--quiet")
    return path


def slip(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    assert ended.value.code == 0
    return 0


def change(
    results: Path, capsys: pytest.CaptureFixture[str], verb: str, model: Path, *more: object
) -> dict[str, Any]:
    capsys.readouterr()
    slip("model", verb, model, *more, "--on", RUN, "--out", results, "--json")
    content: dict[str, Any] = json.loads(capsys.readouterr().out)
    return content


def test_an_error_that_rises_is_said_and_not_taken_unless_asked_for(
    results: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change(results, capsys, "add", model, "drive_lag")
    useless = ("slope_drift", "lateral_skid", "heading_skew", "turn_lag")
    kept = model.read_bytes()
    with pytest.raises(SystemExit) as ended:
        main(["model", "add", str(model), *useless, "--on", RUN, "--out", str(results), "--quiet"])
    assert ended.value.code == 1
    said = capsys.readouterr().err
    assert "are not supported by the data (" in said
    assert "--anyway" in said
    assert model.read_bytes() == kept

    found = change(results, capsys, "add", model, *useless, "--anyway")
    step = found["step"]
    assert step["rises"] == [key for key in ERRORS if step[key][1] > 1.001 * step[key][0]]
    assert step["rises"], "four effects that the vehicle lacks, fitted to 40 s, cost something on unseen data"
    assert set(useless) < set(found["ladder"][-1]["effects"]), "the ladder ends at the model itself"
    for below, rung in itertools.pairwise(found["ladder"]):
        assert rung.get("rises", []) == [key for key in ERRORS if rung[key] > 1.001 * below[key]]

    slip("model", "drop", model, "drive_lag", "turn_lag", "--on", RUN, "--out", results)
    printed = capsys.readouterr().out
    assert "  ! position error rises by " in printed
    assert ": changed as requested" in printed
