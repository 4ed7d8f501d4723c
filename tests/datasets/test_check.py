"""A check of simulated runs: what changed is named, limits are judged, a baseline stands for its runs."""

import json
import math
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from motion_runs import simulate, vehicle_of

from pipeline.datasets import ComparisonError
from pipeline.datasets.changes import AFTER, BEFORE
from pipeline.datasets.check import (
    BROKEN,
    KEPT,
    UNDETERMINED,
    Check,
    check_as_json,
    compare,
    keep_baseline,
    read_limits,
)
from pipeline.datasets.check_readings import POSITION_ERROR, widen
from pipeline.datasets.check_sides import Sides, read_baseline, read_under, unite_effects
from pipeline.models.catalogue import find_effect
from pipeline.models.effect import Effect
from pipeline.models.model import Model
from pipeline.models.model_file import ModelFile
from pipeline.run import MotionRun
from pipeline.words.check import format_junit, format_markdown, format_verdict, list_lines

USUAL = {"drive_lag": {"tau": 0.3}, "effective_track": {"k": 1.6}}
LATE = {**USUAL, "drive_lag": {"tau": 0.45}}
RUNS = 3
LAG = "lag of the drive"


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
    return read_under(model, {BEFORE: drive(USUAL, 10), AFTER: drive(LATE, 20)})


@pytest.fixture(scope="module")
def same(model: ModelFile, late: Sides) -> Sides:
    other = read_under(model, {BEFORE: (), AFTER: drive(USUAL, 30)})
    return replace(late, after=other.after)


@pytest.fixture(scope="module")
def windy(model: ModelFile, late: Sides) -> Sides:
    """After: what no number of the model explains."""
    runs = drive({**USUAL, "yaw_drift": {"c": 0.3}}, 40)
    return replace(late, after=read_under(model, {BEFORE: (), AFTER: runs}).after)


def test_the_number_that_changed_is_named_and_the_others_are_not(late: Sides) -> None:
    found = compare(late)

    assert found.list_status("changed") == ["drive_lag.tau"]
    change = found.changes["drive_lag.tau"]
    assert change.before == pytest.approx(0.3, abs=0.02)
    assert change.after == pytest.approx(0.45, abs=0.02)
    assert change.low < 0.15 < change.high
    assert found.code == BROKEN
    verdict = format_verdict(found)
    assert verdict.startswith("Changed: lag of the drive 0.")
    assert "ground unchanged" in verdict
    assert found.moves is not None
    assert found.moves[0] > 0.005


def test_nothing_is_called_a_change_where_nothing_changed(same: Sides) -> None:
    found = compare(same)

    assert found.code == KEPT
    verdict = format_verdict(found)
    assert verdict.startswith("No change shown in 4 quantities.")
    assert "is not detectable with these 6 runs" in verdict
    assert "default spread" not in verdict


def test_a_check_in_which_most_numbers_are_unknown_shows_nothing(same: Sides) -> None:
    found = compare(same)
    parameters = [label.name for label in found.sides.labels]
    hidden = {name: replace(found.changes[name], status="unknown") for name in parameters}
    blind = replace(found, changes={**found.changes, **hidden})
    assert (found.is_compared, blind.is_compared) == (True, False)
    assert blind.code == UNDETERMINED
    assert "most parameters of the model cannot be compared" in format_verdict(blind)


def test_what_could_not_have_been_seen_is_not_called_unchanged(same: Sides) -> None:
    check = compare(same)
    name = "drive_lag.tau"
    assert ("unchanged", LAG) in {(label, text[: len(LAG)]) for label, text in list_lines(check)}
    blind = replace(check.changes[name], smallest=10.0)
    unseen = replace(check, changes={**check.changes, name: blind})
    lines = list_lines(unseen)
    (row,) = (index for index, (_, text) in enumerate(lines) if text.startswith(LAG))
    assert lines[row][0] == "unclear"
    assert lines[row + 3][1].strip() == "too few runs to detect a change of its own size"
    (case,) = (one for one in read_suite(unseen).iter("testcase") if one.get("name") == name)
    assert case.find("skipped") is not None
    assert "| unclear |" in format_markdown(unseen)


