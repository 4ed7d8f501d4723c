"""Situations that robots are found in, each a drawn log: what is said of it, and which line settles it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_motion import GAIN, STEP, Drive, draw, sides
from few import few
from written_logs import write_log

from pipeline.analysis import Options
from pipeline.core import Floats, SlipError
from pipeline.recording.inspection import inspect_log
from pipeline.recording.log_setup import LogSetup, set_up_log
from pipeline.recording.readings import Held, Reading
from pipeline.words import format_finding, format_refusal


def change(wheels: Reading, by: Callable[[Floats], Floats], *, exchanged: bool = False) -> Reading:
    first, second = (Held(one.times, by(one.values)) for one in (wheels.first, wheels.second) if one)
    return (
        replace(wheels, first=second, second=first)
        if exchanged
        else replace(wheels, first=first, second=second)
    )


def in_millimetres(path: Path, drive: Drive) -> Path:
    """Motion capture in millimetres."""
    return write_log(path, replace(drive, place=1e3 * drive.place))


def in_centimetres(path: Path, drive: Drive) -> Path:
    """A camera above the table, in centimetres."""
    return write_log(path, replace(drive, place=1e2 * drive.place))


def without_signs(path: Path, drive: Drive) -> Path:
    """Hall sensors that count whichever way a wheel turns."""
    return write_log(path, drive, wheels=change(sides(drive), np.abs), wheel_topic="/{}_wheel/speed")


def exchanged_in_rpm(path: Path, drive: Drive) -> Path:
    """Two faults at once: plugs exchanged, and speeds in turns a minute."""
    wheels = change(sides(drive), lambda speed: speed * 30.0 / np.pi, exchanged=True)
    return write_log(path, drive, wheels=wheels, wheel_topic="/motor/{}/rpm")


def beside_an_idle_joystick(path: Path, drive: Drive) -> Path:
    """The usual topic belongs to a joystick that nobody touches."""
    return write_log(path, drive, command_topic="/nav/twist_out", idle_topic="/cmd_vel")


def backward_in_millimetres_per_second(path: Path, drive: Drive) -> Path:
    """Both encoders count backward, and the command is in millimetres a second."""
    wheels = change(sides(drive), np.negative)
    return write_log(path, drive, wheels=wheels, asked=drive.asked * [1e3, 1.0])


def turned_and_in_degrees(path: Path, drive: Drive) -> Path:
    """A heading that is off by a quarter turn, and a yaw rate in degrees a second."""
    asked = drive.asked * [1.0, 180.0 / np.pi]
    return write_log(path, replace(drive, yaw=drive.yaw - 0.5 * np.pi), asked=asked)


def with_a_left_encoder_that_counts_double(path: Path, drive: Drive) -> Path:
    """Both edges of the left encoder are counted, and one of the right."""
    read = sides(drive)
    first = Held(read.first.times, 2.0 * read.first.values)
    return write_log(path, drive, wheels=replace(read, first=first))


def exchanged_and_one_counting_double(path: Path, drive: Drive) -> Path:
    """Plugs exchanged, and what is called left has twice the resolution."""
    read = change(sides(drive), lambda speed: speed, exchanged=True)
    return write_log(path, drive, wheels=replace(read, first=Held(read.first.times, 2.0 * read.first.values)))


def turns_before_a_gear(path: Path, drive: Drive) -> Path:
    """Turns a minute of the motors, 36 of which are one of a wheel."""
    wheels = change(sides(drive), lambda speed: 36.0 * speed * 30.0 / np.pi)
    return write_log(path, drive, wheels=wheels, wheel_topic="/motor/{}/rpm")


def four_wheels(drive: Drive, factors: tuple[float, float, float, float]) -> dict[str, Held]:
    """Front left and right, rear left and right."""
    read = sides(drive)
    pair = [read.first, read.second]
    names = [f"{end}_{side}_wheel" for end in ("front", "rear") for side in ("left", "right")]
    each = zip(names, pair * 2, factors, strict=True)
    return {name: Held(one.times, factor * one.values) for name, one, factor in each}


def with_one_wheel_backward(path: Path, drive: Drive) -> Path:
    """One encoder of four is wired backward."""
    return write_log(path, drive, joints=four_wheels(drive, (1.0, 1.0, -1.0, 1.0)))


def with_one_wheel_counting_double(path: Path, drive: Drive) -> Path:
    """One encoder of four has twice the resolution."""
    return write_log(path, drive, joints=four_wheels(drive, (1.0, 2.0, 1.0, 1.0)))


def with_one_wheel_dead(path: Path, drive: Drive) -> Path:
    """One encoder of four reads zero."""
    return write_log(path, drive, joints=four_wheels(drive, (1.0, 1.0, 1.0, 0.0)))


def stamped_in_the_future(path: Path, drive: Drive) -> Path:
    """The clock of the machine that sends the commands runs half a second ahead."""
    return write_log(path, drive, command_ahead_s=0.5)


def with_a_gyro_in_degrees(path: Path, drive: Drive) -> Path:
    """A gyro in degrees a second beside poses."""
    return write_log(path, drive, gyro=np.degrees(drive.rate))


def with_positions_and_a_gyro_in_degrees(path: Path, drive: Drive) -> Path:
    """The same beside positions alone, whose headings are made of the gyro."""
    return write_log(path, drive, gyro=np.degrees(drive.rate), headed=False)


@pytest.mark.parametrize(
    ("make", "said", "keys"),
    few(
        [
            (with_a_gyro_in_degrees, ["the gyro of /imu is in degrees"], {"imu.unit": "deg/s"}),
            (with_positions_and_a_gyro_in_degrees, ["the gyro of /imu is in degrees"], {"imu.unit": "deg/s"}),
            (stamped_in_the_future, ["its clock runs ahead"], {"command.time": "log"}),
            (exchanged_and_one_counting_double, ["exchanged", "2 times"], {"wheels.exchanged": True}),
            (turns_before_a_gear, ["turns before a gear"], {}),
            (with_a_left_encoder_that_counts_double, ["left wheels' encoder counts 2 times"], {}),
            (
                with_one_wheel_backward,
                ["rear_left_wheel of /joint_states counts backward"],
                {"wheels.factors": {"rear_left_wheel": -1.0}},
            ),
            (with_one_wheel_counting_double, ["front_right_wheel of /joint_states counts 2 times"], {}),
            (with_one_wheel_dead, ["rear_right_wheel"], {"wheels.right": ["front_right_wheel"]}),
            (in_millimetres, ["are in mm"], {"pose.unit": "mm"}),
            (in_centimetres, ["are in cm"], {"pose.unit": "cm"}),
            (without_signs, ["have no sign"], {}),
            (exchanged_in_rpm, ["exchanged", "rpm"], {"wheels.exchanged": True, "wheels.unit": "rpm"}),
            (beside_an_idle_joystick, ["/nav/twist_out is taken for the command"], {}),
            (backward_in_millimetres_per_second, ["backward"], {"wheels.sign": -1, "command.unit": "mm/s"}),
            (turned_and_in_degrees, ["90 degrees"], {"pose.heading_deg": 90.0, "command.yaw_unit": "deg/s"}),
        ],
        3,
    ),
)
def test_a_situation_is_told_and_corrected(
    make: Callable[[Path, Drive], Path], said: list[str], keys: dict[str, object], tmp_path: Path
) -> None:
    setup: LogSetup = set_up_log(make(tmp_path / "log.mcap", draw(51)), Options(out=tmp_path))
    told = " ".join(format_finding(one) for one in setup.choice.findings)
    for text in said:
        assert text in told
    for key, value in keys.items():
        section, name = key.split(".")
        assert getattr(getattr(setup.configuration, section), name) == value
    # Of a pose in metres, wheels of the right size follow.
    if setup.sources.wheels is not None:
        assert setup.vehicle.wheel_radius_m == pytest.approx(0.1, rel=0.03)
        assert setup.vehicle.track_width_m == pytest.approx(0.5, rel=0.03)
    assert not [one for one in setup.choice.findings if one.severity == "error"]


def test_of_commands_in_percent_no_unit_is_sure(tmp_path: Path) -> None:
    drive = draw(54)
    log = write_log(tmp_path / "log.mcap", drive, asked=drive.asked * [125.0, 140.0])
    setup = set_up_log(log, Options(out=tmp_path))
    told = [format_finding(one) for one in setup.choice.findings]
    assert any("or has no unit, as percent of a throttle" in text for text in told)
    # Lengths are of the motion, and no gain of the drive is made of such numbers.
    assert setup.vehicle.wheel_radius_m == pytest.approx(0.1, rel=0.03)
    scales = np.array([setup.alignment.command_scale, setup.alignment.command_turn_scale])
    units = setup.configuration.command
    factors = {"cm/s": 0.01, "mm/s": 1e-3, "deg/s": np.pi / 180.0}
    by_unit = [factors[str(units.unit)], factors[str(units.yaw_unit)]]
    np.testing.assert_allclose(scales * by_unit, [1.0 / 125.0, GAIN / 140.0], rtol=0.03)


def test_of_commands_from_minus_one_to_one_no_gain_is_told(tmp_path: Path) -> None:
    drive = draw(54)
    log = write_log(tmp_path / "log.mcap", drive, asked=drive.asked / [1.6, 2.0], is_measured=False)
    setup = set_up_log(log, Options(out=tmp_path))
    assert any("have no sure unit" in format_finding(one) for one in setup.choice.findings)
    scales = [setup.alignment.command_scale, setup.alignment.command_turn_scale]
    np.testing.assert_allclose(scales, [1.6, 2.0 * GAIN], rtol=0.03)


def test_a_car_that_takes_a_twist_for_a_steering_angle_is_read_so(tmp_path: Path) -> None:
    drive, wheelbase = draw(55), 1.2
    asked = drive.asked * [1.0, 0.4]
    yaw = np.cumsum(asked[:, 0] * np.tan(asked[:, 1]) / wheelbase) * STEP
    place = np.cumsum(asked[:, 0] * np.exp(1j * yaw)) * STEP
    noise = np.random.default_rng(55).normal(0.0, 0.002, (3, drive.rows.size))
    body = replace(drive, place=place[drive.rows] + noise[0] + 1j * noise[1], yaw=yaw[drive.rows] + noise[2])
    still = {"mast": Held(drive.time[::5], 0.0 * drive.time[::5])}
    setup = set_up_log(
        write_log(tmp_path / "log.mcap", body, asked=asked, joints=still), Options(out=tmp_path)
    )
    assert setup.vehicle.kind == "ackermann"
    assert setup.vehicle.wheelbase_m == pytest.approx(wheelbase, rel=0.03)
    assert any(
        "steering angles in place of yaw rates" in format_finding(one) for one in setup.choice.findings
    )


def test_wheels_that_several_axles_steer_are_no_differential_drive(tmp_path: Path) -> None:
    drive = draw(53)
    at = slice(None, None, 5)
    bend = np.arctan2(0.5 * drive.rate[at], np.abs(drive.speed[at]) + 0.1)
    rolled, zero = Held(drive.time[at], drive.speed[at] / 0.1), Held(drive.time[at], 0.0 * bend)
    speeds, angles = {}, {}
    for end, sense in (("front", 1.0), ("rear", -1.0)):
        for side in ("left", "right"):
            speeds |= {f"{end}_{side}_wheel": rolled, f"{end}_{side}_steering": zero}
            angles |= {f"{end}_{side}_wheel": zero.values, f"{end}_{side}_steering": sense * bend}
    log = write_log(tmp_path / "log.mcap", drive, joints=speeds, angles=angles)
    setup = set_up_log(log, Options(out=tmp_path))
    assert setup.sources.wheels is None
    (told,) = [format_finding(one) for one in setup.choice.findings if one.id == "wheels_steered"]
    assert "front_left_steering" in told


def test_wheels_of_a_known_vehicle_that_read_three_times_too_fast_are_told(tmp_path: Path) -> None:
    drive = draw(52)
    log = write_log(tmp_path / "log.mcap", drive, wheels=change(sides(drive), lambda speed: 3.0 * speed))
    (tmp_path / "line.toml").write_text("[vehicle]\nwheel_radius_m = 0.1\ntrack_width_m = 0.5")
    setup = set_up_log(log, Options(out=tmp_path, config=tmp_path / "line.toml"))
    (told,) = [one for one in setup.choice.findings if one.id == "wheels_scaled"]
    assert told.value == pytest.approx(3.0, rel=0.02)
    assert "scale = 0.333 under [wheels]" in format_finding(told)


@pytest.mark.parametrize(
    "names",
    [("steering_joint", "traction_joint"), ("front_steer", "front_wheel"), ("azimuth_1", "drive_motor")],
)
@pytest.mark.parametrize("commanded", few([False, True], 2))
def test_a_wheel_that_steers_and_drives_is_a_tricycle(
    names: tuple[str, str], tmp_path: Path, *, commanded: bool
) -> None:
    """Behind it the body drives by the cosine of the steering angle, and turns by its sine."""
    wheelbase, radius, drawn = 1.2, 0.12, draw(54)
    bend = 0.9 * drawn.rate
    speed, rate = drawn.speed * np.cos(bend), drawn.speed * np.sin(bend) / wheelbase
    yaw = np.cumsum(rate) * STEP
    place = np.cumsum(speed * np.exp(1j * yaw)) * STEP
    noise = np.random.default_rng(1).normal(0.0, 0.002, (3, drawn.rows.size))
    drive = replace(
        drawn,
        speed=speed,
        rate=rate,
        place=place[drawn.rows] + noise[0] + 1j * noise[1],
        yaw=yaw[drawn.rows] + noise[2],
    )
    at = slice(None, None, 5)
    steers, drives = names
    rolled = Held(drive.time[at], drawn.speed[at] / radius)
    joints = {steers: Held(drive.time[at], 0.0 * bend[at]), drives: rolled}
    angles = {steers: bend[at], drives: np.cumsum(rolled.values) * STEP * 5}
    asked = np.column_stack((speed, rate)) if commanded else np.zeros((drive.time.size, 2))
    log = write_log(tmp_path / "log.mcap", drive, joints=joints, angles=angles, asked=asked)
    setup = set_up_log(log, Options(out=tmp_path))
    assert setup.vehicle.kind == "ackermann"
    assert setup.sources.wheels is not None
    assert setup.vehicle.wheelbase_m == pytest.approx(wheelbase, rel=0.02)
    assert setup.vehicle.wheel_radius_m == pytest.approx(radius, rel=0.02)


@pytest.mark.parametrize("wheels", [2, 4])
@pytest.mark.parametrize("ratio", [1.5, 1.8])
def test_circles_of_one_radius_show_no_scale_of_an_encoder(wheels: int, ratio: float, tmp_path: Path) -> None:
    """Both sides turn in one ratio throughout, which is not that of their encoders."""
    drive, rng = draw(57), np.random.default_rng(3)
    left = 2.0 + 1.5 * np.sin(0.4 * drive.time)
    turns = [left, ratio * left]
    # The ground takes a share of the turning that varies.
    taken = np.interp(drive.time, np.arange(0.0, 101.0, 2.0), rng.normal(0.6, 0.03, 51))
    speed, rate = 0.05 * (1.0 + ratio) * left, 0.1 / 0.5 * (ratio - 1.0) * left * taken
    yaw = np.cumsum(rate) * STEP
    place = np.cumsum(speed * np.exp(1j * yaw))[drive.rows] * STEP
    moved = replace(
        drive,
        asked=np.column_stack([speed, rate]),
        speed=speed,
        rate=rate,
        place=place + rng.normal(0.0, 0.002, place.size),
        yaw=yaw[drive.rows] + rng.normal(0.0, 0.01, place.size),
    )
    names = [f"{end}_{side}_wheel" for end in ("front", "rear") for side in ("left", "right")][:wheels]
    joints = {name: Held(drive.time[::5], one[::5]) for name, one in zip(names, turns * 2, strict=False)}
    setup = set_up_log(write_log(tmp_path / "log.mcap", moved, joints=joints), Options(out=tmp_path))
    assert setup.configuration.wheels.factors is None
    assert "counts" not in " ".join(format_finding(one) for one in setup.choice.findings)


def test_a_command_scale_that_turns_contradict_is_told_and_not_applied(tmp_path: Path) -> None:
    drive = draw(58)
    speed, rate = 0.78 * drive.speed, 1.05 * drive.rate
    yaw = np.cumsum(rate) * STEP
    place = np.cumsum(speed * np.exp(1j * yaw)) * STEP
    moved = replace(drive, speed=speed, rate=rate, place=place[drive.rows], yaw=yaw[drive.rows])
    log = write_log(tmp_path / "log.mcap", moved, asked=drive.asked)
    geometry = {"vehicle": {"kind": "differential", "wheel_radius_m": 0.1, "track_width_m": 0.5}}
    setup = set_up_log(log, Options(out=tmp_path, overrides=geometry))
    told = {one.id: format_finding(one) for one in setup.choice.findings}
    assert "no single scale fits" in told["command_scale"]
    assert [setup.alignment.command_scale, setup.alignment.command_turn_scale] == [1.0, 1.0]


def drive_by_hand(path: Path, left: Floats, right: Floats, gyro: Floats | None) -> Path:
    """A straight drive, and turns on the spot, of which wheels alone, or a gyro too, are recorded."""
    time = STEP * np.arange(left.size)
    none = np.zeros(0)
    still = np.zeros((left.size, 2))
    drive = Drive(time, still, none, none if gyro is None else gyro, none, none, np.zeros(0, dtype=np.int64))
    joints = {name: Held(time[::5], one[::5]) for name, one in (("left_wheel", left), ("right_wheel", right))}
    return write_log(path, drive, joints=joints, gyro=gyro)


@pytest.mark.parametrize(
    ("radius", "track", "metres", "turns"), [(0.033, 0.16, 2.0, 10.0), (0.12, 0.61, 5.0, 3.0)]
)
@pytest.mark.parametrize("counted", [True, False], ids=["counted", "gyro"])
def test_a_tape_and_turns_tell_radius_and_track(
    radius: float,
    track: float,
    metres: float,
    turns: float,
    counted: bool,  # noqa: FBT001
    tmp_path: Path,
) -> None:
    moves = [(0.0, 0.0, 2.0), (metres / radius, metres / radius, 10.0), (0.0, 0.0, 2.0)]
    spun = np.pi * turns * track / radius
    moves += [(-spun, spun, 40.0), (0.0, 0.0, 2.0)]
    left, right = (
        np.concatenate([np.full(round(one[2] / STEP), one[side] / one[2]) for one in moves])
        for side in (0, 1)
    )
    gyro = None if counted else radius * (right - left) / track
    log = drive_by_hand(tmp_path / "log.mcap", left, right, gyro)
    said = f"[truth]\ndistance_m = {metres}\n" + (f"turns = {turns}\n" if counted else "")
    (tmp_path / "run.toml").write_text(said)
    (found,) = [one for one in inspect_log(log, Options(out=tmp_path)).notes if one.id == "lengths_by_tape"]
    for name, length in (("wheel_radius_m", radius), ("track_width_m", track)):
        value, low, high = found.values[name]
        assert value == pytest.approx(length, rel=0.01)
        assert low < length < high
        assert f"{name} = " in format_finding(found)
    with pytest.raises(SlipError, match=r"by hand, vehicle = \{wheel_radius_m = .*, track_width_m = .*\} in"):
        set_up_log(log, Options(out=tmp_path))


@pytest.mark.parametrize("legs", [(10.0,), (-10.0,), (0.5,), (5.0, -5.0), (-20.0, 10.0, -0.5)])
@pytest.mark.parametrize("counted", [True, False], ids=["counted", "gyro"])
def test_turns_to_either_side_add_up(
    legs: tuple[float, ...],
    counted: bool,  # noqa: FBT001
    tmp_path: Path,
) -> None:
    radius, track = 0.033, 0.16
    still = np.zeros(round(2.0 / STEP))
    ahead = np.full(round(10.0 / STEP), 2.0 / radius / 10.0)
    spins = [
        np.full(round(4.0 * abs(leg) / STEP), np.sign(leg) * np.pi * track / radius / 4.0) for leg in legs
    ]
    noise = np.random.default_rng(7).normal(scale=0.01, size=(2, 10**5))
    left, right = (
        np.concatenate([still, ahead, *(part for spin in spins for part in (still, side * spin)), still])
        for side in (-1.0, 1.0)
    )
    left, right = left + noise[0, : left.size], right + noise[1, : right.size]
    log = drive_by_hand(
        tmp_path / "log.mcap", left, right, None if counted else radius * (right - left) / track
    )
    turns = f"turns = {sum(abs(leg) for leg in legs)}" if counted else ""
    (tmp_path / "run.toml").write_text(f"[truth]\ndistance_m = 2.0\n{turns}\n")
    (found,) = [one for one in inspect_log(log, Options(out=tmp_path)).notes if one.id == "lengths_by_tape"]
    value, low, high = found.values["track_width_m"]
    assert value == pytest.approx(track, rel=0.02)
    assert 0.0 < low < track < high


def test_a_tape_that_contradicts_the_vehicle_offers_no_length(samples: Path, tmp_path: Path) -> None:
    options = Options(out=tmp_path, overrides={"truth": {"distance_m": 0.2, "turns": 3.0}})
    notes = inspect_log(samples / "husky_tile.mcap", options).notes
    (found,) = [one for one in notes if one.id == "tape_contradicts_vehicle"]
    assert "wheel_radius_m" not in found.values
    said = format_finding(found)
    assert re.search(r"contradicts the .*Husky.* times as far in this log\. No length is taken", said), said


def test_a_tape_that_contradicts_the_poses_offers_no_length(tmp_path: Path) -> None:
    options = Options(out=tmp_path, overrides={"truth": {"distance_m": 2.0}})
    findings = set_up_log(write_log(tmp_path / "log.mcap", draw(51)), options).choice.findings
    said = " ".join(format_finding(one) for one in findings)
    assert re.search(r"contradicts the other signals: by .* times as far in this log\. No length", said), said
    assert not any(one.id == "lengths_by_tape" for one in findings)


@pytest.mark.parametrize(
    ("back", "truth", "said", "hint"),
    [
        (2.0, {"distance_m": 2.0, "turns": 10.0}, "forward and back", "drove forward and back"),
        (1.96, {"distance_m": 2.0}, "50 % of the way|49 % of the way", "measures one way"),
        (0.0, {"distance_m": 100.0, "turns": 10.0}, "which no vehicle has", "that no vehicle has"),
        (0.0, {"turns": 10.0}, "wheel radius is not known", "give --wheel-radius, or --drove"),
    ],
)
def test_what_is_measured_by_hand_is_refused_where_it_shows_no_length(
    back: float, truth: dict[str, float], said: str, hint: str, tmp_path: Path
) -> None:
    radius, track = 0.0825, 0.45
    still, second = np.zeros(round(2.0 / STEP)), round(1.0 / STEP)
    ways = [np.full(8 * second, 2.0 / radius / 8.0), np.full(8 * second, -back / radius / 8.0)]
    spin = np.full(40 * second, 10.0 * np.pi * track / radius / 40.0)
    left, right = (
        np.concatenate([still, ways[0], still, ways[1], still, side * spin, still]) for side in (-1.0, 1.0)
    )
    log = drive_by_hand(tmp_path / "log.mcap", left, right, None)
    options = Options(out=tmp_path, overrides={"truth": truth})
    (found,) = [one for one in inspect_log(log, options).notes if one.id == "no_length_by_tape"]
    assert re.search(said, format_finding(found)), format_finding(found)
    with pytest.raises(SlipError) as refused:
        set_up_log(log, options)
    assert hint in refused.value.hint
    assert "wheel_radius_m =" not in refused.value.hint


def numbered(path: Path, drive: Drive) -> Path:
    """Four wheels whose names do not say their side: 1 and 4 are left."""
    pair = sides(drive).inputs
    joints = {f"wheel_{number}": pair[side] for number, side in zip(range(1, 5), (0, 1, 1, 0), strict=True)}
    return write_log(path, drive, joints=joints)


def upside_down(path: Path, drive: Drive) -> Path:
    return write_log(path, drive, gyro=-drive.rate)


CONFIGURED = [
    (write_log, {"command": {"yaw_unit": "deg/s"}}, 'yaw_unit = "deg/s"', ""),
    (upside_down, {"imu": {"unit": "deg/s"}}, 'unit = "deg/s"', ""),
    (write_log, {"wheels": {"factors": {"left": 0.5}}}, 'factors = {"left" = 0.5}', ""),
    (
        numbered,
        {"wheels": {"left": ["wheel_1", "wheel_2"], "right": ["wheel_3", "wheel_4"]}},
        'right = ["wheel_3", "wheel_4"]',
        'left = ["wheel_1", "wheel_4"]',
    ),
]


@pytest.mark.parametrize(("make", "given", "said", "instead"), CONFIGURED)
def test_a_line_that_the_log_contradicts_is_named(
    make: Callable[[Path, Drive], Path],
    given: dict[str, object],
    said: str,
    instead: str,
    tmp_path: Path,
) -> None:
    findings = set_up_log(
        make(tmp_path / "log.mcap", draw(51)), Options(out=tmp_path, overrides=given)
    ).choice.findings
    (error,) = [format_finding(one) for one in findings if one.severity == "error"]
    assert "contradicts the other signals" in error
    assert said in error
    assert instead in error


@pytest.mark.parametrize(
    ("make", "given"),
    [
        (write_log, {"command": {"yaw_unit": "rad/s"}}),
        (upside_down, {"imu": {"unit": "rad/s"}}),
        (numbered, {"wheels": {"left": ["wheel_1", "wheel_4"], "right": ["wheel_2", "wheel_3"]}}),
    ],
)
def test_a_line_that_is_right_is_obeyed(
    make: Callable[[Path, Drive], Path], given: dict[str, object], tmp_path: Path
) -> None:
    options = Options(out=tmp_path, overrides=given)
    setup = set_up_log(make(tmp_path / "log.mcap", draw(51)), options)
    assert not {one.id for one in setup.choice.findings} & {"configured_wrongly", "kept_as_recorded"}


@pytest.mark.parametrize(
    ("make", "given"),
    [
        (turned_and_in_degrees, {"command": {"yaw_unit": "rad/s"}}),
        (with_a_gyro_in_degrees, {"imu": {"unit": "rad/s"}}),
    ],
)
def test_a_unit_that_keeps_a_log_as_recorded_is_obeyed_and_told(
    make: Callable[[Path, Drive], Path], given: dict[str, object], tmp_path: Path
) -> None:
    options = Options(out=tmp_path, overrides=given)
    setup = set_up_log(make(tmp_path / "log.mcap", draw(51)), options)
    told = [format_finding(one) for one in setup.choice.findings if one.id == "kept_as_recorded"]
    assert any('unit = "rad/s", and it is taken as it is recorded' in one for one in told)


def turned(path: Path, drive: Drive) -> Path:
    """A heading that is off by a quarter turn."""
    return write_log(path, replace(drive, yaw=drive.yaw - 0.5 * np.pi))


def in_rpm(path: Path, drive: Drive) -> Path:
    return write_log(path, drive, wheels=change(sides(drive), lambda speed: speed * 30.0 / np.pi))


def steered_in_degrees(path: Path, drive: Drive) -> Path:
    speed = np.maximum(drive.asked[:, 0], 0.2)
    angle = np.degrees(np.arctan(1.3 * drive.asked[:, 1] / speed))
    return write_log(path, drive, car=np.column_stack([speed, angle]))


OF_A_CAR = {"vehicle": {"kind": "ackermann", "wheelbase_m": 1.3}}
OF_TWO_SIDES = {"vehicle": {"wheel_radius_m": 0.1, "track_width_m": 0.5}}


@pytest.mark.parametrize(
    ("make", "given", "instead"),
    [
        (turned, {"pose": {"heading_deg": 0}}, "heading_deg = 90"),
        (in_millimetres, {"pose": {"unit": "m"}}, 'unit = "mm"'),
        (in_centimetres, {"pose": {"unit": "m"}}, 'unit = "cm"'),
        (in_rpm, {"wheels": {"unit": "rad/s"}, **OF_TWO_SIDES}, 'unit = "rpm"'),
        (steered_in_degrees, {"command": {"steering_unit": "rad"}, **OF_A_CAR}, 'steering_unit = "deg"'),
    ],
)
def test_a_line_that_keeps_a_misread_log_forbids_names_and_says_what_agrees(
    make: Callable[[Path, Drive], Path], given: dict[str, dict[str, object]], instead: str, tmp_path: Path
) -> None:
    setup = set_up_log(make(tmp_path / "log.mcap", draw(51)), Options(out=tmp_path, overrides=given))
    section, keys = next(iter(given.items()))
    for key, value in keys.items():
        assert getattr(getattr(setup.configuration, section), key) == value
    verdict = format_refusal(setup.choice.findings)
    assert f"[{section}] in run.toml gives" in verdict
    assert f"{instead} in its place agrees with the other signals" in verdict
    assert verdict.endswith("No effect can be estimated.")
    told = {one.id for one in setup.choice.findings}
    assert not told & {"command_corrected", "wheels_corrected", "command_scale", "wheelbase_contradicted"}


@pytest.mark.parametrize(("silent", "is_told"), [("/amcl_pose", True), ("/goal_pose", False)])
def test_a_topic_without_any_message_that_would_be_the_pose_is_told(
    silent: str,
    is_told: bool,  # noqa: FBT001
    tmp_path: Path,
) -> None:
    log = write_log(tmp_path / "log.mcap", draw(51), silent=silent)
    setup = set_up_log(log, Options(out=tmp_path))
    told = [format_finding(one) for one in setup.choice.findings if one.id == "topic_without_messages"]
    said = "is recorded without any message: by its name and type it may be the pose, and /lio/pose is taken"
    assert told == [f"{silent} {said} for it"] * is_told


def test_a_unit_of_a_steering_angle_that_a_wheelbase_contradicts_is_named(tmp_path: Path) -> None:
    drive = draw(51)
    speed = np.maximum(drive.asked[:, 0], 0.2)
    car = np.column_stack([speed, np.arctan(1.3 * drive.asked[:, 1] / speed)])
    given = {"command": {"steering_unit": "deg"}, **OF_A_CAR}
    log = write_log(tmp_path / "log.mcap", drive, car=car)
    verdict = format_refusal(set_up_log(log, Options(out=tmp_path, overrides=given)).choice.findings)
    assert 'gives steering_unit = "deg", which contradicts the other signals' in verdict


def test_a_unit_of_the_wheels_of_an_unknown_vehicle_may_mean_any_radius(tmp_path: Path) -> None:
    options = Options(out=tmp_path, overrides={"wheels": {"unit": "rad/s"}})
    setup = set_up_log(in_rpm(tmp_path / "log.mcap", draw(51)), options)
    assert not format_refusal(setup.choice.findings)
    assert setup.vehicle.wheel_radius_m == pytest.approx(0.1 * np.pi / 30.0, rel=0.03)


def test_a_heading_is_read_in_the_frame_that_is_corrected(tmp_path: Path) -> None:
    """Of poses with y up, a heading that says nothing about z says something about y."""
    drive = draw(51)
    log = write_log(tmp_path / "log.mcap", drive, up="y")
    for heading, told in ((0, "pose_turned"), (90, "configured_wrongly")):
        options = Options(out=tmp_path, overrides={"pose": {"heading_deg": heading}})
        ids = {one.id for one in set_up_log(log, options).choice.findings}
        assert told in ids


@pytest.mark.parametrize(
    ("radius", "track", "said"),
    [(0.3, 0.5, "scale = 0.333 under [wheels]"), (0.3, 1.08, "the track is 0.5 m and not 1.08 m")],
)
def test_lengths_of_another_vehicle_forbid_names(
    radius: float, track: float, said: str, tmp_path: Path
) -> None:
    given = {"vehicle": {"wheel_radius_m": radius, "track_width_m": track}}
    log = write_log(tmp_path / "log.mcap", draw(51))
    verdict = format_refusal(set_up_log(log, Options(out=tmp_path, overrides=given)).choice.findings)
    assert said in verdict
    assert ("scale = " in verdict) == (track == 0.5)


@pytest.mark.parametrize(
    ("log", "given", "is_told"),
    [
        ("husky_tile", "warthog", True),
        ("husky_tile", "husky_a200", False),
        ("warthog_ice", "husky_a200", True),
        ("warthog_ice", "warthog", False),
    ],
)
def test_a_preset_whose_wheels_do_not_roll_so_forbids_names(
    log: str,
    given: str,
    is_told: bool,  # noqa: FBT001
    samples: Path,
    tmp_path: Path,
) -> None:
    options = Options(out=tmp_path, overrides={"vehicle": {"preset": given}})
    verdict = format_refusal(set_up_log(samples / f"{log}.mcap", options).choice.findings)
    assert ("that is stated: correct" in verdict) == is_told


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({"left": ["wheel_1", "wheel_5"], "right": ["wheel_2"]}, "left under [wheels] names wheel_5"),
        ({"left": ["wheel1"], "right": ["wheel2"]}, "left under [wheels] names wheel1"),
        ({"factors": {"wheel_9": 0.5}}, "factors under [wheels] names wheel_9"),
    ],
)
def test_a_joint_that_is_not_there_is_refused_with_those_that_are(
    given: dict[str, object], what: str, tmp_path: Path
) -> None:
    log = numbered(tmp_path / "log.mcap", draw(51))
    with pytest.raises(SlipError) as refused:
        set_up_log(log, Options(out=tmp_path, overrides={"wheels": given}))
    assert refused.value.code == "joint_unknown"
    assert what in refused.value.what
    assert "wheel_1, wheel_2, wheel_3 and wheel_4" in refused.value.hint


def test_a_number_that_an_array_does_not_have_is_refused(tmp_path: Path) -> None:
    log = numbered(tmp_path / "log.mcap", draw(51))
    sections = {side: f"/joint_states.velocity[{at}]" for side, at in (("left_topic", 0), ("right_topic", 4))}
    with pytest.raises(SlipError) as refused:
        set_up_log(log, Options(out=tmp_path, overrides={"wheels": sections}))
    assert refused.value.code == "element_not_found"
    assert "velocity of /joint_states has 4 numbers" in refused.value.what
    assert "the last one is velocity[3]" in refused.value.hint


@pytest.mark.parametrize(("late_s", "is_told"), [(0.5, True), (0.01, False), (-1.0, False)])
def test_a_delay_that_a_configured_time_makes_is_told(
    late_s: float,
    is_told: bool,  # noqa: FBT001
    tmp_path: Path,
) -> None:
    options = Options(out=tmp_path, overrides={"command": {"late_s": late_s}})
    found = set_up_log(write_log(tmp_path / "log.mcap", draw(51)), options).choice.findings
    told = [format_finding(one) for one in found if one.id == "late_as_configured"]
    assert len(told) == is_told
    assert all("late_s = 0.5 under [command]" in one for one in told)


@pytest.mark.parametrize(("wheelbase", "is_told"), [(13.0, True), (1.3, False)])
def test_a_wheelbase_by_which_a_car_does_not_turn_is_told(
    wheelbase: float,
    is_told: bool,  # noqa: FBT001
    tmp_path: Path,
) -> None:
    drive = draw(51)
    speed = np.maximum(drive.asked[:, 0], 0.2)
    car = np.column_stack([speed, np.arctan(drive.asked[:, 1] / speed)])
    options = Options(out=tmp_path, overrides={"vehicle": {"kind": "ackermann", "wheelbase_m": wheelbase}})
    setup = set_up_log(write_log(tmp_path / "log.mcap", drive, car=car), options)
    told = [format_finding(one) for one in setup.choice.findings if one.id == "wheelbase_contradicted"]
    assert len(told) == is_told, setup.choice.recording.geometry
    assert bool(format_refusal(setup.choice.findings)) == is_told


@pytest.mark.parametrize(("spoilt", "share"), [("command", 0.55), ("command", 0.4), ("wheels", 0.55)])
def test_a_correction_that_a_part_of_a_drive_denies_is_not_applied(
    spoilt: str, share: float, tmp_path: Path
) -> None:
    drive = draw(51)
    late = drive.time > np.quantile(drive.time, share)
    asked, wheels = drive.asked, sides(drive)
    if spoilt == "command":
        asked = drive.asked * np.where(late, 1e3, 1.0)[:, None]
    else:
        left = np.where(np.interp(wheels.first.times, drive.time, late) > 0.0, 2.5, 1.0)
        wheels = replace(wheels, first=Held(wheels.first.times, left * wheels.first.values))
    setup = set_up_log(
        write_log(tmp_path / "log.mcap", drive, wheels=wheels, asked=asked), Options(out=tmp_path)
    )
    told = " ".join(format_finding(one) for one in setup.choice.findings)
    assert setup.configuration.wheels.factors is None
    assert setup.configuration.command.unit is None
    assert ("its parts contradict each other" in told) == (spoilt == "command")


def test_what_is_rounding_ahead_of_a_base_that_moves_to_its_side_says_nothing() -> None:
    times = np.arange(0.0, 30.0, 0.1)
    ahead = Held(times, np.full(times.size, 4e-9), may_stand=True)
    assert not ahead.moves
    assert Held(times, np.full(times.size, 0.1), may_stand=True).moves
