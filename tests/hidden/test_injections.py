"""What is injected into recordings is what its name says, and is judged as it should be."""

import math
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from inject import Answer, judge
from injections import Drive, Injection, Tables, list_injections

pytestmark = pytest.mark.long

DRIVE = Drive(0.1, 0.5)
BY_NAME = {injection.name: injection for injection in list_injections()}


@pytest.fixture
def tables() -> Tables:
    """A vehicle that does what its wheels do: 1 m/s, .5 rad/s, in a map in which it starts at (3, -2)."""
    times = np.arange(0.0, 20.0, 0.05)
    yaw = 0.3 + 0.5 * times
    place = 3.0 - 2.0j + (np.exp(1j * yaw) - np.exp(0.3j)) / 0.5j
    stamps = (times * 1e9).astype(np.int64)
    still = np.zeros(times.size)
    poses = pl.DataFrame(
        {
            "t": times, "stamp": stamps, "segment": np.zeros(times.size, dtype=np.int32),
            "x": place.real, "y": place.imag, "z": still,
            "q_x": still, "q_y": still, "q_z": np.sin(0.5 * yaw), "q_w": np.cos(0.5 * yaw),
            "held": np.zeros(times.size, dtype=bool), "active": np.ones(times.size, dtype=bool),
        }
    )  # fmt: skip
    wheels = pl.DataFrame(
        {
            "t": times, "stamp": stamps,
            "left": np.full(times.size, (1.0 - 0.25 * 0.5) / 0.1),
            "right": np.full(times.size, (1.0 + 0.25 * 0.5) / 0.1),
        }
    )  # fmt: skip
    imu = pl.DataFrame({"t": times, "rate_z": np.full(times.size, -0.5)})
    commands = wheels.with_columns(pl.lit(1.0).alias("body_x"), pl.lit(0.5).alias("body_w"))
    return {"poses": poses, "wheels": wheels, "commands": commands, "imu": imu}


def find_velocity(poses: pl.DataFrame) -> tuple[complex, float]:
    """Mean body velocity v_x + j v_y [m/s] and yaw rate [rad/s] by differences of poses."""
    yaw = np.unwrap(2.0 * np.arctan2(poses["q_z"].to_numpy(), poses["q_w"].to_numpy()))
    times = poses["t"].to_numpy()
    moved = np.diff(poses["x"].to_numpy() + 1j * poses["y"].to_numpy())
    own = moved * np.exp(-0.5j * (yaw[1:] + yaw[:-1])) / np.diff(times)
    return complex(own.mean()), float((yaw[-1] - yaw[0]) / (times[-1] - times[0]))


@pytest.mark.parametrize(
    ("name", "velocity", "turning"),
    [
        ("map turned and moved", 1.0, 0.5),
        ("poses at 5 Hz", 1.0, 0.5),
        ("poses from the wheels", 1.0, 0.5),
        ("misalignment 3 deg", np.exp(-1j * math.radians(3.0)), 0.5),
        ("lever arm .3 m", 1.0 + 0.3j * 0.5, 0.5),
        ("skid .1 s", 1.0 - 0.1j * 0.5, 0.5),
        ("resistance .15 s", 1.0 - 0.15 * 0.5, 0.5),
        ("speed slip .03 s/m", 0.97, 0.5),
        ("track x 1.2", 1.0, 0.5 / 1.2),
        ("track at speed +.05", 1.0, 0.525),
        ("gains .8 and .7 half-way", 0.9, 0.425),
    ],
)
def test_poses_move_as_the_effect_says(name: str, velocity: complex, turning: float, tables: Tables) -> None:
    changed = BY_NAME[name].change(tables, DRIVE)
    found, turned = find_velocity(changed["poses"])
    assert found == pytest.approx(velocity, abs=2e-3)
    assert turned == pytest.approx(turning, abs=2e-3)
    # An inverted gyro feels the same turning, by its own sign.
    felt = float(changed["imu"]["rate_z"].mean())  # type: ignore[arg-type]
    assert felt == pytest.approx(-turning, abs=5e-3)