def test_a_screen_has_a_row_for_what_changed_and_names_for_the_rest(late: Sides) -> None:
    found = compare(late)
    lines = list_lines(found, everything=False)
    (changed,) = (text for label, text in lines if label == "changed")
    assert changed.startswith(f"{LAG}  0.")
    assert changed.count("[") == 1
    named = " ".join(text for label, text in lines if label in {"unchanged", "unclear"})
    assert "effective track" in named
    assert not any("detectable change 0" in text for _, text in lines)
    assert len(lines) < len(list_lines(found))


def test_an_error_that_could_double_unseen_is_not_called_unchanged(same: Sides) -> None:
    check = compare(same)
    for smallest, outcome in ((0.5, "unchanged"), (3.4, "unclear")):
        one = replace(check.changes[POSITION_ERROR], status="unchanged", smallest=smallest)
        changed = replace(check, changes={**check.changes, POSITION_ERROR: one})
        lines = list_lines(changed)
        (row,) = (index for index, (_, text) in enumerate(lines) if text.startswith("position error over"))
        assert lines[row][0] == outcome
        assert lines[row + 3][1].endswith("too few runs to detect a factor of two") == (outcome == "unclear")


def test_one_run_a_side_says_how_the_two_differ_and_that_runs_may_differ_as_much(late: Sides) -> None:
    found = compare(replace(late, before=late.before[:1], after=late.after[:1]))

    assert found.code == UNDETERMINED
    assert found.list_status("differs") == ["drive_lag.tau"]
    verdict = format_verdict(found)
    assert verdict.startswith(
        "One run a side: differences between runs of this robot without a change are not known."
    )
    assert "These two differ in lag of the drive by +0.1" in verdict
    assert "more runs a side would decide" in verdict
    # The differences are the answer: each with its interval, of these recordings alone.
    lines = list_lines(found, everything=False)
    known = [name for name, change in found.changes.items() if change.status != "unknown"]
    assert sum(label in {"differs", "unclear"} and text.endswith("]") for label, text in lines) == len(known)
    change = found.changes["drive_lag.tau"]
    assert 0.0 < change.within[0] < 0.15 < change.within[1]
    assert change.low < change.within[0]
    row = next(one for one in check_as_json(found, lines)["numbers"] if one["number"] == "drive_lag.tau")  # type: ignore[attr-defined]
    assert [row["low_within_runs"], row["high_within_runs"]] == pytest.approx(change.within)


def test_two_single_runs_that_are_alike_are_not_called_unchanged(same: Sides) -> None:
    found = compare(replace(same, before=same.before[:1], after=same.after[:1]))

    verdict = format_verdict(found)
    assert "No quantity differs by more than the errors of these two recordings." in verdict
    assert "unchanged" not in {label for label, _ in list_lines(found)}


def test_other_runs_of_the_robot_tell_how_much_single_runs_differ(late: Sides) -> None:
    others = {"grass": (*late.before[1:], *late.after[1:])}
    found = compare(replace(late, before=late.before[:1], after=late.after[:1], others=others))

    assert "One run a side" not in format_verdict(found)


def test_an_error_that_no_number_explains_is_a_finding_of_its_own(windy: Sides) -> None:
    found = compare(windy)

    assert set(found.list_status("changed")) & {"error.position", "error.heading"}
    assert "and no effect of the model explains it: run slip diagnose on AFTER" in format_verdict(found)


def read_suite(found: Check) -> ET.Element:
    return ET.fromstring(format_junit(found).encode())  # noqa: S314 - our own


