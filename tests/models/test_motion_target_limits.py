"""Limits that are exported are those that the vehicle of the model reaches."""

import math

import numpy as np
import pytest
from exported_files import make, predict, take

from pipeline.export import export_model
from pipeline.models import find_effect


def test_limits_are_reached_and_not_more() -> None:
    effects = (
        find_effect("effective_track")(k=1.8),
        find_effect("wheel_radius")(k=0.9),
        find_effect("wheel_speed_limit")(limit=6.0),
        find_effect("acceleration_limit")(limit=3.0),
        find_effect("body_turn_limit")(limit=5.0),
    )
    file = make(*effects)
    p, q, degrees = take("nav2", file), take("gazebo", file), take("px4", file)
    straight = predict(file, [(-1.0, 99.0, 99.0)], 4.0)
    spin = predict(make(*effects[:-1]), [(-1.0, -99.0, 99.0)], 4.0)
    assert straight[-1, 4] == pytest.approx(p["FollowPath.vx_max"], rel=1e-4)
    assert spin[-1, 6] == pytest.approx(p["FollowPath.wz_max"], rel=1e-4)
    assert np.diff(straight[:100, 4]).max() / 0.005 == pytest.approx(p["FollowPath.ax_max"], rel=1e-4)
    assert np.diff(spin[:100, 6]).max() / 0.005 == pytest.approx(p["FollowPath.az_max"], rel=1e-4)
    assert p["max_velocity"] == [p["FollowPath.vx_max"], 0.0, p["FollowPath.wz_max"]]  # type: ignore[comparison-overlap]
    assert q["max_linear_velocity"] == -q["min_linear_velocity"] == p["FollowPath.vx_max"]
    assert math.radians(degrees["RO_YAW_RATE_LIM"]) == pytest.approx(p["FollowPath.wz_max"], rel=1e-4)


def test_ramps_of_the_command_are_limits_of_acceleration() -> None:
    effects = (
        find_effect("effective_track")(k=1.8),
        find_effect("wheel_radius")(k=0.9),
        find_effect("body_acceleration_limit")(limit=1.0),
        find_effect("turn_acceleration_limit")(limit=2.0),
    )
    file = make(*effects)
    p, degrees = take("nav2", file), take("px4", file)
    straight, spin = predict(file, [(-1.0, 9.0, 9.0)], 1.0), predict(file, [(-1.0, -9.0, 9.0)], 1.0)
    assert np.diff(straight[:100, 4]).max() / 0.005 == pytest.approx(p["FollowPath.ax_max"], rel=1e-4)
    assert np.diff(spin[:100, 6]).max() / 0.005 == pytest.approx(p["FollowPath.az_max"], rel=1e-4)
    assert math.radians(degrees["RO_YAW_ACCEL_LIM"]) == pytest.approx(p["FollowPath.az_max"], rel=1e-4)
    # Of two limits the smaller one holds; ros2_control has a parameter for both.
    steep = make(*effects, find_effect("acceleration_limit")(limit=99.0))
    assert take("nav2", steep)["FollowPath.ax_max"] == p["FollowPath.ax_max"]
    assert "Not covered by these parameters" not in export_model(make(*effects[2:]), "ros2_control")
