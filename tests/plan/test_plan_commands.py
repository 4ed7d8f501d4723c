"""What a plan asks of a robot: within the limits, back where it began, and what a player reads."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from pipeline.models import find_effect
from pipeline.plan import (
    PlanError,
    Request,
    ask_presence,
    assume,
    choose_limits,
    make_plan,
    parse_area,
    write_plan,
)
from pipeline.plan.files import list_types, read_promises
from pipeline.plan.limits import is_steered, parse_time
from pipeline.plan.manoeuvres import LEAD_S, RATE_HZ, limit_yaw_rate, list_manoeuvres
from pipeline.plan.plan import Plan, find_largest
from pipeline.plan.rehearsal import Rehearsal
from pipeline.vehicles import Vehicle, find_preset, list_presets

if TYPE_CHECKING:
    from pathlib import Path

PRESETS = [preset for preset in list_presets() if preset.max_speed_mps]
TURNING = ("effective_track", "wheel_asymmetry")


def _find(name: str) -> Vehicle:
    vehicle = find_preset(name)
    assert vehicle is not None
    return vehicle


@pytest.fixture(scope="module")
def plan() -> Plan:
    vehicle = _find("husky_a200")
    knowledge, limits = assume(vehicle), choose_limits(vehicle, speed_mps=0.8)
    questions = ask_presence(knowledge, TURNING, find_largest(knowledge, limits, 60.0))
    request = Request(limits, parse_area("12x8m", vehicle), 60.0, type_name="geometry_msgs/msg/TwistStamped")
    return make_plan(knowledge, questions, request)


@pytest.mark.parametrize("vehicle", PRESETS, ids=lambda vehicle: vehicle.id)
def test_no_manoeuvre_asks_for_more_than_the_limits(vehicle: Vehicle) -> None:
    limits = choose_limits(vehicle)
    for manoeuvre in list_manoeuvres(vehicle, limits):
        speed, turn = manoeuvre.commands.speed, manoeuvre.commands.turn
        assert np.abs(speed).max() <= limits.speed_mps + 1e-9
        assert (np.abs(turn) <= limit_yaw_rate(speed, vehicle, limits) + 1e-9).all()
        assert np.abs(np.diff(speed, prepend=0.0)).max() * RATE_HZ <= limits.acceleration_mps2 * (1 + 1e-6)
        assert np.abs(np.diff(turn, prepend=0.0)).max() * RATE_HZ <= 1.5 * limits.turn_rate
        assert speed[-1] == turn[-1] == 0.0


@pytest.mark.parametrize("name", ["husky_a200", "car"])
def test_an_ideal_vehicle_ends_every_manoeuvre_where_it_began(name: str) -> None:
    vehicle = _find(name)
    for manoeuvre in list_manoeuvres(vehicle, choose_limits(vehicle)):
        rate = manoeuvre.commands.turn
        if is_steered(vehicle):
            rate = manoeuvre.commands.speed * np.tan(rate) / vehicle.wheelbase_m
        heading = np.cumsum(rate) / RATE_HZ
        middle = heading - 0.5 * rate / RATE_HZ
        way = np.sum(manoeuvre.commands.speed * np.exp(1j * middle)) / RATE_HZ
        assert abs(heading[-1]) < 1e-9
        assert abs(way) < 1e-9


def test_a_plan_begins_gently_and_stays_inside_the_area(plan: Plan) -> None:
    assert plan.manoeuvres
    lead = plan.commands.times < LEAD_S
    assert not plan.commands.speed[lead].any()
    assert not plan.commands.turn[lead].any()
    assert plan.commands.duration_s <= 60.0
    assert plan.area.holds(plan.ways)
    assert len(plan.ways) > len(TURNING)
    assert plan.home_m <= 0.5 * plan.area.width_m


@pytest.mark.parametrize("hidden", [{"limit": 2.0}, {"limit": 3.27}, {"limit": 5.0}])
def test_a_plan_stays_inside_whatever_limit_of_acceleration_no_log_has_shown(
    plan: Plan, hidden: dict[str, float]
) -> None:
    """Wheels that cannot follow do not retrace the way there; a plan of a slow log once left its area so."""
    knowledge = assume(_find("husky_a200"))
    rehearsal = Rehearsal(plan.commands, knowledge.vehicle, knowledge.senses, np.zeros(1))
    path, _ = rehearsal.trace([find_effect("acceleration_limit")(**hidden)])
    assert np.abs(path.real).max() < 0.5 * plan.area.length_m
    assert np.abs(path.imag).max() < 0.5 * plan.area.width_m


def test_the_same_request_gives_the_same_plan(plan: Plan) -> None:
    vehicle = _find("husky_a200")
    knowledge = assume(vehicle)
    questions = ask_presence(knowledge, TURNING, find_largest(knowledge, plan.limits, 60.0))
    again = make_plan(knowledge, questions, Request(plan.limits, plan.area, 60.0, type_name=plan.type_name))
    assert again.manoeuvres == plan.manoeuvres
    assert again.promises == plan.promises


def test_the_official_reader_reads_the_commands_with_right_stamps(plan: Plan, tmp_path: Path) -> None:
    toml, csv, mcap = write_plan(plan, tmp_path / "plan")
    with mcap.open("rb") as file:
        messages = [
            (message.log_time, decoded)
            for _, _, message, decoded in make_reader(
                file, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages()
        ]
    assert len(messages) == plan.commands.speed.size
    times = np.array([time for time, _ in messages])
    assert np.diff(times).tolist() == [round(1e9 / RATE_HZ)] * (len(messages) - 1)
    stamps = [one.header.stamp.sec * 1_000_000_000 + one.header.stamp.nanosec for _, one in messages]
    assert stamps == times.tolist()
    speed = np.array([one.twist.linear.x for _, one in messages])
    assert np.abs(speed).max() <= 0.8
    assert np.abs(np.diff(speed)).max() * RATE_HZ <= plan.limits.acceleration_mps2 * (1 + 1e-6)
    assert np.abs([one.twist.angular.z for _, one in messages]).max() <= plan.limits.turn
    assert np.allclose(speed, np.loadtxt(csv, delimiter=",", skiprows=1)[:, 1], atol=1e-6)
    promised = read_promises(toml)
    assert [one.question for one in promised.promises] == [one.question for one in plan.promises]


def test_a_plan_is_written_only_in_a_type_that_carries_its_commands(plan: Plan, tmp_path: Path) -> None:
    with pytest.raises(PlanError, match="cannot be written as"):
        write_plan(replace(plan, type_name=list_types(steered=True)[0]), tmp_path / "plan")
    assert not (tmp_path / "plan").exists()


def test_a_slope_cannot_be_promised_on_level_ground() -> None:
    vehicle = _find("husky_a200")
    knowledge, limits = assume(vehicle), choose_limits(vehicle)
    questions = ask_presence(knowledge, ["slope_drift"], find_largest(knowledge, limits, 60.0))
    plan = make_plan(knowledge, questions, Request(limits, parse_area("20x10m", vehicle), 60.0))
    assert not plan.manoeuvres
    assert not plan.promises
    assert "slope" in plan.impossible[0].because


def test_an_area_that_holds_no_manoeuvre_is_refused() -> None:
    vehicle = _find("husky_a200")
    knowledge, limits = assume(vehicle), choose_limits(vehicle)
    questions = ask_presence(knowledge, TURNING, find_largest(knowledge, limits, 60.0))
    with pytest.raises(PlanError, match="no manoeuvre fits"):
        make_plan(knowledge, questions, Request(limits, parse_area("1.7x1.6m", vehicle), 5.0))


@pytest.mark.parametrize("text", ["20", "0x5m", "1x1m", "ax3", "20x10km"])
def test_a_wrong_area_is_one_clear_error(text: str) -> None:
    with pytest.raises(PlanError, match="--area"):
        parse_area(text, _find("husky_a200"))


@pytest.mark.parametrize(("text", "seconds"), [("60s", 60.0), ("2min", 120.0), ("45", 45.0)])
def test_times_are_read(text: str, seconds: float) -> None:
    assert parse_time(text) == seconds


@pytest.mark.parametrize("text", ["soon", "3s", "2h"])
def test_a_wrong_time_is_one_clear_error(text: str) -> None:
    with pytest.raises(PlanError, match="--time"):
        parse_time(text)


def test_a_vehicle_without_limits_asks_for_them() -> None:
    vehicle = msgspec.structs.replace(_find("husky_a200"), max_speed_mps=None)
    with pytest.raises(PlanError, match="--max-speed"):
        choose_limits(vehicle)
    assert choose_limits(vehicle, speed_mps=0.5).speed_mps == 0.5


def test_limits_asked_for_never_raise_those_of_the_vehicle() -> None:
    limits = choose_limits(_find("husky_a200"), speed_mps=50.0, yaw_rate_radps=50.0)
    assert (limits.speed_mps, limits.turn) == (1.0, 1.0)
    assert math.isinf(limits.yaw_rate_radps)
