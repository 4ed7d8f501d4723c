"""The noise floor against what the true model leaves, on drawn logs: no model is asked for the floor."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from game.draw import draw_riddle, write_riddle
from game.true_model import build_true

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import EstimationData, Input, fit_model, hold_out, load_recording
from pipeline.estimation.floor import estimate_floor
from pipeline.estimation.ladder import assess_model
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.models import Model, find_effect
from pipeline.simulate import simulate_case

# Random motion of its usual size and three times that, late and repeated poses, cars, fast vehicles.
_CATEGORIES = ("natural", "late", "cars", "single", "empty")
_SEEDS = (98_900, 98_901, 98_902, 98_903)
_LONGEST_S = 110.0


def _compare(category: str, seed: int, folder: Path) -> np.ndarray:
    """The floor over what the true model leaves of unseen data: x, y, w, and T and R over 2 s."""
    riddle = draw_riddle(category, seed)  # type: ignore[arg-type]
    scenario = replace(riddle.scenario, duration_s=min(riddle.scenario.duration_s, _LONGEST_S))
    log = folder / f"{category}_{seed}.mcap"
    write_riddle(replace(riddle, scenario=scenario), log)
    manifest = analyze_log(log, Options(out=folder / "out", report=False)).manifest
    vehicle, recording = read_recording(manifest)
    run = load_recording(recording, vehicle)
    data = EstimationData([run], vehicle, Input.COMMAND)
    true = build_true(riddle.answer, run.duration_s)
    left = hold_out(data, fit_model(data, Model(data.vehicle, true))).pooled
    return np.array(estimate_floor(data).ratios(left))


@pytest.mark.long
def test_the_floor_is_what_the_true_model_leaves_though_no_model_is_asked(tmp_path: Path) -> None:
    found = np.array([_compare(name, seed, tmp_path) for name in _CATEGORIES for seed in _SEEDS])
    velocity, over_2s = found[:, :3], found[:, 3:]
    assert np.abs(np.median(velocity, axis=0) - 1.0).max() < 0.1
    assert np.mean(np.abs(velocity - 1.0) < 0.2) >= 0.85
    assert np.abs(np.median(over_2s, axis=0) - 1.0).max() < 0.2
    assert np.mean(np.abs(over_2s - 1.0) < 0.3) >= 0.85


def _measure_floor(effects: dict[str, dict[str, float]], folder: Path) -> float:
    """The floor in heading [rad] of a run, judged with the model that has these effects."""
    log = simulate_case("ideal_husky", effects, out=folder / "log.mcap", duration_s=180.0, seed=1)
    options = Options(out=folder / "out", report=False, diagnosis=False)
    vehicle, recording = read_recording(analyze_log(log, options).manifest)
    data = EstimationData([load_recording(recording, vehicle)], vehicle, Input.COMMAND)
    model = Model(data.vehicle, tuple(find_effect(name)() for name in effects))
    return assess_model(data, model).floor.r_mrmse_rad


@pytest.mark.long
def test_a_ground_that_changes_half_way_does_not_change_the_noise_floor(tmp_path: Path) -> None:
    """Of a model that has the change: the ideal model leaves it, and takes it for noise."""
    empty = _measure_floor({}, tmp_path / "empty")
    change = {"terrain_change": {"k_v": 1.0, "k_w": 0.6, "at_s": 60.0}}
    assert _measure_floor(change, tmp_path / "change") == pytest.approx(empty, rel=0.15)
