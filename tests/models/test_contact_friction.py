"""Contact friction: its limits, its bound, and an integration that is made differently."""

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from few import few
from motion_runs import QUIET, simulate, vehicle_of
from scipy.integrate import solve_ivp

from pipeline.estimation import EstimationData, Input, fit_model
from pipeline.estimation.path_residuals import PathResiduals
from pipeline.estimation.run_residuals import RunResiduals
from pipeline.export import export_model
from pipeline.models import Model, ModelFile, Timing, find_effect
from pipeline.models.model import JointBody
from pipeline.models.parameter import Conditions, Largest
from pipeline.run.signals import Resets, Rolling, RunContext, Velocity, Wheels
from pipeline.simulate import Disturbance

HUSKY = vehicle_of("husky_a200")
ICE = {"friction": 0.11, "creep": 0.8, "k": 1.7, "gyration": 1.1}
HALF = 0.5 * (HUSKY.track_width_m or math.nan)


def _compare(rate_hz: float = 50.0) -> RunResiduals:
    run = simulate({}, duration_s=60.0, encoders=None, pose=QUIET, disturbance=Disturbance())
    return RunResiduals(run, HUSKY, Input.COMMAND, rate_hz=rate_hz)


def _move(values: dict[str, float], run_residuals: RunResiduals) -> np.ndarray:
    effect = find_effect("contact_friction")().change(**values)
    velocity = run_residuals.predict_velocity((effect,), Timing())
    return np.stack((velocity.x, velocity.y, velocity.w))


def _accelerate(state: np.ndarray, sides: tuple[float, float], values: dict[str, float]) -> np.ndarray:
    """The formula of the page, wheel by wheel."""
    v_x, v_y, w = state
    force, torque = np.zeros(2), 0.0
    for y, rolled in ((HALF, sides[0]), (-HALF, sides[1])):
        for x in (-math.sqrt(values["k"] - 1.0) * HALF, math.sqrt(values["k"] - 1.0) * HALF):
            slip = np.array((rolled - (v_x - y * w), -(v_y + x * w)))
            rolling = values["creep"] * math.hypot(rolled, 0.1)
            push = 9.80665 * slip / 4.0 / math.hypot(rolling, math.hypot(*slip) / values["friction"])
            force, torque = force + push, torque + x * push[1] - y * push[0]
    return np.array((force[0] + v_y * w, force[1] - v_x * w, torque / (values["gyration"] * HALF) ** 2))


def _step(values: dict[str, float], sides: tuple[float, float], cells: int) -> tuple[RunContext, Velocity]:
    """The motion from rest on the cells of a run whose wheels are made to step once."""
    context = _compare().context
    effect = find_effect("contact_friction")().change(**values)
    none = np.zeros(1, dtype=np.int64)
    once = Resets(np.zeros(cells, dtype=np.int64), first=none, at=none, start=np.zeros((1, 3)))
    v0, w0 = 0.5 * sum(sides), (sides[1] - sides[0]) / (2.0 * HALF)
    rolling = Rolling(np.full(cells, v0), np.full(cells, w0), Wheels(*np.zeros((3, cells))))
    return context, effect.move_body(rolling, replace(context, body=once))  # type: ignore[attr-defined]


def test_one_step_of_the_wheels_is_answered_as_the_equations_say() -> None:
    cells, values, sides = 150, {**ICE, "creep": 4.0}, (0.4, 0.9)
    context, moved = _step(values, sides, cells)
    edges = np.arange(cells + 1) * context.step_s
    exact = solve_ivp(
        lambda _, state: _accelerate(state, sides, values), (0.0, edges[-1]), np.zeros(3), t_eval=edges,
        rtol=1e-8, atol=1e-10,
    )  # fmt: skip
    means = 0.5 * (exact.y[:, 1:] + exact.y[:, :-1])
    got = np.stack((moved.x, moved.y, moved.w))
    assert np.abs(got - means).max() < 0.01
    assert got[:, -1] == pytest.approx(means[:, -1], abs=2e-3)


