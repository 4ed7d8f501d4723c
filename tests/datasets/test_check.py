"""A check of simulated runs: what changed is named, and limits are judged."""

import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import polars as pl
import pytest
from motion_runs import simulate, vehicle_of

import slip
from pipeline.core import objects_in
from pipeline.datasets import ComparisonError
from pipeline.datasets.check import (
    BROKEN,
    KEPT,
    UNDETERMINED,
    CheckedNumber,
    RunsCheck,
    compare_sides,
    read_limits,
)
from pipeline.datasets.check_readings import COMMANDED_TURN, MULTIPLIER, POSITION_ERROR, RunReading
from pipeline.datasets.check_sides import Sides, read_under, unite_effects
from pipeline.models.catalogue import find_effect
from pipeline.models.effect import Effect
from pipeline.models.model import Model
from pipeline.models.model_file import ModelFile
from pipeline.run import MotionRun
from pipeline.words.check import check_as_json, format_check, format_junit, format_markdown, list_check_lines

USUAL = {"drive_lag": {"tau": 0.3}, "effective_track": {"k": 1.6}}
LATE = {**USUAL, "drive_lag": {"tau": 0.45}}
RUNS = 3
LAG = "drive_lag.tau"


def drive(effects: dict[str, dict[str, float]], first: int) -> list[MotionRun]:
    return [
        replace(simulate(effects, seed=first + number, duration_s=60.0), terrain="grass")
        for number in range(RUNS)
    ]


def make(name: str, **values: float) -> Effect:
    return find_effect(name)().change(**values)


@pytest.fixture(scope="module")
def model() -> ModelFile:
    effects = (make("drive_lag", tau=0.3), make("effective_track", k=1.6))
    return ModelFile(Model(vehicle_of("husky_a200"), effects))


@pytest.fixture(scope="module")
def late(model: ModelFile) -> Sides:
    return read_under(model, (drive(USUAL, 10), drive(LATE, 20)))


@pytest.fixture(scope="module")
def same(model: ModelFile, late: Sides) -> Sides:
    return replace(late, after=read_under(model, ((), drive(USUAL, 30))).after)


def find(check: RunsCheck, name: str) -> CheckedNumber:
    return next(one for one in check.numbers if one.name == name)


def test_the_number_that_changed_is_named_and_the_others_are_not(late: Sides) -> None:
    found = compare_sides(late)

    assert [one.name for one in found.list_status("changed")] == [LAG]
    lag = find(found, LAG)
    assert (lag.before, lag.after) == pytest.approx((0.3, 0.45), abs=0.02)
    assert lag.low < 0.15 < lag.high
    assert lag.freedom == 4
    assert found.code == BROKEN
    assert format_check(found).startswith("Changed: lag of the drive 0.")


def test_nothing_is_called_a_change_where_nothing_changed(same: Sides) -> None:
    found = compare_sides(same)

    assert found.code == KEPT
    assert format_check(found).startswith("No change shown in 4 numbers.")
    lag = find(found, LAG)
    assert 0.0 < lag.smallest < 0.1
    assert lag.low < 0.0 < lag.high


def test_a_check_in_which_most_numbers_are_unknown_shows_nothing(same: Sides) -> None:
    names = {label.name for label in same.labels}

    def hide(reading: RunReading) -> RunReading:
        return replace(reading, estimates={k: v for k, v in reading.estimates.items() if k not in names})

    blind = compare_sides(replace(same, after=tuple(map(hide, same.after))))
    assert blind.code == UNDETERMINED
    assert "most parameters of the model cannot be compared" in format_check(blind)


