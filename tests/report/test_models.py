"""Figures of models: what they show of a prediction, and of a step of a command."""

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import EstimationData, Input, ModelState, RunResiduals
from pipeline.estimation.prediction import predict_at_from
from pipeline.models import Model, Timing, find_effect
from pipeline.report.figures.slip_figures import list_responses
from pipeline.report.motion_view import MotionStage
from pipeline.report.scene import RunReport, Scene
from pipeline.run import load_run
from pipeline.simulate import simulate_case
from pipeline.sources import Vehicle, find_preset


def vehicle() -> Vehicle:
    found = find_preset("husky_a200")
    assert found is not None
    return found


def test_a_view_shows_what_a_prediction_says(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("view")
    log = simulate_case("husky_tile", out=folder / "run.mcap", duration_s=40.0)
    manifest = analyze_log(log, Options(out=folder / "results", report=False)).manifest
    tables = {
        name: manifest.read(name) for name in ("poses", "alignments", "commands", "wheels", "imu", "slip")
    }
    run = load_run(tables, vehicle(), name="run")
    model = Model(vehicle(), (find_effect("effective_track")(k=1.7),))
    places = manifest.read("velocities").select("t", "x", "y")
    data = EstimationData([run], vehicle(), Input.COMMAND)
    view = MotionStage(data, places).view(ModelState(model.effects, (Timing(),)), (), None)

    shown = view.velocity.sort("t")
    at = shown["t"].to_numpy()
    expected = predict_at_from(data.residuals_by_run[0], model.effects, Timing(), at)
    assert np.allclose(shown["v_w"], expected[:, 2], atol=1e-9)
    # The data's run is anchored, see `MotionRun.anchored`.
    recorded = predict_at_from(RunResiduals(run, vehicle(), Input.COMMAND), model.effects, Timing(), at)
    assert np.allclose(expected, recorded, atol=1e-4, equal_nan=True)
    starts = view.arcs.group_by("piece", maintain_order=True).first()
    for axis in "xy":
        at = np.interp(starts["t"], places["t"], places[axis])
        assert np.allclose(starts[axis], at, atol=1e-6)


def test_a_vehicle_that_follows_at_once_does_the_whole_step(tmp_path: Path) -> None:
    """Smoothed velocities hold half of a step already where it begins."""
    log = simulate_case("ideal_husky", out=tmp_path / "run.mcap", duration_s=90.0)
    manifest = analyze_log(log, Options(out=tmp_path / "results", report=False, diagnosis=False)).manifest
    rows = list_responses(Scene(RunReport({}, {"slip": manifest.read("slip")})))
    assert rows
    for name, response in rows.items():
        measured = response.filter(pl.col("series") == "velocity", pl.col("t").is_between(0.5, 2.5))
        assert measured["value"].to_numpy() == pytest.approx(1.0, abs=0.05), name