def judge(tmp_path: Path, sides: Sides, text: str) -> Check:
    path = tmp_path / "check.toml"
    path.write_text(text, encoding="utf-8")
    return compare(sides, read_limits(path))


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ('[parameter]\n"drive_lag.tau" = {max = 0.6}', KEPT),
        ('[parameter]\n"drive_lag.tau" = {max = 0.4}', BROKEN),
        ('[parameter]\n"drive_lag.tau" = {min = 0.2, max = 0.6, change = 0.1}', BROKEN),
        ('[parameter]\n"drive_lag.tau" = {change = 2.0}', KEPT),
        ("[error]\nposition = {max = 10.0}", KEPT),
        ("[error]\nposition = {max = 0.0001}", BROKEN),
        ("[slip]\nice = {max = 0.1}", UNDETERMINED),
    ],
)
def test_limits_decide_the_exit_code(late: Sides, tmp_path: Path, text: str, code: int) -> None:
    assert judge(tmp_path, late, text).code == code


def test_a_limit_within_the_interval_cannot_be_told(late: Sides, tmp_path: Path) -> None:
    value = sum(float(one.numbers.values[0]) for one in late.after) / RUNS

    found = judge(tmp_path, late, f'[parameter]\n"drive_lag.tau" = {{max = {value:.6f}}}')

    assert found.code == UNDETERMINED
    assert "cannot be judged from these runs" in format_verdict(found)


def test_a_limit_of_an_unknown_number_names_those_that_there_are(late: Sides, tmp_path: Path) -> None:
    with pytest.raises(ComparisonError, match=r"Did you mean drive_lag\.tau"):
        judge(tmp_path, late, '[parameter]\n"drive_lag.tua" = {max = 1.0}')


def test_a_baseline_stands_for_its_runs(same: Sides, late: Sides, tmp_path: Path) -> None:
    path = tmp_path / "robot.json"
    keep_baseline(compare(same), path)

    kept = read_baseline(path)
    found = compare(replace(late, before=kept.readings))

    turned = tuple(replace(one, numbers=replace(one.numbers, side=BEFORE)) for one in same.after)
    direct = compare(replace(late, before=turned))
    assert kept.names == same.names
    assert found.changes["drive_lag.tau"].p == pytest.approx(direct.changes["drive_lag.tau"].p)
    assert found.code == BROKEN
    # A broken check does not become the new normal by itself.
    text = path.read_text(encoding="utf-8")
    with pytest.raises(ComparisonError) as raised:
        keep_baseline(found, path)
    assert raised.value.code == "baseline_stays"
    assert path.read_text(encoding="utf-8") == text


def test_a_single_run_that_differs_does_not_replace_a_baseline(
    same: Sides, late: Sides, tmp_path: Path
) -> None:
    path = tmp_path / "robot.json"
    one = replace(same, after=same.after[:1])
    keep_baseline(compare(one), path)
    text = path.read_text(encoding="utf-8")
    kept = read_baseline(path)

    found = compare(replace(late, before=kept.readings, after=late.after[:1]))

    assert found.code == UNDETERMINED
    with pytest.raises(ComparisonError, match=r"the runs differ in drive_lag\.tau") as raised:
        keep_baseline(found, path)
    assert raised.value.code == "baseline_stays"
    assert path.read_text(encoding="utf-8") == text