def test_single_runs_that_differ_cannot_tell_and_other_runs_of_the_robot_can(
    late: Sides, same: Sides
) -> None:
    one = replace(late, before=late.before[:1], after=late.after[:1])
    found = compare_sides(one)

    assert found.code == UNDETERMINED
    assert [number.name for number in found.list_status("differs")] == [LAG]
    assert format_check(found).startswith(
        "Cannot tell: one run a side. These recordings differ in lag of the"
    )
    assert "how much runs of this robot differ without a change is not known" in format_check(found)
    assert 0.0 < find(found, LAG).low < 0.15 < find(found, LAG).high
    notes = [text for label, text in list_check_lines(found) if not label]
    assert any("fitted to each run; the diagnosis of a run chooses its own effects" in one for one in notes)
    assert any(one.endswith("; intervals: of these recordings alone") for one in notes)

    others = {"grass": late.before[1:], "sand": late.after[1:], "tile": same.after}
    told = compare_sides(replace(one, others=others))
    assert [number.name for number in told.list_status("changed")] == [LAG]
    assert told.code == BROKEN
    assert compare_sides(one, simulated=True).code == BROKEN, "runs of a simulation do not differ"


def test_one_run_a_side_cannot_tell_on_any_face_and_shows_the_table(same: Sides, late: Sides) -> None:
    for after in (same.after, late.after):
        found = compare_sides(replace(same, before=same.before[:1], after=after[:1]))
        content = check_as_json(found)
        screen = dict(list_check_lines(found))["verdict"]
        faces = (str(content["verdict"]), format_markdown(found), format_junit(found), screen)
        for said in ("Cannot tell: one run a side.", "ow much runs of this robot differ without a change"):
            assert all(said in face for face in faces)
        assert (found.code, content["kept"]) == (UNDETERMINED, None)
        titles = {number.title for number in found.numbers}
        assert all(any(title in text for _, text in list_check_lines(found)) for title in titles)
        # A probability of a change needs to know how much runs differ.
        assert not any("p <" in face or "p =" in face for face in faces)
        rows = {str(row["number"]): row for row in objects_in(content, "numbers")}
        assert {row["p"] for row in rows.values() if row["spread"] is None} == {None}
        assert {row["p_adjusted"] for row in rows.values() if row["spread"] is None} == {None}
        assert rows[LAG]["spread"] is None
        unknown = slip.Check(found).numbers.filter(pl.col("spread").is_null())
        assert unknown.height == unknown["p"].null_count() >= len(found.sides.labels)


def test_what_its_interval_or_its_width_leaves_open_is_not_called_unchanged(same: Sides) -> None:
    blank = CheckedNumber(
        COMMANDED_TURN,
        "share of asked yaw rate",
        "1",
        is_ratio=True,
        before=0.23,
        after=0.35,
        spread=0.1,
        freedom=4.0,
        chance=0.016,
        chance_adjusted=0.137,
        size=0.25,
    )
    for low, high, smallest, status in (
        (0.08, 1.04, 0.2, "not shown"),
        (-0.1, 0.2, 0.6, "not shown"),
        (-0.1, 0.2, 0.2, "unchanged"),
    ):
        number = replace(blank, difference=0.5 * (low + high), low=low, high=high, smallest=smallest)
        assert number.status == status
        found = RunsCheck(same, (number,))
        (row,) = (line for line in list_check_lines(found) if line[0] == status)
        assert re.search(r"\] +0\.1$", row[1]), "the p over all numbers stands beside the word"
    single = replace(blank, difference=0.5, low=0.08, high=1.04, smallest=0.2)
    assert "Not shown beyond chance, but near: share of asked yaw rate 0.23 -> 0.35" in format_check(
        RunsCheck(same, (single,))
    )


def test_other_terrains_and_other_driving_are_said_first(late: Sides) -> None:
    ice = tuple(replace(one, terrain="ice", pace=2.0 * one.pace) for one in late.after)
    sentences = format_check(compare_sides(replace(late, after=ice))).split(". ")
    assert sentences[0].startswith("The terrains differ, grass before and ice after")
    assert sentences[1].startswith("The driving differed, ")
    assert any(one.startswith("Changed: lag of the drive") for one in sentences)
    assert "differ" not in format_check(compare_sides(late))


