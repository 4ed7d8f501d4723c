"""Vehicles that move sideways: commands with linear.y, four wheels, and who is told when it does not fit."""

from dataclasses import replace

import polars as pl
import pytest
from stage_logs import EXACT, PLAIN, TakeThrough, rms

from pipeline.recording import StageError
from pipeline.simulate import VEHICLES, PoseSensor
from pipeline.words import format_finding

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
    assert "(differential) cannot do" in format_finding(finding)
    for name in ("dingo_o", "rosbot_xl_mecanum", "youbot"):
        assert name in format_finding(finding)
    assert rms(taken.slip("command")["f_y"]) == 0.0


def test_the_wheel_odometry_of_a_mecanum_vehicle_is_known_for_what_it_is(drive: TakeThrough) -> None:
    exact = PoseSensor(source="wheels", noise_m=0.0, noise_rad=0.0, noise_z_m=0.0, noise_tilt_rad=0.0)
    taken = drive(replace(YOUBOT, pose=exact, effects={"lateral_scale": 0.8}))
    assert "pose_from_wheels" in taken.ids()
    assert "pose_from_wheels" not in drive(YOUBOT).ids()


def test_a_vehicle_that_was_driven_sideways_only_has_moved(drive: TakeThrough) -> None:
    crab = replace(VEHICLES["youbot"], max_speed_mps=1e-9, max_turn_radps=0.0)
    taken = drive(replace(IDEAL, vehicle=crab))
    assert "not_moving" not in taken.ids()
    assert rms(taken.slip("command")["v_y"]) > 0.2
