"""Traps of commands and wheels."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from stage_logs import FIELD, ICP, PLAIN, TakeThrough, rms, slope

from pipeline.core import SlipError
from pipeline.recording.command_scale import find_ratio
from pipeline.recording.drive import _mean_steering
from pipeline.run import read_wheels
from pipeline.simulate import VEHICLES, Encoders, PoseSensor, Program, Recording
from pipeline.words import format_finding

LONGER = replace(FIELD, duration_s=150.0)


def test_trap_7_wheels_are_told_apart_by_name_whatever_their_order(drive: TakeThrough) -> None:
    # The simulated command lists its joints from the back, the encoders from the front.
    taken = drive(replace(FIELD, recording=Recording("husky")))
    command, measured = taken.slip("command"), taken.slip("measured")
    steady = ~pl.col("transitory")
    both = command.filter(steady).join(measured.filter(steady), on="stamp", suffix="_measured")
    assert slope(both["f_w"], both["f_w_measured"]) == pytest.approx(1.0, abs=0.02)
    assert slope(both["f_x"], both["f_x_measured"]) == pytest.approx(1.0, abs=0.02)


def test_trap_7_positions_are_differentiated_where_there_is_no_velocity(drive: TakeThrough) -> None:
    usual = replace(FIELD, encoders=Encoders(noise_radps=0.0, report="velocity"))
    only = replace(FIELD, encoders=Encoders(noise_radps=0.0, report="position"))
    plain = drive(usual).slip("measured")
    taken = drive(only)
    assert taken.finding("velocity_from_position").severity == "info"
    steady = taken.slip("measured").filter(~pl.col("transitory"))
    both = steady.join(plain, on="stamp", suffix="_plain")
    assert rms(both["f_x"] - both["f_x_plain"]) < 5e-3


@pytest.mark.parametrize("track", [0.0, 0.45])
def test_trap_7_steered_wheels_about_one_centre_steer_as_the_one_between_them(track: float) -> None:
    asked, wheelbase = np.linspace(-0.6, 0.6, 25), 0.6
    slope = np.tan(asked)
    inner, outer = (np.arctan(slope / (1.0 + side * slope * track / wheelbase)) for side in (-0.5, 0.5))
    joints = {"front_left_steering_joint": inner, "front_right_steering_joint": outer, "rear_left": asked}
    assert np.allclose(_mean_steering(joints, None, "/joint_states"), asked)
    # Toed in by a play of the rods the wheels have no centre; and one sensor is its wheel's.
    toed = {"left_steer": np.full(3, 0.01), "right_steer": np.full(3, -0.01)}
    assert np.allclose(_mean_steering(toed, None, "/joint_states"), 0.0)
    assert np.array_equal(_mean_steering({"steering": asked}, None, "/joint_states"), asked)


@pytest.mark.parametrize(("unit", "factor"), [("rad/s", 1.0), ("rpm", 2.0 * np.pi / 60.0), ("m/s", 1 / 0.3)])
@pytest.mark.parametrize("sign", [1, -1])
def test_units_and_signs_of_wheel_speeds_are_those_configured(
    drive: TakeThrough, unit: str, factor: float, sign: int
) -> None:
    scenario = replace(PLAIN, vehicle=VEHICLES["warthog"], duration_s=20.0)
    plain = drive(scenario).extracted.tables["wheels"]
    sides = {"left_topic": "/left_drive/status/speed", "right_topic": "/right_drive/status/speed"}
    taken = drive(scenario, {"wheels": {**sides, "unit": unit, "sign": sign}}).extracted.tables["wheels"]
    assert np.allclose(taken["left"], plain["left"] * factor * sign)


def test_trap_8_only_live_intervals_count_by_default(drive: TakeThrough) -> None:
    by_hand = replace(LONGER, recording=Recording(hand_driven_s=40.0))
    taken = drive(by_hand)
    assert taken.finding("interval_applied").count == 1
    assert taken.slip("command")["t"].min() >= 40.0 - 0.2
    assert "stale_command" not in taken.ids()


def test_trap_8_a_command_that_says_zero_while_someone_drives_is_noticed(drive: TakeThrough) -> None:
    taken = drive(replace(LONGER, recording=Recording(hand_driven_s=40.0)), {"use_intervals": "all"})
    assert taken.slip("command")["t"].min() < 1.0
    by_hand = taken.finding("manual_driving")
    assert by_hand.t_start is not None
    assert by_hand.t_start < 10.0
    assert by_hand.value is not None
    assert by_hand.value > 20.0


def test_trap_8_a_vehicle_that_rests_under_zero_commands_is_not_stale(drive: TakeThrough) -> None:
    taken = drive(replace(LONGER, program=Program("stop_and_go"), effects={"drive_lag": 0.6}))
    assert "stale_command" not in taken.ids()


def test_trap_8_a_command_is_held_only_as_long_as_it_counts(drive: TakeThrough) -> None:
    # A joystick that is let go sends nothing; the controller stops half a second later.
    released = replace(LONGER, program=Program("teleop"))
    taken = drive(released)
    gone = taken.finding("stale_command")
    assert gone.count is not None
    commands = taken.extracted.tables["commands"]["t"].to_numpy()
    kept = taken.slip("command")["t"].to_numpy()
    last = commands[np.searchsorted(commands, kept + 1e-6, side="right") - 1]
    assert float((kept - last).max()) <= 0.5 + 1e-6
    longer = drive(released, {"command": {"hold_s": 1e4}})
    assert longer.slip("command").height > taken.slip("command").height
    assert "stale_command" not in longer.ids()


def test_trap_8_intervals_by_time_and_by_state(drive: TakeThrough) -> None:
    by_hand = replace(LONGER, recording=Recording(hand_driven_s=40.0))
    timed = drive(by_hand, {"interval": [{"start_s": 60.0, "end_s": 80.0}, {"start_s": 100.0}]})
    times = timed.slip("command")["t"]
    assert (times.min(), times.filter(times < 90.0).max()) == pytest.approx((60.0, 80.0), abs=0.1)
    assert times.filter(times > 90.0).min() == pytest.approx(100.0, abs=0.1)
    state = {"topic": "/drive/calib_state", "equals": "idle"}
    idle = drive(by_hand, {"interval": [state]})
    assert idle.slip("measured")["t"].max() == pytest.approx(40.0, abs=0.2)
    either = drive(by_hand, {"interval": [state, {"topic": "/drive/calib_state", "equals": "calib"}]})
    assert either.slip("measured").height > 2900
    clipped = drive(by_hand, {"interval": [{**state, "start_s": 10.0, "end_s": 20.0}]})
    found = clipped.slip("measured")["t"]
    assert (found.min(), found.max()) == pytest.approx((10.0, 20.0), abs=0.1)


ODOMETRY = PoseSensor(source="wheels", noise_m=0.0, noise_rad=0.0, noise_z_m=0.0, noise_tilt_rad=0.0)


@pytest.mark.parametrize(
    "program",
    [
        "drive_steps",
        "teleop",
        "straight",
        *(pytest.param(more, marks=pytest.mark.long) for more in ("slalom", "smooth", "spins")),
    ],
)
def test_trap_9_wheel_odometry_is_recognised_however_it_is_driven(drive: TakeThrough, program: str) -> None:
    scenario = replace(LONGER, pose=ODOMETRY, program=Program(program), encoders=Encoders(noise_radps=0.02))  # type: ignore[arg-type]
    taken = drive(scenario)
    assert taken.finding("pose_from_wheels").severity == "error"


def test_trap_9_commands_in_place_of_encoders_are_not_evaluated_and_still_show_odometry(
    drive: TakeThrough,
) -> None:
    """A controller in open loop: its odometry is its command, and poses may be made of it."""
    echo = replace(LONGER, effects={}, program=Program("smooth"), encoders=Encoders(noise_radps=0.0))
    taken = drive(echo)
    assert taken.finding("wheels_from_commands").severity == "warning"
    assert "pose_from_wheels" not in taken.ids()
    assert set(taken.result.inputs) == {"command"}
    assert read_wheels(taken.aligned.tables["wheels"], taken.aligned.vehicle) is None
    assert {"wheels_from_commands", "pose_from_wheels"} <= drive(replace(echo, pose=ODOMETRY)).ids()
    assert "wheels_from_commands" not in drive(replace(echo, effects={"drive_lag": 0.02})).ids()
    with pytest.raises(SlipError, match="--input command"):
        drive(echo, inputs=("measured",))


@pytest.mark.parametrize("vehicle", ["husky", "warthog", "turtlebot3"])
def test_trap_9_an_ideal_vehicle_with_a_good_localization_is_not_accused(
    drive: TakeThrough, vehicle: str
) -> None:
    # 0.5 mm is better than any laser in the field.
    pose = PoseSensor(noise_m=0.0005, noise_rad=0.0005)
    taken = drive(replace(PLAIN, vehicle=VEHICLES[vehicle], pose=pose))
    assert "pose_from_wheels" not in taken.ids()


def test_trap_11_a_controller_that_widens_the_track_is_found(drive: TakeThrough) -> None:
    clearpath = replace(VEHICLES["husky"], controller_track_multiplier=1.875)
    scenario = replace(LONGER, vehicle=clearpath, recording=Recording("husky_body_command"))
    taken = drive(scenario)
    assert taken.finding("controller_multiplier").value == pytest.approx(1.875, rel=0.03)
    assert "controller_track_multiplier = 1.8" in format_finding(taken.finding("controller_multiplier"))
    told = drive(scenario, {"vehicle": {"controller_track_multiplier": 1.875}})
    assert "controller_multiplier" not in told.ids()
    both = told.slip("command").join(told.slip("measured"), on="stamp", suffix="_measured")
    steady = both.filter(~pl.col("transitory"))
    assert slope(steady["f_w"], steady["f_w_measured"]) == pytest.approx(1.0, abs=0.02)


def test_trap_11_a_multiplier_that_the_controller_does_not_use_is_taken_back(drive: TakeThrough) -> None:
    scenario = replace(LONGER, recording=Recording("husky_body_command"))
    taken = drive(scenario, {"vehicle": {"controller_track_multiplier": 1.875}})
    assert taken.finding("controller_multiplier").value == pytest.approx(1.0, rel=0.03)
    both = taken.slip("command").join(taken.slip("measured"), on="stamp", suffix="_measured")
    steady = both.filter(~pl.col("transitory"))
    assert slope(steady["f_w"], steady["f_w_measured"]) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("layout", ["husky_body_command", "husky"])
def test_trap_11_a_plain_controller_is_not_accused(drive: TakeThrough, layout: str) -> None:
    taken = drive(replace(LONGER, recording=Recording(layout)))
    assert {"controller_multiplier", "command_scale"} & taken.ids() == set()


def test_trap_13_the_command_that_the_controller_received_is_taken(drive: TakeThrough) -> None:
    decoyed = replace(LONGER, recording=Recording("husky_body_command", decoys="both"))
    taken = drive(decoyed)
    assert str(taken.sources.command) == "/controller/cmd_vel"
    assert str(taken.sources.pose) == "/mapping/icp_odom"
    steady = taken.slip("command").filter(~pl.col("transitory"))
    assert float(steady["g_x"].abs().median()) < 0.03
    assert [note for note in taken.sources.notes if "/navigation/cmd_vel" in note]


@pytest.mark.parametrize("program", ["drive_steps", "slalom", "straight", "spins"])
def test_trap_14_wheels_in_the_air_are_not_moving(drive: TakeThrough, program: str) -> None:
    lifted = replace(
        FIELD,
        effects={"wheel_radius": 0.0},
        program=Program(program, lead_s=0.5),
        duration_s=90.0,  # type: ignore[arg-type]
    )
    taken = drive(lifted)
    found = taken.finding("not_moving")
    assert found.severity == "error"
    assert abs(found.value or 0.0) < 0.05
    assert {"bad_stretch", "command_scale"} & taken.ids() == set()


def test_trap_14_encoders_that_say_zero_are_dead(drive: TakeThrough) -> None:
    taken = drive(replace(FIELD, encoders=Encoders(gain=0.0, noise_radps=0.0)))
    assert taken.finding("wheels_dead").severity == "error"
    assert "not_moving" not in taken.ids()


@pytest.mark.parametrize(
    "scenario",
    [
        replace(FIELD, program=Program("spins")),
        replace(FIELD, program=Program("straight")),
        replace(FIELD, program=Program(speed_scale=0.1, turn_scale=0.1)),
        replace(FIELD, effects={"wheel_radius": 0.4, "effective_track": 2.5}),
        replace(FIELD, vehicle=VEHICLES["warthog"], effects={"body_inertia": 1.5}),
        replace(FIELD, duration_s=300.0, program=Program(lead_s=145.0)),
    ],
    ids=["spins", "straight", "slow", "half the radius", "ice", "mostly idle"],
)
def test_trap_14_a_vehicle_that_moves_is_not_accused(drive: TakeThrough, scenario: object) -> None:
    assert {"not_moving", "wheels_dead"} & drive(scenario).ids() == set()


def test_trap_19_commands_beyond_the_limits_are_told(drive: TakeThrough) -> None:
    # The preset's Husky lets 1 m/s and 1 rad/s through.
    eager = replace(VEHICLES["husky"], max_speed_mps=2.0, max_turn_radps=2.0)
    taken = drive(replace(FIELD, vehicle=eager))
    found = [finding for finding in taken.findings if finding.id == "command_beyond_limit"]
    assert {finding.where for finding in found} == {"command speed", "command yaw rate"}
    assert all(finding.value is not None and 0.2 < finding.value < 0.8 for finding in found)
    (speed,) = (finding for finding in found if finding.where == "command speed")
    assert format_finding(speed).endswith("so this limit does not act")
    clipped = drive(replace(FIELD, vehicle=eager, effects={"body_speed_limit": 1.0}))
    texts = {one.where: format_finding(one) for one in clipped.findings if one.id == "command_beyond_limit"}
    assert texts["command speed"].endswith("the controller may clip it")
    assert "command_beyond_limit" not in drive(FIELD).ids()


@pytest.mark.parametrize("scale", [1.82, 0.5])
def test_trap_21_a_command_of_another_radius_is_found(drive: TakeThrough, scale: float) -> None:
    taken = drive(replace(LONGER, recording=Recording(command_scale=scale)))
    assert taken.finding("command_scale").value == pytest.approx(1.0 / scale, rel=0.02)
    assert "no single scale fits" not in format_finding(taken.finding("command_scale"))
    assert "controller_multiplier" not in taken.ids()


@pytest.mark.parametrize("reached", [1.0, 0.6])
def test_trap_21_commands_of_another_vehicle_are_those_of_its_wheels_and_track(
    drive: TakeThrough, reached: float
) -> None:
    """Whether the sides reach the difference or, against the ground, less of it."""
    husky, warthog = VEHICLES["husky"], VEHICLES["warthog"]
    radii = warthog.wheel_radius_m / husky.wheel_radius_m
    tracks = radii * husky.lever_m / warthog.lever_m
    recording = Recording(command_scale=1.0 / radii, command_turn_scale=1.0 / tracks)
    effects = {} if reached == 1.0 else {"difference_gain": reached}
    taken = drive(replace(LONGER, effects=effects, recording=recording))
    finding = taken.finding("command_scale")
    assert "another vehicle (Clearpath Warthog: " in format_finding(finding)
    assert finding.value == pytest.approx(radii, rel=1e-6)
    aligned = drive(replace(LONGER, effects=effects)).aligned.tables["commands"]
    for side in ("left_aligned", "right_aligned"):
        assert taken.aligned.tables["commands"][side].to_numpy() == pytest.approx(
            aligned[side].to_numpy(), rel=1e-3, abs=1e-6, nan_ok=True
        )


@pytest.mark.parametrize(
    "effects",
    [
        {"turn_lag": {"tau_mean": 0.3, "tau_diff": 1.0}},
        {"body_speed_limit": 0.7, "body_turn_limit": 0.6},
        {"deadband": 0.2},
        {"wheel_radius": 0.8},
        *(
            pytest.param(more, marks=pytest.mark.long)
            for more in ({"drive_lag": 0.6}, {"wheel_speed_limit": 4.5}, {"deadband": 0.1})
        ),
    ],
    ids=str,
)
def test_trap_21_what_the_drive_does_is_no_wrong_scale(drive: TakeThrough, effects: dict[str, float]) -> None:
    taken = drive(replace(LONGER, effects=effects))
    assert {"command_scale", "controller_multiplier"} & taken.ids() == set()


def test_trap_21_a_dead_band_is_no_scale() -> None:
    """It takes a third of slow steps; a scale takes the same of all."""
    asked = np.tile([0.3, -0.35, 0.42, -0.5, 0.58, 0.64, -0.7, 1.5], 5)
    assert find_ratio(asked, asked - 0.14 * np.sign(asked)) is None
    assert find_ratio(asked, 0.7 * asked) == pytest.approx(0.7)
    # Steps of one speed show no dead band, whatever their noise is.
    draw = np.random.default_rng(5)
    for _ in range(20):
        alike = 0.5 * np.array([1.0, -1.0] * 20) * (1.0 + 0.01 * draw.normal(size=40))
        noisy = 1.8 * alike * (1.0 + 0.02 * draw.normal(size=40))
        found = find_ratio(np.append(alike, 1.5), np.append(noisy, 2.7))
        assert found == pytest.approx(1.8, rel=0.05)


@pytest.mark.parametrize("layout", ["ackermann", "ackermann_status", "ackermann_floats"])
def test_a_car_is_read_from_every_form(drive: TakeThrough, layout: str) -> None:
    car = replace(PLAIN, vehicle=VEHICLES["car"], pose=ICP, recording=Recording(layout))
    taken = drive(car)
    steady = taken.slip("measured").filter(~pl.col("transitory"))
    assert slope(steady["f_x"], steady["v_x"]) == pytest.approx(1.0, abs=0.02)
    assert slope(steady["f_w"], steady["v_w"]) == pytest.approx(1.0, abs=0.03)
    assert taken.warned() == set()
