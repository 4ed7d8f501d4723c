"""What the body does of the wheels' motion by itself is named alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import diagnose_runs
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.models import find_effect
from pipeline.models.parameter import Conditions, Largest
from pipeline.simulate import VEHICLES, Disturbance, Scenario, simulate_run, write_log

if TYPE_CHECKING:
    from pathlib import Path


def test_a_yaw_that_swings_after_the_wheels_stand_is_the_torsion_of_tyres(tmp_path: Path) -> None:
    """It is named beside a lag of the drive, which makes the wheels late and not the body."""
    hidden = {"tyre_torsion": {"tau": 0.12, "damping": 0.2}, "drive_lag": {"tau": 0.3}}
    scenario = Scenario(
        vehicle=VEHICLES["husky"],
        effects=hidden,
        duration_s=90.0,
        seed=3,
        disturbance=Disturbance(0.02, 0.02),
    )
    write_log(simulate_run(scenario), tmp_path / "run.mcap")
    options = Options(out=tmp_path / "out", report=False, diagnosis=False)
    vehicle, recording = read_recording(analyze_log(tmp_path / "run.mcap", options).manifest)
    (told,) = diagnose_runs([recording], vehicle).runs
    found = {
        effect.id: {name: number.value for name, number in effect.parameters.items()}
        for effect in told.effects
    }
    assert found.keys() == hidden.keys()
    assert found["tyre_torsion"] == pytest.approx(hidden["tyre_torsion"], rel=0.05)


def test_without_encoders_or_a_swing_there_is_no_torsion_of_tyres() -> None:
    effect = find_effect("tyre_torsion")
    largest = Largest(1.0, 1.0, 5.0, 3.0, np.linspace(0.0, 60.0, 11))
    assert effect is not None
    assert effect().can_show(Conditions(largest, encoders=True))
    assert not effect().can_show(Conditions(largest))
    assert effect().change(tau=0.1, damping=0.9).is_degenerate(Conditions(largest, encoders=True))
    assert not effect().change(tau=0.1, damping=0.2).is_degenerate(Conditions(largest, encoders=True))
