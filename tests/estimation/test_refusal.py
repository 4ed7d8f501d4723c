"""What would be accepted next in a model, and why an addition would not be: by the judge of the search."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from motion_runs import simulate, vehicle_of

from pipeline.estimation import EstimationData, Input, decision
from pipeline.estimation.additions import Tries, explain_refusals
from pipeline.estimation.ladder import judge_whole
from pipeline.models import Model, find_effect
from pipeline.simulate import Disturbance, Program

if TYPE_CHECKING:
    from pipeline.models import Effect

HUSKY = vehicle_of("husky_a200")


@pytest.fixture(scope="module")
def data() -> EstimationData:
    """A drive by hand with a wide track and a lag."""
    hidden = {"effective_track": 1.4, "drive_lag": 0.3}
    run = simulate(hidden, duration_s=100.0, program=Program("teleop"), disturbance=Disturbance(0.02, 0.03))
    return EstimationData([run], HUSKY, Input.COMMAND)


def explain(data: EstimationData, *effects: Effect) -> dict[str, str]:
    step = judge_whole(data, Model(HUSKY, effects))
    return explain_refusals(step, step.effects)


def test_what_is_there_is_accepted_and_what_is_not_is_refused(data: EstimationData) -> None:
    track, lag = find_effect("effective_track")(k=1.4), find_effect("drive_lag")(tau=0.3)
    assert explain(data, track, lag) == {}
    refused = explain(data, track, lag, find_effect("wheel_radius")(k=1.05))
    assert list(refused) == ["wheel_radius"]
    assert "required 5" in refused["wheel_radius"]


def test_a_fall_that_is_too_small_says_of_which_error(
    data: EstimationData, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(decision, "SHOWN", 1.0)
    refused = explain(data, find_effect("effective_track")(k=1.4), find_effect("drive_lag")(tau=0.3))
    for name, target in {"effective_track": "the poses", "drive_lag": "the measured wheels"}.items():
        assert refused[name].startswith(f"no error against {target} falls by more than ")


@pytest.mark.parametrize(
    ("effect", "values", "reason"),
    [
        ("turning_resistance", {"k": -0.02}, "k = -0.02 s is not possible: it must be above 0 s"),
        ("side_lag", {"tau_left": 0.3, "tau_right": 0.3}, "with these values it acts as drive_lag"),
    ],
)
def test_values_that_are_held_and_cannot_be_are_told(
    data: EstimationData, effect: str, values: dict[str, float], reason: str
) -> None:
    held = find_effect(effect)(**values).fix(*values)
    track = find_effect("effective_track")(k=1.4)
    assert explain(data, track, held)[effect].startswith(reason)


def test_after_the_last_accepted_effect_nothing_is_next(data: EstimationData) -> None:
    """Whatever is accepted is added, the largest fall first: what is hidden, and then no more."""
    model = Model(HUSKY)
    for _ in range(4):
        tries = Tries(data, model)
        accepted = tries.fold([one for one in tries.try_each() if one is not None])
        if not accepted:
            break
        model = judge_whole(data, model + accepted[0].effect).fitted.model
    assert sorted(model.ids) == ["drive_lag", "effective_track"]
