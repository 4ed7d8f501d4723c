"""What the data prove is said, also where no vehicle did so before: as unusual."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import DiagnosisInput, diagnose_runs
from pipeline.estimation.plausibility import is_nameable, is_possible
from pipeline.models import find_effect
from pipeline.models.parameter import Conditions, Largest
from pipeline.simulate import Disturbance, PoseSensor, Scenario, simulate_run, write_log
from pipeline.sources import find_preset
from pipeline.words import format_finding

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.estimation.fit import PathFit

_SCENE = Scenario(
    duration_s=100.0, seed=7, disturbance=Disturbance(0.01, 0.01), pose=PoseSensor(drift_m=0.003)
)
_CONDITIONS = Conditions(Largest(1.0, 1.0, 8.0, 3.0, np.linspace(0.0, 120.0, 11)))


@pytest.mark.parametrize(
    ("effect", "number", "value"),
    [("effective_track", "k", 0.5), ("effective_track", "k", 6.0)],
)
def test_a_value_beyond_what_was_seen_is_named_and_called_unusual(
    effect: str, number: str, value: float, tmp_path: Path
) -> None:
    scene = replace(_SCENE, effects={effect: value})
    log = tmp_path / "run.mcap"
    write_log(simulate_run(scene), log)
    manifest = analyze_log(log, Options(out=tmp_path / "out", report=False)).manifest
    vehicle = find_preset(scene.vehicle.name)
    assert vehicle is not None
    recording = DiagnosisInput(manifest.run, {name: manifest.read(name) for name in manifest.tables})
    (run,) = diagnose_runs([recording], vehicle, inputs=("measured",)).runs
    named = {one.id: one for one in run.effects}
    assert named[effect].parameters[number].value == pytest.approx(value, rel=0.05)
    (unusual,) = [one for one in run.findings if one.id == "unusual_value"]
    assert unusual.where == effect
    assert "unusual" in format_finding(unusual)


def test_what_is_not_proven_beyond_what_was_seen_is_not_possible() -> None:
    effect = find_effect("effective_track")(k=0.5)
    assert not is_nameable(effect, _CONDITIONS)
    number = SimpleNamespace(effect=effect.id, name="k", is_smooth=True)
    for error, possible in ((0.009, True), (0.011, False)):
        fit = cast("PathFit", SimpleNamespace(free=(number,), covariance=np.array([[error**2]])))
        assert is_possible(fit, effect, _CONDITIONS) is possible
    sure = cast("PathFit", SimpleNamespace(free=(number,), covariance=np.array([[1e-12]])))
    low, _ = effect.parameter("k").bounds
    assert not is_possible(sure, effect.change(k=low), _CONDITIONS)
