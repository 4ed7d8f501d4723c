"""Localization effects, noise and faults are as asked, and each source has random numbers of its own."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.core.rigid import euler_from_quaternions, interpolate_poses, rotate, wrap_angle
from pipeline.simulate.facts import SimulateError
from pipeline.simulate.run import SimulatedRun, integrate_odometry, simulate_run
from pipeline.simulate.scenario import Ground, Imu, PoseSensor, Program, Scenario

Floats = NDArray[np.float64]

CLEAN = PoseSensor(noise_m=0.0, noise_rad=0.0, noise_z_m=0.0, noise_tilt_rad=0.0)
SHORT = Scenario(duration_s=60.0, pose=CLEAN)


def true_poses(run: SimulatedRun, at: Floats) -> tuple[Floats, Floats]:
    path = run.truth.path
    position, quaternion = interpolate_poses(at, path.time_s, path.position, path.quaternion)
    return position, euler_from_quaternions(quaternion)[2]


def reported(run: SimulatedRun) -> tuple[Floats, Floats]:
    position, quaternion = run.poses.in_map()
    return position, euler_from_quaternions(quaternion)[2]


def test_without_noise_the_pose_is_the_truth() -> None:
    run = simulate_run(SHORT)
    position, yaw = reported(run)
    true_position, true_yaw = true_poses(run, run.poses.stamp_s)
    np.testing.assert_allclose(position, true_position, atol=1e-12)
    np.testing.assert_allclose(wrap_angle(yaw - true_yaw), 0.0, atol=1e-12)


def test_lever_arm_reports_another_point_of_the_body() -> None:
    run = simulate_run(replace(SHORT, effects={"lever_arm": {"l_x": 0.2, "l_y": -0.1}}))
    position, yaw = reported(run)
    base, _ = true_poses(run, run.poses.stamp_s)
    arm = np.stack((0.2 * np.cos(yaw) + 0.1 * np.sin(yaw), 0.2 * np.sin(yaw) - 0.1 * np.cos(yaw)), axis=1)
    np.testing.assert_allclose(position[:, :2] - base[:, :2], arm, atol=1e-9)


def test_lever_arm_is_an_icr_offset_of_the_opposite_sign() -> None:
    hung = simulate_run(replace(SHORT, effects={"lever_arm": {"l_x": 0.2, "l_y": 0.1}}))
    offset = simulate_run(replace(SHORT, effects={"icr_offset": -0.2, "icr_lateral": -0.1}))
    np.testing.assert_allclose(
        np.diff(hung.poses.position, axis=0), np.diff(offset.poses.position, axis=0), atol=1e-6
    )


def test_misaligned_heading_makes_forward_motion_look_sideways() -> None:
    run = simulate_run(replace(SHORT, effects={"yaw_misalignment": 0.05}))
    _, yaw = reported(run)
    _, true_yaw = true_poses(run, run.poses.stamp_s)
    np.testing.assert_allclose(wrap_angle(yaw - true_yaw), 0.05, atol=1e-9)


def test_skewed_heading_is_that_of_some_time_ago() -> None:
    run = simulate_run(replace(SHORT, effects={"heading_skew": 0.15}))
    position, yaw = reported(run)
    base, _ = true_poses(run, run.poses.stamp_s)
    _, old = true_poses(run, run.poses.stamp_s - 0.15)
    np.testing.assert_allclose(position, base, atol=1e-12)
    np.testing.assert_allclose(wrap_angle(yaw - old), 0.0, atol=1e-9)


@pytest.mark.parametrize("offset", [0.2, -0.15])
def test_clock_offset_moves_the_stamps_and_nothing_else(offset: float) -> None:
    plain, shifted = simulate_run(SHORT), simulate_run(replace(SHORT, effects={"clock_offset": offset}))
    np.testing.assert_allclose(shifted.poses.stamp_s - plain.poses.stamp_s, offset, atol=1e-12)
    assert (shifted.poses.log_s == plain.poses.log_s).all()
    assert (shifted.poses.position == plain.poses.position).all()


def test_white_noise_has_the_asked_size() -> None:
    noisy = simulate_run(replace(SHORT, duration_s=200.0, pose=replace(CLEAN, noise_m=0.02, noise_rad=0.005)))
    position, yaw = reported(noisy)
    base, true_yaw = true_poses(noisy, noisy.poses.stamp_s)
    # 4000 poses: a standard deviation is known to 1.1 %, four of those are allowed.
    np.testing.assert_allclose((position - base)[:, :2].std(axis=0), 0.02, rtol=0.045)
    assert wrap_angle(yaw - true_yaw).std() == pytest.approx(0.005, rel=0.045)
    assert not (position - base)[:, 2].any()


def test_gyro_has_sign_scale_and_bias() -> None:
    run = simulate_run(replace(SHORT, imu=Imu(noise_radps=0.0, bias_radps=0.02, scale=1.05, sign=-1)))
    path = run.truth.path
    rate = np.interp(run.imu.time_s, path.time_s[:-1] + 0.0005, path.velocity[:, 2])
    error = run.imu.rates[:, 2] + (1.05 * rate + 0.02)
    assert np.quantile(np.abs(error), 0.95) < 1e-9


def test_accelerometer_feels_gravity_on_a_slope() -> None:
    still = replace(
        SHORT, program=Program(lead_s=60.0), ground=Ground(pitch_rad=0.2), imu=Imu(noise_mps2=0.0)
    )
    forces = simulate_run(still).imu.accelerations
    np.testing.assert_allclose(forces[5], [-9.80665 * math.sin(0.2), 0.0, 9.80665 * math.cos(0.2)], atol=1e-9)


def test_pose_from_wheels_has_no_slip_at_all() -> None:
    odometry = replace(SHORT, pose=replace(CLEAN, source="wheels"), effects={"effective_track": 1.8})
    run = simulate_run(odometry)
    own = integrate_odometry(odometry.vehicle, run.wheels, start=odometry.start_pose)
    expected, _ = interpolate_poses(run.poses.stamp_s, own.time_s, own.position, own.quaternion)
    np.testing.assert_allclose(run.poses.position, expected, atol=1e-12)
    with pytest.raises(SimulateError, match="needs encoders"):
        simulate_run(replace(odometry, encoders=None))


def test_each_source_has_random_numbers_of_its_own() -> None:
    plain = simulate_run(replace(SHORT, pose=PoseSensor()))
    without = simulate_run(replace(SHORT, pose=PoseSensor(), imu=None, encoders=None))
    assert plain.poses.position.tobytes() == without.poses.position.tobytes()
    other = simulate_run(replace(SHORT, pose=PoseSensor(), seed=1))
    assert plain.poses.position.tobytes() != other.poses.position.tobytes()


def test_poses_on_a_slope_have_height_roll_and_pitch() -> None:
    run = simulate_run(replace(SHORT, ground=Ground(pitch_rad=0.2)))
    position, quaternion = run.poses.in_map()
    np.testing.assert_allclose(position[:, 2], -math.tan(0.2) * position[:, 0], atol=1e-9)
    up = rotate(quaternion, np.tile([0.0, 0.0, 1.0], (position.shape[0], 1)))
    np.testing.assert_allclose(up, np.tile([math.sin(0.2), 0.0, math.cos(0.2)], (up.shape[0], 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("effects", "expected"),
    [
        ({"heading_skew": 0.1}, (0.6 * math.cos(0.06), 0.6 * math.sin(0.06), 0.6)),
        ({"yaw_misalignment": 0.05}, (0.6 * math.cos(0.05), -0.6 * math.sin(0.05), 0.6)),
        ({"lever_arm": {"l_x": 0.2, "l_y": 0.1}}, (0.6 - 0.1 * 0.6, 0.2 * 0.6, 0.6)),
    ],
    ids=str,
)
def test_what_is_reported_on_a_circle_has_the_signs_of_the_formulas(
    effects: dict[str, float], expected: tuple[float, float, float]
) -> None:
    circle = replace(SHORT, program=Program("circle"), pose=replace(CLEAN, rate_hz=100.0), effects=effects)
    run = simulate_run(circle)
    position, yaw = reported(run)
    steady = (run.poses.stamp_s > 10.0) & (run.poses.stamp_s < 50.0)
    step = np.diff(position[steady, :2], axis=0) * 100.0
    turned = wrap_angle(np.diff(yaw[steady]))
    heading = yaw[steady][:-1] + 0.5 * turned
    along = step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading)
    across = step[:, 1] * np.cos(heading) - step[:, 0] * np.sin(heading)
    np.testing.assert_allclose([along.mean(), across.mean(), turned.mean() * 100.0], expected, atol=1e-4)
