"""Every effect against numbers worked out by hand from its formula, on motions with a closed form."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.core.rigid import rotate
from pipeline.simulate.facts import CATALOGUE, VEHICLES, Vehicle
from pipeline.simulate.run import simulate_run
from pipeline.simulate.scenario import Commands, Disturbance, Ground, Program, Scenario, State

Floats = NDArray[np.float64]
Asked = Mapping[str, Mapping[str, float] | float]

HUSKY = VEHICLES["husky"]
CAR = VEHICLES["car"]
YOUBOT = VEHICLES["youbot"]
OMNI = VEHICLES["omni"]
BY_KIND = {"differential": HUSKY, "ackermann": CAR, "mecanum": YOUBOT}
CIRCLE = Scenario(
    program=Program("circle", lead_s=1.0),
    duration_s=30.0,
    pose=replace(Scenario().pose, noise_m=0, noise_rad=0),
)
# A circle is driven at 60 % of the Husky's 1 m/s and 1 rad/s.
V0, W0 = 0.6, 0.6
FIRST_COMMAND_S = 1.0 + 0.37 / 20.0


def steady_velocity(effects: Asked, scenario: Scenario = CIRCLE) -> Floats:
    run = simulate_run(replace(scenario, effects=effects))
    path = run.truth.path
    window = (path.time_s[:-1] > 20.0) & (path.time_s[:-1] < 28.0)
    return path.velocity[window].mean(axis=0)


INERTIA = 1.0 + (0.5 * W0) ** 2


# On mecanum wheels a circle is driven at 60 % of 0.8 m/s ahead and to the left, and of 1.2 rad/s.
AHEAD, ASIDE, AROUND = 0.48, 0.48, 0.72
LEVER, RADIUS = 0.5 * (0.3 + 0.47), 0.0475
SLIDING = (AHEAD + 1j * ASIDE) / (1.0 + 0.5j * AROUND)
DELTA, SPEED = 0.6 * CAR.max_steering_rad, 0.6 * CAR.max_speed_mps

STEADY: list[tuple[Vehicle, Asked, tuple[float, float, float]]] = [
    (HUSKY, {}, (V0, 0, W0)),
    (HUSKY, {"wheel_radius": 0.9}, (0.9 * V0, 0, 0.9 * W0)),
    (HUSKY, {"wheel_asymmetry": 0.1}, (V0 + 0.05 * W0 * 0.275, 0, W0 + 0.1 * V0 / 0.55)),
    (HUSKY, {"effective_track": 1.8}, (V0, 0, W0 / 1.8)),
    (HUSKY, {"icr_offset": 0.12}, (V0, -0.12 * W0, W0)),
    (HUSKY, {"icr_lateral": 0.1}, (V0 + 0.1 * W0, 0, W0)),
    (HUSKY, {"lateral_skid": 0.1}, (V0, -0.1 * V0 * W0, W0)),
    (HUSKY, {"speed_slip": 0.08}, (V0 - 0.08 * V0**2, 0, W0)),
    (HUSKY, {"turning_resistance": 0.24}, (V0 - 0.24 * V0 * W0, 0, W0)),
    (HUSKY, {"speed_track": 0.2}, (V0, 0, W0 + 0.2 * V0 * W0)),
    (HUSKY, {"lateral_drift": 0.05}, (V0, 0.05, W0)),
    (HUSKY, {"yaw_drift": 0.06}, (V0, 0, W0 + 0.06)),
    (HUSKY, {"terrain_change": {"k_v": 0.8, "k_w": 0.7, "at_s": 10.0}}, (0.8 * V0, 0, 0.7 * W0)),
    (HUSKY, {"body_speed_limit": 0.5}, (0.5, 0, W0)),
    (HUSKY, {"body_turn_limit": 0.4}, (V0, 0, 0.4)),
    # The right wheel runs at (0.6 + 0.6 * 0.275) / 0.165 = 4.636 rad/s, the left one at 2.636.
    (HUSKY, {"wheel_speed_limit": 4.0}, ((0.435 + 0.66) / 2, 0, (0.66 - 0.435) / 0.55)),
    (HUSKY, {"wheel_speed_scaling": 4.0}, (V0 * 0.66 / 0.765, 0, W0 * 0.66 / 0.765)),
    (HUSKY, {"deadband": 0.5}, (0.765 / 2, 0, 0.765 / 0.55)),
    (HUSKY, {"turn_droop": {"threshold": 1.5, "gain": 0.4}}, (V0, 0, 0.165 / 0.55 * (1.5 + 0.4 * 0.5))),
    (HUSKY, {"drive_gain": 0.9}, (0.9 * V0, 0, 0.9 * W0)),
    (HUSKY, {"load_droop": 0.05}, (V0 - 0.05, 0, W0)),
    (HUSKY, {"difference_gain": 0.5}, (V0, 0, 0.5 * W0)),
    (HUSKY, {"side_gain": 0.1}, (V0 + 0.05 * W0 * 0.275, 0, W0 + 0.1 * V0 / 0.55)),
    (HUSKY, {"body_inertia": 0.5}, (V0 / INERTIA, -0.5 * W0 * V0 / INERTIA, W0)),
    (HUSKY, {"tyre_torsion": {"tau": 0.1, "damping": 0.3}}, (V0, 0, W0)),
    # The order of a command's way: the track changes w0, and only then inertia and skid look at it.
    (
        HUSKY,
        {"effective_track": 1.5, "lateral_skid": 0.1, "icr_offset": 0.1},
        (V0, -0.1 * V0 * 0.4 - 0.1 * 0.4, 0.4),
    ),
    (
        HUSKY,
        {"body_inertia": 0.5, "lateral_skid": 0.1},
        (V0 / INERTIA, -0.5 * W0 * V0 / INERTIA - 0.1 * V0 * W0, W0),
    ),
    (HUSKY, {"drive_lag": 0.4, "turn_lag": {"tau_mean": 0.2, "tau_diff": 0.9}}, (V0, 0, W0)),
    (YOUBOT, {"yaw_pull": 0.1}, (AHEAD, ASIDE, AROUND + 0.1 * AHEAD)),
    (YOUBOT, {"lateral_pull": 0.1}, (AHEAD, ASIDE + 0.1 * AHEAD, AROUND)),
    (YOUBOT, {}, (AHEAD, ASIDE, AROUND)),
    (YOUBOT, {"lateral_scale": 0.8}, (AHEAD, 0.8 * ASIDE, AROUND)),
    (YOUBOT, {"roller_slip": 0.3}, (AHEAD, ASIDE - 0.3 * ASIDE**2, AROUND)),
    (
        YOUBOT,
        {"lateral_scale": 0.8, "roller_slip": 0.3},
        (AHEAD, 0.8 * ASIDE - 0.3 * (0.8 * ASIDE) ** 2, AROUND),
    ),
    (YOUBOT, {"effective_track": 1.2}, (AHEAD, ASIDE, AROUND / 1.2)),
    (YOUBOT, {"wheel_radius": 0.9}, (0.9 * AHEAD, 0.9 * ASIDE, 0.9 * AROUND)),
    (YOUBOT, {"wheel_asymmetry": 0.1}, (AHEAD + 0.05 * LEVER * AROUND, ASIDE, AROUND + 0.05 * AHEAD / LEVER)),
    (YOUBOT, {"lateral_skid": 0.1}, (AHEAD + 0.1 * ASIDE * AROUND, ASIDE - 0.1 * AHEAD * AROUND, AROUND)),
    (YOUBOT, {"body_inertia": 0.5}, (SLIDING.real, SLIDING.imag, AROUND)),
    (YOUBOT, {"drive_lag": 0.4, "turn_lag": {"tau_mean": 0.2, "tau_diff": 0.9}}, (AHEAD, ASIDE, AROUND)),
    # Rims turn at 0 -+ 0.2772 and 0.96 -+ 0.2772 m/s; only the front right one is held back, to 0.95 m/s.
    (
        YOUBOT,
        {"wheel_speed_limit": 0.95 / RADIUS},
        (0.4082, 0.4082, (2 * 0.2772 + 0.95 - 0.6828) / 4 / LEVER),
    ),
    (OMNI, {"lateral_scale": 0.9}, (AHEAD, 0.9 * ASIDE, 0.6 * OMNI.max_turn_radps)),
    (CAR, {}, (SPEED, 0.0, SPEED * math.tan(DELTA) / 2.6)),
    (CAR, {"steering_offset": 0.05}, (SPEED, 0.0, SPEED * math.tan(DELTA + 0.05) / 2.6)),
    (CAR, {"steering_sensor_offset": 0.05}, (SPEED, 0.0, SPEED * math.tan(DELTA + 0.05) / 2.6)),
    (CAR, {"steering_gain": 0.8}, (SPEED, 0.0, SPEED * math.tan(0.8 * DELTA) / 2.6)),
    (CAR, {"understeer": 0.03}, (SPEED, 0.0, SPEED * math.tan(DELTA) / (2.6 + 0.03 * SPEED**2))),
    (CAR, {"effective_wheelbase": 1.2}, (SPEED, 0.0, SPEED * math.tan(DELTA) / (1.2 * 2.6))),
    (CAR, {"steering_lag": 0.4}, (SPEED, 0.0, SPEED * math.tan(DELTA) / 2.6)),
    (CAR, {"steering_rate_limit": 0.3}, (SPEED, 0.0, SPEED * math.tan(DELTA) / 2.6)),
    (CAR, {"steering_sensor_play": 0.05}, (SPEED, 0.0, SPEED * math.tan(DELTA - 0.05) / 2.6)),
    (CAR, {"body_turn_limit": 0.5}, (SPEED, 0.0, 0.5)),
]


def test_a_steady_circle_has_the_velocity_of_the_formula() -> None:
    for vehicle, effects, expected in STEADY:
        found = steady_velocity(effects, replace(CIRCLE, vehicle=vehicle))
        np.testing.assert_allclose(found, expected, atol=1e-6, err_msg=f"{vehicle.name} {effects}")


def test_every_mecanum_wheel_has_an_encoder_of_its_own() -> None:
    wheels = simulate_run(replace(CIRCLE, vehicle=YOUBOT)).wheels
    steady = (wheels.time_s > 20.0) & (wheels.time_s < 28.0)
    found = [float(wheel[steady].mean()) for wheel in wheels.corners.values()]
    turn = LEVER * AROUND
    rims = [AHEAD - ASIDE - turn, AHEAD + ASIDE + turn, AHEAD + ASIDE - turn, AHEAD - ASIDE + turn]
    assert list(wheels.corners) == ["front_left", "front_right", "rear_left", "rear_right"]
    assert found == pytest.approx([rim / RADIUS for rim in rims], abs=0.01)


def test_a_circle_has_the_radius_of_speed_over_rate() -> None:
    path = simulate_run(replace(CIRCLE, effects={"effective_track": 1.8})).truth.path
    x, y = path.position[(path.time_s > 2.0) & (path.time_s < 28.0), :2].T
    # Least-squares circle: x^2 + y^2 = 2 a x + 2 b y + c.
    (a, b, c), *_ = np.linalg.lstsq(np.stack((2 * x, 2 * y, np.ones_like(x)), 1), x**2 + y**2, rcond=None)
    assert math.sqrt(c + a**2 + b**2) == pytest.approx(1.8, rel=1e-5)


STRAIGHT = replace(CIRCLE, program=Program("circle", lead_s=1.0, turn_scale=0.0))


def wheel_response(effects: Asked, scenario: Scenario = STRAIGHT) -> tuple[Floats, Floats, Floats]:
    drive = simulate_run(replace(scenario, effects=effects)).truth.drive
    time = (np.arange(drive.left.size) + 0.5) * drive.step_s - FIRST_COMMAND_S
    keep = (time > 0.002) & (time < 20.0)
    return time[keep], drive.left[keep], drive.right[keep]


def rise(tau_s: float, to: float = V0 / 0.165) -> Callable[[Floats], Floats]:
    return lambda time: to * (1.0 - np.exp(-time / tau_s))


TURNING = rise(1.2, W0 * 0.55 / 0.165)
RESPONSES: list[tuple[Asked, Scenario, Callable[[Floats], Floats], Callable[[Floats], Floats], float]] = [
    ({"drive_lag": 0.5}, STRAIGHT, rise(0.5), rise(0.5), 2e-5),
    (
        {"turn_lag": {"tau_mean": 0.3, "tau_diff": 1.2}},
        CIRCLE,
        lambda time: rise(0.3)(time) - 0.5 * TURNING(time),
        lambda time: rise(0.3)(time) + 0.5 * TURNING(time),
        2e-5,
    ),
    ({"side_lag": {"tau_left": 0.9, "tau_right": 0.5}}, STRAIGHT, rise(0.9), rise(0.5), 2e-5),
    (
        {"acceleration_limit": 2.0},
        STRAIGHT,
        *[lambda time: np.minimum(2.0 * time, V0 / 0.165)] * 2,
        2e-3,
    ),
]


def test_a_step_of_the_command_is_answered_as_the_formula_says() -> None:
    for effects, scenario, on_left, on_right, atol in RESPONSES:
        time, left, right = wheel_response(effects, scenario)
        np.testing.assert_allclose(left, on_left(time), atol=atol, err_msg=str(effects))
        np.testing.assert_allclose(right, on_right(time), atol=atol, err_msg=str(effects))


# Forward for four seconds, backward for four, both from a command at a round second.
THERE_AND_BACK = replace(
    STRAIGHT,
    duration_s=8.0,
    played=Commands(np.arange(0.0, 8.0, 0.1), np.repeat([V0, -V0], 40), np.zeros(80)),
)


def test_a_braked_wheel_slows_down_fast_and_speeds_up_slowly() -> None:
    drive = simulate_run(
        replace(THERE_AND_BACK, effects={"brake_lag": {"tau_drive": 0.5, "tau_brake": 0.1}})
    ).truth.drive
    left, time = drive.left * 0.165 / V0, (np.arange(drive.left.size) + 1.0) * drive.step_s
    up, down = time < 4.0, (time > 4.0) & (left > 0.0)
    np.testing.assert_allclose(left[up], 1.0 - np.exp(-time[up] / 0.5), atol=1e-9)
    np.testing.assert_allclose(left[down], 2.0 * np.exp((4.0 - time[down]) / 0.1) - 1.0, atol=2e-3)
    stands = 4.0 + 0.1 * math.log(2.0)
    back = time > stands + 0.01
    np.testing.assert_allclose(left[back], np.exp((stands - time[back]) / 0.5) - 1.0, atol=5e-3)


def test_a_motor_of_limited_torque_ramps_and_then_lags() -> None:
    tau, limit = 0.2, 3.0 * V0 / 0.165
    drive = simulate_run(
        replace(THERE_AND_BACK, effects={"torque_limit": {"tau": tau, "limit": limit}})
    ).truth.drive
    left, time = drive.left * 0.165 / V0, (np.arange(drive.left.size) + 1.0) * drive.step_s
    ramp = 1.0 / 3.0 - tau
    first = np.where(time < ramp, 3.0 * time, 1.0 - 3.0 * tau * np.exp((ramp - time) / tau))
    np.testing.assert_allclose(left[time < 4.0], first[time < 4.0], atol=2e-3)
    ramp, since = 2.0 / 3.0 - tau, time - 4.0
    back = np.where(since < ramp, 1.0 - 3.0 * since, 3.0 * tau * np.exp((ramp - since) / tau) - 1.0)
    np.testing.assert_allclose(left[since > 0.01], back[since > 0.01], atol=2e-3)


def test_a_wheel_rests_before_it_reverses() -> None:
    drive = simulate_run(replace(THERE_AND_BACK, effects={"reversal_pause": 0.3})).truth.drive
    time = (np.arange(drive.left.size) + 0.5) * drive.step_s
    rests = (time > 4.0) & (time < 4.3)
    assert not drive.left[rests].any()
    np.testing.assert_allclose(drive.right[~rests] * 0.165, np.where(time[~rests] < 4.0, V0, -V0))


_WEAVING = Scenario(
    vehicle=VEHICLES["car"],
    duration_s=8.0,
    played=Commands(np.arange(0.0, 8.0, 0.1), np.ones(80), 0.3 * np.sin(np.arange(80) * 0.2)),
)


def test_a_steering_that_is_slow_turns_at_its_limit_until_it_has_caught_up() -> None:
    plain, slow = (
        simulate_run(replace(_WEAVING, effects=given)).truth.drive
        for given in ({}, {"steering_rate_limit": 0.25})
    )
    rates = np.diff(slow.steering) / slow.step_s
    assert np.abs(rates).max() == pytest.approx(0.25)
    late = plain.steering[1:] != slow.steering[1:]
    np.testing.assert_allclose(np.abs(rates[late]), 0.25)
    assert late.any()


def test_play_behind_the_sensor_is_seen_by_the_tyres_alone() -> None:
    before, behind = (
        simulate_run(replace(_WEAVING, effects={name: 0.04})).truth
        for name in ("steering_play", "steering_sensor_play")
    )
    np.testing.assert_array_equal(
        behind.drive.steering, simulate_run(replace(_WEAVING, effects={})).truth.drive.steering
    )
    np.testing.assert_allclose(behind.path.position, before.path.position)


def test_tyres_stay_within_the_play_of_their_steering() -> None:
    plain, loose = (
        simulate_run(replace(_WEAVING, effects=given)).truth.drive.steering
        for given in ({}, {"steering_play": 0.04})
    )
    moves = np.diff(loose) != 0.0
    np.testing.assert_allclose(np.abs(plain - loose)[1:][moves], 0.04, atol=1e-12)
    assert np.abs(plain - loose).max() <= 0.04 + 1e-12
    # It follows from behind: after each peak it stays until the steering has come back through the play.
    assert loose.max() == pytest.approx(plain.max() - 0.04)


@pytest.mark.parametrize("delay", [0.2, 0.1234567])
def test_transport_delay_shifts_the_step_even_between_grid_points(delay: float) -> None:
    drive = simulate_run(replace(STRAIGHT, effects={"transport_delay": delay})).truth.drive
    until = int(20.0 / drive.step_s)
    missing = 20.0 - drive.left[:until].sum() * drive.step_s / (V0 / 0.165)
    assert missing == pytest.approx(FIRST_COMMAND_S + delay, abs=1e-9)


def test_inertia_starts_from_rest_as_a_lag_when_going_straight() -> None:
    path = simulate_run(replace(STRAIGHT, effects={"body_inertia": 0.7})).truth.path
    time = path.time_s[:-1] + 0.0005 - FIRST_COMMAND_S
    keep = (time > 0.002) & (time < 20.0)
    np.testing.assert_allclose(path.velocity[keep, 0], V0 * (1 - np.exp(-time[keep] / 0.7)), atol=2e-5)


def test_time_drift_reaches_its_share_at_the_end() -> None:
    path = simulate_run(replace(STRAIGHT, effects={"time_drift": 0.1})).truth.path
    at = path.time_s[:-1]
    half = path.velocity[np.argmin(np.abs(at - 15.0)), 0]
    assert half == pytest.approx(V0 * 0.95, rel=1e-4)


def test_the_gain_of_the_drive_fades_to_its_share_at_the_end() -> None:
    drive = simulate_run(replace(STRAIGHT, effects={"gain_drift": 0.1, "drive_gain": 0.9})).truth.drive
    half = np.argmin(np.abs(np.arange(drive.left.size) * drive.step_s - 15.0))
    assert 0.165 * drive.left[half] == pytest.approx(0.9 * 0.95 * V0, rel=1e-4)


def test_the_controller_stops_some_time_after_the_last_command() -> None:
    quiet = replace(STRAIGHT, program=Program("circle", rate_hz=1.0, lead_s=1.0, hold_s=0.25))
    drive = simulate_run(quiet).truth.drive
    moving = np.mean(drive.left[5000:25000] > 0.0)
    assert moving == pytest.approx(0.25, abs=0.01)


def test_neutral_parameters_change_nothing_bit_for_bit() -> None:
    lagging: Asked = {"drive_lag": 0.3}
    base = Scenario(
        duration_s=12.0, disturbance=Disturbance(0.03, 0.05), ground=Ground(pitch_rad=0.1), effects=lagging
    )
    plain = {kind: simulate_run(replace(base, vehicle=vehicle)) for kind, vehicle in BY_KIND.items()}
    for name, spec in CATALOGUE.items():
        neutral = {item.name: item.neutral for item in spec.parameters if not math.isnan(item.neutral)}
        without = plain[spec.kinds[0]]
        added = simulate_run(replace(without.scenario, effects={name: neutral, **lagging}))
        assert without.truth.path.position.tobytes() == added.truth.path.position.tobytes(), name
        assert without.poses.quaternion.tobytes() == added.poses.quaternion.tobytes(), name
        assert without.poses.stamp_s.tobytes() == added.poses.stamp_s.tobytes(), name


def test_both_integrators_agree_on_a_plane() -> None:
    base = Scenario(duration_s=60.0, ground=Ground(0.15, -0.1), effects={"icr_offset": 0.1, "drive_lag": 0.3})
    at_once = simulate_run(base).truth.path
    stepwise = simulate_run(replace(base, extra=lambda _: (0.0, 0.0, 0.0))).truth.path
    np.testing.assert_allclose(stepwise.position, at_once.position[::5], atol=2e-3)
    alike = np.abs(np.sum(stepwise.quaternion * at_once.quaternion[::5], axis=1))
    np.testing.assert_allclose(alike, 1.0, atol=1e-8)


def test_on_hills_the_body_lies_on_the_ground_and_turns_as_its_gyro_says() -> None:
    run = simulate_run(
        Scenario(
            duration_s=60.0,
            ground=Ground(hill_m=0.4, hill_length_m=12.0),
            imu=replace(Scenario().imu, noise_radps=0.0),
        )
    )
    path = run.truth.path
    normal = rotate(path.quaternion, np.tile([0.0, 0.0, 1.0], (path.time_s.size, 1)))
    steps = np.diff(path.position, axis=0)
    assert np.ptp(path.position[:, 2]) > 0.1
    off_ground = np.abs(np.einsum("ij,ij->i", steps, 0.5 * (normal[1:] + normal[:-1])))
    assert off_ground.max() < 1e-5
    speed = np.linalg.norm(steps, axis=1) / 0.005
    np.testing.assert_allclose(speed, np.hypot(*path.velocity[:, :2].T), atol=2e-3)
    gyro = np.interp(run.imu.time_s, path.time_s[:-1] + 0.0025, path.velocity[:, 2])
    assert np.median(np.abs(gyro - run.imu.rates[:, 2])) < 1e-3


def test_odd_physics_sees_the_state_and_adds_to_the_velocity() -> None:
    seen = []

    def wobble(state: State) -> tuple[float, float, float]:
        seen.append((state.t, state.left_angle, state.yaw))
        return 0.0, 0.05 * math.sin(state.left_angle), 0.0

    run = simulate_run(replace(CIRCLE, extra=wobble))
    path = run.truth.path
    time, angle, yaw = np.array(seen).T
    np.testing.assert_allclose(path.velocity[:, 1], 0.05 * np.sin(angle), atol=1e-12)
    np.testing.assert_allclose(np.diff(time), 0.005, atol=1e-12)
    assert np.ptp(yaw) > 5.0


def test_terrain_may_change_at_a_place() -> None:
    effects = {"terrain_change": {"k_v": 0.5, "k_w": 1.0, "at_x": 3.0}}
    path = simulate_run(replace(STRAIGHT, effects=effects)).truth.path
    before, after = (
        path.velocity[mask, 0] for mask in (path.position[:-1, 0] < 2.9, path.position[:-1, 0] > 3.1)
    )
    assert before.max() == pytest.approx(V0, rel=1e-6)
    assert after.max() == pytest.approx(0.5 * V0, rel=1e-6)


def test_random_motion_has_the_asked_size_and_memory_and_rests_with_the_wheels() -> None:
    shaken = replace(
        STRAIGHT,
        duration_s=400.0,
        disturbance=Disturbance(speed_mps=0.03, turn_radps=0.05, correlation_s=0.5),
        seed=4,
    )
    path = simulate_run(shaken).truth.path
    moving = path.velocity[3000:-3000] - [V0, 0.0, 0.0]
    np.testing.assert_allclose(moving.std(axis=0), [0.03, 0.03, 0.05], rtol=0.12)
    later = np.corrcoef(moving[:-500, 1], moving[500:, 1])[0, 1]
    assert later == pytest.approx(math.exp(-1.0), abs=0.1)
    assert not path.velocity[:900].any()


def test_a_smoother_ramps_the_body_and_a_swing_overshoots_what_is_asked() -> None:
    """The circle is asked for at once, 0.6 m/s and 0.6 rad/s, and held."""

    def drive(effects: Asked) -> tuple[Floats, Floats]:
        path = simulate_run(replace(CIRCLE, effects=effects)).truth.path
        return path.time_s[:-1] - FIRST_COMMAND_S, path.velocity

    since, velocity = drive({"body_acceleration_limit": 0.2, "turn_acceleration_limit": 0.4})
    rising = (since > 0.1) & (since < 1.4)
    assert np.allclose(velocity[rising, 0], 0.2 * since[rising], atol=0.005)
    assert np.allclose(velocity[rising, 2], 0.4 * since[rising], atol=0.01)
    since, velocity = drive({"drive_overshoot": {"tau": 0.3, "damping": 0.4}})
    beyond = math.exp(-math.pi * 0.4 / math.sqrt(1.0 - 0.4**2))
    assert velocity[:, 0].max() == pytest.approx(V0 * (1.0 + beyond), rel=0.01)
    assert float(since[velocity[:, 0].argmax()]) == pytest.approx(
        math.pi * 0.3 / math.sqrt(1.0 - 0.4**2), abs=0.02
    )