@pytest.mark.parametrize("friction", few([0.1, 0.3, 0.9], 3))
def test_a_drive_moves_as_with_far_shorter_steps(friction: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps with the friction of their start made fits of a true friction of 0.3 end near 0.315."""
    values = {"friction": friction, "creep": 0.3, "k": 1.8, "gyration": 1.1}
    usual = _move(values, _compare())
    monkeypatch.setattr("pipeline.models.effects.contact_friction._STEP_S", 1e-3)
    short = _move(values, _compare())
    assert not np.array_equal(usual, short)
    assert np.sqrt(np.mean((usual - short) ** 2, axis=1)).max() < 4e-3


@pytest.mark.parametrize("speed", few([0.5, 2.0], 2))
def test_while_wheels_hardly_slide_the_lag_grows_with_speed_and_the_track_is_wider(speed: float) -> None:
    values = {"friction": math.inf, "creep": 3.0, "k": 1.8, "gyration": math.sqrt(1.8)}
    context, moved = _step(values, (0.95 * speed, 1.05 * speed), cells=200)
    middle = (np.arange(moved.x.size) + 0.5) * context.step_s
    grown = 1.0 - np.exp(-middle * 9.80665 / (values["creep"] * math.hypot(speed, 0.1)))
    assert moved.x == pytest.approx(speed * grown, abs=0.02 * speed)
    assert moved.w[-1] == pytest.approx(0.1 * speed / (2.0 * HALF * values["k"]), rel=0.03)


def test_finer_cells_give_the_same_motion() -> None:
    coarse, fine = _compare(25.0), _compare(100.0)
    one, other = _move(ICE, coarse), _move(ICE, fine)
    seen = np.stack([np.interp(coarse.grid.times, fine.grid.times, row) for row in other])
    assert np.sqrt(np.mean((one - seen) ** 2, axis=1)) == pytest.approx(0.0, abs=0.006)


@pytest.mark.parametrize("count", few([3, 9, 18], 3))
def test_bodies_that_are_computed_at_once_move_as_each_does_alone(count: int) -> None:
    context, kind = _compare().context, cast("type[JointBody]", find_effect("contact_friction"))
    draws = np.random.default_rng(count)
    cells = context.times.size
    rollings = [Rolling(*draws.normal(size=(2, cells)), Wheels(*np.zeros((3, cells)))) for _ in range(2)]
    effects = [
        kind(**{name: share * value for name, value in ICE.items()})
        for share in draws.uniform(0.8, 3.0, count)
    ]
    pairs = [(effect, rollings[index % 2]) for index, effect in enumerate(effects)]
    for (effect, rolling), found in zip(pairs, kind.move_each(pairs, context), strict=True):
        alone = effect.move_body(rolling, context)
        assert all(np.array_equal(getattr(found, name), getattr(alone, name)) for name in ("x", "y", "w"))


@pytest.mark.parametrize(
    "effects", [("wheel_servo", "body_acceleration_limit"), ("contact_friction", "wheel_radius")]
)
def test_derivatives_are_the_same_as_of_one_state_after_the_other(
    effects: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = simulate({}, duration_s=60.0, pose=QUIET)
    columns = list[np.ndarray]()
    for look_ahead in (PathResiduals.look_ahead, lambda *_: None):
        monkeypatch.setattr(PathResiduals, "look_ahead", look_ahead)
        data = EstimationData([run], HUSKY, Input.COMMAND)
        (path,) = [path for path in data.paths if path.owns(find_effect(effects[0])())]
        state = data.start_state([find_effect(name)().make_usual(data.largest) for name in effects])
        free, residual = path.list_free(state), path.find_residuals(state)
        columns.append(path.differentiate(state, residual, free))
    assert np.abs(columns[0]).max() > 0.0
    assert np.array_equal(*columns)


@pytest.mark.parametrize(
    "friction", [pytest.param(0.1, marks=pytest.mark.long), 0.3, pytest.param(0.7, marks=pytest.mark.long)]
)
def test_friction_comes_back_from_every_start(friction: float) -> None:
    truth = {**ICE, "friction": friction}
    run = simulate({"contact_friction": truth}, duration_s=150.0)
    data = EstimationData([run], HUSKY, Input.MEASURED)
    kind = find_effect("contact_friction")
    for start in kind.starts:
        fitted = fit_model(data, Model(HUSKY, (kind().change(**start),)))
        assert fitted.model.effect("contact_friction").values["friction"] == pytest.approx(friction, rel=0.1)


def test_effects_of_the_ground_act_on_the_motion_of_the_sliding_body() -> None:
    """With a track that is twice as wide, the yaw rate of the wheels would give half of the skid."""
    truth = {"friction": 0.6, "creep": 0.4, "k": 2.0, "gyration": 1.1}
    run = simulate({"contact_friction": truth, "lateral_skid": 0.2}, duration_s=120.0)
    start = Model(HUSKY, (find_effect("contact_friction")().change(**truth), find_effect("lateral_skid")()))
    fitted = fit_model(EstimationData([run], HUSKY, Input.MEASURED), start)
    assert fitted.model.effect("lateral_skid").values["c"] == pytest.approx(0.2, rel=0.1)


def test_a_body_without_turning_inertia_is_exported_and_turns_with_its_wheels() -> None:
    effect = find_effect("contact_friction")().change(**{**ICE, "friction": 0.7, "gyration": 0.0})
    model = ModelFile(Model(HUSKY, (effect,)))
    namespace: dict[str, Any] = {}
    exec(export_model(model, "python"), namespace)  # noqa: S102 - our own text
    rows = np.array(namespace["predict"]([(0.0, -0.2, 0.2)], 3.0))
    rolled = 0.2 * HUSKY.wheel_radius_m / HALF
    assert rows[-1, 6] == pytest.approx(rolled / ICE["k"], rel=0.02)


def test_friction_that_makes_nothing_late_is_a_wider_track() -> None:
    """Wheels that skid in a turn at 1.5 m/s: from 20 ms on, time stamps show that the body is late."""
    conditions = Conditions(Largest(1.5, 1.0, 10.0, 5.0, np.zeros(11)))
    for friction, creep, is_track in (
        (20.0, 0.07, True),
        (20.0, 0.16, False),
        (0.6, 0.0, False),
        (0.1, 0.07, False),
    ):
        effect = find_effect("contact_friction")(friction=friction, creep=creep, k=1.5, gyration=1.0)
        assert effect.is_degenerate(conditions) == is_track
        simpler = effect.collapse()
        assert (simpler.id, simpler.values["k"]) == ("effective_track", 1.5)
    # A search may end at a track that the simpler effect cannot have: that was an error.
    widest = find_effect("contact_friction")(friction=20.0, creep=0.07, k=20.0, gyration=1.0).collapse()
    assert widest.values["k"] == find_effect("effective_track").parameters[0].bounds[1]
    # Without skid in turns nothing but the creep is seen of a firm ground.
    assert find_effect("contact_friction")(friction=1.4, creep=0.07, k=1.0).is_degenerate(conditions)
