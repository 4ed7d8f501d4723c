"""What is said where no effect is named: that nothing is missing is said only of what shows it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from drawn_diagnoses import FLOOR, draw_diagnosis
from test_diagnosis import _SCENE, _diagnose

from pipeline.simulate import VEHICLES
from pipeline.words.diagnosis import describe
from pipeline.words.errors import describe_rest, describe_structure
from pipeline.words.objects import diagnosis_as_json
from pipeline.words.verdict import NOTHING_MISSING, format_verdict

_HUSKY = replace(_SCENE, vehicle=VEHICLES["husky"])
_CLAIMS = (
    NOTHING_MISSING,
    "not depend on any recorded signal",
    "no term that was tried predicts",
)


def test_a_run_of_18_s_is_too_short_to_tell(tmp_path: Path) -> None:
    diagnosis = _diagnose(replace(_HUSKY, duration_s=18.0), tmp_path)
    assert not diagnosis.runs[0].effects
    screen = describe(diagnosis.runs)
    assert "The run is too short to determine the cause." in screen
    assert not any(claim in screen for claim in _CLAIMS)


def test_a_run_that_is_long_enough_may_miss_nothing(tmp_path: Path) -> None:
    diagnosis = _diagnose(_HUSKY, tmp_path)
    assert NOTHING_MISSING in describe(diagnosis.runs)
    assert diagnosis.runs[0].concentrated is None
    assert "not depend on any recorded signal" in describe_rest(diagnosis.runs[0])


@pytest.mark.parametrize(("excess", "said"), [(1.1, NOTHING_MISSING), (1.4, "No effect is evident")])
def test_above_the_floor_nobody_knows_that_nothing_is_missing(excess: float, said: str) -> None:
    diagnosis = draw_diagnosis({}, [(FLOOR["t_mrmse_m"], excess * FLOOR["r_mrmse_rad"])])
    assert format_verdict(diagnosis).endswith(f"{said}.")


def test_an_error_that_a_wet_patch_makes_is_told_by_where_it_is(tmp_path: Path) -> None:
    # Nearly all turning within the patch is driven in the first fifth of the run.
    patch = {"terrain_change": {"k_v": 0.85, "k_w": 0.6, "at_x": -1.5}}
    diagnosis = _diagnose(replace(_HUSKY, effects=patch, duration_s=150.0), tmp_path)
    (run,) = diagnosis.runs
    assert run.unexplained is not None
    assert "from 0 to 30 s (20 % of the time): 90 % of the yaw error" in describe_structure(run.unexplained)
    assert describe_structure(run.unexplained) in describe(diagnosis.runs)
    assert not any(claim in f"{describe(diagnosis.runs)} {diagnosis_as_json(run)}" for claim in _CLAIMS)
