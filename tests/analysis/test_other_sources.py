"""Poses, wheels and vehicles from what few robots publish: written as they do, taken through the program."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer
from simulated_platforms import PLATFORMS, Platform, fix, ground_velocity, simulate_platform

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import SlipError
from pipeline.logs import definition_text, open_log
from pipeline.recording.log_choice import Choice, choose
from pipeline.simulate.facts import Published, Q
from pipeline.simulate.messages import Fields, imu, joints, odometry, twist
from pipeline.sources import load_configuration
from pipeline.words import format_finding

FOUR = ("front_left", "front_right", "rear_left", "rear_right")
WHEEL = "{}_wheel_joint"
HUSKY = PLATFORMS["husky_a200"].vehicle
PLAIN = replace(HUSKY, controller_track_multiplier=1.0)
Messages = list[tuple[str, str, dict[str, Any]]]


def publish(
    folder: Path, monkeypatch: pytest.MonkeyPatch, *topics: Published, kind: Platform | None = None
) -> Path:
    """A log of 30 s with some topics."""
    platform = Platform(PLAIN, topics) if kind is None else replace(kind, topics=topics)
    monkeypatch.setitem(PLATFORMS, "made_up", platform)
    effects = {"drive_lag": 0.3}
    return simulate_platform("made_up", effects, out=folder / "run.mcap", seed=5, duration_s=30.0)


def rewrite(log: Path, change: Callable[[str, Any], Messages | None]) -> Path:
    """The log with messages replaced, serialized by mcap-ros2-support; None leaves one as it is.

    Args:
        log: to be changed.
        change: topic and decoded message to topics, types and messages.
    """
    target = log.with_name("changed.mcap")
    with log.open("rb") as source, target.open("wb") as sink:
        writer = Writer(sink)
        schemas = {}
        reader = make_reader(source, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema is not None
            plain = [(channel.topic, schema.name, decoded)]
            made = change(channel.topic, decoded)
            for topic, kind, content in plain if made is None else made:
                if kind not in schemas:
                    text = definition_text(kind)
                    assert text is not None
                    schemas[kind] = writer.register_msgdef(kind, text)
                writer.write_message(topic, schemas[kind], content, message.log_time, message.publish_time)
        writer.finish()
    return target


def choose_for(log: Path, **overrides: object) -> Choice:
    return choose(open_log(log), load_configuration(log, overrides=overrides), overrides)


def extract(log: Path, table: str) -> pl.DataFrame:
    """A table of the extract stage of a Husky's log."""
    options = Options(
        out=log.parent / "results",
        report=False,
        through="extract",
        overrides={"vehicle": {"preset": "husky_a200"}},
    )
    return analyze_log(log, options).manifest.read(table)


def bodies(*names: str) -> Published:
    """Models of a simulator; those called husky move as the vehicle does, others stand at (5, 5)."""
    fields: Fields = {"name": list(names)}
    for axis in "xyz":
        fields[f"pose[].position.{axis}"] = tuple(
            Q(axis) if "husky" in name else Q(axis, 0.0, 5.0) for name in names
        )
    for axis in "xyzw":
        fields[f"pose[].orientation.{axis}"] = tuple(Q(f"q{axis}") for _ in names)
    return Published(
        "/gazebo/model_states", "gazebo_msgs/msg/ModelStates", "localization", fields, stamp="none"
    )


DRIVE = (twist("/cmd_vel", stamped=True), joints("/joint_states", WHEEL, FOUR))


def test_the_model_that_moves_is_the_vehicle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lidar = odometry("/icp_odom", "localization", "map", "base_link")
    log = publish(tmp_path, monkeypatch, *DRIVE, bodies("ground_plane", "my_husky", "box"), lidar)
    poses = extract(rewrite(log, lambda topic, _: [] if topic == "/icp_odom" else None), "poses")
    plain = extract(rewrite(log, lambda topic, _: [] if "gazebo" in topic else None), "poses")
    for axis in ("x", "y", "q_z", "q_w"):
        np.testing.assert_allclose(poses[axis], plain[axis])


def test_of_several_models_that_move_one_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = publish(tmp_path, monkeypatch, *DRIVE, bodies("husky_1", "husky_2"))
    with pytest.raises(SlipError) as caught:
        extract(log, "poses")
    assert caught.value.code == "no_body"
    assert "husky_1 and husky_2" in str(caught.value)
    (tmp_path / "run.toml").write_text('[pose]\nname = "husky_2"\n', encoding="utf-8")
    assert extract(log, "poses").height > 500


