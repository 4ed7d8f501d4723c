"""Poses of satellite navigation: places on a plane, and a heading that is never pretended."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from simulated_platforms import fix, ground_velocity, to_earth
from stage_logs import PLAIN, Taken, TakeThrough, rms, slope

from pipeline.logs import TopicColumns
from pipeline.recording.satellite import (
    Turning,
    follow_closely,
    follow_track,
    list_turnings,
    locate_vehicle,
    read_headings,
    read_over_ground,
    to_local_plane,
)
from pipeline.recording.topic_values import Receiver
from pipeline.simulate import Imu, Layout, PoseSensor, Scenario
from pipeline.simulate.facts import Published
from pipeline.simulate.messages import imu, joints, twist
from pipeline.sources.candidates import Topics
from pipeline.words import format_finding

FOUR = ("front_left", "front_right", "rear_left", "rear_right")
SKIDDING = replace(
    PLAIN,
    duration_s=90.0,
    pose=PoseSensor(noise_m=0.005),
    effects={"drive_lag": 0.3, "effective_track": 1.5, "lateral_skid": 0.08},
)
ANTENNA = Published(
    "/tf_static",
    "tf2_msgs/msg/TFMessage",
    "once",
    {
        "transforms[].header.frame_id": "base_link",
        "transforms[].child_frame_id": "gps_link",
        "transforms[].transform.translation.x": 0.4,
        "transforms[].transform.rotation.w": 1.0,
    },
)


def publishing(scenario: Scenario, *topics: Published) -> Scenario:
    """A scenario that publishes a twist, joint states and some topics."""
    drive = (twist("/cmd_vel", stamped=True), joints("/joint_states", "{}_wheel_joint", FOUR))
    layout = Layout("differential", (*drive, *topics))
    return replace(scenario, recording=replace(scenario.recording, layout=layout))


def lateral_skid(taken: Taken) -> float:
    """c of v_y = -c v w."""
    table = taken.velocities.select("v_x", "v_y", "v_w").drop_nulls()
    return -slope(table["v_x"] * table["v_w"], table["v_y"])


def test_a_fix_is_placed_where_a_surveyor_would() -> None:
    # A thousandth of a degree at the equator: 110.574 m of a meridian, 111.320 m of the equator.
    degrees = np.array([0.0, 1e-3, 0.0])
    placed = to_local_plane(degrees, degrees[[0, 2, 1]], np.array([np.nan, np.nan, np.nan]))
    np.testing.assert_allclose(placed[:, :2], [[0.0, 0.0], [0.0, 110.574], [111.320, 0.0]], atol=1e-3)


@pytest.mark.parametrize(
    ("topics", "sign"),
    [
        ((fix("/gps/fix"), imu("/imu")), 1.0),
        ((ground_velocity("/gps/vel"), imu("/imu")), -1.0),
        ((fix("/fix"), ground_velocity("/vel"), ANTENNA, imu("/imu", attitude=True)), 1.0),
    ],
    ids=["fixes", "velocities and a gyro upside down", "both, an antenna ahead and an attitude"],
)
def test_with_an_imu_sideways_slip_is_seen(
    drive: TakeThrough, topics: tuple[Published, ...], sign: float
) -> None:
    ahead = PoseSensor(noise_m=0.005, child_frame="gps_link", mount_x_m=0.4)
    sensor = ahead if ANTENNA in topics else SKIDDING.pose
    taken = drive(publishing(replace(SKIDDING, pose=sensor, imu=Imu(sign=sign)), *topics))
    assert lateral_skid(taken) == pytest.approx(0.08, abs=0.02)
    assert taken.velocities["segment"].n_unique() == 1
    assert "heading_from_imu" in taken.ids()
    assert "heading_from_course" not in taken.ids()


def test_without_an_imu_the_course_is_the_heading_and_that_is_said(drive: TakeThrough) -> None:
    taken = drive(publishing(SKIDDING, fix("/gps/fix"), ground_velocity("/gps/vel")))
    said = taken.finding("heading_from_course")
    assert said.severity == "warning"
    assert "lateral slip is not observable" in format_finding(said)
    # Two seconds at either end and some of the steps stand, and a standing vehicle has no course.
    assert said.value is not None
    assert 0.04 < said.value < 0.4
    assert abs(lateral_skid(taken)) < 0.02
    moving = taken.slip("measured").filter(~pl.col("transitory") & (pl.col("v_x").abs() > 0.3))
    assert moving.height > 300
    assert rms(moving["g_x"]) < 0.05


@pytest.mark.parametrize("turns", [True, False], ids=["with a gyro", "without"])
def test_driving_backwards_turns_no_heading_round(drive: TakeThrough, turns: bool) -> None:  # noqa: FBT001
    topics = (fix("/gps/fix"), *((imu("/imu"),) if turns else ()))
    taken = drive(publishing(SKIDDING, *topics))
    ideal = taken.slip("measured").filter(~pl.col("transitory"))
    backwards = ideal.filter(pl.col("f_x") < -0.3)
    assert backwards.height > 100
    assert float(backwards["v_x"].median()) < -0.25  # type: ignore[arg-type]
    assert slope(ideal["f_x"], ideal["v_x"]) == pytest.approx(1.0, abs=0.05)


def receive(change: Callable[[dict[str, np.ndarray]], object]) -> Receiver:
    """A minute of fixes at 5 Hz of a vehicle that drives north-east, changed."""
    times = np.arange(300) / 5.0
    way = np.stack((times, times, np.zeros_like(times)), axis=-1)
    latitude, longitude, altitude = to_earth(way)
    status = np.zeros(times.size)
    fields = {"latitude": latitude, "longitude": longitude, "altitude": altitude, "status.status": status}
    change(fields)
    stamps = (times * 1e9).astype(np.int64)
    columns = TopicColumns("/fix", 1, "sensor_msgs/msg/NavSatFix", stamps, stamps, stamps, fields, ())
    return Receiver(columns, times, np.arange(times.size))


@pytest.mark.parametrize(
    ("change", "lost"),
    [
        (lambda fields: fields["status.status"].__setitem__(slice(50, 80), -1.0), 30),
        (lambda fields: [fields[name].__setitem__(7, 0.0) for name in ("latitude", "longitude")], 1),
        (lambda fields: fields["latitude"].__setitem__(slice(0, 5), np.nan), 5),
        (lambda fields: fields["latitude"].__setitem__(3, 1e9), 1),
    ],
    ids=["a status below zero", "zero and zero", "no number", "beyond the pole"],
)
def test_what_is_no_fix_is_left_out_and_counted(change: Callable[..., object], lost: int) -> None:
    made = locate_vehicle(receive(change), None, [], None, np.zeros(3))
    (said,) = [finding for finding in made.findings if finding.id == "no_fix"]
    assert said.count == lost
    assert made.rows.size == 300 - lost
    assert np.isfinite(made.arrays.position).all()


def test_an_altitude_that_is_not_known_moves_nothing_sideways() -> None:
    made = locate_vehicle(
        receive(lambda fields: fields["altitude"].fill(np.nan)), None, [], None, np.zeros(3)
    )
    moved = np.diff(made.arrays.position[:, :2], axis=0)
    np.testing.assert_allclose(moved, 0.2, rtol=1e-3)
    yaw = 2.0 * np.arctan2(made.arrays.quaternion[:, 2], made.arrays.quaternion[:, 3])
    np.testing.assert_allclose(yaw, np.pi / 4.0, atol=1e-2)
    assert "direction_assumed" in {finding.id for finding in made.findings}


@pytest.mark.parametrize("count", [0, 1, 30])
def test_a_log_with_hardly_a_fix_has_no_pose_and_no_crash(count: int) -> None:
    whole = receive(lambda _: None)
    few = replace(whole, order=whole.order[:count])
    stamps = whole.columns.log_time[:0]
    silent = TopicColumns("/imu", 2, "sensor_msgs/msg/Imu", stamps, stamps, stamps, {}, ())
    made = locate_vehicle(
        few, None, list_turnings(Receiver(silent, np.zeros(0), whole.order[:0])), None, np.zeros(3)
    )
    assert made.rows.size == (count if count == 30 else 0)
    assert made.arrays.position.shape == (made.rows.size, 3)


def test_velocities_that_give_north_first_are_recognized_and_those_of_the_body_refused() -> None:
    times = np.arange(600) / 10.0
    heading = 0.2 * times
    east, north = np.cos(heading), np.sin(heading)
    place = np.stack((np.sin(heading) / 0.2, -np.cos(heading) / 0.2, np.zeros_like(times)), axis=-1)
    plain = np.stack((east, north), axis=-1)
    for published in (plain, plain[:, ::-1]):
        read = read_over_ground(times, place, times, published)
        np.testing.assert_array_equal(read, plain)
    body = np.stack((np.ones_like(times), np.zeros_like(times)), axis=-1)
    assert read_over_ground(times, place, times, body) is None


@pytest.mark.parametrize(
    ("types", "found"),
    [
        ({"/panther/gps/vel": "geometry_msgs/TwistStamped"}, ["/panther/gps/vel"]),
        ({"/vel": "geometry_msgs/TwistStamped", "/fix": "sensor_msgs/NavSatFix"}, ["/vel"]),
        ({"/vel": "geometry_msgs/TwistStamped"}, []),
        ({"/ublox/fix_velocity": "geometry_msgs/TwistWithCovarianceStamped"}, ["/ublox/fix_velocity"]),
        ({"/gps_guidance/cmd_vel": "geometry_msgs/TwistStamped"}, []),
    ],
)
def test_a_velocity_over_ground_is_no_command(types: dict[str, str], found: list[str]) -> None:
    topics = Topics(types)
    assert topics.ground_velocities() == found
    commands = {str(source) for _, source in topics.list_drives(commanded=True, steered=False)}
    assert commands.isdisjoint(found)


ALONE = replace(SKIDDING, pose=PoseSensor(noise_m=0.005, reports_heading=False))


@pytest.mark.parametrize("turns", [True, False], ids=["with a gyro", "without"])
def test_poses_that_look_one_way_all_the_time_are_positions_alone(
    drive: TakeThrough,
    turns: bool,  # noqa: FBT001
) -> None:
    """Such a vehicle "does not move", since what it drives ahead goes anywhere but ahead."""
    taken = drive(replace(ALONE, imu=Imu() if turns else None))
    assert "not_moving" not in taken.ids()
    said = taken.finding("no_heading")
    assert said.severity == "warning"
    assert "positions alone" in format_finding(said)
    assert ("heading_from_imu" if turns else "heading_from_course") in taken.ids()
    moving = taken.slip("measured").filter(~pl.col("transitory") & (pl.col("v_x").abs() > 0.3))
    assert moving.height > 300
    assert rms(moving["g_x"]) < 0.05
    assert lateral_skid(taken) == pytest.approx(0.08 if turns else 0.0, abs=0.02)


def wind(noise_m: float = 0.005) -> tuple[Receiver, np.ndarray]:
    """Two minutes of fixes at 5 Hz of a vehicle that turns both ways at 1 m/s, and its heading [rad]."""
    times = np.arange(0.0, 120.0, 0.2)
    yaw = 0.5 + 2.0 * np.sin(0.5 * times) + 0.02 * times
    way = np.cumsum(np.stack((np.cos(yaw), np.sin(yaw), 0.0 * yaw), axis=-1), axis=0) * 0.2
    way += np.random.default_rng(1).normal(0.0, noise_m, way.shape)
    latitude, longitude, altitude = to_earth(way)
    fields = {"latitude": latitude, "longitude": longitude, "altitude": altitude, "status.status": 0.0 * yaw}
    stamps = (times * 1e9).astype(np.int64)
    columns = TopicColumns("/fix", 1, "sensor_msgs/msg/NavSatFix", stamps, stamps, stamps, fields, ())
    return Receiver(columns, times, np.arange(times.size)), yaw


def read_number(values: np.ndarray, like: Receiver) -> list[Turning]:
    columns = replace(
        like.columns, topic="/compass", type_name="std_msgs/msg/Float64", fields={"data": values}
    )
    return read_headings(replace(like, columns=columns), "data")


@pytest.mark.parametrize("unit", ["rad", "deg"])
@pytest.mark.parametrize("sense", ["compass", "counterclockwise"])
def test_a_number_is_the_heading_in_any_unit_and_sense(unit: str, sense: str) -> None:
    receiver, yaw = wind()
    values = (np.pi / 2.0 - yaw if sense == "compass" else yaw) % (2.0 * np.pi)
    values = np.degrees(values) if unit == "deg" else values
    made = locate_vehicle(receiver, None, read_number(values, receiver), None, np.zeros(3))
    (said,) = [one for one in made.findings if one.id == "heading_from_imu"]
    assert "that of /compass" in format_finding(said)
    found = 2.0 * np.arctan2(made.arrays.quaternion[:, 2], made.arrays.quaternion[:, 3])
    off = np.angle(np.exp(1j * (found - yaw[made.rows])))
    # The course of a step is that in its middle.
    assert np.abs(off - np.median(off)).max() < 0.05
    assert abs(np.median(off)) < 0.15


def test_a_number_that_does_not_turn_with_the_vehicle_is_no_heading() -> None:
    receiver, yaw = wind()
    other = np.cumsum(np.random.default_rng(2).normal(0.0, 0.3, yaw.size))
    made = locate_vehicle(receiver, None, read_number(other, receiver), None, np.zeros(3))
    assert "heading_from_course" in {one.id for one in made.findings}


@pytest.mark.parametrize(("noise_m", "longest_s"), [(0.01, 0.61), (0.3, 1.01)], ids=["fine", "coarse"])
def test_a_course_is_derived_over_no_longer_than_its_noise_asks_for(noise_m: float, longest_s: float) -> None:
    receiver, yaw = wind()
    way = np.cumsum(np.stack((np.cos(yaw), np.sin(yaw), 0.0 * yaw), axis=-1), axis=0) * 0.2
    way += np.random.default_rng(1).normal(0.0, noise_m, way.shape)
    course = follow_closely(follow_track(receiver.times, way, None), way, None)
    assert course.window_s == pytest.approx(longest_s, abs=0.02)


def test_numbers_are_headings_by_their_names() -> None:
    names = ("/compass_hdg", "/gps/heading_deg", "/yaw_rate", "/heading_error", "/cmd/heading", "/speed")
    topics = Topics(dict.fromkeys(names, "std_msgs/Float64"))
    assert [one.topic for one in topics.headings()] == ["/compass_hdg", "/gps/heading_deg"]
