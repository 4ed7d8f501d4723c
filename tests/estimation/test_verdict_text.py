"""The verdict on a run: at most three sentences for people, of which every number is a stored one."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from pipeline.estimation.diagnosis import Value
from pipeline.estimation.error_regions import ABOVE_FLOOR, format_excess, format_remaining_error
from pipeline.estimation.estimates import restore_known
from pipeline.estimation.verdict import (
    NOTHING_MISSING,
    format_verdict,
    is_small,
    rank_effects,
    rank_main,
    split_main,
)
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.job.run_results import load_vehicle
from pipeline.models import find_effect, list_effects
from pipeline.sources import Vehicle, list_presets
from pipeline.stages.checks import FAULTS

_LOGS = Path(__file__).parents[2] / ".." / "shared" / "logs"
_PRESETS = {vehicle.id: vehicle for vehicle in list_presets()}
_WARTHOG = _PRESETS["warthog"]
_FLOOR = {"t_mrmse_m": 0.05, "r_mrmse_rad": 0.02}
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")

Diagnosis = dict[str, Any]


def draw_diagnosis(
    effects: Mapping[str, Mapping[str, float]],
    errors: Sequence[tuple[float, float]],
    vehicle: Vehicle = _WARTHOG,
    **more: object,
) -> Diagnosis:
    """A stored diagnosis with a rung an effect."""
    ids = list(effects)
    return {
        "effects": [
            {
                "id": name,
                "parameters": {key: {"value": value} for key, value in values.items()},
                "clause": find_effect(name)().change(**values).describe_clause(vehicle),
            }
            for name, values in effects.items()
        ],
        "ladder": [
            {"effects": ids[:number], "t_mrmse_m": t, "r_mrmse_rad": r}
            for number, (t, r) in enumerate(errors)
        ],
        "noise_floor": _FLOOR,
        "findings": [],
        "undecided": [],
        **more,
    }


def list_stored_numbers(diagnosis: Diagnosis, vehicle: Vehicle) -> set[str]:
    """Every number that a verdict may hold, as people read it, from what is stored."""
    known = {"2"}
    ladder, floor = diagnosis["ladder"], diagnosis["noise_floor"]
    for rung in (ladder[0], ladder[-1]):
        metres, degrees = rung["t_mrmse_m"], math.degrees(rung["r_mrmse_rad"])
        known.add(f"{metres:.3g}" if metres >= 0.995 else f"{100.0 * metres:.2g}")
        known.add(f"{degrees:.0f}" if degrees >= 9.95 else f"{degrees:.2g}")
    known |= {
        format_excess(ladder[-1][key] / floor[key]).removesuffix(" times") for key in _FLOOR if floor[key]
    }
    known.add(str(len(ladder[-1]["effects"])))
    effects = [
        restore_known(entry["id"], {key: read_value(one) for key, one in entry["parameters"].items()})
        for entry in diagnosis["effects"]
    ]
    for entry, told in zip(diagnosis["effects"], effects, strict=True):
        clause = told.describe_clause(vehicle, effects)
        assert entry["clause"].startswith(clause)
        known |= set(_NUMBER.findall(clause))
    return known


def read_value(stored: Diagnosis) -> Value:
    """A stored value; one without an interval in the JSON is drawn, and exact."""
    ends = (stored.get(end, stored["value"]) for end in ("low", "high"))
    low, high = (math.nan if end is None else end for end in ends)
    return Value(stored["value"], low, high, "1", at_bound=stored.get("undetermined", False))


def check_verdict(diagnosis: Diagnosis, vehicle: Vehicle = _WARTHOG) -> str:
    """What holds of every verdict on a run that was fitted; returns it."""
    verdict = format_verdict(json.loads(json.dumps(diagnosis)))
    check_form(verdict)
    assert set(_NUMBER.findall(verdict)) <= list_stored_numbers(diagnosis, vehicle)
    return verdict


def check_form(verdict: str) -> None:
    """One to three sentences of 400 characters at most, without names of the program."""
    assert 0 < len(verdict) <= 400
    assert 1 <= len(re.findall(r"\.(?:\s|$)", verdict)) <= 3
    assert verdict[0].isupper()
    assert verdict.endswith(".")
    # Angles are in degrees; rates in rad/s, as in commands.
    assert not re.search(r"\w_\w|\b(?:nan|inf|None|rad(?!/s))\b", verdict)


def test_the_verdict_says_how_far_off_why_and_what_remains() -> None:
    effects = {"effective_track": {"k": 1.79}, "turn_lag": {"tau_mean": 0.4, "tau_diff": 1.08}}
    drawn = draw_diagnosis(effects, [(1.06, 0.96), (0.44, 0.14), (0.1, 0.04)])
    assert check_verdict(drawn) == (
        "Over 2 s the ideal model is 1.06 m and 55 degrees off. The robot turns at 56 % of the ideal rate "
        "and follows turns with a time constant of 1.1 s; with both in the model 10 cm and 2.3 degrees "
        "remain, 2 times the noise floor. No known effect explains the rest."
    )


def test_what_is_too_small_to_be_named_is_not_unexplained() -> None:
    small = {"id": "lateral_skid", "parameters": {"c": {"value": 0.04, "undetermined": False}}}
    unknown = {"id": "acceleration_limit", "parameters": {"limit": {"value": 143.0, "undetermined": True}}}
    drawn = draw_diagnosis({"drive_lag": {"tau": 0.3}}, [(1.0, 0.5), (0.3, 0.2)], immaterial=[small, unknown])
    assert check_verdict(drawn).endswith(
        "Apart from lateral skid below the detection threshold, no known effect explains the rest."
    )
    alone = draw_diagnosis({}, [(0.4, 0.2)], immaterial=[small])
    assert check_verdict(alone).endswith(
        "Apart from lateral skid below the detection threshold, no known effect explains the error."
    )
    assert check_verdict({**alone, "immaterial": [unknown]}).endswith("No known effect explains the error.")


def test_what_removes_less_than_a_tenth_is_counted_and_not_told() -> None:
    effects = {"effective_track": {"k": 1.5}, "drive_lag": {"tau": 0.3}, "wheel_asymmetry": {"e": 0.02}}
    drawn = draw_diagnosis(effects, [(1.0, 0.5), (0.5, 0.05), (0.1, 0.04), (0.05, 0.02)])
    assert list(rank_main(drawn["ladder"])) == ["effective_track", "drive_lag"]
    verdict = check_verdict(drawn)
    assert "with all effects in the model 5 cm and 1.1 degrees remain, at the noise floor." in verdict
    assert "larger" not in verdict


def test_what_removes_little_is_listed_where_a_later_effect_removes_more() -> None:
    """Errors chain from line to line: an effect may remove most beside one that removes little alone."""
    effects = {"drive_lag": {"tau": 0.3}, "wheel_asymmetry": {"e": 0.02}, "effective_track": {"k": 1.5}}
    drawn = draw_diagnosis(effects, [(1.0, 0.5), (0.5, 0.5), (0.45, 0.48), (0.05, 0.02)])
    assert list(rank_main(drawn["ladder"])) == list(effects)


def test_a_clock_that_was_corrected_is_no_smaller_effect() -> None:
    errors = [(1.0, 0.5), (0.1, 0.1), (0.05, 0.1)]
    ladder = draw_diagnosis({"drive_lag": {"tau": 0.3}, "deadband": {"d": 0.01}}, errors)["ladder"]
    lag, band, clock = ("drive_lag", False), ("deadband", False), ("clock_offset", True)
    assert split_main([lag, band, clock], ladder, lambda one: one) == ([lag, clock], [band])
    assert split_main([band, clock], ladder, lambda one: one) == ([band, clock], [])


def test_no_effect_is_smaller_where_none_is_larger() -> None:
    drawn = draw_diagnosis({"deadband": {"d": 0.01}}, [(1.0, 0.5), (0.95, 0.5)])
    assert [*rank_main(drawn["ladder"])] == ["deadband"]
    band = ("deadband", False)
    assert split_main([band], drawn["ladder"], lambda one: one) == ([band], [])
    assert not is_small("deadband", drawn["ladder"])
    assert "ignores wheel speeds below 0.01 m/s; with this in the model" in check_verdict(drawn)


def test_a_number_that_rises_is_no_share_and_of_small_effects_one_is_told() -> None:
    effects = {"deadband": {"d": 0.01}, "lateral_skid": {"c": 0.02}}
    drawn = draw_diagnosis(effects, [(0.2, 0.1), (0.19, 0.095), (0.2, 0.115)])
    assert list(rank_main(drawn["ladder"])) == ["deadband"]
    assert "below 0.01 m/s; with two effects in the model" in check_verdict(drawn)


def test_the_verdict_keeps_the_order_of_the_effects_whatever_their_subject() -> None:
    effects = {"heading_skew": {"d": 0.1}, "effective_track": {"k": 1.5}, "drive_lag": {"tau": 0.3}}
    drawn = draw_diagnosis(effects, [(1.0, 1.0), (0.4, 0.6), (0.2, 0.3), (0.05, 0.02)])
    assert [*rank_effects(drawn["ladder"])] == list(effects)
    assert (
        "The heading is 100 ms older than the position, and the robot turns at 67 % of the ideal rate and "
        "follows commands with a time constant of 0.3 s; with these in the model"
    ) in check_verdict(drawn)


def test_drivetrain_ground_and_sensors_stand_in_one_sentence() -> None:
    effects = {
        "acceleration_limit": {"limit": 4.0},
        "effective_track": {"k": 1.5},
        "heading_skew": {"d": 0.1},
    }
    drawn = draw_diagnosis(effects, [(1.0, 1.0), (0.6, 0.6), (0.3, 0.2), (0.05, 0.02)])
    verdict = check_verdict(drawn)
    assert "at the noise floor" in verdict
    assert ", and the heading is 100 ms older than the position; with these in the model" in verdict
    assert f"at most {4.0 * _WARTHOG.wheel_radius_m:.2g} m/s^2" in verdict


def test_alternatives_stand_in_and_doubts_are_named() -> None:
    undecided = [{"candidates": ["body_inertia", "lateral_skid"], "in_model": "body_inertia"}]
    drawn = draw_diagnosis({"body_inertia": {"tau": 0.3}}, [(1.0, 0.5), (0.3, 0.2)], undecided=undecided)
    assert check_verdict(drawn) == (
        "Over 2 s the ideal model is 1 m and 29 degrees off. With one effect in the model 30 cm and 11 "
        "degrees remain, 10 times the noise floor in heading and 6 times in position. This log does not "
        "decide between body inertia and lateral skid; no known effect explains the rest."
    )
    drawn = draw_diagnosis({"drive_lag": {"tau": 3.5}}, [(1.0, 0.5), (0.3, 0.2)])
    drawn["effects"][0]["clause"] += " (a stand-in for another cause)"
    assert "3.5 s (a stand-in for another cause); with this" in check_verdict(drawn)


def test_without_an_effect_the_noise_floor_decides_what_is_said() -> None:
    close, far = [(0.055, 0.02)], [(0.4, 0.2)]
    nothing = check_verdict(draw_diagnosis({}, close))
    assert nothing.endswith(f"5.5 cm and 1.1 degrees off, at the noise floor. {NOTHING_MISSING}.")
    assert check_verdict(draw_diagnosis({}, far)).endswith(
        "off, 10 times the noise floor in heading and 8 times in position. "
        "No known effect explains the error."
    )
    half_known = draw_diagnosis({}, far, noise_floor={"t_mrmse_m": 0.05, "r_mrmse_rad": 0.0})
    assert "off, 8 times the noise floor in position. No known" in check_verdict(half_known)
    short = [{"id": "little_driving", "text": "the run has 31 s of driving", "where": "diagnosis"}]
    for errors in (close, far):
        verdict = check_verdict(draw_diagnosis({}, errors, findings=short))
        assert verdict.endswith("The run is too short to determine the cause.")
        assert NOTHING_MISSING not in verdict
    named = draw_diagnosis({"drive_lag": {"tau": 0.3}}, [(1.0, 0.5), (0.05, 0.02)], findings=short)
    assert check_verdict(named).endswith("The run is too short for certainty.")
    groups = [{"candidates": ["turning_resistance", "wheel_radius"], "in_model": None}]
    assert check_verdict(draw_diagnosis({}, far, undecided=groups)).endswith(
        "The cause is turning resistance or effective wheel radius, which this log does not separate."
    )
    ids = ["icr_lateral", "speed_slip", "turning_resistance", "wheel_radius", "icr_offset"]
    groups = [{"candidates": ids, "in_model": None}]
    assert "cause is lateral centre of rotation, speed slip or 3 others, which" in format_verdict(
        draw_diagnosis({}, far, undecided=groups)
    )
    clock = draw_diagnosis({"clock_offset": {"d": -0.15}}, close)
    assert check_verdict(clock).endswith("The poses are stamped 150 ms early, which is corrected.")


@pytest.mark.parametrize("name", ["not_moving", "pose_from_wheels", *FAULTS])
def test_a_refusal_is_the_whole_verdict(name: str) -> None:
    text = "the vehicle does not move: it covered 0.5 % of the 90 m turned by the wheels"
    finding = {"id": name, "text": text, "severity": "error"}
    drawn = draw_diagnosis({"drive_lag": {"tau": 0.3}}, [(1.0, 0.5), (0.5, 0.2)], findings=[finding])
    verdict = format_verdict(drawn)
    assert verdict == f"{text.capitalize()}. No effect can be estimated."
    # It is said of a run that nobody diagnosed as well, of which nothing else is.
    assert format_verdict({"findings": [finding]}) == verdict
    assert format_verdict({"findings": [{**finding, "id": "held_poses"}]}) == ""


def test_a_log_that_is_too_poor_says_why() -> None:
    finding = {"id": "too_short", "text": "run: 9 s of driving. Drive longer.", "where": "diagnosis"}
    verdict = format_verdict({"ladder": [], "findings": [finding]})
    assert verdict == "No effect can be estimated: run: 9 s of driving. Drive longer."


@pytest.mark.parametrize("kind", list_effects(), ids=lambda kind: str(kind.id))
def test_every_effect_reads_well_in_a_verdict(kind: type[Any]) -> None:
    vehicle = next(v for v in (_PRESETS["husky_a200"], _PRESETS["ackermann_car"], _PRESETS["dingo_o"])
                   if v.kind in kind.kinds)  # fmt: skip
    usual = {p.name: p.typical for p in kind.parameters if not p.instead_of}
    drawn = draw_diagnosis({kind.id: usual}, [(0.4, 0.3), (0.3, 0.2)], vehicle)
    verdict = check_verdict(drawn, vehicle)
    # With a number of its own, and short enough for three of them.
    clause = str(drawn["effects"][0]["clause"])
    assert _NUMBER.search(clause)
    assert len(clause) < 80
    assert re.search(r"\. (The robot [a-z]+s |The [a-z]+ )", verdict)


def test_a_verdict_is_never_too_long() -> None:
    long = ("steering_sensor_offset", "turning_resistance", "wheel_servo", "side_lag", "icr_lateral")
    effects = {
        name: {p.name: p.typical for p in find_effect(name).parameters if not p.instead_of} for name in long
    }
    errors = [(10.0 ** -(number / 5.0), 1.0) for number in range(len(long) + 1)]
    verdict = check_verdict(draw_diagnosis(effects, errors))
    assert "with all effects in the model" in verdict


@pytest.mark.long
@pytest.mark.parametrize("log", sorted(_LOGS.glob("*.mcap")) or [None], ids=lambda log: log and log.stem)
def test_the_verdict_on_a_recording_is_that_of_its_stored_results(log: Path | None, tmp_path: Path) -> None:
    if log is None:
        pytest.skip("the real recordings are not here")
    manifest = analyze_log(log, Options(out=tmp_path, report=False, diagnosis=True)).manifest
    summary = manifest.read_json("summary.json")
    stored: Diagnosis = json.loads(manifest.path("diagnosis.json").read_text())
    assert summary["verdict"] == stored["verdict"] == format_verdict(stored)
    if stored["ladder"]:
        check_verdict(stored, load_vehicle(manifest))
    else:
        check_form(stored["verdict"])


def test_without_a_noise_floor_nobody_says_that_nothing_is_missing() -> None:
    diagnosis = draw_diagnosis({}, [(1.0, 0.2)])
    diagnosis["noise_floor"] = {}
    verdict = format_verdict(diagnosis)
    assert NOTHING_MISSING not in verdict
    assert "The noise floor of this run is not known" in verdict


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (0.057, "at the noise floor"),
        (0.072, "1.4 times the noise floor"),
        (0.074, "1.5 times the noise floor"),
        (0.08, "1.6 times the noise floor"),
    ],
)
def test_the_verdict_and_the_line_below_agree_on_the_noise_floor(error: float, says: str) -> None:
    diagnosis = draw_diagnosis({"drive_lag": {"tau": 0.3}}, [(1.0, 0.2), (error, 0.02 * error / 0.05)])
    assert says in format_verdict(diagnosis)
    line = format_remaining_error(error, _FLOOR["t_mrmse_m"], 0.98)
    assert ("at the noise floor" in line) is (says == "at the noise floor")
    assert (says in line) or error >= ABOVE_FLOOR * _FLOOR["t_mrmse_m"]