def test_what_is_unknown_says_on_which_side_and_why(late: Sides) -> None:
    def hide(reading: RunReading, *names: str) -> RunReading:
        return replace(reading, estimates={k: v for k, v in reading.estimates.items() if k not in names})

    blind = replace(
        late,
        before=tuple(hide(one, POSITION_ERROR) for one in late.before),
        after=tuple(hide(one, POSITION_ERROR, LAG) for one in late.after),
    )
    rows = " ".join(text for label, text in list_check_lines(compare_sides(blind)) if label == "unknown")
    assert "unknown before and after: fewer than 3 stretches of 10 s" in rows
    assert "unknown after: the runs do not determine it" in rows
    of_model = replace(blind, is_model=True, before=blind.before[:1])
    rows = " ".join(text for label, text in list_check_lines(compare_sides(of_model)) if label == "unknown")
    assert "unknown before: a model file holds no drive" in rows


def test_one_run_a_side_says_how_many_more_would_tell_and_on_which_ground(late: Sides) -> None:
    one = replace(late, before=late.before[:1], after=late.after[:1])
    said = format_check(compare_sides(one))
    assert "2 more runs BEFORE or AFTER on grass tell" in said
    assert "or 3 other runs on one terrain (the results have none)" in said
    other = replace(one, others={"grass": late.before[1:2]})
    assert "(the results have 1 on grass)" in format_check(compare_sides(other))
    assert compare_sides(other).code == UNDETERMINED
    # As many more as it says do tell.
    more = replace(one, before=late.before[:3])
    assert compare_sides(more).is_spread_known


def test_a_screen_has_one_probability_a_row_and_only_of_what_changed(late: Sides) -> None:
    found = compare_sides(late)
    (changed,) = found.list_status("changed")
    screen = " ".join(text for _, text in list_check_lines(found))
    assert re.findall(r"(\S+ \S+) \(p [<=]", screen) == [f"{changed.after:.2g} {changed.unit}"]
    assert len(re.findall(r"\bp (?:&lt;|=)", format_markdown(found))) == 1


def make_readings(rng: np.random.Generator, shift: float = 0.0) -> tuple[RunReading, ...]:
    """Three runs whose numbers scatter by .1, and are known to .05."""
    names = (LAG, "effective_track.k", POSITION_ERROR)
    return tuple(
        RunReading(
            "r", "grass", 1.0, {name: (1.0 + shift + float(rng.normal(0.0, 0.11)), 0.05) for name in names}
        )
        for _ in range(3)
    )


def test_checks_alarm_once_in_fifty_and_find_what_they_foresee(late: Sides) -> None:
    rng, checks = np.random.default_rng(4), 200
    alarms, smallest = 0, []
    for _ in range(checks):
        found = compare_sides(replace(late, before=make_readings(rng), after=make_readings(rng)))
        alarms += found.code == BROKEN
        smallest.append(find(found, LAG).smallest)
    assert alarms / checks <= 0.02 + 2.6 * (0.02 * 0.98 / checks) ** 0.5
    shift, seen = float(np.median(smallest)), 0
    for _ in range(100):
        found = compare_sides(replace(late, before=make_readings(rng), after=make_readings(rng, shift)))
        seen += find(found, LAG).status == "changed"
    assert seen >= 60


def test_a_multiplier_is_a_setting_known_to_two_percent_however_many_runs(late: Sides) -> None:
    def turn(by: float, runs: int) -> tuple[RunReading, ...]:
        estimates = {**late.before[0].estimates, MULTIPLIER: (by, 0.02)}
        return (replace(late.before[0], estimates=estimates),) * runs

    for runs in (1, 16):
        for by, status in ((0.02, "unchanged"), (0.2, "changed")):
            check = compare_sides(replace(late, before=turn(0.0, runs), after=turn(by, runs)))
            assert find(check, MULTIPLIER).status == status


def read_suite(found: RunsCheck) -> ET.Element:
    return ET.fromstring(format_junit(found).encode())  # noqa: S314 - our own


def judge(tmp_path: Path, sides: Sides, text: str) -> RunsCheck:
    path = tmp_path / "check.toml"
    path.write_text(text, encoding="utf-8")
    return compare_sides(sides, read_limits(path))


