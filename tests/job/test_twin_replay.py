"""A log's commands replayed through a twin: as good as its model, and what it lacks is said with its cost."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from verbs import run_verb

from pipeline.export import export_model
from pipeline.export.twin_body import build_twin_body
from pipeline.job import Options, twin_replay
from pipeline.job.analyze import analyze_log
from pipeline.job.run_results import load_vehicle
from pipeline.job.stored_fits import read_runs
from pipeline.job.twin_replay import LEAST_REPRODUCED, TwinGround, make_twin_effects, replay_twin
from pipeline.models import Model, ModelFile, find_effect, write_model
from pipeline.report.motion_view import load_motion_run
from pipeline.run import MotionError
from pipeline.simulate import simulate_case

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from pipeline.store import Manifest

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")

HIDDEN = {"effective_track": 1.8, "drive_lag": 0.3, "transport_delay": 0.1}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("twin")
    simulate_case(None, {**HIDDEN, "speed_slip": 0.15}, out=place / "run.mcap", duration_s=30.0)
    return place


@pytest.fixture(scope="module")
def manifest(folder: Path) -> Manifest:
    options = Options(out=folder / "results", report=False)
    return analyze_log(folder / "run.mcap", options).manifest


def make_file(manifest: Manifest, sizes: Mapping[str, float], **fit: object) -> ModelFile:
    effects = [find_effect(name)() for name in sizes]
    made = [e.change(**{e.parameters[0].name: sizes[e.id]}) for e in effects]
    return ModelFile(Model(load_vehicle(manifest), tuple(made)), fit=fit)


ALL = {**HIDDEN, "speed_slip": 0.15}
OF_ANOTHER = {"runs": [{"run": "another", "sha256": "0"}]}


def test_a_twin_is_as_good_as_its_model_but_for_what_contact_cannot_do(manifest: Manifest) -> None:
    file = make_file(manifest, ALL, **OF_ANOTHER)
    _, (run,) = read_runs([manifest], file.model.vehicle, None)
    found = replay_twin(file, run)
    errors = {side: error.t_mrmse_m for side, error in found.errors.items()}
    (missing,) = found.missing
    assert not found.is_seen
    assert missing.effect == "speed_slip"
    assert errors["model"] < 0.005 < missing.t_mrmse_m
    # All that the twin lacks is this effect.
    assert errors["twin"] == pytest.approx(missing.t_mrmse_m, rel=0.15)
    assert errors["twin"] < 0.5 * errors["ideal"]


def test_a_log_that_the_model_was_fitted_to_is_judged_without_the_stretch_it_is_judged_on(
    manifest: Manifest,
) -> None:
    file = make_file(manifest, dict.fromkeys(ALL, 0.2) | {"effective_track": 1.5})
    _, (run,) = read_runs([manifest], file.model.vehicle, None)
    found = replay_twin(file, run)
    assert found.is_seen
    assert found.model.effect("effective_track").values["k"] == pytest.approx(1.8, rel=0.02)
    assert found.errors["model"].t_mrmse_m < 0.01
    assert found.reproduced < 1.0


def test_a_run_without_commands_is_one_clear_error(manifest: Manifest) -> None:
    file = make_file(manifest, HIDDEN)
    run = load_motion_run(manifest, file.model.vehicle)
    with pytest.raises(MotionError, match="no commands"):
        replay_twin(file, replace(run, commands=None))


def test_driving_a_part_of_a_run_gives_what_driving_all_of_it_gives_there(manifest: Manifest) -> None:
    from pipeline.estimation.comparison import Comparison, Input  # noqa: PLC0415 - heavy
    from pipeline.models import Timing  # noqa: PLC0415

    file = make_file(manifest, HIDDEN)
    run = load_motion_run(manifest, file.model.vehicle)
    comparison = Comparison(run, file.model.vehicle, Input.COMMAND)
    body = build_twin_body(file.model)
    wanted = np.zeros(comparison.grid.times.size, dtype=bool)
    wanted[600:700] = True
    whole = comparison.predict_velocity(make_twin_effects(body), Timing())
    part = comparison.predict_velocity(make_twin_effects(body, wanted), Timing())
    assert part.x[600:700] == pytest.approx(whole.x[600:700], abs=5e-3)
    assert part.w[600:700] == pytest.approx(whole.w[600:700], abs=5e-3)
    assert not part.x[:500].any()
    assert whole.x[:500].any()
    assert TwinGround(body).values == {}


def test_the_verb_prints_the_table_says_what_is_missing_and_writes_the_page(
    folder: Path, manifest: Manifest
) -> None:
    model = folder / "husky.toml"
    write_model(make_file(manifest, ALL, input="command", **OF_ANOTHER), model)
    page = folder / "twin.html"
    results = ("--results", folder / "results")
    done = run_verb("simulate", folder / "run.mcap", "--twin", model, "--page", page, *results)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert [line.split("  ")[0] for line in lines if line.endswith("deg")] == [
        "ideal model",
        "kinematic model",
        "twin in MuJoCo",
    ]
    assert any(line.startswith("Contact of wheels cannot reproduce speed_slip: ") for line in lines)
    text = page.read_text("utf-8")
    assert "Twin beside the robot" in text
    assert '"twin_twin"' in text
    assert "http://" not in text.replace("http://www.w3.org", "")
    told = json.loads(run_verb("simulate", folder / "run.mcap", "--twin", model, *results, "--json").stdout)
    assert told["missing"][0]["effect"] == "speed_slip"
    assert set(told["errors"]) == {"ideal", "model", "twin"}
    assert told["reproduced"] == pytest.approx(
        (told["errors"]["ideal"]["t_mrmse_m"] - told["errors"]["twin"]["t_mrmse_m"])
        / (told["errors"]["ideal"]["t_mrmse_m"] - told["errors"]["model"]["t_mrmse_m"])
    )
    assert LEAST_REPRODUCED < 1.0


@pytest.mark.parametrize(
    ("name", "value", "code"),
    [("write_world", lambda _: "<mujoco old='1'/>", "mujoco_old"),
     ("_differentiate", lambda *_: (np.nan, 0.0, 0.0), "twin_unstable")],
)  # fmt: skip
def test_what_mujoco_cannot_read_or_compute_is_one_clear_error(
    manifest: Manifest, monkeypatch: pytest.MonkeyPatch, name: str, value: object, code: str
) -> None:
    file = make_file(manifest, HIDDEN, **OF_ANOTHER)
    run = load_motion_run(manifest, file.model.vehicle)
    monkeypatch.setattr(twin_replay, name, value)
    with pytest.raises(MotionError) as error:
        replay_twin(file, run)
    assert error.value.code == code
    assert "\n" not in str(error.value)


def test_a_body_that_slides_begins_predictions_with_the_velocity_it_was_seen_at(manifest: Manifest) -> None:
    """Its wheels do not say how it moves: from standstill it would lose most of two seconds."""
    file = make_file(manifest, {"effective_track": 1.8, "body_inertia": 0.3}, **OF_ANOTHER)
    run = load_motion_run(manifest, file.model.vehicle)
    errors = replay_twin(file, run).errors
    assert errors["twin"].t_mrmse_m == pytest.approx(errors["model"].t_mrmse_m, rel=0.1)


@pytest.mark.long
def test_wheels_that_slide_have_the_friction_of_the_model(tmp_path: Path) -> None:
    ice = {"friction": 0.1, "creep": 0.5, "k": 1.65, "gyration": 0.9}
    simulate_case(
        None, {"contact_friction": ice}, out=tmp_path / "ice.mcap", duration_s=60.0, vehicle="warthog"
    )
    manifest = analyze_log(tmp_path / "ice.mcap", Options(out=tmp_path / "results", report=False)).manifest
    vehicle = load_vehicle(manifest)
    _, (run,) = read_runs([manifest], vehicle, None)
    file = ModelFile(Model(vehicle, (find_effect("contact_friction")().change(**ice),)), fit=OF_ANOTHER)
    replayed = replay_twin(file, run)
    assert replayed.missing == ()
    assert replayed.errors["twin"].t_mrmse_m < 0.05 * replayed.errors["ideal"].t_mrmse_m
    body = build_twin_body(file.model)
    assert (body.grip, body.slides) == (0.1, True)
    assert body.turning_inertia_kgm2 == pytest.approx(body.mass_kg * (0.45 * body.track_m) ** 2)
    assert (body.wheelbase_m / body.track_m) ** 2 == pytest.approx(0.65)
    for target, friction in (("mjcf", 'friction="0.1 '), ("sdf", "<mu>0.1</mu>")):
        written = export_model(file, target)
        assert written.count(friction) == len(body.wheels)
        assert "slide above a friction coefficient of 0.1" in written


def test_a_model_without_a_log_is_one_clear_error(folder: Path, manifest: Manifest) -> None:
    model = folder / "alone.toml"
    write_model(make_file(manifest, HIDDEN), model)
    refused = run_verb("simulate", "--twin", model)
    assert refused.returncode == 1
    assert "no log is named" in refused.stderr