def test_a_gyro_ahead_of_the_poses_stays_ahead(tables: Tables) -> None:
    """Poses are stamped .4 s late, wheels and gyro are not: each turns as the effect says."""
    times, late = tables["poses"]["t"].to_numpy(), 0.4
    rate = np.interp(times, np.arange(-5.0, 30.0), np.random.default_rng(1).normal(0.0, 0.5, 35))
    yaw = np.interp(times - late, times, np.cumsum(rate) * 0.05)
    poses = tables["poses"].with_columns(
        pl.Series("q_z", np.sin(0.5 * yaw)), pl.Series("q_w", np.cos(0.5 * yaw))
    )
    imu = tables["imu"].with_columns(pl.Series("rate_z", -rate))
    wheels = tables["wheels"].with_columns(pl.Series("left", 10.0 - rate), pl.Series("right", 10.0 + rate))
    moving = {**tables, "poses": poses, "imu": imu, "wheels": wheels}
    changed = BY_NAME["track x 1.2"].change(moving, DRIVE)
    assert changed["imu"]["rate_z"].to_numpy() == pytest.approx(-rate / 1.2, abs=1e-9)
    turned = np.unwrap(
        2.0 * np.arctan2(changed["poses"]["q_z"].to_numpy(), changed["poses"]["q_w"].to_numpy())
    )
    assert turned - turned[0] == pytest.approx((yaw - yaw[0]) / 1.2, abs=1e-6)
    half = BY_NAME["gains .8 and .7 half-way"].change(moving, DRIVE)["imu"]["rate_z"].to_numpy()
    assert half[-100:] == pytest.approx(-0.7 * rate[-100:], abs=1e-9)


def test_the_rest_changes_one_table_alone(tables: Tables) -> None:
    for name, table in (
        ("wheels x 1.05", "wheels"),
        ("commands x 1.5", "commands"),
        ("commands .2 s early", "commands"),
        ("gyro negated", "imu"),
        ("1 cm of noise", "poses"),
        ("poses .15 s late", "poses"),
    ):
        changed = BY_NAME[name].change(tables, DRIVE)
        differing = [key for key in tables if not changed[key].equals(tables[key])]
        assert differing == [table], name


def test_a_heading_that_is_late_is_that_of_before(tables: Tables) -> None:
    late = BY_NAME["heading .1 s late"].change(tables, DRIVE)["poses"]
    yaw = np.unwrap(2.0 * np.arctan2(late["q_z"].to_numpy(), late["q_w"].to_numpy()))
    assert yaw[-1] == pytest.approx(0.3 + 0.5 * (late["t"][-1] - 0.1), abs=1e-6)


def test_a_slow_localization_is_late_by_as_much_and_the_wheels_are_not_slow(tables: Tables) -> None:
    """Every fourth pose is new and stands until the next."""
    rows = np.arange(400) // 4 * 4
    own = pl.col("x", "y", "q_z", "q_w").gather(rows)
    slow = {**tables, "poses": tables["poses"].with_columns(own, pl.Series("held", np.arange(400) % 4 != 0))}
    late = BY_NAME["heading .1 s late"].change(slow, DRIVE)["poses"]
    fresh = late.filter(~pl.col("held"))
    yaw = np.unwrap(2.0 * np.arctan2(fresh["q_z"].to_numpy(), fresh["q_w"].to_numpy()))
    assert yaw[1:] == pytest.approx(0.3 + 0.5 * (fresh["t"].to_numpy()[1:] - 0.1), abs=1e-6)
    assert not BY_NAME["poses from the wheels"].change(slow, DRIVE)["poses"]["held"].any()


