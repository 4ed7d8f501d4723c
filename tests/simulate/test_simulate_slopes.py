"""What a slope does to a vehicle: it pulls the body downhill and loads the wheels."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pipeline.core.rigid import euler_from_quaternions
from pipeline.simulate import SLOPE_EFFECTS
from pipeline.simulate.run import simulate_run
from pipeline.simulate.scenario import Ground, Program, Scenario


def test_slope_pulls_downhill_whatever_the_heading() -> None:
    slope = Scenario(
        program=Program("spins"),
        duration_s=60.0,
        ground=Ground(pitch_rad=0.1, roll_rad=-0.05),
        effects={"slope_creep": 0.6, "side_slope_creep": 0.6},
    )
    path = simulate_run(slope).truth.path
    moved = path.position[-1] - path.position[0]
    # The plane's steepest way down: +x for pitch > 0, +y for roll < 0.
    down = np.array([math.sin(0.1) * math.cos(0.05), math.sin(0.05)])
    turning = simulate_run(slope).truth.motion.turning.sum() * slope.step_s
    assert moved[2] < 0.0
    np.testing.assert_allclose(moved[:2] / np.linalg.norm(moved[:2]), down / np.linalg.norm(down), atol=0.01)
    steepest = math.sqrt(1.0 - (math.cos(0.1) * math.cos(0.05)) ** 2)
    assert np.linalg.norm(moved) == pytest.approx(0.6 * steepest * turning, rel=1e-3)


@pytest.mark.parametrize("effect", SLOPE_EFFECTS)
@pytest.mark.parametrize("ground", [Ground(pitch_rad=0.2), Ground(hill_m=0.5, hill_length_m=15.0)])
def test_slope_follows_pitch_and_roll_of_the_body(effect: str, ground: Ground) -> None:
    driving = Program("teleop")
    truth = simulate_run(
        Scenario(duration_s=30.0, program=driving, ground=ground, effects={effect: 0.5}, start_pose=(0, 0, 1))
    ).truth
    path = truth.path
    stride = round(truth.motion.v0.size / len(path.velocity))

    def average(signal: np.ndarray) -> np.ndarray:
        return signal.reshape(len(path.velocity), stride, -1).mean(axis=1).squeeze()

    roll, pitch, _ = euler_from_quaternions(path.quaternion[:-1])
    ahead, aside = np.sin(pitch), -np.cos(pitch) * np.sin(roll)
    speed, turning = average(truth.motion.v0), average(truth.motion.turning)
    channel, added = {
        "slope_slip": (0, ahead * np.abs(speed)),
        "slope_creep": (0, ahead * turning),
        "side_slope_slip": (1, aside * np.abs(speed)),
        "side_slope_creep": (1, aside * turning),
        "side_slope_turn": (2, aside * speed),
    }[effect]
    moved = path.velocity - average(truth.motion.velocity)
    assert np.abs(moved).max() > 0.01
    expected = np.zeros_like(moved)
    expected[:, channel] = 0.5 * added
    np.testing.assert_allclose(moved, expected, atol=1e-12)


@pytest.mark.long
def test_wheels_bear_the_slope_that_they_drive_over() -> None:
    hills = Ground(hill_m=0.8, hill_length_m=15.0)
    base = Scenario(duration_s=60.0, ground=hills, program=Program("slalom"))
    loaded = simulate_run(replace(base, effects={"grade_load": 0.9})).truth
    plain = simulate_run(base).truth
    radius = base.vehicle.wheel_radius_m
    middles = (np.arange(plain.drive.left.size) + 0.5) * base.step_s
    pitch = np.interp(middles, loaded.path.time_s, euler_from_quaternions(loaded.path.quaternion)[1])
    assert np.degrees(np.abs(pitch)).max() > 8.0
    for side in ("left", "right"):
        with_it, without = getattr(loaded.drive, side), getattr(plain.drive, side)
        load = np.where(np.abs(without) * radius > 0.01, 0.9 / radius * np.sin(pitch), 0.0)
        np.testing.assert_allclose(with_it - without, load, atol=1e-5)


def test_on_level_ground_a_grade_load_changes_nothing() -> None:
    level, plain = (
        simulate_run(Scenario(duration_s=20.0, effects=effects)).truth.path
        for effects in ({"grade_load": 0.9}, {})
    )
    assert np.array_equal(level.position, plain.position)
