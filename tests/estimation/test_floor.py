"""The noise floor: never far above what the true model leaves, whatever drives and disturbs it."""

from __future__ import annotations

import pytest
from motion_runs import WANDERING, simulate, vehicle_of

from pipeline.estimation import Input, Problem
from pipeline.estimation.ladder import judge_model
from pipeline.models import Model, find_effect
from pipeline.simulate import Disturbance, PoseSensor, Program

HUSKY = vehicle_of("husky_a200")
TRUTH = {"effective_track": 1.8, "drive_lag": 0.3, "icr_offset": 0.1}


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("pose", "disturbance"),
    [
        (PoseSensor(), Disturbance(0.03, 0.05)),
        (PoseSensor(), Disturbance(0.003, 0.004)),
        (WANDERING, Disturbance(0.03, 0.05)),
        (PoseSensor(rate_hz=5.0, noise_m=0.02, noise_rad=0.005), Disturbance()),
    ],
    ids=["usual", "quiet", "wandering", "sparse poses"],
)
def test_the_floor_is_near_what_the_true_model_leaves_of_unseen_data(
    pose: PoseSensor, disturbance: Disturbance, seed: int
) -> None:
    run = simulate(
        TRUTH, seed=seed, duration_s=90.0, pose=pose, disturbance=disturbance, program=Program("teleop")
    )
    true = Model(HUSKY, tuple(find_effect(name)() for name in TRUTH))
    judged = judge_model(Problem([run], HUSKY, Input.COMMAND), true)
    floor, errors = judged.floor, judged.whole.errors
    assert 0.6 * errors.t_mrmse_m < floor.t_mrmse_m < 1.3 * errors.t_mrmse_m
    assert 0.6 * errors.r_mrmse_rad < floor.r_mrmse_rad < 1.3 * errors.r_mrmse_rad
