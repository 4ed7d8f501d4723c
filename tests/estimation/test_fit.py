"""Fits: one answer from every start, and from what is written, and residuals of what is held out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of

from pipeline.estimation import EstimationData, Input, fit_model
from pipeline.estimation.fit import fit_path, hold_out, make_folds
from pipeline.models import Model, ModelFile, find_effect, format_model
from pipeline.models.model_file import parse_model
from pipeline.simulate import Disturbance, Encoders, Program

HUSKY = vehicle_of("husky_a200")
TRUTH = {"effective_track": 1.7, "icr_offset": 0.1, "drive_lag": 0.3}
STARTS = (
    (find_effect("effective_track")(), find_effect("icr_offset")(), find_effect("drive_lag")()),
    (
        find_effect("effective_track")(k=1.2),
        find_effect("icr_offset")(x_icr=-0.2),
        find_effect("drive_lag")(tau=0.6),
    ),
    (
        find_effect("effective_track")(k=2.4),
        find_effect("icr_offset")(x_icr=0.3),
        find_effect("drive_lag")(tau=0.05),
    ),
)


@pytest.fixture(scope="module")
def data() -> EstimationData:
    run = simulate(TRUTH, duration_s=60.0, program=Program("teleop"), disturbance=Disturbance(0.03, 0.05))
    return EstimationData([run], HUSKY, Input.COMMAND)


def read_values(model: Model) -> dict[str, float]:
    return {f"{effect.id}.{name}": value for effect in model for name, value in effect.values.items()}


def test_an_exact_fit_ends_at_the_same_values_from_every_start(data: EstimationData) -> None:
    ends = [read_values(fit_model(data, Model(HUSKY, start), exact=True).model) for start in STARTS]
    for other in ends[1:]:
        # One unit in the last of the six digits that a file keeps.
        assert other == pytest.approx(ends[0], rel=1e-5, abs=2e-6)
    assert ends[0]["drive_lag.tau"] == pytest.approx(0.3, abs=0.01)


def test_the_fit_of_a_written_model_is_the_model(data: EstimationData) -> None:
    fitted = fit_model(data, Model(HUSKY, STARTS[0]), exact=True)
    written = parse_model(format_model(ModelFile(fitted.model)), "model.toml").model
    assert written == fitted.model
    # Also where nothing is remembered.
    fresh = EstimationData(data.runs, HUSKY, Input.COMMAND)
    again = read_values(fit_model(fresh, written, exact=True).model)
    assert again == pytest.approx(read_values(written), rel=2e-6, abs=2e-6)


def test_numbers_stay_within_their_bounds(data: EstimationData) -> None:
    """Nothing skids, so that a number from near a bound moves away from it."""
    skid = find_effect("lateral_skid")
    low, high = skid.parameters[0].bounds
    for start in (0.9 * low, 0.9 * high):
        fitted = fit_model(data, Model(HUSKY, (*STARTS[1], skid(c=start))))
        assert low <= fitted.model.effect("lateral_skid").values["c"] <= high


def test_what_is_held_out_is_what_a_fit_without_it_leaves(data: EstimationData) -> None:
    path = data.paths[0]
    fit = fit_path(path, data.start_state([find_effect("effective_track")(k=1.6)]))
    folds = make_folds(path)
    held = hold_out(fit, fit.noise, folds)
    # Each fold by one step of the numbers, to those that the others ask for.
    assert held.shape == fit.residual.shape
    moved = held - fit.residual
    for fold in np.unique(folds).tolist():
        mine = folds == fold
        step, *_ = np.linalg.lstsq(
            fit.columns[mine].reshape(-1, len(fit.free)), -moved[mine].ravel(), rcond=None
        )
        left = -moved[mine].ravel() - fit.columns[mine].reshape(-1, len(fit.free)) @ step
        assert np.abs(left).max() < 1e-9
        assert np.abs(step[0]) < 4.0 * np.sqrt(fit.covariance[0, 0])
    # What a fit says of itself is too good.
    assert np.mean(held[:, 2] ** 2) > np.mean(fit.residual[:, 2] ** 2)


def test_a_limit_that_does_little_stays_a_limit_in_one_step(data: EstimationData) -> None:
    """A step of several times its value goes to where it does a few times as much, not to nothing at all."""
    limit = find_effect("wheel_speed_limit")(limit=18.0)
    state = data.start_state([limit])
    (number,) = (one for one in data.paths[0].list_free(state) if one.effect == limit.id)
    assert state.move([number], [-30.0]).get(number) == pytest.approx(18.0 / (1.0 + 30.0 / 18.0))
    assert state.move([number], [1.0]).get(number) == pytest.approx(18.0 / (1.0 - 1.0 / 18.0))
    assert state.move([number], [60.0]).get(number) == number.bounds[1]


def test_each_ground_has_its_own_numbers_and_the_vehicle_one() -> None:
    truths = [
        ("tile", {"wheel_asymmetry": 0.04, "speed_slip": 0.06}),
        ("snow", {"wheel_asymmetry": 0.04, "speed_slip": 0.2}),
        ("snow", {"wheel_asymmetry": 0.04, "speed_slip": 0.2}),
    ]
    runs = [
        replace(simulate(truth, seed=seed, duration_s=60.0), terrain=terrain, name=f"{terrain} {seed}")
        for seed, (terrain, truth) in enumerate(truths)
    ]
    model = Model(HUSKY, (find_effect("wheel_asymmetry")(), find_effect("speed_slip")()))
    state = fit_model(EstimationData(runs, HUSKY, Input.MEASURED), model).state
    numbers = [{one.id: next(iter(one.values.values())) for one in state.effects_of(run)} for run in range(3)]
    for found, (_, truth) in zip(numbers, truths, strict=True):
        assert found == pytest.approx(truth, abs=0.01)
    assert numbers[1] == numbers[2]
    assert numbers[0]["wheel_asymmetry"] == numbers[1]["wheel_asymmetry"]
    # On one ground they share all.
    alike = [replace(run, terrain="tile") for run in runs]
    shared = fit_model(EstimationData(alike, HUSKY, Input.MEASURED), model).state
    assert shared.effects_of(0) == shared.effects_of(1)


@pytest.mark.parametrize("late_s", [0.0, 0.06])
def test_a_dead_time_is_that_of_the_commands_however_late_encoders_are(late_s: float) -> None:
    run = simulate({"transport_delay": 0.25}, duration_s=120.0, encoders=Encoders(delay_s=late_s))
    data = EstimationData([run], HUSKY, Input.COMMAND)
    fitted = fit_model(data, Model(HUSKY, (find_effect("transport_delay")(),)), exact=True)
    assert fitted.model.effect("transport_delay").delay == pytest.approx(0.25, abs=0.01)
