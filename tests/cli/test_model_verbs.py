"""The model verbs: what a model is fed with, and an error that rises is said to rise."""

from __future__ import annotations

import itertools
import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from verbs import run_verb

from pipeline.cli import main
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.models import Place, list_effects
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


def test_an_effect_of_the_drivetrain_is_fitted_from_the_command(
    results: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = change(results, capsys, "add", model, "drive_lag")

    assert found["input"] == "command"
    assert found["input_reason"] == "drive_lag acts between command and wheels"
    assert found["not_fitted"] == []
    lag = found["parameters"]["drive_lag.tau"]
    assert lag["low"] <= 0.3 <= lag["high"]
    assert tomllib.loads(model.read_text())["fit"]["input"] == "command"


def test_measured_wheels_are_refused_to_it_in_one_line(
    results: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = "not fitted from wheel encoders: drive_lag acts between command and wheels (--input command)"
    change(results, capsys, "add", model, "drive_lag")
    found = change(results, capsys, "fit", model, "--input", "measured")
    assert found["input"] == "measured"
    assert found["input_reason"] == "as requested"
    assert found["not_fitted"] == ["drive_lag"]
    assert said in found["warnings"]

    slip("model", "fit", model, "--on", RUN, "--out", results, "--input", "measured")
    printed = capsys.readouterr().out.splitlines()
    assert printed.count(said) == 1
    assert f"from wheel encoders of {RUN} (as requested)" in printed


DRIVETRAIN = [
    effect.id for effect in list_effects() if effect.place <= Place.DRIVE and "differential" in effect.kinds
]


@pytest.mark.parametrize("more", [(), ("--anyway",)])
def test_an_effect_that_cannot_be_fitted_is_not_added(
    results: Path, model: Path, more: tuple[str, ...]
) -> None:
    written = model.read_bytes()
    for effect in DRIVETRAIN:
        on = ("--on", RUN, "--out", results, "--input", "measured", "--quiet")
        said = run_verb("model", "add", model, "effective_track", effect, *on, *more)
        assert said.returncode == 1
        (line,) = said.stderr.splitlines()
        assert f"{effect} acts between command and wheels (--input command); the model is unchanged" in line
        assert model.read_bytes() == written


def test_two_models_are_compared_on_one_input(
    results: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.toml"
    slip("model", "new", other, "--vehicle", "husky_a200", "--effects", "drive_lag", "--quiet")
    change(results, capsys, "fit", model, "--input", "measured")
    found = change(results, capsys, "compare", model, other)

    (own,) = (text for text in found["warnings"] if "is not a held-out error" in text)
    assert own.startswith(f"{model} was fitted to {RUN}")
    assert found["input"] == "command"
    assert len(change(results, capsys, "compare", model, model)["compared"]) == 1
    ideal = [row["ideal"] for row in found["compared"]]
    assert ideal[0] == ideal[1], "both start from the same error"


def test_a_diagnosis_says_its_input_and_why(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    slip("diagnose", RUN, "--out", results, "--json")
    run = json.loads(capsys.readouterr().out)["runs"][0]
    assert (run["input"], run["input_reason"]) == ("command", "commands are preferred where recorded")

    slip("diagnose", RUN, "--out", results, "--input", "measured")
    first = capsys.readouterr().out.splitlines()[0]
    assert first.endswith("from wheel encoders (as requested)")


def test_an_effect_that_is_no_help_is_refused_with_the_reason_and_taken_only_where_insisted(
    results: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = model.read_bytes()
    asked = ["model", "add", str(model), "slope_drift", "--on", RUN, "--results", str(results), "--quiet"]
    with pytest.raises(SystemExit) as ended:
        main(asked)
    (said,) = capsys.readouterr().err.splitlines()
    assert ended.value.code == 1
    assert "slope_drift is not supported by the data (" in said
    assert said.endswith("Choose another effect, or give --anyway.")
    assert model.read_bytes() == kept
    with pytest.raises(SystemExit) as ended:
        main([*asked, "--anyway"])
    assert ended.value.code == 0
    assert 'id = "slope_drift"' in model.read_text(encoding="utf-8")


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


def test_an_effect_that_acts_beside_another_one_alone_says_which(
    results: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["model", "add", str(model), "motor_imbalance", "--on", RUN, "--results", str(results), "--quiet"]
    with pytest.raises(SystemExit) as ended:
        main(asked)
    assert ended.value.code == 1
    said = capsys.readouterr().err
    assert "motor_imbalance is not supported by the data (it acts only beside wheel_servo)" in said
    slip("effects", "motor_imbalance")
    assert "acts beside   wheel_servo, which a model must contain" in capsys.readouterr().out
    new = model.with_name("idle.toml")
    slip("model", "new", new, "--vehicle", "husky_a200", "--effects", "motor_imbalance")
    assert "  ! motor_imbalance acts only beside wheel_servo" in capsys.readouterr().out
    slip("model", "show", new)
    assert "  ! motor_imbalance acts only beside wheel_servo" in capsys.readouterr().out
