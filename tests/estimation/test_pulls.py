"""A base that moves sideways and pulls to one side as it drives ahead is told by how much per metre."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import DiagnosisInput, diagnose_runs
from pipeline.simulate import VEHICLES, Disturbance, Scenario, simulate_run, write_log
from pipeline.sources import find_preset
from pipeline.words.diagnosis import describe

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("effect", "value", "said"),
    [
        ("yaw_pull", -0.25, "to the right per metre ahead"),
        ("lateral_pull", 0.1, "cm to the left per metre ahead"),
    ],
)
def test_a_pull_is_named_by_how_much_per_metre(effect: str, value: float, said: str, tmp_path: Path) -> None:
    scene = Scenario(
        vehicle=VEHICLES["youbot"], duration_s=100.0, seed=7, disturbance=Disturbance(0.01, 0.01)
    )
    log = tmp_path / "run.mcap"
    write_log(simulate_run(replace(scene, effects={effect: value})), log)
    manifest = analyze_log(log, Options(out=tmp_path / "out", report=False)).manifest
    vehicle = find_preset(scene.vehicle.name)
    assert vehicle is not None
    recording = DiagnosisInput(manifest.run, {name: manifest.read(name) for name in manifest.tables})
    diagnosis = diagnose_runs([recording], vehicle)
    (named,) = [one for one in diagnosis.runs[0].effects if one.id == effect]
    assert named.parameters["c"].value == pytest.approx(value, rel=0.05)
    assert said in describe(diagnosis.runs)
