"""What a plan asks of a robot: within the limits, back where it began, and what a player reads."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from pipeline.models import Excitation, find_effect, list_effects
from pipeline.plan import (
    LEAD_S,
    RATE_HZ,
    Plan,
    PlanError,
    Studied,
    choose_limits,
    is_steered,
    join,
    list_manoeuvres,
    make_plan,
    parse_area,
    parse_time,
    plan_files,
    wait,
)
from pipeline.plan.plan_files import find_likeness, list_types, read_plan, write_plan
from pipeline.plan.rehearsal import Rehearsal
from pipeline.simulate import find_vehicle
from pipeline.simulate.programs import read_played
from pipeline.sources import Vehicle, find_preset, list_presets

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

PRESETS = [preset for preset in list_presets() if preset.max_speed_mps]
TWIST = ("/cmd_vel", "geometry_msgs/msg/TwistStamped")


def _find(name: str) -> Vehicle:
    vehicle = find_preset(name)
    assert vehicle is not None
    return vehicle


def _plan(time_s: float = 60.0, *, speed_mps: float = 0.8, area: str = "12x8m") -> Plan:
    vehicle = _find("husky_a200")
    limits = choose_limits(vehicle, speed_mps=speed_mps)
    return make_plan(Studied(vehicle), limits, parse_area(area, vehicle), time_s, TWIST)


@pytest.fixture(scope="module")
def plan() -> Plan:
    return _plan()


@pytest.mark.parametrize("vehicle", PRESETS, ids=lambda vehicle: vehicle.id)
def test_no_manoeuvre_asks_for_more_than_the_limits(vehicle: Vehicle) -> None:
    limits = choose_limits(vehicle)
    made = list_manoeuvres(vehicle, limits)
    assert len(made) == (4 if is_steered(vehicle) else 5)
    for commands in made.values():
        speed, turn = commands.speed, commands.turn
        assert np.abs(speed).max() <= limits.speed_mps + 1e-9
        assert (np.abs(turn) <= limits.limit_turn(speed, vehicle) + 1e-9).all()
        assert np.abs(np.diff(speed, prepend=0.0)).max() * RATE_HZ <= limits.acceleration_mps2 * (1 + 1e-6)
        assert np.abs(np.diff(turn, prepend=0.0)).max() * RATE_HZ <= limits.turn_rate * (1 + 1e-6)
        assert speed[-1] == turn[-1] == 0.0


@pytest.mark.parametrize("name", ["husky_a200", "car"])
def test_an_ideal_vehicle_ends_every_manoeuvre_where_it_began(name: str) -> None:
    vehicle = _find(name)
    for commands in list_manoeuvres(vehicle, choose_limits(vehicle)).values():
        rate = commands.turn
        if is_steered(vehicle):
            rate = commands.speed * np.tan(rate) / vehicle.wheelbase_m
        heading = np.cumsum(rate) / RATE_HZ
        middle = heading - 0.5 * rate / RATE_HZ
        way = np.sum(commands.speed * np.exp(1j * middle)) / RATE_HZ
        assert abs(heading[-1]) < 1e-9
        assert abs(way) < 1e-9


def test_a_plan_begins_gently_and_stays_inside_the_area(plan: Plan) -> None:
    assert plan.manoeuvres
    lead = plan.commands.times < LEAD_S
    assert not plan.commands.speed[lead].any()
    assert not plan.commands.turn[lead].any()
    assert plan.commands.duration_s <= 60.0
    assert plan.area.holds(plan.ways)
    assert len(plan.ways) > 20
    assert plan.home_m <= 0.5 * plan.area.width_m


def test_a_small_area_is_driven_slower_and_one_without_room_is_refused(plan: Plan) -> None:
    small = _plan(speed_mps=0.8, area="5x5m")
    assert small.area.holds(small.ways)
    assert np.abs(small.commands.speed).max() < np.abs(plan.commands.speed).max()
    with pytest.raises(PlanError, match="no drive fits"):
        _plan(area="1.8x1.8m")


@pytest.mark.parametrize("hidden", [{"limit": 2.0}, {"limit": 3.27}, {"limit": 5.0}])
def test_a_plan_stays_inside_whatever_limit_of_acceleration_no_log_has_shown(
    plan: Plan, hidden: dict[str, float]
) -> None:
    """Wheels that cannot follow do not retrace the way there; a plan of a slow log once left its area so."""
    rehearsal = Rehearsal(plan.commands, Studied(_find("husky_a200")), np.zeros(1))
    path, _ = rehearsal.trace([find_effect("acceleration_limit")(**hidden)])
    assert np.abs(path.real).max() < 0.5 * plan.area.length_m
    assert np.abs(path.imag).max() < 0.5 * plan.area.width_m


def test_the_same_request_gives_the_same_plan(plan: Plan) -> None:
    again = _plan()
    assert again.manoeuvres == plan.manoeuvres
    assert again.questions == plan.questions


def _read(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Log times and messages by topic, of the official reader."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def _check_stamps(messages: list[tuple[int, Any]], plan: Plan) -> None:
    times = [time for time, _ in messages]
    assert len(times) == plan.commands.speed.size
    assert np.diff(times).tolist() == [round(1e9 / RATE_HZ)] * (len(times) - 1)
    if plan.type_name.endswith("Stamped"):
        stamps = [one.header.stamp.sec * 1_000_000_000 + one.header.stamp.nanosec for _, one in messages]
        assert stamps == times


def _check_limits(speed: Floats, turn: Floats, vehicle: Vehicle, plan: Plan, rounding: float = 1e-9) -> None:
    limits = plan.limits
    assert np.abs(speed).max() <= limits.speed_mps + rounding
    assert (np.abs(turn) <= limits.limit_turn(speed, vehicle) + rounding).all()
    assert np.abs(np.diff(speed, prepend=0.0)).max() <= limits.acceleration_mps2 / RATE_HZ + rounding
    lead = round(LEAD_S * RATE_HZ)
    assert not speed[:lead].any()
    assert not turn[:lead].any()
    assert np.abs(speed).max() > 0.1 * limits.speed_mps


@pytest.mark.parametrize("type_name", list_types(steered=False))
def test_the_official_reader_reads_body_commands_within_the_limits(
    plan: Plan, tmp_path: Path, type_name: str
) -> None:
    toml, csv, mcap = write_plan(replace(plan, type_name=type_name), tmp_path / "plan")
    (messages,) = _read(mcap).values()
    _check_stamps(messages, replace(plan, type_name=type_name))
    twists = [getattr(one, "twist", one) for _, one in messages]
    speed, turn = np.array([t.linear.x for t in twists]), np.array([t.angular.z for t in twists])
    _check_limits(speed, turn, _find("husky_a200"), plan)
    assert np.allclose(speed, np.loadtxt(csv, delimiter=",", skiprows=1)[:, 1], atol=1e-6)
    stored = read_plan(toml)
    assert [one.question for one in stored.promises] == [one.question for one in plan.informative]


@pytest.mark.parametrize("type_name", list_types(steered=True))
def test_the_official_reader_reads_steering_within_the_limits(
    plan: Plan, tmp_path: Path, type_name: str
) -> None:
    car = _find("car")
    limits = choose_limits(car)
    commands = join([wait(LEAD_S), *list_manoeuvres(car, limits).values()])
    driven = replace(plan, steered=True, type_name=type_name, commands=commands, limits=limits)
    (messages,) = _read(write_plan(driven, tmp_path / "plan")[2]).values()
    _check_stamps(messages, driven)
    asked = [getattr(one, "drive", one) for _, one in messages]
    # The fields are float32.
    speed, turn = np.array([one.speed for one in asked]), np.array([one.steering_angle for one in asked])
    assert np.allclose(speed, commands.speed, atol=1e-6)
    _check_limits(speed, turn, car, driven, rounding=1e-6)


def test_the_simulator_plays_the_commands_and_another_type_is_refused(plan: Plan, tmp_path: Path) -> None:
    played = read_played(write_plan(plan, tmp_path / "plan")[2], find_vehicle("husky"))
    assert np.allclose(played.speed_mps, plan.commands.speed, atol=1e-9)
    assert np.allclose(played.time_s, plan.commands.times, atol=1e-9)
    with pytest.raises(PlanError, match="cannot be written as"):
        write_plan(replace(plan, type_name="std_msgs/msg/Float64"), tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_a_slope_cannot_be_promised_on_level_ground(plan: Plan) -> None:
    slopes = {one.id for one in list_effects() if Excitation.SLOPE in one.needs}
    assert not slopes & {name for one in plan.informative for name in one.effects}
    told = [row for row in plan.list_rows() if row[1] == "not by this drive"]
    assert any("drive on a slope" in needs for _, _, needs in told)


def test_the_first_line_says_what_the_plan_decides(plan: Plan) -> None:
    first = f"decides {len(plan.decided)} of {len(plan.questions)} open questions in "
    assert plan.decided
    assert plan.summarize().startswith(first)
    assert all(LEAD_S < one.decided_after_s <= plan.commands.duration_s for one in plan.decided)


def test_more_time_decides_more_and_stays_inside(plan: Plan) -> None:
    assert len(_plan(20.0).decided) < len(plan.decided)
    long = _plan(180.0)
    assert long.commands.duration_s <= 180.0
    assert long.area.holds(long.ways)


def test_a_short_drive_says_what_more_time_or_room_would_decide(plan: Plan) -> None:
    short = _plan(20.0)
    told = re.search(r"--time (\d+)min would decide (\d+) more", short.summarize())
    assert told is not None
    assert int(told[2]) == sum(one.longer_s < np.inf for one in short.questions if not one.informs)
    assert len(_plan(60.0 * float(told[1])).decided) > len(short.decided)
    more = len(plan.decided) + 1
    assert f"--area 40x30m would decide {more}" in replace(plan, roomier=(more, 40.0, 30.0)).summarize()
    assert "--area" not in replace(plan, roomier=None).summarize()


@pytest.mark.parametrize(("text", "seconds"), [("60s", 60.0), ("2min", 120.0), ("45", 45.0)])
def test_times_are_read(text: str, seconds: float) -> None:
    assert parse_time(text) == seconds


def test_an_interrupted_plan_leaves_the_earlier_one_whole(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_plan(plan, tmp_path, "the page")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    shorter = replace(plan, commands=wait(5.0), runs=("another",))

    def interrupt(_path: Path, _data: bytes) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(plan_files, "replace_file", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_plan(shorter, tmp_path, "another page")

    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def draw_steps(seed: int, seconds: float) -> np.ndarray:
    """Random steps of three seconds: forward speed and yaw rate at 10 Hz, shape (n, 2)."""
    steps = np.random.default_rng(seed).uniform(-1.0, 1.0, (int(seconds / 3.0), 2))
    return np.repeat(steps, 30, axis=0)


@pytest.mark.parametrize("seed", range(5))
def test_a_plan_is_found_wherever_it_was_played(seed: int) -> None:
    asked, other = draw_steps(seed, 45.0), draw_steps(seed + 100, 600.0)
    noise = np.random.default_rng(seed).normal(0.0, 0.05, (len(asked), 2))
    assert find_likeness(asked, np.concatenate((other, asked + noise, np.zeros((50, 2))))) > 0.95
    assert find_likeness(asked, asked) == pytest.approx(1.0)
    # Stopped half-way, and then nothing.
    assert find_likeness(asked, np.concatenate((asked[: len(asked) // 2], np.zeros((300, 2))))) > 0.6
    assert find_likeness(asked, other) < 0.6
    assert find_likeness(asked, np.zeros((400, 2))) < 0.1