def test_answers_are_judged() -> None:
    track = Injection("t", lambda tables, _: tables, (), {"effective_track.k": lambda k: 1.2 * k})
    plain = Answer({"effective_track.k": (1.5, 0.01)})

    def name(value: float, **more: float) -> Answer:
        numbers = {"effective_track.k": (value, 0.01), **{f"{key}.k": (v, 0.01) for key, v in more.items()}}
        return Answer(numbers)

    assert judge(track, plain, name(1.81)) == ("recovered", [])
    assert judge(track, plain, name(1.5)) == ("number", [])
    assert judge(track, plain, Answer({})) == ("missed", [])
    assert judge(track, plain, name(1.8, speed_slip=0.1)) == ("recovered", ["speed_slip"])
    assert judge(track, replace(plain, undecided=("speed_slip",)), name(1.8, speed_slip=0.1))[1] == []
    assert judge(track, plain, Answer({}, undecided=("effective_track",)))[0] == "undecided"
    one = Answer({}, undecided=("effective_track",), rivals={"effective_track.k": (1.81, 0.01)})
    assert judge(track, plain, one)[0] == "one of"
    assert judge(track, plain, replace(one, rivals={"effective_track.k": (1.5, 0.01)}))[0] == "undecided"
    assert judge(track, plain, Answer({}, unobservable=("effective_track",)))[0] == "cannot"
    assert judge(track, plain, Answer({}, detectable={"effective_track.k": 0.5}))[0] == "cannot"
    told = Injection("f", lambda tables, _: tables, ("wheel_dead",))
    assert judge(told, plain, Answer({}, {"wheel_dead": 0.5})) == ("reported", [])
    assert judge(told, Answer({}, {"wheel_dead": 0.5}), Answer({}, {"wheel_dead": 0.5}))[0] == "missed"
    assert judge(told, Answer({}, {"wheel_dead": 0.5}), Answer({}, {"wheel_dead": 0.75}))[0] == "reported"
    same = Injection("s", lambda tables, _: tables, same=True)
    assert judge(same, plain, plain)[0] == "recovered"
    assert judge(same, plain, Answer({}))[0] == "missed"
    assert judge(same, plain, name(1.6))[0] == "missed"
    assert judge(same, plain, name(1.5, speed_slip=0.1)) == ("missed", ["speed_slip"])
    for estimate, verdict in (((0.1, 0.05), "edge"), ((0.1, 0.2), "missed"), ((0.05, 0.02), "missed")):
        nearly = replace(plain, estimates={"speed_slip.k": estimate})
        assert judge(same, nearly, name(1.5, speed_slip=0.1)) == (verdict, ["speed_slip"])
        assert judge(same, name(1.5, speed_slip=0.1), nearly) == (verdict, [])
    assert (
        judge(same, name(1.5, speed_slip=0.1), replace(plain, detectable={"speed_slip.k": 0.2}))[0]
        == "cannot"
    )
    assert judge(same, name(1.5, speed_slip=0.1), replace(plain, unobservable=("speed_slip",)))[0] == "cannot"


def test_what_an_effect_cancels_is_not_named() -> None:
    skid = Injection("t", lambda tables, _: tables, (), {"lateral_skid.c": lambda c: c + 0.1})
    sliding = Answer({"lateral_skid.c": (-0.1, 0.01)})
    assert judge(skid, sliding, Answer({}, detectable={"lateral_skid.c": 0.03}))[0] == "recovered"
    assert judge(skid, Answer({}), Answer({}, detectable={"lateral_skid.c": 0.03}))[0] == "missed"
    # Of what the unchanged recording did not speak silence recovers nothing.
    unsure = Answer({}, estimates={"lateral_skid.c": (-0.1, 0.01)})
    assert judge(skid, unsure, Answer({}, detectable={"lateral_skid.c": 0.03}))[0] == "missed"


def test_effects_that_are_one_to_first_order_add_up() -> None:
    skid = BY_NAME["skid .1 s"]
    numbers = {"lateral_skid.c": (0.19, 0.02), "heading_skew.d": (0.06, 0.02)}
    plain = Answer({}, estimates={"lateral_skid.c": (0.02, 0.01)})
    assert judge(skid, plain, Answer(numbers))[0] == "recovered"
    assert judge(skid, plain, Answer(numbers, undecided=("lateral_skid",)))[0] == "one of"
    assert judge(skid, plain, Answer({**numbers, "heading_skew.d": (-0.06, 0.02)}))[0] == "number"
    assert judge(skid, plain, Answer({}, estimates=numbers))[0] == "missed"


