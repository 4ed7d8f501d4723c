"""Motors under speed controllers, against closed forms and a general differential equation solver."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from pipeline.simulate.drivetrain import turn_by_motors
from pipeline.simulate.facts import VEHICLES, Effects
from pipeline.simulate.programs import lag_signal
from pipeline.simulate.run import simulate_run
from pipeline.simulate.scenario import Program, Scenario

Floats = NDArray[np.float64]

STEP = 0.001
HUSKY = VEHICLES["husky"]
RADIUS, HALF = HUSKY.wheel_radius_m, HUSKY.lever_m
USUAL = {"tau": 0.2, "reset": 0.4, "drag": 0.08, "bound": 1.1, "scrub": 1.3, "creep": 0.07}
_STUCK = 1.0 / 1.7 / math.sqrt(1.0 + 1.0 / 0.75)
"""Push over scrub at which a vehicle at rest begins to turn: ahead and aside the ground has 1 to 1 / .87."""


def drive(speed: Floats, turn: Floats, *, step_s: float = STEP, **numbers: float) -> tuple[Floats, Floats]:
    """Speed [m/s] and yaw rate [rad/s] of the wheels under commanded ones."""
    left, right = (speed - HALF * turn) / RADIUS, (speed + HALF * turn) / RADIUS
    left, right = turn_by_motors(HUSKY, left, right, Effects({"wheel_servo": numbers}), step_s)
    return 0.5 * RADIUS * (left + right), 0.5 * RADIUS / HALF * (right - left)


def hold(value: float, seconds: float) -> Floats:
    return np.full(round(seconds / STEP), value)


def test_wheels_in_the_air_lag_as_their_own_inertia_says() -> None:
    speed = np.concatenate((hold(0.6, 2.0), hold(-0.4, 2.0)))
    turn = np.concatenate((hold(0.3, 1.0), hold(0.9, 3.0)))
    found, turned = drive(speed, turn, tau=0.5)
    lag = 0.7 / 1.7 * 0.5
    np.testing.assert_allclose(found, lag_signal(speed, tau_s=lag, step_s=STEP), atol=1e-5)
    np.testing.assert_allclose(turned, lag_signal(turn, tau_s=lag, step_s=STEP), atol=1e-5)


def test_straight_ahead_on_firm_ground_wheels_push_the_whole_vehicle() -> None:
    speed = hold(0.6, 3.0)
    found, turned = drive(speed, hold(0.0, 3.0), tau=0.5, scrub=100.0)
    np.testing.assert_allclose(found, lag_signal(speed, tau_s=0.5, step_s=STEP), atol=0.02)
    assert not turned.any()


def test_with_grip_the_bound_over_tau_is_the_largest_acceleration() -> None:
    numbers = {"tau": 0.2, "bound": 0.1, "scrub": 50.0}
    speed = np.concatenate((hold(1.0, 4.0), hold(-1.0, 6.0)))
    found, _ = drive(speed, 0.0 * speed, **numbers)
    # Before the vehicle follows, the slip that gives its force appears: a centimetre a second.
    since = np.arange(speed.size) * STEP
    assert np.all(found[:4000] < 0.1 / 0.2 * since[:4000] + 0.01)
    gain = np.diff(found) / STEP
    assert gain[100:1700] == pytest.approx(0.1 / 0.2, rel=1e-3)
    assert gain[4100:7500] == pytest.approx(-0.1 / 0.2, rel=1e-3)


def test_a_bound_below_the_scrub_keeps_a_vehicle_from_turning_on_the_spot() -> None:
    reached = [
        drive(hold(0.0, 15.0), hold(1.0, 15.0), tau=0.2, reset=0.4, scrub=1.3, bound=share * _STUCK * 1.3)[1]
        for share in (0.9, 1.1)
    ]
    # Stuck, it creeps: the force of .9 takes a slip of .021 of the scrub, most of it of the wheels.
    level = 0.01 * 0.9 / math.sqrt(1.0 - 0.9**2) * 1.3
    along, aside = level * math.sqrt(0.75 / 1.75), level / math.sqrt(1.75)
    assert reached[0][-1] == pytest.approx((along + aside / math.sqrt(0.75)) / HALF, rel=1e-3)
    assert reached[1][-1] > 0.9


def test_a_turn_below_the_scrub_begins_when_the_integral_part_has_grown() -> None:
    """Stuck, the error is all that is asked, e (1 + reset t), which here passes the friction after 5 s."""
    turn = hold(0.6, 12.0)
    numbers = {"tau": 0.1, "reset": 0.2, "scrub": 2.0 * 0.6 * HALF / _STUCK}
    _, turned = drive(0.0 * turn, turn, **numbers)
    assert turned[:2500].max() < 0.1 * 0.6
    assert turned[:5000].max() < 0.2 * 0.6
    assert turned[11_000:].min() > 0.6 * 0.6
    _, fast = drive(0.0 * turn, 5.0 * turn, **numbers)
    assert fast[500] > 0.5 * 5.0 * 0.6


def test_a_rolling_wheel_has_less_friction_in_a_turn() -> None:
    turn = hold(0.5, 4.0)
    numbers = {"tau": 0.2, "scrub": 1.3}
    spot, slow, fast, ideal = (
        drive(0.0 * turn + speed, turn, creep=creep, **numbers)[1][-1]
        for speed, creep in ((0.0, 0.3), (1.0, 0.07), (1.0, 0.3), (1.0, 1e9))
    )
    assert 0.0 < spot < slow < fast < ideal
    assert ideal == pytest.approx(0.5, abs=1e-6)


def test_without_a_command_the_integral_part_is_cleared() -> None:
    turn, rest = hold(0.6, 3.0), hold(0.0, 3.0)
    asked = np.concatenate((turn, rest, turn, rest, -turn))
    first, _, second, _, back = np.split(drive(0.0 * asked, asked, **USUAL)[1], 5)
    np.testing.assert_allclose(second, first, atol=1e-5)
    np.testing.assert_allclose(back, -first, atol=1e-5)
    # A command of the other side keeps it.
    kept = np.split(drive(np.where(asked == 0.0, 0.1, 0.0), asked, **USUAL)[1], 5)[2]
    assert np.abs(kept - first).max() > 0.05


@pytest.mark.parametrize(("reset", "short"), [(0.0, 0.08 * 0.6 / math.hypot(0.6, 0.05)), (0.4, 0.0)])
def test_rolling_resistance_takes_speed_until_the_integral_part_makes_up_for_it(
    reset: float, short: float
) -> None:
    speed = hold(0.6 + short, 30.0)
    found, _ = drive(speed, 0.0 * speed, **{**USUAL, "reset": reset})
    assert found[-1] == pytest.approx(0.6, abs=1e-4)


def test_the_integral_part_does_not_wind_up_at_the_bound() -> None:
    speed = hold(1.0, 20.0)
    numbers = {"tau": 0.2, "reset": 2.0, "scrub": 50.0}
    held, free = (drive(speed, 0.0 * speed, bound=bound, **numbers)[0] for bound in (0.05, math.inf))
    assert held.max() < free.max()
    assert held.max() < 1.05


def test_both_sides_are_alike() -> None:
    generator = np.random.default_rng(3)
    speed, turn = (np.repeat(generator.uniform(-1.0, 1.0, 6), 500) for _ in range(2))
    found, turned = drive(speed, turn, **USUAL)
    mirrored, turned_back = drive(speed, -turn, **USUAL)
    reverse, turned_reverse = drive(-speed, turn, **USUAL)
    np.testing.assert_allclose(mirrored, found, atol=1e-12)
    np.testing.assert_allclose(turned_back, -turned, atol=1e-12)
    np.testing.assert_allclose(reverse, -found, atol=1e-12)
    np.testing.assert_allclose(turned_reverse, turned, atol=1e-12)


def test_the_width_of_cells_hardly_matters() -> None:
    generator = np.random.default_rng(4)
    speed, turn = (np.repeat(generator.uniform(-1.0, 1.0, 4), 1000) for _ in range(2))
    fine = drive(speed, turn, **USUAL)
    coarse = drive(speed[::20], turn[::20], step_s=0.02, **USUAL)
    for one, other in zip(fine, coarse, strict=True):
        np.testing.assert_allclose(one.reshape(-1, 20).mean(axis=1), other, atol=1e-9)


@pytest.mark.parametrize(
    ("speed", "turn", "numbers"),
    [
        (1.0, 0.8, USUAL),
        (0.0, 1.0, {**USUAL, "scrub": 0.3}),
        (0.3, -0.6, {**USUAL, "tau": 0.4, "bound": 0.3, "drag": 0.01, "creep": 0.0}),
        (-0.8, 0.5, {**USUAL, "tau": 0.05, "reset": 1.0, "scrub": 0.6, "creep": 0.3}),
    ],
    ids=str,
)
def test_its_steps_are_short_enough(speed: float, turn: float, numbers: dict[str, float]) -> None:
    """The equations as they are written, by a method with a step of its own choice."""
    tau, lean = numbers["tau"], math.sqrt(0.75)
    asked = np.array([speed - HALF * turn, speed + HALF * turn])
    side = np.array([-1.0, 1.0])

    def change(_: float, state: Floats) -> Floats:
        rim, memory, ahead, rate = state[:2], state[2:4], state[4], state[5]
        error = asked - rim
        push = np.clip(error + memory, -numbers["bound"], numbers["bound"])
        along, aside = rim - (ahead + side * HALF * rate), lean * HALF * rate
        slip = np.hypot(along, aside) / numbers["scrub"]
        least = 2.0 * np.sqrt((numbers["creep"] * rim) ** 2 + slip**2 + 0.01**2)
        pushed, held = along / least, aside / least
        resistance = numbers["drag"] * rim / np.hypot(rim, 0.05)
        faster = (1.7 * (push - resistance) - 2.0 * pushed) / (0.7 * tau)
        winds = (np.abs(error + memory) < numbers["bound"]) | (error * push < 0.0)
        yaw = (pushed @ side - lean * held.sum()) / tau / HALF
        return np.array([*faster, *(numbers["reset"] * error * winds), pushed.sum() / tau, yaw])

    edges = np.arange(1001) * STEP
    found = solve_ivp(change, (0.0, 1.0), np.zeros(6), method="LSODA", t_eval=edges, rtol=1e-8, atol=1e-9)
    left, right = 0.5 * (found.y[:2, 1:] + found.y[:2, :-1])
    ours, turned = drive(hold(speed, 1.0), hold(turn, 1.0), **numbers)
    np.testing.assert_allclose(ours, 0.5 * (left + right), atol=1e-2)
    np.testing.assert_allclose(turned, 0.5 * (right - left) / HALF, atol=3e-2)
    assert np.sqrt(np.mean((ours - 0.5 * (left + right)) ** 2)) < 1e-3


def test_they_act_in_a_log_where_the_other_effects_of_the_drivetrain_do() -> None:
    circle = Scenario(program=Program("circle", lead_s=1.0), duration_s=10.0)
    asked = {"wheel_servo": {**USUAL, "reset": 0.0, "scrub": 0.3}}
    plain, lagged = (
        simulate_run(replace(circle, effects=effects)).truth.drive
        for effects in (asked, {**asked, "transport_delay": {"d": 0.2}})
    )
    np.testing.assert_allclose(lagged.left[200:8000], plain.left[:7800], atol=1e-9)
    left, right = 0.165 * plain.left[8000], 0.165 * plain.right[8000]
    # .6 m/s and .6 rad/s are asked for: it is slower by its rolling resistance and turns less.
    assert 0.5 * (left + right) == pytest.approx(0.6 - 0.08, abs=0.01)
    assert 0.1 < (right - left) / 0.55 < 0.5
