"""An effect whose numbers are open leaves the model only where no error over 2 s doubles without it."""

from __future__ import annotations

import pytest
from motion_runs import simulate, vehicle_of

from pipeline.estimation import Input, Problem
from pipeline.estimation.conclude import _is_needed
from pipeline.estimation.ladder import Judgement, judge_model
from pipeline.models import Model, find_effect

HUSKY = vehicle_of("husky_a200")


@pytest.fixture(scope="module")
def judgement() -> Judgement:
    run = simulate({"turn_lag": {"tau_mean": 0.2, "tau_diff": 2.0}, "wheel_asymmetry": 0.01}, duration_s=60.0)
    names = ("turn_lag", "effective_track", "wheel_asymmetry")
    return judge_model(
        Problem([run], HUSKY, Input.COMMAND), Model(HUSKY, tuple(find_effect(name)() for name in names))
    )


@pytest.mark.parametrize(("name", "is_needed"), [("turn_lag", True), ("wheel_asymmetry", False)])
def test_an_effect_that_halves_an_error_is_kept(judgement: Judgement, name: str, is_needed: bool) -> None:  # noqa: FBT001
    assert _is_needed({"id": "insignificant_effect", "where": name}, judgement) is is_needed


def test_an_effect_that_no_vehicle_shows_is_not_kept_by_what_it_explains(judgement: Judgement) -> None:
    assert not _is_needed({"id": "implausible_effect", "where": "turn_lag"}, judgement)
    assert not _is_needed({"id": "insignificant_effect", "where": "turn_lag"}, None)