@pytest.mark.parametrize(
    "damage",
    [
        "{",
        "[]",
        "numbers",
        "format",
        "covariance",
        "input",
        "pace",
        "negative",
        "skew",
        "hole",
        "error",
        "slip",
    ],
)
def test_what_is_no_baseline_is_refused(same: Sides, tmp_path: Path, damage: str) -> None:
    path = tmp_path / "robot.json"
    keep_baseline(compare(same), path)
    content = json.loads(path.read_text(encoding="utf-8"))
    if damage == "numbers":
        content["numbers"] = content["numbers"][1:]
    elif damage == "format":
        content["format"] = 99
    elif damage == "covariance":
        content["runs"][0]["covariance"].pop()
    elif damage == "input":
        content["input"] = "thoughts"
    elif damage == "pace":
        content["runs"][0]["pace"] = 0.0
    elif damage == "negative":
        content["runs"][0]["covariance"][0][1] = content["runs"][0]["covariance"][1][0] = 1e6
    elif damage in {"skew", "hole"}:
        content["runs"][0]["covariance"][0][1] = 1e6 if damage == "skew" else None
    elif damage == "error":
        content["runs"][0]["values"][-1] = 1e5
    elif damage == "slip":
        content["runs"][0]["slip"] = [1e5, 0.1]
    path.write_text(damage if damage in {"{", "[]"} else json.dumps(content), encoding="utf-8")

    with pytest.raises(ComparisonError) as raised:
        read_baseline(path)

    assert raised.value.code == "bad_baseline"


def test_every_format_says_the_same_and_markup_in_a_name_stays_text(late: Sides) -> None:
    hostile = "a<b>|`\x1b[31m"
    runs = tuple(replace(one, numbers=replace(one.numbers, run=hostile)) for one in late.after)
    found = compare(replace(late, after=runs))
    lines = list_lines(found)

    content = json.loads(json.dumps(check_as_json(found, lines), allow_nan=False))
    suite = read_suite(found)
    markdown = format_markdown(found)

    rows = {row["number"]: row for row in content["numbers"]}
    assert rows["drive_lag.tau"]["status"] == "changed"
    assert rows[POSITION_ERROR]["unit"] == "m"
    assert rows[POSITION_ERROR]["before"] > 0.0
    assert content["exit_code"] == BROKEN
    assert lines[0] == ("verdict", content["verdict"])
    failed = [case.get("name") for case in suite if case.find("failure") is not None]
    assert failed == ["drive_lag.tau"]
    assert suite.get("failures") == "1"
    assert "| lag of the drive | changed | +0.1" in markdown
    assert "<b>" not in markdown
    assert "\x1b" not in markdown


def test_an_error_towards_a_far_value_is_that_of_the_likelihood_there() -> None:
    # A drive whose force falls with speed, and one of less force at every speed, turn much alike.
    servo = {"tau": 0.15, "reset": 0.35, "drag": 0.07, "bound": 1.29, "no_load": 1.5, "scrub": 1.4}
    run = simulate({"wheel_servo": servo}, seed=3, duration_s=60.0)
    file = ModelFile(Model(vehicle_of("husky_a200"), (make("wheel_servo", **servo),)))
    sides = read_under(file, {BEFORE: [run], AFTER: [run]})
    name, (reading,) = "wheel_servo.no_load", sides.before
    index = [label.name for label in sides.labels].index(name)
    value, error = reading.numbers.values[index], math.sqrt(reading.numbers.covariance[index, index])

    def count_deviations(other: float) -> float:
        wide = widen(reading, sides.labels, {name: other}).numbers.covariance[index, index]
        return float(abs(other - value) / math.sqrt(wide))

    assert count_deviations(value + error) == pytest.approx(1.0, abs=0.3)
    # By the error of small changes it would be thousands.
    assert 3.0 < count_deviations(26.5) < 50.0 < (26.5 - value) / error


def test_models_of_both_sides_are_united() -> None:
    vehicle = vehicle_of("husky_a200")
    one = Model(vehicle, (make("drive_lag", tau=0.2), make("lateral_skid", c=0.1)))
    two = Model(vehicle, (make("drive_lag", tau=0.4), make("terrain_change", k_v=0.9, at_s=30.0)))
    three = Model(vehicle, (make("drive_lag", tau=0.4),))

    found = {effect.id: effect for effect in unite_effects([one], [two, three, three])}

    # What acts from a moment of one recording on says nothing of another.
    assert set(found) == {"drive_lag", "lateral_skid"}
    assert found["drive_lag"].values["tau"] == pytest.approx(0.4)
