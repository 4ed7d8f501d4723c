"""The noise floor: what the true model leaves, whatever drives and disturbs it."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest
from few import few
from motion_runs import WANDERING, simulate, vehicle_of

from pipeline.estimation import EstimationData, Input
from pipeline.estimation.ladder import assess_model
from pipeline.models import Model, find_effect
from pipeline.results import Errors
from pipeline.simulate import Disturbance, PoseSensor, Program

HUSKY = vehicle_of("husky_a200")
TRUTH = {"effective_track": 1.8, "drive_lag": 0.3, "icr_offset": 0.1}


_USUAL = (PoseSensor(), Disturbance(0.03, 0.05))
_DRAWN = {
    "usual": _USUAL,
    "quiet": (PoseSensor(), Disturbance(0.003, 0.004)),
    "wandering": (WANDERING, Disturbance(0.03, 0.05)),
    "sparse poses": (PoseSensor(rate_hz=5.0, noise_m=0.02, noise_rad=0.005), Disturbance()),
    "lasting": (PoseSensor(), Disturbance(0.05, 0.08, correlation_s=4.0)),
}


def _judge(
    drawn: tuple[PoseSensor, Disturbance], seed: int, effects: Iterable[str], duration_s: float
) -> tuple[Errors, Errors]:
    """The floor of a run, and the errors of a model with these of its effects."""
    pose, disturbance = drawn
    program = Program("teleop")
    run = simulate(
        TRUTH, seed=seed, duration_s=duration_s, pose=pose, disturbance=disturbance, program=program
    )
    model = Model(HUSKY, tuple(find_effect(name)() for name in effects))
    judged = assess_model(EstimationData([run], HUSKY, Input.COMMAND), model)
    return judged.floor, judged.whole.errors


@pytest.mark.parametrize("duration_s", few([40.0, 90.0], 2))
@pytest.mark.parametrize("seed", few([0, 1], 2))
@pytest.mark.parametrize("drawn", _DRAWN)
def test_the_floor_is_what_the_true_model_leaves_of_unseen_data(
    drawn: str, seed: int, duration_s: float
) -> None:
    """As an error that lasts is no effect, and forty seconds are few: the floor was a third of it."""
    floor, errors = _judge(_DRAWN[drawn], seed, TRUTH, duration_s)
    assert 0.7 * errors.t_mrmse_m < floor.t_mrmse_m < 1.1 * errors.t_mrmse_m
    assert 0.7 * errors.r_mrmse_rad < floor.r_mrmse_rad < 1.1 * errors.r_mrmse_rad


@pytest.mark.parametrize("seed", few([0, 1], 2))
@pytest.mark.parametrize("drawn", ["usual", "quiet", "sparse poses"])
def test_the_floor_of_a_model_that_lacks_an_effect_is_that_of_the_true_one(drawn: str, seed: int) -> None:
    true, _ = _judge(_DRAWN[drawn], seed, TRUTH, 90.0)
    floor, errors = _judge(_DRAWN[drawn], seed, ["effective_track", "drive_lag"], 90.0)
    assert floor.t_mrmse_m == pytest.approx(true.t_mrmse_m, rel=0.25)
    assert floor.t_mrmse_m < 0.9 * errors.t_mrmse_m


def test_trials_of_seconds_have_a_floor_together() -> None:
    """A regression of each alone has more inputs than steps: it had no number for one of the channels."""
    runs = [
        simulate(
            TRUTH, seed=seed, duration_s=8.0, program=Program("teleop"), disturbance=Disturbance(0.03, 0.05)
        )
        for seed in range(4)
    ]
    model = Model(HUSKY, tuple(find_effect(name)() for name in TRUTH))
    judged = assess_model(EstimationData(runs, HUSKY, Input.COMMAND), model)
    assert all(math.isfinite(value) for value in (*judged.floor.velocity_rms, *judged.floor.velocity_spread))
    assert 0.5 * judged.whole.errors.t_mrmse_m < judged.floor.t_mrmse_m < judged.whole.errors.t_mrmse_m
    # Half a minute of turning tells noise from what the input does within a factor of three.
    assert 0.3 * judged.whole.errors.r_mrmse_rad < judged.floor.r_mrmse_rad < judged.whole.errors.r_mrmse_rad
