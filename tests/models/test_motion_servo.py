"""Speed loops: what they are without integral part, friction and bound, and that they come back of a log."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_runs import simulate, vehicle_of

from pipeline.estimation import Input, Problem, fit_model
from pipeline.estimation.comparison import Comparison
from pipeline.models import Model, Timing, find_effect
from pipeline.models.filters import ServoNumbers, follow_servo, lag_signal, limit_rate
from pipeline.models.parameter import Conditions, Largest
from pipeline.run.heading import Grid, average_held
from pipeline.run.signals import Resets
from pipeline.simulate import VEHICLES, Program
from pipeline.simulate.drivetrain import turn_by_motors
from pipeline.simulate.facts import Effects

STEP = 0.02
HUSKY = VEHICLES["husky"]
SERVO = {"tau": 0.6, "reset": 0.4, "scrub": 0.8, "effort": 2.5, "windup": 0.6}


def from_rest(size: int) -> tuple[Resets, np.ndarray]:
    first = np.array([0])
    return Resets(np.zeros(size, dtype=np.int64), first, first, np.zeros((1, 3))), np.zeros(1)


def serve(signal: np.ndarray, across: float = 0.0, **numbers: float) -> np.ndarray:
    resets, start = from_rest(signal.size)
    return follow_servo(signal, ServoNumbers(**numbers), np.full(signal.size, across), STEP, resets, start)


def draw_steps(seed: int, size: float = 1.0) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).uniform(-size, size, 40), 75)


def test_without_integral_part_friction_and_bound_it_is_a_lag() -> None:
    signal = draw_steps(1)
    resets, start = from_rest(signal.size)
    assert np.allclose(serve(signal, tau=0.7), lag_signal(signal, 0.7, STEP, resets, start), atol=1e-12)


def test_a_drag_makes_the_lag_shorter_and_its_end_lower() -> None:
    signal = draw_steps(2)
    resets, start = from_rest(signal.size)
    lagged = lag_signal(signal / 1.25, 0.7 / 1.25, STEP, resets, start)
    assert np.allclose(serve(signal, tau=0.7, drag=0.25), lagged, atol=1e-12)


def test_without_time_constant_it_is_a_limit_of_acceleration() -> None:
    signal = draw_steps(3)
    resets, start = from_rest(signal.size)
    assert np.allclose(
        serve(signal, tau=0.0, effort=1.5), limit_rate(signal, 1.5, STEP, resets, start), atol=1.5 * STEP
    )


def test_without_a_command_the_integral_part_is_cleared() -> None:
    """A turn after a pause begins as late as the first one; after a turn the other way, too."""
    numbers = {"tau": 0.4, "reset": 0.3, "scrub": 1.1, "windup": 1.0, "effort": 4.0}
    turn, pause = np.full(300, 0.4), np.zeros(100)
    served = serve(np.concatenate((turn, pause, turn, pause, -turn)), **numbers).reshape(-1, 100)
    first, again, back = served[:3].ravel(), served[4:7].ravel(), served[8:].ravel()
    assert np.abs(first[:100]).max() == 0.0 < first.max()
    assert np.allclose(again, first, atol=1e-12)
    assert np.allclose(back, -first, atol=1e-12)


def test_as_effects_both_loops_without_more_are_a_turn_lag() -> None:
    run = simulate({}, duration_s=40.0)
    comparison = Comparison(run, vehicle_of("husky_a200"), Input.COMMAND)
    loops = (find_effect("speed_servo")(tau=0.3), find_effect("turn_servo")(tau=1.1))
    lag = find_effect("turn_lag")(tau_mean=0.3, tau_diff=1.1)
    one, other = (comparison.predict_velocity(effects, Timing()) for effects in (loops, (lag,)))
    assert np.allclose(one.x, other.x, atol=1e-12)
    assert np.allclose(one.w, other.w, atol=1e-12)


def test_below_the_friction_it_stands_until_the_integral_part_has_grown() -> None:
    signal = np.full(500, 0.5)
    turned = serve(signal, tau=0.4, reset=0.25, scrub=1.0)
    # Stuck, the error is all of the signal: 0.5 (1 + 0.25 t) passes 1 after four seconds.
    moving = int(np.flatnonzero(turned)[0]) * STEP
    assert moving == pytest.approx(4.0, abs=1.5 * STEP)
    assert 0.35 < turned[-1] < 0.5


def test_motion_beside_it_lowers_the_friction() -> None:
    signal = np.full(2000, 0.5)
    turned = float(serve(signal, across=0.2, tau=0.4, scrub=0.6)[-1])
    assert turned == pytest.approx(0.5 - 0.6 * turned / (turned + 0.2), abs=1e-9)


@pytest.mark.parametrize("across", [0.0, 1e-9])
def test_friction_holds_what_stands_whether_it_drives_by_a_hair_or_not(across: float) -> None:
    assert np.abs(serve(np.full(300, 0.5), across, tau=0.4, scrub=0.6)).max() < 1e-6


def test_a_bound_that_nothing_reaches_holds_the_integral_part() -> None:
    """Else it winds up while the drive gives all that it can, and the turn overshoots."""
    signal = np.repeat([2.0, 2.0, 0.0], 100)
    turned = serve(signal, tau=0.2, reset=2.0, effort=0.5)
    assert turned[:200].max() < 2.0
    assert turned[-1] == pytest.approx(turned[199] - 0.5 * 2.0, abs=0.02)


def test_the_integral_part_grows_no_further_than_its_windup() -> None:
    signal = np.full(2000, 0.5)
    assert serve(signal, tau=0.4, reset=1.0, scrub=0.8, windup=0.4)[-1] == pytest.approx(0.1, abs=1e-9)


@given(
    seed=st.integers(0, 2**31),
    tau=st.floats(0.2, 2.0),
    reset=st.floats(0.0, 0.8),
    scrub=st.floats(0.0, 1.0),
    effort=st.floats(0.3, 5.0),
    windup=st.floats(0.05, 2.0),
)
@settings(max_examples=20, deadline=None)
def test_it_agrees_with_motors_that_are_stepped_through(
    seed: int, tau: float, reset: float, scrub: float, effort: float, windup: float
) -> None:
    """The generator's motors, written on their own and integrated by short steps."""
    numbers = {"tau": tau, "reset": reset, "scrub": scrub, "effort": effort, "windup": windup}
    speed, turn = draw_steps(seed), draw_steps(seed + 1)
    half = HUSKY.lever_m * turn
    left, right = (speed - half) / HUSKY.wheel_radius_m, (speed + half) / HUSKY.wheel_radius_m
    driven = turn_by_motors(HUSKY, left, right, Effects({"turn_servo": numbers}), STEP)
    expected = (driven[1] - driven[0]) * HUSKY.wheel_radius_m / (2.0 * HUSKY.lever_m)
    resets, start = from_rest(turn.size)
    across = 0.15 * np.abs(speed) / (2.0 * HUSKY.lever_m)
    found = follow_servo(turn, ServoNumbers(**numbers), across, STEP, resets, start)
    assert float(np.sqrt(np.mean((found - expected) ** 2))) < 0.02


