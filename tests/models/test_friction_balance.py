"""The model of Rabiee and Biswas: its formulas beside a balance of forces that is solved number by number."""

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of
from msgspec.structs import replace
from scipy.optimize import fsolve

from pipeline.core.arrays import Floats
from pipeline.estimation import EstimationData, Input, fit_model
from pipeline.models import Model, Timing
from pipeline.models.literature import find_model, list_models
from pipeline.run import MotionError
from pipeline.simulate import Program
from pipeline.simulate import State as SimulatedState

HUSKY = vehicle_of("husky_a200")
TERMS = "friction_based_terms"


def balance(left: float, right: float, *, base: float, track: float, rolling: float) -> Floats:
    """Forward speed and yaw rate at which forces and moment on four equal wheels vanish."""
    wheels = [
        (x, y, right if y < 0.0 else left) for x in (-base / 2, base / 2) for y in (-track / 2, track / 2)
    ]

    def rest(motion: Floats) -> list[float]:
        ahead, turning = motion
        force, moment = 0.0, 0.0
        for x, y, rim in wheels:
            slip = np.array((ahead - turning * y - rim, turning * x))
            fx, fy = -slip / np.linalg.norm(slip)
            fx -= rolling * np.sign(rim)
            force, moment = force + fx, moment + x * fy - y * fx
        return [float(force), float(moment)]

    start = ((left + right) / 2.0 - 0.01, (right - left) / track / 2.0)
    found, _, flag, text = fsolve(rest, start, full_output=True)
    assert flag == 1, text
    return found


@pytest.fixture(scope="module")
def driven() -> EstimationData:
    # Slow enough that the sides often travel opposite ways.
    run = simulate({}, duration_s=60.0, program=Program(speed_scale=0.3))
    return EstimationData([run], HUSKY, Input.MEASURED)


def predict(data: EstimationData, model: Model) -> Floats:
    velocity = data.residuals_by_run[0].predict_velocity(model.effects, Timing())
    return np.array((velocity.x, velocity.y, velocity.w))


@pytest.mark.parametrize("rolling", [0.02, 0.1, 0.25])
def test_the_formulas_are_where_forces_and_moment_vanish(driven: EstimationData, rolling: float) -> None:
    base, track = HUSKY.wheelbase_m, HUSKY.track_width_m
    assert base is not None
    assert track is not None
    ideal = predict(driven, Model(HUSKY))
    found = predict(driven, find_model("friction_based").make(HUSKY).change(TERMS, rolling=rolling))
    left, right = ideal[0] - 0.5 * track * ideal[2], ideal[0] + 0.5 * track * ideal[2]
    turns = np.flatnonzero((np.abs(ideal[2]) > 0.1) & (np.minimum(np.abs(left), np.abs(right)) > 0.02))
    same = left[turns] * right[turns] > 0.0
    assert same.any()
    assert (~same).any()
    for cell in (*turns[same][::40], *turns[~same][::40]):
        expected = balance(left[cell], right[cell], base=base, track=track, rolling=rolling)
        np.testing.assert_allclose(found[[0, 2], cell], expected, atol=1e-8)
    np.testing.assert_array_equal(found[1], 0.0)


def slip_by_balance(state: SimulatedState) -> tuple[float, float, float]:
    base, track = HUSKY.wheelbase_m or np.nan, HUSKY.track_width_m or np.nan
    left, right = (state.v0 + side * 0.5 * track * state.w0 for side in (-1.0, 1.0))
    if abs(right - left) < 1e-6:
        return 0.0, 0.0, 0.0
    square = (base / track) ** 2
    if left * right > 0.0:
        # The directions of slip in closed form, from the angles and not from the model's formula.
        sigma, delta = np.arctan(base / track), np.arcsin(0.2 * np.sqrt(1.0 + square))
        outer, inner = np.tan(sigma + delta), np.tan(sigma - delta)
        turning = (right - left) / (track + base * (outer + inner) / 2.0)
        ahead = -np.sign(left) * abs(turning) * base / 4.0 * (outer - inner)
    else:
        sigma = np.arctan(base / track) + np.arcsin(0.2 / np.sqrt(1.0 + square))
        turning, ahead = (right - left) / (track + base * np.tan(sigma)), 0.0
    return float(ahead), 0.0, float(turning - state.w0)


def test_a_fit_returns_the_share_of_rolling_resistance() -> None:
    data = EstimationData([simulate({}, extra=slip_by_balance, duration_s=120.0)], HUSKY, Input.MEASURED)
    fitted = fit_model(data, find_model("friction_based").make(HUSKY), exact=True)
    assert fitted.model.effect(TERMS).values["rolling"] == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize("change", [{"wheelbase_m": None}, {"running_gear": "tracks"}])
def test_a_vehicle_without_four_known_wheels_is_refused(change: dict[str, object]) -> None:
    vehicle = replace(HUSKY, **change)
    assert "friction_based" not in {model.name for model in list_models(vehicle)}
    with pytest.raises(MotionError) as caught:
        find_model("friction_based").make(vehicle)
    assert caught.value.code == "model_unavailable"
    assert "distance between their axles" in str(caught.value)
    assert "icr_asymmetric" in caught.value.hint
