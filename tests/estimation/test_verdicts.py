"""What is said where no effect is named: that nothing is missing is said only of what shows it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_diagnosis import _SCENE, _diagnose

from pipeline.estimation.acceptance import NotSignificant
from pipeline.estimation.conclude import _find_lead
from pipeline.estimation.diagnosis_lines import describe
from pipeline.estimation.verdict import NOTHING_MISSING
from pipeline.models import find_effect
from pipeline.simulate import VEHICLES

_HUSKY = replace(_SCENE, vehicle=VEHICLES["husky"])
_CLAIMS = (
    NOTHING_MISSING,
    "not depend on any recorded signal",
    "no term that was tried predicts",
)


def test_a_run_of_18_s_is_too_short_to_tell(tmp_path: Path) -> None:
    diagnosis = _diagnose(replace(_HUSKY, duration_s=18.0), tmp_path)
    assert not diagnosis.runs[0].effects
    screen = describe(diagnosis)
    assert "The run is too short to determine the cause." in screen
    assert not any(claim in screen for claim in _CLAIMS)


def test_a_run_that_is_long_enough_may_miss_nothing(tmp_path: Path) -> None:
    diagnosis = _diagnose(_HUSKY, tmp_path)
    assert NOTHING_MISSING in describe(diagnosis)
    assert diagnosis.runs[0].lead == ""
    assert "not depend on any recorded signal" in str(diagnosis.runs[0].disturbance["text"])


def test_an_error_that_a_wet_patch_makes_is_told_by_where_it_is(tmp_path: Path) -> None:
    # Nearly all turning within the patch is driven in the first fifth of the run.
    patch = {"terrain_change": {"k_v": 0.85, "k_w": 0.6, "at_x": -1.5}}
    diagnosis = _diagnose(replace(_HUSKY, effects=patch, duration_s=150.0), tmp_path)
    (run,) = diagnosis.runs
    assert run.unexplained is not None
    assert "from 0 to 30 s: 90 % of the yaw error in 20 % of the time" in run.unexplained.where
    assert run.unexplained.where in describe(diagnosis)
    assert not any(claim in f"{describe(diagnosis)} {run.to_json()}" for claim in _CLAIMS)


@pytest.mark.parametrize(
    ("error", "gain", "is_told"), [(0.2, 0.12, True), (0.14, 0.12, False), (0.2, 0.08, False)]
)
def test_an_effect_that_is_not_significant_is_told_where_the_error_is_far_above_the_floor(
    monkeypatch: pytest.MonkeyPatch, error: float, gain: float, *, is_told: bool
) -> None:
    monkeypatch.setattr("pipeline.estimation.conclude.find_main_region", lambda *_: None)
    monkeypatch.setattr("pipeline.estimation.conclude.find_places", lambda _: np.zeros((3, 2)))
    part = SimpleNamespace(comparisons=[None])
    search = SimpleNamespace(selection=SimpleNamespace(part=part), final=SimpleNamespace(held=None))
    declined = [NotSignificant(find_effect("lateral_skid")(c=0.1), share, 0.8) for share in (0.02, gain)]
    ways = [SimpleNamespace(search=search, not_significant=declined)]
    judgement = SimpleNamespace(
        whole=SimpleNamespace(errors=SimpleNamespace(t_mrmse_m=error)), floor=SimpleNamespace(t_mrmse_m=0.1)
    )
    lead = _find_lead(ways, judgement)  # type: ignore[arg-type]
    assert ("lateral_skid would remove 12 %" in lead) == is_told
    assert bool(lead) == is_told
    assert _find_lead(ways, None) == ""  # type: ignore[arg-type]