def test_what_cancels_is_known_as_well_as_before() -> None:
    """A frame's offset has two numbers, of which no least size is told."""
    ahead = BY_NAME["turning about a point .15 m ahead"]
    mounted = Answer({"lever_arm.l_x": (0.147, 0.002), "lever_arm.l_y": (0.02, 0.003)})
    assert judge(ahead, mounted, Answer({"icr_lateral.y_icr": (-0.02, 0.003)}))[0] == "missed"
    assert (
        judge(ahead, replace(mounted, numbers={"lever_arm.l_x": (0.149, 0.002)}), Answer({}))[0]
        == "recovered"
    )


def test_a_gain_holds_the_one_that_is_not_named_beside_it() -> None:
    half_way = BY_NAME["gains .8 and .7 half-way"]
    plain = Answer({}, estimates={"wheel_radius.k": (0.9, 0.01)})
    gains = {"terrain_change.k_v": (0.72, 0.01), "terrain_change.k_w": (0.7, 0.01)}
    assert judge(half_way, plain, Answer(gains))[0] == "recovered"
    assert judge(half_way, plain, Answer({**gains, "wheel_radius.k": (0.9, 0.01)}))[0] == "number"


def test_what_a_change_makes_besides_is_no_extra_name_where_it_is_right() -> None:
    """Wheels that are read slower than they turn are so to their commands, too."""
    encoder = BY_NAME["left encoder x .95"]
    for gain, extra in ((0.055, []), (0.2, ["side_gain"])):
        after = Answer({"wheel_asymmetry.e": (-0.05, 0.01), "side_gain.e": (gain, 0.01)})
        assert judge(encoder, Answer({}), after) == ("recovered", extra)
    after = Answer({"wheel_asymmetry.e": (-0.05, 0.01), "drive_gain.g": (0.975, 0.01)})
    assert judge(encoder, Answer({}), after) == ("recovered", []), "their mean is slower, too"
    commands = BY_NAME["commands x 1.5"]
    assert judge(commands, Answer({}), Answer({"drive_gain.g": (0.66, 0.01)})) == ("recovered", [])
    assert judge(commands, Answer({}), Answer({"drive_gain.g": (0.9, 0.01)})) == ("number", [])


def test_a_special_case_with_the_same_number_is_no_extra_name() -> None:
    wider, sliding = {"effective_track.k": (1.72, 0.02)}, {"contact_friction.k": (1.71, 0.02)}
    plain, noise = Answer({**sliding, "contact_friction.friction": (0.9, 0.2)}), BY_NAME["1 cm of noise"]
    assert judge(noise, plain, Answer(wider)) == ("missed", [])
    assert judge(noise, plain, Answer({"effective_track.k": (1.9, 0.02)}))[1] == ["effective_track"]
    assert judge(noise, plain, Answer({**plain.numbers, **wider}))[1] == ["effective_track"]
    # Ratios multiply, in whichever of the two they are.
    track = BY_NAME["track x 1.2"]
    assert judge(track, plain, Answer({"effective_track.k": (2.05, 0.03)}))[0] == "recovered"
    assert judge(track, plain, Answer({**sliding, "effective_track.k": (1.2, 0.02)}))[0] == "recovered"
    assert judge(track, plain, Answer(wider))[0] == "number"


def test_a_finding_tells_by_what_was_put_in() -> None:
    injection = BY_NAME["commands .2 s early"]
    before = Answer({}, {"command_delay": 0.31})
    told = [judge(injection, before, Answer({}, {"command_delay": one}))[0] for one in (0.5, 0.31, 0.4)]
    assert told == ["reported", "missed", "missed"]
