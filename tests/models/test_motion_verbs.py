from __future__ import annotations

import json
import tomllib
from typing import TYPE_CHECKING

import pytest
from verbs import run_program, run_verb

from pipeline.simulate import simulate_case

if TYPE_CHECKING:
    from pathlib import Path
    from subprocess import CompletedProcess


def run_slip(*arguments: object, check: bool = True) -> CompletedProcess[str]:
    done = run_verb(*arguments)
    assert not check or done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("verbs")
    for seed in (1, 2):
        simulate_case("husky_tile", out=made / f"tile{seed}.mcap", seed=seed, duration_s=90.0)
    return made


def test_the_catalogue_and_a_page_are_printed() -> None:
    listed = run_slip("effects").stdout
    assert "lateral_skid" in listed
    page = run_slip("effects", "lateral_skid").stdout
    assert "v_y += -c * v0 * w0" in page
    assert "Source: " in page
    wrong = run_slip("effects", "lateral_skit", check=False)
    assert wrong.returncode == 1
    assert "lateral_skid" in wrong.stderr
    assert len(wrong.stderr.splitlines()) == 1
    assert json.loads(run_program("effects", "--json").stdout)["effects"][0]["id"]


def test_a_model_is_made_grown_asked_about_another_run_and_exported(folder: Path) -> None:
    model, out = folder / "husky.toml", folder / "results"
    assert run_program("model", "new", model, "--vehicle", "husky_a200").returncode == 0
    on = ["--on", folder / "tile1.mcap", "--out", out, "--input", "measured"]
    grown = json.loads(
        run_slip("model", "add", model, "effective_track", "lateral_drift", *on, "--anyway", "--json").stdout
    )
    assert [rung["effects"] for rung in grown["ladder_before"]] == [[]]
    assert grown["ladder"][1]["effects"] == ["effective_track"]
    assert grown["ladder"][1]["t_mrmse_m"] < grown["ladder"][0]["t_mrmse_m"]
    assert {"velocity_rms", "t_mrmse_m", "r_mrmse_rad"} <= set(grown["noise_floor"])
    track = grown["parameters"]["effective_track.k"]
    assert track["low"] < 1.8 < track["high"]
    assert track["unit"] == "1"

    written = tomllib.loads(model.read_text(encoding="utf-8"))
    assert written["effect"][0]["k"]["value"] == pytest.approx(track["value"], rel=1e-4)
    assert len(written["fit"]["runs"][0]["sha256"]) == 64

    run_slip("model", "add", model, "drive_lag", *on[:-1], "command", "--anyway")
    asleep = run_slip("model", "fit", model, *on)
    said = "not fitted from wheel encoders: drive_lag acts between command and wheels (--input command)"
    assert f"slip: {said}" in asleep.stderr.splitlines()
    run_slip("model", "remove", model, "drive_lag", *on)

    dropped = run_slip("model", "drop", model, "lateral_drift", *on)
    assert "before" in dropped.stdout
    floors = [line for line in dropped.stdout.splitlines() if line.startswith("noise floor")]
    assert len(floors) == 2
    assert floors[0] == floors[1]

    carried = json.loads(
        run_slip("model", "fit", model, *on, "--predict", folder / "tile2.mcap", "--json").stdout
    )
    assert carried["carried_over"][0]["ratio"] < 1.1
    assert carried["warnings"] == []

    other = folder / "other.toml"
    run_slip("model", "new", other, "--vehicle", "husky_a200", "--effects", "effective_track")
    on_two = ["--on", folder / "tile2.mcap", "--out", out, "--input", "measured"]
    compared = json.loads(run_slip("model", "compare", model, other, *on_two, "--json").stdout)
    assert [row["model"] for row in compared["compared"]] == [str(model), str(other)]
    assert compared["compared"][1]["warning"]

    assert "wheel_separation_multiplier" in run_slip("model", "export", model, "--to", "ros2_control").stdout

    # The covariance on another log is that of a fit to it, and the model's file stays.
    export = ("model", "export", model, "--to", "robot_localization")
    of_two = run_slip(*export, "--on", folder / "tile2.mcap", "--results", out).stdout
    assert "tile2" in of_two
    assert "tile1" in run_slip(*export).stdout
    run_slip("model", "fit", model, *on_two)
    assert run_slip(*export).stdout == of_two
    refused = run_slip("model", "export", model, "--to", "nav2", "--on", folder / "tile2.mcap", check=False)
    assert refused.returncode == 1
    assert refused.stderr.startswith("slip: --on: nav2 contains no held-out errors")
    assert "effective_track" in run_slip("model", "show", model).stdout


def test_errors_are_one_line_with_the_line_of_the_file(tmp_path: Path) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text(
        '[vehicle]\npreset = "husky_a200"\n[[effect]]\nid = "effective_track"\nk = 99\n', encoding="utf-8"
    )
    done = run_slip("model", "show", bad, check=False)
    assert done.returncode == 1
    assert f"{bad}:5" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    missing = run_slip("model", "fit", bad.with_name("good.toml"), "--on", "nowhere", check=False)
    assert missing.returncode == 1
    exists = run_slip("model", "new", bad, "--vehicle", "husky_a200", check=False)
    assert exists.returncode == 1
    assert "--force" in exists.stderr
