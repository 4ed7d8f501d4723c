"""Logs of simulated runs, read back with the official reader: layouts, stamps, faults, equal bytes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from few import few
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from pipeline.simulate import (
    LAYOUTS,
    VEHICLES,
    Case,
    Clock,
    PoseSensor,
    Recording,
    Scenario,
    SimulatedRun,
    SimulateError,
    list_cases,
    simulate_case,
    simulate_run,
    write_log,
)
from pipeline.simulate.messages import list_topics

SHORT = Scenario(duration_s=12.0)
START_NS = SHORT.clock.start_ns


class Message:
    """One decoded message with its times."""

    def __init__(self, log_ns: int, decoded: object) -> None:
        self.log_ns = log_ns
        self.body = decoded

    @property
    def stamp_ns(self) -> int:
        stamp = self.body.header.stamp
        return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def read_back(path: Path) -> dict[str, list[Message]]:
    topics: dict[str, list[Message]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
            topics.setdefault(channel.topic, []).append(Message(message.log_time, decoded))
    return topics


def record(scenario: Scenario, path: Path) -> tuple[SimulatedRun, dict[str, list[Message]]]:
    run = simulate_run(scenario)
    write_log(run, path)
    return run, read_back(path)


def in_layout(name: str) -> Scenario:
    names = {"differential": "husky", "ackermann": "car", "mecanum": "youbot", "omni": "omni"}
    vehicle = VEHICLES[names[LAYOUTS[name].kind]]
    return replace(SHORT, vehicle=vehicle, recording=Recording(name))


@pytest.mark.parametrize("name", few(sorted(LAYOUTS), 4))
def test_every_layout_is_read_by_the_official_reader_and_holds_what_was_recorded(
    name: str, tmp_path: Path
) -> None:
    run, topics = record(in_layout(name), tmp_path / "a.mcap")
    published = {one.topic: one for one in list_topics(LAYOUTS[name], run.scenario)}
    assert set(topics) == set(published)
    position, quaternion = run.poses.in_map()
    for topic, one in published.items():
        seventh = topics[topic][min(7, len(topics[topic]) - 1)]
        if one.source == "command":
            assert len(topics[topic]) == run.commands.time_s.size
        elif one.source == "imu":
            assert len(topics[topic]) == run.imu.time_s.size
            assert seventh.body.angular_velocity.z == run.imu.rates[7, 2]
        elif one.source == "localization":
            pose = seventh.body.pose if "PoseStamped" in one.type_name else seventh.body.pose.pose
            assert (pose.position.x, pose.position.y) == tuple(position[7, :2])
            assert (pose.orientation.z, pose.orientation.w) == tuple(quaternion[7, 2:])
            assert seventh.stamp_ns == START_NS + round(run.poses.stamp_s[7] * 1e9)
            assert seventh.log_ns == START_NS + round(run.poses.log_s[7] * 1e9)


def test_wheel_commands_are_told_by_name_and_carry_the_ideal_inverse(tmp_path: Path) -> None:
    run, topics = record(SHORT, tmp_path / "a.mcap")
    command = topics["/wheel_commands"][150].body
    twist = topics["/controller/cmd_vel"][150].body.twist
    assert list(command.name) != list(topics["/joint_states"][0].body.name)
    wheels = dict(zip(command.name, command.velocity, strict=True))
    assert set(wheels) == {"front_left_wheel", "rear_left_wheel", "front_right_wheel", "rear_right_wheel"}
    assert twist.linear.x == run.commands.speed_mps[150]
    left = (twist.linear.x - 0.275 * twist.angular.z) / 0.165
    right = (twist.linear.x + 0.275 * twist.angular.z) / 0.165
    assert [wheels["front_left_wheel"], wheels["rear_right_wheel"]] == pytest.approx([left, right])


def test_sideways_commands_and_four_wheels_that_differ_arrive(tmp_path: Path) -> None:
    run, topics = record(in_layout("mecanum"), tmp_path / "a.mcap")
    assert run.wheels.corners is not None
    assert run.wheels.corner_angles is not None
    assert topics["/cmd_vel"][150].body.linear.y == run.commands.sideways_mps[150] != 0.0
    state = topics["/joint_states"][150].body
    for name, speed, angle in zip(state.name, state.velocity, state.position, strict=True):
        place = name.removesuffix("_wheel_joint")
        assert speed == run.wheels.corners[place][150]
        assert angle == run.wheels.corner_angles[place][150]
    assert len(set(state.velocity)) == 4


def test_transforms_chain_to_the_pose_and_step_at_a_jump(tmp_path: Path) -> None:
    scenario = replace(in_layout("tf"), pose=PoseSensor(jumps=1, jump_m=0.7))
    run, topics = record(scenario, tmp_path / "a.mcap")
    edges = [message.body.transforms[0] for message in topics["/tf"]]
    odometry = [edge for edge in edges if edge.child_frame_id == "base_link"]
    corrections = [edge for edge in edges if edge.child_frame_id == "odom"]
    assert {edge.header.frame_id for edge in odometry} == {"odom"}
    assert {edge.header.frame_id for edge in corrections} == {"map"}
    assert odometry[50].transform.translation.x == run.poses.position[50, 0]
    shifts = [edge.transform.translation.x for edge in corrections]
    assert len(set(shifts)) == 2
    assert topics["/tf_static"][0].body.transforms[0].child_frame_id == "imu_link"


def test_a_pose_of_another_frame_is_told_by_name_and_mounting(tmp_path: Path) -> None:
    mounted = PoseSensor(
        child_frame="lidar", mount_x_m=0.3, mount_y_m=-0.1, mount_yaw_rad=0.5, noise_m=0, noise_rad=0
    )
    run, topics = record(replace(SHORT, pose=mounted), tmp_path / "a.mcap")
    odometry = topics["/mapping/icp_odom"][200].body
    edge = topics["/tf_static"][0].body.transforms[0]
    assert odometry.child_frame_id == edge.child_frame_id == "lidar"
    at = run.poses.sampled_s[200]
    path = run.truth.path
    yaw = np.interp(
        at, path.time_s, np.unwrap(2.0 * np.arctan2(path.quaternion[:, 2], path.quaternion[:, 3]))
    )
    x = np.interp(at, path.time_s, path.position[:, 0]) + 0.3 * np.cos(yaw) + 0.1 * np.sin(yaw)
    assert odometry.pose.pose.position.x == pytest.approx(x, abs=1e-6)
    assert edge.transform.rotation.z == pytest.approx(np.sin(0.25))
    with pytest.raises(SimulateError, match="cannot be of lidar"):
        simulate_run(replace(in_layout("tf"), pose=mounted))


def test_stamps_tell_latency_and_an_offset_clock(tmp_path: Path) -> None:
    late = replace(SHORT, effects={"clock_offset": 0.3})
    _, topics = record(late, tmp_path / "a.mcap")
    latency = np.array([m.log_ns - m.stamp_ns for m in topics["/mapping/icp_odom"]]) * 1e-9
    assert np.median(latency) == pytest.approx(0.03 - 0.3, abs=0.002)


def test_clock_may_start_unset_and_go_back(tmp_path: Path) -> None:
    clock = Clock(unset_s=2.0, backward_at_s=8.0, backward_s=1.5)
    _, topics = record(replace(SHORT, clock=clock), tmp_path / "a.mcap")
    stamps = np.array([m.stamp_ns for m in topics["/mapping/icp_odom"]])
    by_sampling = np.sort(stamps)
    assert (stamps < 2_000_000_000).sum() == 40
    assert by_sampling[40] > START_NS
    late = stamps - START_NS
    assert late.max() == pytest.approx(12e9 - 1.5e9, abs=0.1e9)
    # The 1.5 s before the jump are stamped twice.
    twice = ((late > 6.5e9) & (late < 8.0e9)).sum()
    assert twice == pytest.approx(60, abs=2)


def test_a_layout_that_does_not_fit_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(SimulateError):
        write_log(simulate_run(replace(SHORT, recording=Recording("ackermann"))), tmp_path / "a.mcap")
    assert not (tmp_path / "a.mcap").exists()


def test_the_same_scenario_gives_the_same_bytes_and_another_seed_does_not(tmp_path: Path) -> None:
    ask = {"effects": {"effective_track": 1.7}, "duration_s": 10.0}
    first = simulate_case("husky_tile", out=tmp_path / "a.mcap", **ask).read_bytes()
    second = simulate_case("husky_tile", out=tmp_path / "b.mcap", **ask).read_bytes()
    other = simulate_case("husky_tile", out=tmp_path / "c.mcap", seed=7, **ask).read_bytes()
    assert first == second != other


def test_the_truth_stays_out_of_the_log(tmp_path: Path) -> None:
    scenario = replace(SHORT, effects={"lateral_skid": 0.1}, recording=Recording(decoys="both"))
    record(scenario, tmp_path / "a.mcap")
    assert b"lateral_skid" not in (tmp_path / "a.mcap").read_bytes()


@pytest.mark.parametrize("case", few(list_cases(), 4), ids=lambda case: case.name)
def test_every_case_is_written_and_read(case: Case, tmp_path: Path) -> None:
    topics = read_back(simulate_case(case.name, out=tmp_path / "a.mcap", duration_s=12.0))
    assert sum(len(messages) for messages in topics.values()) > 500
