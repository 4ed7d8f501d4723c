"""Vehicles that move sideways: commands with linear.y, four wheels, and who is told when it does not fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from stage_logs import EXACT, PLAIN, TakeThrough, record, rms

from pipeline.job.log_choice import choose
from pipeline.logs import Ragged, RaggedStrings, TopicColumns, open_log
from pipeline.simulate import VEHICLES, PoseSensor, Recording, simulate_run
from pipeline.sources import DriveSection, find_preset, load_configuration
from pipeline.stages import StageError
from pipeline.stages.drive import read_joints

FINE = replace(EXACT, noise_m=0.002, noise_rad=0.001)
YOUBOT = replace(PLAIN, vehicle=VEHICLES["youbot"], pose=FINE, duration_s=25.0)
IDEAL = replace(YOUBOT, effects={})


def test_without_any_effect_the_slip_of_command_and_wheels_is_nothing(drive: TakeThrough) -> None:
    taken = drive(IDEAL)
    assert rms(taken.slip("command")["f_y"]) > 0.2
    assert taken.slip("measured")["modulus"].median() < 0.01  # type: ignore[operator]
    assert taken.slip("command")["modulus"].median() < 0.01  # type: ignore[operator]
    assert taken.warned() == set()
    assert taken.warned() == set()


def test_what_rollers_give_away_is_sideways_slip_of_command_and_wheels(drive: TakeThrough) -> None:
    taken = drive(replace(YOUBOT, effects={"lateral_scale": 0.8}))
    for source in ("command", "measured"):
        steady = taken.slip(source).filter(~pl.col("transitory"), pl.col("f_y").abs() > 0.1)
        assert (steady["g_y"] / steady["f_y"]).median() == pytest.approx(0.2, abs=0.01)
        for channel in ("g_x", "g_w"):
            assert steady[channel].abs().median() < 0.01  # type: ignore[operator]
    # Sideways driving is no fault of the localization.
    assert taken.warned() == set()


def test_the_tables_hold_what_was_asked_and_measured_sideways(drive: TakeThrough) -> None:
    taken = drive(IDEAL)
    commands, wheels = (taken.aligned.tables[name] for name in ("commands", "wheels"))
    asked = simulate_run(IDEAL).commands
    radius = IDEAL.vehicle.wheel_radius_m
    assert commands["body_y"].to_numpy() == pytest.approx(asked.sideways, abs=1e-9)
    assert commands["sideways_aligned"].to_numpy() * radius == pytest.approx(asked.sideways, abs=1e-9)
    truth = simulate_run(IDEAL).wheels
    assert truth is not None
    assert wheels["sideways"].to_numpy() * radius == pytest.approx(
        truth.sideways_mps(IDEAL.vehicle), abs=1e-6
    )


def test_wheels_of_other_names_are_told_by_the_configuration(drive: TakeThrough) -> None:
    # The names say left and right at random: only the configuration knows.
    front = ["front_left_wheel_joint", "rear_left_wheel_joint"]
    sides = {"left": ["front_left_wheel_joint", "rear_right_wheel_joint"]}
    sides["right"] = ["front_right_wheel_joint", "rear_left_wheel_joint"]
    usual = drive(IDEAL).aligned.tables["wheels"]
    told = drive(IDEAL, {"wheels": {"front": front, **sides}}).aligned.tables["wheels"]
    wheels = simulate_run(IDEAL).wheels
    assert wheels is not None
    assert wheels.corners is not None
    corners = wheels.corners
    # Front wheels: front left and rear left; left ones: front left and rear right.
    swapped = corners["rear_left"] + corners["rear_right"] - corners["front_left"] - corners["front_right"]
    assert told["sideways"].to_numpy() == pytest.approx(swapped / 4.0, abs=1e-4)
    assert not np.allclose(told["sideways"].to_numpy(), usual["sideways"].to_numpy(), atol=0.1)


def test_joints_that_do_not_say_front_or_rear_are_refused_with_the_key_to_set() -> None:
    vehicle = find_preset("youbot")
    assert vehicle is not None
    times, joints = np.arange(3) * 0.1, ("left_wheel_a", "left_wheel_b", "right_wheel_a", "right_wheel_b")
    names = RaggedStrings(np.tile(np.arange(4), 3), joints, np.arange(4) * 4)
    velocity = Ragged(np.tile([-1.0, 1.0, 1.0, -1.0], 3), names.offsets)
    fields = {"name": names, "velocity": velocity, "position": None}
    stamps = (times * 1e9).astype(np.int64)
    columns = TopicColumns("/j", 0, "sensor_msgs/msg/JointState", stamps, stamps, None, fields, ())  # type: ignore[arg-type]
    with pytest.raises(StageError) as caught:
        read_joints(columns, times, DriveSection(), vehicle)
    assert "front or a rear wheel" in str(caught.value)
    assert "Set front" in str(caught.value)
    told = read_joints(columns, times, DriveSection(front=["left_wheel_a", "right_wheel_a"]), vehicle)
    assert told.sideways == pytest.approx(1.0)


def test_a_pair_of_wheel_speeds_cannot_tell_how_a_mecanum_vehicle_moves(drive: TakeThrough) -> None:
    pair = {
        "left_topic": "/joint_states.velocity[0]",
        "right_topic": "/joint_states.velocity[1]",
    }
    with pytest.raises(StageError) as caught:
        drive(IDEAL, {"wheels": pair})
    assert caught.value.code == "no_sideways"
    assert "linear.y" in str(caught.value)


def test_a_differential_preset_on_sideways_commands_is_said_as_an_error(drive: TakeThrough) -> None:
    taken = drive(IDEAL, {"vehicle": {"preset": "husky_a200", "wheel_radius_m": 0.0475}})
    finding = taken.finding("sideways_command")
    assert finding.severity == "error"
    assert "(differential) cannot do" in finding.text
    for name in ("dingo_o", "rosbot_xl_mecanum", "youbot"):
        assert name in finding.text
    assert rms(taken.slip("command")["f_y"]) == 0.0


def test_a_mecanum_preset_on_a_differential_log_finds_no_sideways_motion(drive: TakeThrough) -> None:
    geometry = {"wheel_radius_m": 0.165, "track_width_m": 0.3, "wheelbase_m": 0.25}
    scenario = replace(PLAIN, pose=EXACT, duration_s=30.0, effects={}, recording=Recording("tf"))
    taken = drive(scenario, {"vehicle": {"preset": "youbot", **geometry}})
    assert rms(taken.slip("command")["f_y"]) == 0.0
    assert taken.slip("command")["modulus"].median() < 5e-4  # type: ignore[operator]


def test_the_wheel_odometry_of_a_mecanum_vehicle_is_known_for_what_it_is(drive: TakeThrough) -> None:
    exact = PoseSensor(source="wheels", noise_m=0.0, noise_rad=0.0, noise_z_m=0.0, noise_tilt_rad=0.0)
    taken = drive(replace(YOUBOT, pose=exact, effects={"lateral_scale": 0.8}))
    assert "pose_from_wheels" in taken.ids()
    assert "pose_from_wheels" not in drive(YOUBOT).ids()


def test_an_unknown_vehicle_that_is_asked_sideways_is_told_as_body_motion(tmp_path: Path) -> None:
    unnamed = replace(YOUBOT, recording=Recording("mecanum", deployment="absent"))
    log = record(unnamed, tmp_path / "run.mcap")
    chosen = choose(open_log(log), load_configuration(log), {})
    assert (chosen.vehicle.kind, chosen.vehicle_source) == ("omni", "fitted")
    (finding,) = [found for found in chosen.findings if found.id == "vehicle_fitted"]
    assert "sideways" in finding.text


def test_a_vehicle_that_was_driven_sideways_only_has_moved(drive: TakeThrough) -> None:
    crab = replace(VEHICLES["youbot"], max_speed_mps=1e-9, max_turn_radps=0.0)
    taken = drive(replace(IDEAL, vehicle=crab))
    assert "not_moving" not in taken.ids()
    assert rms(taken.slip("command")["v_y"]) > 0.2
