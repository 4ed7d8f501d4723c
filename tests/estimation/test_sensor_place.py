"""A point that lies outside the vehicle is where the sensor stands, not what the vehicle turns about."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import diagnose_runs
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.simulate import VEHICLES, Scenario, simulate_run, write_log

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.long
@pytest.mark.parametrize(
    ("hidden", "name", "parameter", "value"),
    [
        ({"lever_arm": {"l_x": 0.9, "l_y": 0.0}}, "lever_arm", "l_x", 0.9),
        ({"lever_arm": {"l_x": -0.9, "l_y": 0.0}}, "lever_arm", "l_x", -0.9),
        ({"icr_offset": 0.15}, "icr_offset", "x_icr", 0.15),
    ],
)
def test_a_lever_longer_than_the_wheelbase_is_the_sensors(
    hidden: dict[str, object], name: str, parameter: str, value: float, tmp_path: Path
) -> None:
    scenario = Scenario(vehicle=VEHICLES["husky"], effects=hidden, duration_s=60.0, seed=5)
    write_log(simulate_run(scenario), tmp_path / "run.mcap")
    options = Options(out=tmp_path / "out", report=False, diagnosis=False)
    vehicle, recording = read_recording(analyze_log(tmp_path / "run.mcap", options).manifest)
    (told,) = diagnose_runs([recording], vehicle, inputs=("command",)).runs
    assert [effect.id for effect in told.effects] == [name]
    assert told.effects[0].parameters[parameter].value == pytest.approx(value, rel=0.02)
    assert told.effects[0].parameters[parameter].high > value
