"""The rigid-body skid-steer slips for physical reasons, in the measure that mechanics predicts."""

import math
from dataclasses import replace

import numpy as np
import pytest
from game.rigid_bodies import MACHINES, SkidSteer, simulate_skid_steer
from numpy.typing import NDArray

from pipeline.simulate.facts import VEHICLES, SimulateError
from pipeline.simulate.run import SimulatedRun
from pipeline.simulate.scenario import Ground, Program, Scenario

pytestmark = pytest.mark.long

Floats = NDArray[np.float64]
SPIN = Scenario(program=Program("circle", speed_scale=0.0), duration_s=15.0)
STRAIGHT = Scenario(program=Program("circle", turn_scale=0.0), duration_s=12.0)
HUSKY = MACHINES["husky"]


def steady(run: SimulatedRun) -> Floats:
    velocity = run.truth.path.velocity
    means: Floats = velocity[velocity.shape[0] // 2 : int(0.8 * velocity.shape[0])].mean(axis=0)
    return means


@pytest.mark.parametrize("name", ["husky", "warthog"])
def test_spinning_on_the_spot_scrubs_as_the_wheelbase_says(name: str) -> None:
    vehicle = VEHICLES[name]
    run = simulate_skid_steer(replace(SPIN, vehicle=vehicle), replace(MACHINES[name], friction=0.3))
    ratio = float(np.median(run.truth.motion.w0[4000:6000])) / steady(run)[2]
    assert ratio == pytest.approx(1.0 + (vehicle.wheelbase_m / vehicle.track_width_m) ** 2, rel=0.05)


def test_a_fast_curve_turns_more_of_what_its_wheels_ask_than_a_spin() -> None:
    """The curve's centripetal force takes grip that would resist the turn: `speed_track` is contact's."""

    def share(speed: float) -> float:
        turn = Program("circle", speed_scale=speed / 3.0, turn_scale=1.0 / 1.2)
        fast = replace(SPIN, vehicle=VEHICLES["warthog"], program=turn)
        run = simulate_skid_steer(fast, MACHINES["warthog"])
        return float(steady(run)[2] / np.median(run.truth.motion.w0[4000:6000]))

    assert share(2.5) > 1.2 * share(0.0)
    assert share(1.0) < 1.1 * share(0.0)


@pytest.mark.parametrize("friction", [0.1, 0.3])
def test_getting_under_way_takes_the_time_that_grip_allows(friction: float) -> None:
    path = simulate_skid_steer(STRAIGHT, replace(HUSKY, friction=friction)).truth.path
    moving = path.time_s[:-1][path.velocity[:, 0] > 0.9 * 0.6][0] - 2.0185
    assert moving == pytest.approx(0.9 * 0.6 / (friction * 9.80665), rel=0.15)


def test_wheels_slip_downhill_on_a_slope() -> None:
    on_slope = replace(SPIN, ground=Ground(roll_rad=0.15))
    run = simulate_skid_steer(on_slope, replace(HUSKY, friction=0.4))
    moved = run.truth.path.position[-1] - run.truth.path.position[0]
    # roll > 0 rises towards +y: down is -y.
    assert moved[1] < -0.1
    assert moved[2] < 0.0
    assert abs(moved[0]) < 0.3 * abs(moved[1])


def test_a_load_at_the_back_moves_the_centre_of_rotation_back() -> None:
    _, v_y, v_w = steady(simulate_skid_steer(SPIN, replace(HUSKY, payload_kg=35.0, payload_x_m=-0.15)))
    # v_y = -x_icr w.
    assert -0.2 < -v_y / v_w < -0.08
    _, centred, rate = steady(simulate_skid_steer(SPIN, HUSKY))
    assert abs(centred / rate) < 0.01


def test_smaller_wheels_on_one_side_pull_to_that_side() -> None:
    velocity = steady(simulate_skid_steer(STRAIGHT, replace(HUSKY, left_radius_scale=0.95)))
    assert velocity[2] > 0.01
    assert velocity[0] == pytest.approx(0.6 * 0.975, rel=0.01)


def test_weak_motors_are_late() -> None:
    def reach_half(machine: SkidSteer) -> float:
        path = simulate_skid_steer(STRAIGHT, machine).truth.path
        return float(path.time_s[:-1][path.velocity[:, 0] > 0.3][0])

    assert reach_half(replace(HUSKY, torque_nm=10.0)) > reach_half(HUSKY) + 0.3


def test_a_rigid_body_run_is_recorded_like_any_other_and_repeats_bit_for_bit() -> None:
    scenario = Scenario(duration_s=20.0, effects={"lever_arm": {"l_x": 0.1}, "drive_lag": 0.3}, seed=3)
    first, second = simulate_skid_steer(scenario, HUSKY), simulate_skid_steer(scenario, HUSKY)
    assert first.poses.position.tobytes() == second.poses.position.tobytes()
    assert first.wheels is not None
    assert first.imu is not None
    spread = np.abs(np.interp(first.imu.time_s, first.truth.path.time_s[1:], first.truth.path.velocity[:, 2]))
    assert np.corrcoef(spread, np.abs(first.imu.rates[:, 2]))[0, 1] > 0.98


@pytest.mark.parametrize(
    "scenario",
    [
        replace(SPIN, effects={"effective_track": 1.8}),
        replace(SPIN, ground=Ground(hill_m=0.2)),
        replace(SPIN, vehicle=VEHICLES["car"]),
        replace(SPIN, extra=lambda _: (0.0, 0.0, 0.0)),
    ],
    ids=["ground_effect", "hills", "car", "extra"],
)
def test_formulas_are_refused_where_contact_decides(scenario: Scenario) -> None:
    with pytest.raises(SimulateError):
        simulate_skid_steer(scenario, HUSKY)


def test_slope_is_in_the_reported_attitude() -> None:
    poses = simulate_skid_steer(replace(STRAIGHT, ground=Ground(pitch_rad=0.1)), HUSKY).poses
    position, _ = poses.in_map()
    drop = position[-1, 2] - position[0, 2]
    assert drop == pytest.approx(-math.tan(0.1) * (position[-1, 0] - position[0, 0]), rel=0.02)