def test_a_joint_of_several_degrees_of_freedom_is_a_pose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner = "transforms[]."
    fields: Fields = {"joint_names": ["world_joint"], "header.frame_id": "world"}
    fields |= {f"{inner}translation.{axis}": Q(axis) for axis in "xyz"}
    fields |= {f"{inner}rotation.{axis}": Q(f"q{axis}") for axis in "xyzw"}
    kind = "sensor_msgs/msg/MultiDOFJointState"
    log = publish(
        tmp_path, monkeypatch, *DRIVE, Published("/multi_dof_joint_states", kind, "localization", fields)
    )
    assert str(choose_for(log, vehicle={"preset": "husky_a200"}).sources.pose) == "/multi_dof_joint_states"
    assert float(np.ptp(extract(log, "poses")["x"].to_numpy())) > 1.0


def to_dynamic(topic: str, message: Any) -> Messages | None:  # noqa: ANN401 - a decoded message
    """Joint states as the broadcaster gives all of its interfaces."""
    if topic != "/joint_states":
        return None
    values = [
        {"interface_names": ["velocity", "position"], "values": [message.velocity[i], message.position[i]]}
        for i in range(len(message.name))
    ]
    content = {"header": message.header, "joint_names": message.name, "interface_values": values}
    return [("/dynamic_joint_states", "control_msgs/msg/DynamicJointState", content)]


def test_dynamic_joint_states_are_joint_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = publish(tmp_path, monkeypatch, *DRIVE, odometry("/icp_odom", "localization", "map", "base_link"))
    plain = extract(log, "wheels")
    changed = rewrite(log, to_dynamic)
    assert (
        str(choose_for(changed, vehicle={"preset": "husky_a200"}).sources.wheels) == "/dynamic_joint_states"
    )
    found = extract(changed, "wheels")
    for side in ("left", "right"):
        np.testing.assert_allclose(found[side], plain[side])
    both = rewrite(log, lambda topic, m: (made := to_dynamic(topic, m)) and [*made, (topic, JOINT_STATE, m)])
    assert str(choose_for(both, vehicle={"preset": "husky_a200"}).sources.wheels) == "/joint_states"


JOINT_STATE = "sensor_msgs/msg/JointState"


def frames(places: Mapping[str, tuple[float, float, float]], parent: str = "base_link") -> list[Published]:
    """Static transforms of frames."""
    return [
        Published(
            "/tf_static",
            "tf2_msgs/msg/TFMessage",
            "once",
            {
                "transforms[].header.frame_id": parent,
                "transforms[].child_frame_id": name,
                **{f"transforms[].transform.translation.{a}": v for a, v in zip("xyz", place, strict=True)},
                "transforms[].transform.rotation.w": 1.0,
            },
        )
        for name, place in places.items()
    ]


WHEELS = {
    f"{front}_{side}_wheel_link": (x, y, 0.03)
    for front, x in (("front", 0.256), ("rear", -0.256))
    for side, y in (("left", 0.2775), ("right", -0.2775))
}
LIDAR = odometry("/icp_odom", "localization", "map", "base_link")


def test_frames_of_wheels_tell_the_vehicle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    footprint = frames({"base_link": (0.0, 0.0, 0.1351)}, "base_footprint")
    chosen = choose_for(publish(tmp_path, monkeypatch, *DRIVE, LIDAR, *footprint, *frames(WHEELS)))
    assert chosen.vehicle_source == "transforms"
    assert chosen.vehicle.kind == "differential"
    assert chosen.vehicle.track_width_m == pytest.approx(0.555)
    assert chosen.vehicle.wheel_radius_m == pytest.approx(0.1651)


def test_a_body_command_and_its_wheels_tell_the_controllers_geometry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = choose_for(publish(tmp_path, monkeypatch, *DRIVE, LIDAR))
    assert chosen.vehicle_source == "fitted"
    assert chosen.vehicle.track_width_m == pytest.approx(0.555, rel=0.02)
    assert chosen.vehicle.wheel_radius_m == pytest.approx(0.1651, rel=0.02)
    assert "its controller turns commands" in " ".join(format_finding(finding) for finding in chosen.findings)