def test_limits_decide_the_exit_code(late: Sides, tmp_path: Path) -> None:
    for text, code in [
        ('[parameter]\n"drive_lag.tau" = {max = 0.6}', KEPT),
        ('[parameter]\n"drive_lag.tau" = {max = 0.4}', BROKEN),
        ('[parameter]\n"drive_lag.tau" = {min = 0.2, max = 0.6, change = 0.1}', BROKEN),
        ('[parameter]\n"drive_lag.tau" = {change = 2.0}', KEPT),
        ("[error]\nposition = {max = 10.0}", KEPT),
        ("[error]\nposition = {max = 0.0001}", BROKEN),
        ("[slip]\nice = {max = 0.1}", UNDETERMINED),
    ]:
        assert judge(tmp_path, late, text).code == code


def test_a_limit_within_the_interval_cannot_be_told(late: Sides, tmp_path: Path) -> None:
    value = find(compare_sides(late), LAG).after

    found = judge(tmp_path, late, f'[parameter]\n"drive_lag.tau" = {{max = {value:.6f}}}')

    assert found.code == UNDETERMINED
    assert "0 of 1 limits kept, 1 cannot be judged" in format_check(found)


def test_a_limit_of_an_unknown_number_names_those_that_there_are(late: Sides, tmp_path: Path) -> None:
    with pytest.raises(ComparisonError, match=r"Did you mean drive_lag\.tau"):
        judge(tmp_path, late, '[parameter]\n"drive_lag.tua" = {max = 1.0}')


def test_the_slip_of_a_terrain_has_limits_of_its_own(late: Sides, tmp_path: Path) -> None:
    slip = [replace(one, slip=(np.log(0.2), 0.05)) for one in late.after]
    sides = replace(late, after=tuple(slip))
    text = "[slip]\ngrass = {max = 0.5}\nicee = {max = 0.1}"
    grass, ice = judge(tmp_path, sides, text).limits
    assert (grass.outcome, grass.limit) == ("kept", "at most 0.5 m/s")
    assert grass.measured.startswith("0.2 [0.1")
    assert ice.outcome == "undetermined"
    assert "no run is on icee" in ice.measured


def test_every_format_says_the_same_and_markup_in_a_name_stays_text(late: Sides) -> None:
    hostile = "a<b>|`\x1b[31m"
    found = compare_sides(replace(late, after=tuple(replace(one, run=hostile) for one in late.after)))
    content = json.loads(json.dumps(check_as_json(found), allow_nan=False))
    suite, markdown = read_suite(found), format_markdown(found)

    rows = {row["number"]: row for row in content["numbers"]}
    assert rows[LAG]["status"] == "changed"
    assert rows[POSITION_ERROR]["unit"] == "m"
    assert content["exit_code"] == BROKEN
    assert content["kept"] is False
    (change,) = content["changes"]
    assert (change["effect"], change["parameter"]) == ("drive_lag", "tau")
    assert content["verdict"] == f"Changed: {change['sentence']}"
    error = content["error"]
    assert error["low"] < error["ratio"] < error["high"]
    assert error["after"] / error["before"] == pytest.approx(error["ratio"])
    assert list_check_lines(found)[0] == ("verdict", content["verdict"])
    failed = [case.get("name") for case in suite if case.find("failure") is not None]
    assert failed == [LAG]
    assert suite.get("failures") == "1"
    assert "| lag of the drive | changed | 0." in markdown
    assert "<b>" not in markdown
    assert "\x1b" not in markdown


def test_models_of_both_sides_are_united() -> None:
    vehicle = vehicle_of("husky_a200")
    one = Model(vehicle, (make("drive_lag", tau=0.2), make("lateral_skid", c=0.1)))
    two = Model(vehicle, (make("drive_lag", tau=0.4), make("terrain_change", k_v=0.9, at_s=30.0)))
    three = Model(vehicle, (make("drive_lag", tau=0.4),))

    found = {effect.id: effect for effect in unite_effects([one], [two, three, three])}

    # What acts from a moment of one recording on says nothing of another.
    assert set(found) == {"drive_lag", "lateral_skid"}
    assert found["drive_lag"].values["tau"] == pytest.approx(0.4)