@pytest.mark.long
def test_a_gentle_drive_tells_the_friction_and_the_integral_part_of_its_loop() -> None:
    """Turns below the scrub begin seconds late: no lag of a plausible size does that."""
    hidden = {"tau": 0.45, "reset": 0.35, "scrub": 1.1, "windup": 1.0, "effort": 4.0}
    run = simulate(
        {"turn_servo": hidden},
        duration_s=240.0,
        vehicle=VEHICLES["warthog"],
        program=Program("smooth", speed_scale=0.2, turn_scale=0.25),
    )
    problem = Problem([run], vehicle_of("warthog"), Input.COMMAND)
    servo = fit_model(problem, Model(problem.vehicle, (find_effect("turn_servo")(),)))
    lag = fit_model(problem, Model(problem.vehicle, (find_effect("turn_lag")(),)))
    found = servo.model.effect("turn_servo").values
    assert found["reset"] == pytest.approx(hidden["reset"], rel=0.1)
    assert found["scrub"] == pytest.approx(hidden["scrub"], rel=0.1)
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
    resets, start = from_rest(1500)

    def turn(change: float) -> np.ndarray:
        numbers = {key: value * (1.0 + (change if key == name else 0.0)) for key, value in SERVO.items()}
        at = times + late + (change if name == "late" else 0.0)
        turned, idle = (average_held(at, values, grid) for values in (turns, 1.0 * (turns == 0.0)))
        numbers = ServoNumbers(**numbers)
        return follow_servo(turned, numbers, np.full(1500, 0.2), STEP, resets, start, idle)

    steps = np.linspace(0.0, STEP, 400)
    size = [float(np.sqrt(np.mean((turn(after) - turn(before)) ** 2))) for before, after in pairwise(steps)]
    assert max(size) < 1e-3


@pytest.mark.parametrize(
    ("reset", "windup", "is_lag"), [(0.0, 1.0, True), (1.0, 1.0, False), (1.0, 0.01, True)]
)
def test_a_loop_with_an_integral_part_is_no_lag(reset: float, windup: float, *, is_lag: bool) -> None:
    """A lag never passes what is asked; an integral that may grow does."""
    numbers = {"tau": 1.0, "reset": reset, "scrub": 0.0, "windup": windup, "effort": 5.0}
    overshoot = float(serve(np.ones(1500), **numbers).max()) - 1.0
    assert (overshoot < 0.02) is is_lag
    conditions = Conditions(Largest(1.0, 1.0, 1.0, 1.0, np.linspace(0.0, 30.0, 11)))
    assert find_effect("turn_servo")(**numbers).is_degenerate(conditions) is is_lag
