import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from few import few
from motion_runs import simulate, vehicle_of
from scipy.optimize import least_squares
from verbs import run_verb

from pipeline.core.arrays import Floats
from pipeline.estimation import EstimationData, Input, fit_model
from pipeline.models import Model, Timing, read_model
from pipeline.models.literature import find_model, list_literature
from pipeline.simulate import VEHICLES, Program
from pipeline.simulate import State as SimulatedState

HUSKY = vehicle_of("husky_a200")
TRACK_M = HUSKY.track_width_m or math.nan


@pytest.fixture(scope="module")
def driven() -> EstimationData:
    return EstimationData([simulate({}, duration_s=40.0)], HUSKY, Input.MEASURED)


def predict(data: EstimationData, model: Model) -> Floats:
    """Velocities of a model on the cells of the run, shape (3, n)."""
    velocity = data.residuals_by_run[0].predict_velocity(model.effects, Timing())
    return np.array((velocity.x, velocity.y, velocity.w))


def split_sides(data: EstimationData) -> tuple[Floats, Floats]:
    """Speeds of the left and of the right wheels' rims [m/s]."""
    forward, _, turning = predict(data, Model(HUSKY))
    return forward - 0.5 * TRACK_M * turning, forward + 0.5 * TRACK_M * turning


def change(model: Model, **values: float) -> Model:
    """The model with numbers by ``effect__name``."""
    for label, value in values.items():
        effect, name = label.split("__")
        model = model.change(effect, **{name: value})
    return model


def test_every_model_has_formula_source_and_numbers() -> None:
    for model in list_literature():
        found = find_model(model.name)  # type: ignore[attr-defined]
        assert found.formula
        assert len(found.source.split(",")) >= 2
        assert found.link == "" or found.link.startswith(("doi:10.", "arXiv:"))
        assert bool(found.effects or found.terms) == (found.count_numbers() > 0)


@pytest.mark.parametrize("model", few(list_literature(), 4), ids=lambda model: model.name)
def test_a_model_file_of_each_is_written_and_read_back(model: object, tmp_path: Path) -> None:
    found = find_model(model.name)  # type: ignore[attr-defined]
    vehicle = "husky_a200" if "differential" in found.kinds else "f1tenth"
    path = tmp_path / "model.toml"
    done = run_verb("model", "new", path, "--vehicle", vehicle, "--from", found.name)
    assert done.returncode == 0, done.stderr
    assert read_model(path).model == found.make(vehicle_of(vehicle))


def test_the_extended_differential_drive_is_an_effective_track(driven: EstimationData) -> None:
    model = find_model("extended_differential_drive").make(HUSKY)
    assert model.ids == ("effective_track",)
    forward, _, turning = predict(driven, Model(HUSKY))
    x, y, w = predict(driven, change(model, effective_track__k=1.7))
    np.testing.assert_allclose(x, forward)
    np.testing.assert_allclose(y, 0.0)
    np.testing.assert_allclose(w, turning / 1.7)


@pytest.mark.parametrize("name", ["icr_symmetric", "icr_asymmetric"])
def test_the_icr_models_are_their_effects_to_rounding(driven: EstimationData, name: str) -> None:
    """Mandow et al.: v = 1/(y_l - y_r) [[-a_l y_r, a_r y_l], [a_l x, -a_r x], [-a_l, a_r]] (v_l, v_r)."""
    symmetric = name == "icr_symmetric"
    uneven, radius, wide, aside, ahead = (
        (0.0, 0.9, 1.6, 0.0, 0.0) if symmetric else (0.06, 0.93, 1.8, 0.05, -0.1)
    )
    numbers = {"effective_track__k": wide, "wheel_radius__k": radius}
    if not symmetric:
        numbers |= {"wheel_asymmetry__e": uneven, "icr_lateral__y_icr": aside, "icr_offset__x_icr": ahead}
    left, right = split_sides(driven)
    a_l, a_r = radius * (1.0 - 0.5 * uneven), radius * (1.0 + 0.5 * uneven)
    y_l, y_r = aside + 0.5 * wide * TRACK_M, aside - 0.5 * wide * TRACK_M
    map_of_mandow = np.array([[-a_l * y_r, a_r * y_l], [a_l * ahead, -a_r * ahead], [-a_l, a_r]]) / (
        y_l - y_r
    )
    found = predict(driven, change(find_model(name).make(HUSKY), **numbers))
    np.testing.assert_allclose(found, map_of_mandow @ np.array((left, right)), atol=1e-12)


def test_the_full_linear_model_reaches_any_map_near_the_ideal_one(driven: EstimationData) -> None:
    left, right = split_sides(driven)
    wanted = np.array([[0.45, 0.52], [0.03, -0.08], [-1.1, 1.05]])
    asked = wanted @ np.array((left, right))
    model = find_model("full_linear").make(HUSKY)
    names = [(effect.id, name) for effect in model for name in effect.values]
    assert len(names) == 6

    def miss(values: Floats) -> Floats:
        changed = model
        for (effect, name), value in zip(names, values.tolist(), strict=True):
            changed = changed.change(effect, **{name: value})
        return (predict(driven, changed) - asked)[:, ::20].ravel()

    start = [model.effect(effect).values[name] for effect, name in names]
    assert np.abs(least_squares(miss, start, x_scale=0.1).fun).max() < 1e-8


