"""Wheel servo: its limiting cases, its steadiness in every number, and that it comes back of a log."""

from itertools import pairwise
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from few import few
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_runs import simulate, vehicle_of

from pipeline.estimation import EstimationData, Input, fit_model
from pipeline.models import Asked, Model, find_effect, predict_step
from pipeline.models.filters import lag_signal
from pipeline.models.model import JointDrive
from pipeline.run.heading import Grid, average_held
from pipeline.run.signals import Resets, RunContext, Wheels
from pipeline.simulate import VEHICLES, Program
from pipeline.simulate.drivetrain import turn_by_motors
from pipeline.simulate.facts import Effects

STEP = 0.02
HUSKY = VEHICLES["husky"]
RADIUS, WIDTH = HUSKY.wheel_radius_m, 2.0 * HUSKY.lever_m
SERVO = {"tau": 0.3, "reset": 0.4, "drag": 0.05, "bound": 0.8, "no_load": 4.0, "scrub": 0.6, "creep": 0.07}


def make_context(size: int, resets: Resets | None = None) -> RunContext:
    first = np.array([0])
    spans = Resets(np.zeros(size, dtype=np.int64), first, first, np.zeros((1, 3)))
    vehicle = SimpleNamespace(wheel_radius_m=RADIUS)
    known = SimpleNamespace(vehicle=vehicle, track_m=WIDTH, wheels=resets or spans, spans=spans, step_s=STEP)
    return cast("RunContext", known)


