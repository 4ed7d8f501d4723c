"""A pose measured beside the axle of a car is told on both axes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import DiagnosisInput, diagnose_runs
from pipeline.simulate import VEHICLES, Disturbance, Program, Scenario, simulate_run, write_log
from pipeline.sources import find_preset

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(("ahead", "left"), [(0.4, 1.0), (-0.6, -1.2)])
def test_a_lever_beside_a_cars_axle_is_told_on_both_axes(ahead: float, left: float, tmp_path: Path) -> None:
    scene = Scenario(
        vehicle=VEHICLES["car"],
        duration_s=100.0,
        seed=7,
        program=Program(speed_scale=0.5),
        disturbance=Disturbance(0.01, 0.005),
        effects={"icr_offset": -ahead, "icr_lateral": -left},
    )
    log = tmp_path / "run.mcap"
    write_log(simulate_run(scene), log)
    manifest = analyze_log(log, Options(out=tmp_path / "out", report=False)).manifest
    vehicle = find_preset(scene.vehicle.name)
    assert vehicle is not None
    recording = DiagnosisInput(manifest.run, {name: manifest.read(name) for name in manifest.tables})
    diagnosis = diagnose_runs([recording], vehicle, inputs=("command",))
    (lever,) = [one for one in diagnosis.runs[0].effects if one.id == "lever_arm"]
    assert lever.parameters["l_x"].value == pytest.approx(ahead, abs=0.05)
    assert lever.parameters["l_y"].value == pytest.approx(left, abs=0.05)