def test_seegmiller_on_flat_ground_is_linear_in_speed_and_centripetal_force(driven: EstimationData) -> None:
    forward, _, turning = predict(driven, Model(HUSKY))
    named = {"c1": 3.0, "c2": -0.1, "c3": 2.0, "c4": 0.5, "c5": 0.02, "c6": -0.3}
    labels = {f"seegmiller_terms__{name}": value for name, value in named.items()}
    flat = np.abs(driven.residuals_by_run[0].context.attitude[:, :2]).max(axis=1) < 0.01
    assert flat.mean() > 0.9
    found = predict(driven, change(find_model("seegmiller").make(HUSKY), **labels))
    pull = -forward * turning / 9.80665
    # Attitudes of a hundredth of a radian and less are the noise of the poses.
    atol = 0.05 * np.abs(forward).max()
    np.testing.assert_allclose(found[0][flat], (0.9 * forward)[flat], atol=atol)
    np.testing.assert_allclose(found[1][flat], (2.0 * pull * forward)[flat], atol=atol)
    np.testing.assert_allclose(
        found[2][flat], (turning + 0.5 * pull * forward + 0.02 * forward - 0.3 * turning)[flat], atol=atol
    )


def slip_by_curvature(state: SimulatedState) -> tuple[float, float, float]:
    difference, total = state.right_speed - state.left_speed, state.right_speed + state.left_speed
    if abs(difference) < 1e-9:
        return 0.0, 0.0, 0.0
    wider = 1.0 + 0.8 / (1.0 + 0.5 * math.sqrt(abs(total / difference)))
    return 0.0, 0.0, state.w0 / wider - state.w0


def slip_by_features(state: SimulatedState) -> tuple[float, float, float]:
    forward, turning = state.v0, state.w0
    return (
        -0.1 * forward,
        -0.05 * forward * turning,
        0.03 * forward * turning - 0.02 * forward - 0.4 * turning,
    )


def slip_by_forces(state: SimulatedState) -> tuple[float, float, float]:
    pull = -state.v0 * state.w0 / 9.80665 - math.tan(state.roll)
    forward = 0.5 * math.tan(state.pitch) * state.v0 - 0.08 * state.v0
    return forward, 0.9 * pull * state.v0, -0.05 * state.v0 - 0.35 * state.w0


@pytest.mark.parametrize(
    ("name", "physics", "truth"),
    [
        ("roc", slip_by_curvature, {"a": (0.8, 0.05), "c": (0.5, 0.1)}),
        (
            "drive",
            slip_by_features,
            {
                "w1": (0.1, 0.01),
                "w2": (0.05, 0.02),
                "w3": (-0.03, 0.02),
                "w4": (0.02, 0.01),
                "w5": (0.4, 0.01),
            },
        ),
        (
            "seegmiller",
            slip_by_forces,
            {"c2": (-0.08, 0.01), "c3": (0.9, 0.3), "c5": (-0.05, 0.01), "c6": (-0.35, 0.01)},
        ),
    ],
)
def test_a_fit_to_a_log_of_known_truth_returns_it(
    name: str,
    physics: Callable[[SimulatedState], tuple[float, float, float]],
    truth: dict[str, tuple[float, float]],
) -> None:
    data = EstimationData([simulate({}, extra=physics, duration_s=120.0)], HUSKY, Input.MEASURED)
    fitted = fit_model(data, find_model(name).make(HUSKY), exact=True)
    values = fitted.model.effect(f"{name}_terms").values
    for number, (value, margin) in truth.items():
        assert values[number] == pytest.approx(value, abs=margin), number


def test_a_fit_of_the_icr_model_returns_known_centres_of_rotation() -> None:
    truth = {"effective_track": {"k": 1.8}, "icr_offset": {"x_icr": 0.12}, "wheel_asymmetry": {"e": 0.04}}
    data = EstimationData([simulate(truth, duration_s=120.0)], HUSKY, Input.MEASURED)
    fitted = fit_model(data, find_model("icr_asymmetric").make(HUSKY), exact=True).model
    assert fitted.effect("effective_track").values["k"] == pytest.approx(1.8, rel=0.02)
    assert fitted.effect("icr_offset").values["x_icr"] == pytest.approx(0.12, abs=0.01)
    assert fitted.effect("wheel_asymmetry").values["e"] == pytest.approx(0.04, abs=0.01)
    assert fitted.effect("icr_lateral").values["y_icr"] == pytest.approx(0.0, abs=0.02)
    assert fitted.effect("wheel_radius").values["k"] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    ("name", "truth"),
    [
        ("bicycle_understeer", {"understeer": {"K": 0.1}}),
        ("kinematic_bicycle_with_lags", {"drive_lag": {"tau": 0.5}, "steering_lag": {"tau": 0.3}}),
    ],
)
def test_a_fit_of_a_car_s_model_returns_the_truth(name: str, truth: dict[str, dict[str, float]]) -> None:
    run = simulate(truth, duration_s=120.0, vehicle=VEHICLES["car"], program=Program(speed_scale=0.5))
    car = vehicle_of(VEHICLES["car"].name)
    fitted = fit_model(
        EstimationData([run], car, Input.COMMAND), find_model(name).make(car), exact=True
    ).model
    for effect, numbers in truth.items():
        for number, value in numbers.items():
            assert fitted.effect(effect).values[number] == pytest.approx(value, rel=0.1), effect