def drive(
    speed: np.ndarray,
    turn: np.ndarray,
    context: RunContext | None = None,
    imbalance: float = 0.0,
    **numbers: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Speed [m/s] and yaw rate [rad/s] of the wheels under commanded ones."""
    left, right = (speed - 0.5 * WIDTH * turn) / RADIUS, (speed + 0.5 * WIDTH * turn) / RADIUS
    wheels = Wheels(left, right, np.zeros(speed.size), imbalance=imbalance)
    driven = find_effect("wheel_servo")(**numbers).drive_wheels(wheels, context or make_context(speed.size))
    return 0.5 * RADIUS * (driven.left + driven.right), RADIUS * (driven.right - driven.left) / WIDTH


def draw_steps(seed: int, size: float = 1.0) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).uniform(-size, size, 40), 75)


def test_without_ground_resistance_and_bound_it_is_a_lag_of_the_rotating_parts() -> None:
    speed, turn = draw_steps(1), draw_steps(2)
    resets = make_context(speed.size).spans
    found = drive(speed, turn, tau=0.7)
    tau = 0.7 * 0.7 / 1.7
    for channel, signal in zip(found, (speed, turn), strict=True):
        assert np.allclose(channel, lag_signal(signal, tau, STEP, resets, np.zeros(1)), atol=3e-3)


def test_a_prediction_begins_with_the_measured_wheels_and_holds_part_of_their_difference() -> None:
    size, at = 400, 200
    first = np.array([0, at])
    number = np.repeat([0, 1], at)
    start = np.array([[0.0, 0.0, 0.0], [0.8 / RADIUS, 1.2 / RADIUS, 0.0]])
    context = make_context(size, Resets(number, first, first, start))
    numbers = {"tau": 0.2, "reset": 0.3, "scrub": 1.0, "creep": 0.07}
    speed, turn = np.ones(size), np.zeros(size)
    found, turned = drive(speed, turn, context, **numbers)
    assert np.allclose(turned[:at], 0.0, atol=1e-9)
    assert turned[at] == pytest.approx(0.4 / WIDTH, rel=0.2)
    assert 0.1 * turned[at] < turned[at + 25] < turned[at]
    assert np.allclose(found, drive(speed, turn, **numbers)[0], atol=0.02)


@given(
    seed=st.integers(0, 2**31),
    tau=st.floats(0.1, 0.6),
    reset=st.floats(0.0, 0.8),
    drag=st.floats(0.0, 0.1),
    bound=st.floats(0.2, 2.0),
    no_load=st.floats(1.0, 10.0) | st.just(np.inf),
    scrub=st.floats(0.0, 1.5),
    creep=st.floats(0.02, 0.3),
    imbalance=st.floats(-0.4, 0.4),
)
@settings(max_examples=20, deadline=None)
def test_it_agrees_with_motors_that_are_stepped_through(
    seed: int,
    tau: float,
    reset: float,
    drag: float,
    bound: float,
    no_load: float,
    scrub: float,
    creep: float,
    imbalance: float,
) -> None:
    """The generator's motors, written on their own and integrated by short steps."""
    numbers = {"tau": tau, "reset": reset, "drag": drag, "bound": bound}
    numbers |= {"no_load": no_load, "scrub": scrub, "creep": creep}
    speed, turn = draw_steps(seed), draw_steps(seed + 1)
    left, right = (speed - 0.5 * WIDTH * turn) / RADIUS, (speed + 0.5 * WIDTH * turn) / RADIUS
    effects = Effects({"wheel_servo": numbers, "motor_imbalance": {"e": imbalance}})
    on_left, on_right = turn_by_motors(HUSKY, left, right, effects, STEP)
    found, turned = drive(speed, turn, imbalance=imbalance, **numbers)
    for ours, theirs in (
        (found, 0.5 * RADIUS * (on_left + on_right)),
        (turned, RADIUS * (on_right - on_left) / WIDTH),
    ):
        assert float(np.sqrt(np.mean((ours - theirs) ** 2))) < 0.03


@pytest.mark.parametrize("count", few([2, 4, 7, 21], 3))
def test_servos_that_are_computed_at_once_move_as_each_does_alone(count: int) -> None:
    size, kind = 3000, cast("type[JointDrive]", find_effect("wheel_servo"))
    first = np.array([0, 1000, 2000])
    resets = Resets(
        np.arange(size) // 1000, first, first + 1, np.array([[3.0, 5.0, 0.0], [np.nan] * 3, [1.0] * 3])
    )
    inputs = [
        Wheels(draw_steps(k, 9.0), draw_steps(k + 9, 9.0), np.zeros(size), imbalance=0.1 * k)
        for k in range(3)
    ]
    shares = np.random.default_rng(count).uniform(0.5, 1.5, (count, len(SERVO)))
    pairs = [
        (kind(**dict(zip(SERVO, (row * list(SERVO.values())).tolist(), strict=True))), inputs[k % 3])
        for k, row in enumerate(shares)
    ]
    context = make_context(size, resets)
    for (effect, wheels), found in zip(pairs, kind.drive_each(pairs, context), strict=True):
        alone = effect.drive_wheels(wheels, context)
        assert np.array_equal(found.left, alone.left)
        assert np.array_equal(found.right, alone.right)


@pytest.mark.long
def test_a_gentle_drive_tells_the_friction_and_the_integral_part_of_its_loop() -> None:
    """Turns below the scrub begin seconds late: no lag of a plausible size does that."""
    hidden = {"tau": 0.2, "reset": 0.35, "drag": 0.06, "bound": 1.1, "scrub": 1.2, "creep": 0.07}
    run = simulate(
        {"wheel_servo": hidden},
        duration_s=240.0,
        vehicle=VEHICLES["warthog"],
        program=Program("smooth", speed_scale=0.2, turn_scale=0.25),
    )
    data = EstimationData([run], vehicle_of("warthog"), Input.COMMAND)
    servo = fit_model(data, Model(data.vehicle, (find_effect("wheel_servo")(),)))
    lag = fit_model(data, Model(data.vehicle, (find_effect("turn_lag")(),)))
    found = servo.model.effect("wheel_servo").values
    for name in ("reset", "drag", "scrub", "creep"):
        assert found[name] == pytest.approx(hidden[name], rel=0.15)
    error = [float(np.sqrt(np.mean(fitted.residuals[:, 2] ** 2))) for fitted in (servo, lag)]
    assert error[0] < 0.5 * error[1]


@pytest.mark.long
@given(seed=st.integers(0, 2**31), late=st.floats(0.0, 0.5), name=st.sampled_from(["late", *SERVO]))
@settings(max_examples=60, deadline=None)
def test_what_comes_out_changes_steadily_with_every_number(seed: int, late: float, name: str) -> None:
    """A jump where a cell more or less counts would be a hollow in the loss, in which a fit stops."""
    draw = np.random.default_rng(seed)
    times = np.cumsum(np.append(0.0, draw.uniform(0.05, 1.5, 60)))
    turns = np.append(0.0, draw.uniform(-3.0, 3.0, 60) * (draw.random(60) > 0.3))
    grid = Grid(
        STEP, (np.arange(1500) + 0.5) * STEP, np.zeros(1500, dtype=np.int64), np.array([0]),
        np.array([0.0]), np.array([1500 * STEP]),
    )  # fmt: skip

    def turn(change: float) -> np.ndarray:
        numbers = {key: value * (1.0 + (change if key == name else 0.0)) for key, value in SERVO.items()}
        at = times + late + (change if name == "late" else 0.0)
        turned, idle = (average_held(at, values, grid) for values in (turns, 1.0 * (turns == 0.0)))
        side = 0.5 * WIDTH / RADIUS * turned
        wheels = Wheels(-side, side, np.zeros(1500), idle=idle)
        driven = find_effect("wheel_servo")(**numbers).drive_wheels(wheels, make_context(1500))
        return RADIUS * (driven.right - driven.left) / WIDTH

    def measure(steps: np.ndarray) -> list[float]:
        driven = [turn(step) for step in steps]
        return [float(np.sqrt(np.mean((after - before) ** 2))) for before, after in pairwise(driven)]

    steps = np.linspace(0.0, STEP, 200)
    size = measure(steps)
    most = int(np.argmax(size))
    # A jump stays as large, however small the step.
    assert max(measure(np.linspace(steps[most], steps[most + 1], 50))) < 0.2 * max(size) + 1e-6


def test_its_sentence_is_what_the_whole_drive_makes_of_a_step() -> None:
    vehicle = vehicle_of("husky_a200")
    servo = find_effect("wheel_servo")(**SERVO)
    alone = servo.list_seen(vehicle)
    beside = (find_effect("drive_lag")(tau=0.3), find_effect("transport_delay")(d=0.2), servo)
    seen = servo.list_seen(vehicle, beside)
    step = predict_step(vehicle, beside, seen["asked"], 0.0, 5.0).x / seen["asked"]
    risen = STEP * (0.5 + np.flatnonzero(step >= 1.0 - np.exp(-1.0))[0])
    assert risen - STEP <= seen["rise"] <= risen
    assert seen["rise"] > alone["rise"] + 0.2
    turned = predict_step(vehicle, beside, 0.0, seen["turn"], 2.0).w[-1] / seen["turn"]
    assert seen["turned"] == pytest.approx(turned)
    assert 0.0 < seen["turned"] < alone["turned"]


def test_its_sentence_speaks_of_what_the_run_asked_for() -> None:
    vehicle, servo = vehicle_of("husky_a200"), find_effect("wheel_servo")(**SERVO)
    said = servo.describe_motion(vehicle, (servo,), Asked(0.6, 1.0))
    assert "of 0.6 m/s" in said
    assert "at 1 rad/s" in said
    assert "turn" not in servo.describe_clause(vehicle, (servo,), Asked(0.6, 0.0))
    assert "m/s" not in servo.describe_motion(vehicle, (servo,), Asked(0.0, 1.0))