PARAMETERS = {
    "wheel_separation": 0.555,
    "wheel_radius": 0.17,
    "left_wheel_radius_multiplier": 0.97,
    "right_wheel_radius_multiplier": 0.97,
    "wheel_separation_multiplier": 1.7,
    "publish_rate": 50.0,
}


def record_parameters(log: Path, *, topic: str = "/parameter_events") -> Path:
    """The log with its drive's parameters declared, one of them wrong at first."""
    first = {**PARAMETERS, "wheel_separation": 9.0}

    def value(number: float) -> dict[str, Any]:
        arrays = {f"{kind}_array_value": [] for kind in ("byte", "bool", "integer", "double", "string")}
        scalars = {"type": 3, "bool_value": False, "integer_value": 0, "string_value": "a"}
        return {**scalars, **arrays, "double_value": number}

    def event(new: Mapping[str, float], changed: Mapping[str, float]) -> dict[str, Any]:
        lists = {"new_parameters": new, "changed_parameters": changed, "deleted_parameters": {}}
        made = {
            key: [{"name": name, "value": value(number)} for name, number in items.items()]
            for key, items in lists.items()
        }
        return {"stamp": {"sec": 1, "nanosec": 0}, "node": "/diffbot_base_controller", **made}

    sent: list[str] = []
    kind = "rcl_interfaces/msg/ParameterEvent"

    def declare(_: str, __: object) -> Messages | None:
        if len(sent) == 2:
            return None
        sent.append("")
        content = event(first, {}) if len(sent) == 1 else event({}, {"wheel_separation": 0.555})
        return [(topic, kind, content)]

    return rewrite(log, declare)


def test_parameters_of_a_controller_tell_the_vehicle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = choose_for(record_parameters(publish(tmp_path, monkeypatch, *DRIVE, LIDAR)))
    assert (chosen.vehicle.id, chosen.vehicle_source) == ("diffbot_base_controller", "parameters")
    assert chosen.vehicle.track_width_m == pytest.approx(0.555)
    assert chosen.vehicle.wheel_radius_m == pytest.approx(0.1649)
    assert chosen.vehicle.controller_track_multiplier == pytest.approx(1.7)


def test_recorded_parameters_count_before_a_preset_and_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = publish(tmp_path, monkeypatch, twist("/a200_0042/cmd_vel"), *DRIVE[1:], LIDAR)
    chosen = choose_for(record_parameters(log))
    assert (chosen.vehicle.id, chosen.vehicle_source) == ("husky_a200", "namespace")
    assert chosen.vehicle.controller_track_multiplier == pytest.approx(1.7)
    named = choose_for(record_parameters(log), vehicle={"wheel_radius_m": 0.2, "track_width_m": 0.5})
    assert (named.vehicle.wheel_radius_m, named.vehicle.track_width_m) == (0.2, 0.5)


@pytest.mark.long
@pytest.mark.parametrize(
    ("topics", "named"),
    [
        ((fix("/gps/fix"), imu("/imu")), {"drive_lag", "effective_track", "lateral_skid"}),
        ((ground_velocity("/gps/vel"), imu("/imu")), {"drive_lag", "effective_track", "lateral_skid"}),
        ((fix("/gps/fix"), ground_velocity("/gps/vel")), {"drive_lag", "effective_track"}),
    ],
    ids=["fixes and a gyro", "velocities and a gyro", "no gyro: lateral slip is not observable"],
)
def test_hidden_effects_are_named_by_satellites(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, topics: tuple[Published, ...], named: set[str]
) -> None:
    drive = (twist("/a200_0042/platform/cmd_vel"), *DRIVE[1:])
    monkeypatch.setitem(PLATFORMS, "made_up", Platform(HUSKY, (*drive, *topics)))
    effects = {"effective_track": 1.5, "drive_lag": 0.3, "lateral_skid": 0.08}
    log = simulate_platform("made_up", effects, out=tmp_path / "run.mcap", seed=3, duration_s=180.0)
    options = Options(out=tmp_path / "results", report=False, diagnosis=True)
    diagnosis = analyze_log(log, options).summary["diagnosis"]
    assert isinstance(diagnosis, dict)
    found = {effect["id"]: effect["parameters"] for effect in diagnosis["effects"]}
    assert set(found) == named
    assert found["effective_track"]["k"]["value"] == pytest.approx(1.5, rel=0.03)
    if "lateral_skid" in named:
        assert found["lateral_skid"]["c"]["value"] == pytest.approx(0.08, abs=0.01)
