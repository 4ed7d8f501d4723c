"""The verdict on a run: at most three sentences for people, of which every number is a stored one."""

import json
import math
import re
from pathlib import Path

import pytest
from drawn_diagnoses import check_form, check_verdict, draw_diagnosis
from msgspec.structs import replace

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.export import export_model, list_omitted
from pipeline.models import FEW_STRETCHES, Model, ModelFile, Number, find_effect, list_effects
from pipeline.results import Errors, Named, Refused, RunDiagnosis, Unexplained, read_result
from pipeline.results.reading import split_main
from pipeline.sources import list_presets
from pipeline.sources.one_vehicle import load_vehicle
from pipeline.words.effects import describe_clause
from pipeline.words.errors import list_remaining_errors
from pipeline.words.models import suggest_export
from pipeline.words.verdict import format_verdict

_LOGS = Path(__file__).parents[2] / ".." / "shared" / "logs"
_PRESETS = {vehicle.id: vehicle for vehicle in list_presets()}
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def test_what_people_act_on_is_no_smaller_effect() -> None:
    """A clock that was corrected has no step; late commands and flat tyres may make little error in a run."""
    errors = [(1.0, 0.5), (0.1, 0.1), (0.05, 0.1)]
    drawn = draw_diagnosis({"drive_lag": {"tau": 0.3}, "deadband": {"d": 0.01}}, errors)
    lag, band = drawn.effects
    clock = Named("clock_offset", {"d": Number(0.1)}, corrected=True)
    late = Named("transport_delay", {"d": Number(0.4, 0.38, 0.42, "s")})
    flat, round_ = (Named("wheel_radius", {"k": Number(k, k - 0.01, k + 0.01)}) for k in (0.85, 0.98))
    vague = Named("transport_delay", {"d": Number(0.4, 0.01, 0.8, "s")})
    effects = [lag, band, clock, late, flat, round_, vague]
    assert split_main(effects, drawn) == ([lag, clock, late, flat], [band, round_, vague])
    assert split_main([band, clock], drawn) == ([band, clock], [])


def test_every_effect_reads_well_in_a_verdict() -> None:
    for kind in list_effects():
        vehicle = next(v for v in (_PRESETS["husky_a200"], _PRESETS["ackermann_car"], _PRESETS["dingo_o"])
                       if v.kind in kind.kinds)  # fmt: skip
        usual = {p.name: p.typical for p in kind.parameters if not p.instead_of}
        drawn = draw_diagnosis({kind.id: usual}, [(0.4, 0.3), (0.3, 0.2)], vehicle)
        verdict = check_verdict(drawn, vehicle)
        # With a number of its own, and short enough for three of them.
        clause = describe_clause(drawn.effects[0], drawn)
        assert _NUMBER.search(clause)
        assert len(clause) < 80
        # Wheels are of plastic, too, or run in tracks.
        assert "tyre" not in clause
        assert not any("tyre" in one.text for one in kind.readings)
        assert re.search(r"\. (The robot [a-z]+s |The [a-z]+ )", verdict)


def test_an_effect_that_few_stretches_tell_is_no_plain_fact() -> None:
    drawn = draw_diagnosis(
        {"time_drift": {"k": 0.08}, "drive_lag": {"tau": 0.3}}, [(1, 1), (0.6, 0.5), (0.1, 0.1)]
    )
    first, second = drawn.effects
    few = {"k": replace(first.parameters["k"], doubt="few_stretches", stretches=3)}
    run = replace(drawn, effects=(replace(first, parameters=few), second))
    assert "at its start (tentative) and follows commands with" in format_verdict(run)
    assert "tentative" not in format_verdict(drawn)


def test_a_verdict_names_the_effect_that_evidence_is_wanting_for() -> None:
    drawn = draw_diagnosis({"drive_lag": {"tau": 0.3}}, [(1.0, 0.5), (0.4, 0.3)])
    why = "it shows in too few stretches of the drive (52 % of resampled recordings, 85 % required)"
    refused = (
        Refused("steering_offset", why, Errors(t_mrmse_m=0.09, r_mrmse_rad=0.02)),
        Refused("steering_gain", why, Errors(t_mrmse_m=0.2, r_mrmse_rad=0.1)),
    )
    for one, before in ((drawn, "remain"), (replace(drawn, ladder=drawn.ladder[:1]), "off")):
        verdict = format_verdict(replace(one, refused=refused))
        assert before in verdict
        assert verdict.endswith(f" Steering offset would leave 9 cm and 1.1 degrees, but {why}.")
        assert "No known effect" not in verdict
        assert "No known effect" in format_verdict(one)


def test_a_verdict_says_what_a_suggested_term_would_leave() -> None:
    drawn = draw_diagnosis({"drive_lag": {"tau": 0.3}}, [(1.0, 0.5), (0.4, 0.3)])
    assert "No known effect explains the rest." in format_verdict(drawn)
    term = Unexplained(with_formula=Errors(t_mrmse_m=0.05, r_mrmse_rad=0.02))
    suggested = format_verdict(replace(drawn, unexplained=term))
    assert suggested.endswith("explains the rest: a suggested term would leave 5 cm and 1.1 degrees.")


def test_where_no_stretch_is_long_enough_the_effect_is_said_and_no_error() -> None:
    drawn = draw_diagnosis({"drive_lag": {"tau": 0.3}}, [(math.nan, math.nan), (math.nan, math.nan)])
    verdict = format_verdict(drawn)
    assert verdict.startswith("No stretch of good poses is long enough to tell an error. The robot")
    assert "unknown amount" not in verdict


def test_what_differs_between_grounds_is_a_range_in_the_verdict() -> None:
    drawn = draw_diagnosis({"effective_track": {"k": 1.5}}, [(1.0, 0.5), (0.05, 0.02)])
    (track,) = drawn.effects
    value = track.parameters["k"]
    by_run = tuple({"k": replace(value, value=k, low=k, high=k)} for k in (2.0, 1.25, 1.6))
    verdict = format_verdict(replace(drawn, effects=(replace(track, by_run=by_run),)))
    assert "The robot turns at 50 to 80 % of the ideal rate; with this in the model" in verdict


def test_the_export_that_is_suggested_takes_the_vehicle() -> None:
    for vehicle in _PRESETS.values():
        file = ModelFile(Model(vehicle, ()))
        *_, target = suggest_export(file, "robot.toml").split()
        assert export_model(file, target)


def test_the_export_that_is_suggested_leaves_not_all_out() -> None:
    effects = (find_effect("drive_lag")().change(tau=0.3), find_effect("effective_track")().change(k=1.6))
    known = Number(1.6, 1.55, 1.65)
    doubtful = replace(known, doubt=FEW_STRETCHES, stretches=3)
    lag = replace(doubtful, value=0.3, low=0.29, high=0.31, unit="s")
    for count, number, expected in ((1, lag, "python"), (2, known, "ros2_control"), (2, doubtful, "python")):
        numbers = {"drive_lag.tau": lag, "effective_track.k": number}
        fit = {"runs": [{"run": "field/a"}]}
        file = ModelFile(Model(_PRESETS["husky_a200"], effects[:count]), numbers=numbers, fit=fit)
        *_, target = suggest_export(file, "robot.toml").split()
        assert target == expected
        assert len(list_omitted(file, target)) < count


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
    stored = read_result(json.loads(manifest.path("diagnosis.json").read_text()), RunDiagnosis)
    assert summary["verdict"] == format_verdict(stored)
    if stored.ladder:
        check_verdict(stored, load_vehicle(manifest))
    else:
        check_form(format_verdict(stored))


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
    lines = list_remaining_errors(diagnosis)
    assert [says in line for line in lines] == [True, True]
    for line, floor in zip(lines, ("5 cm", "1.1 degrees"), strict=True):
        assert f"{says} ({floor})" in line


@pytest.mark.parametrize("explained", [math.nan, -0.2, 0.0, 0.004])
def test_effects_that_remove_nothing_are_not_said_to_remove_a_share(explained: float) -> None:
    diagnosis = draw_diagnosis({"drive_lag": {"tau": 0.3}}, [(1.0, 0.2), (0.4, 0.01)])
    shares = [replace(diagnosis, explained_share=one) for one in (explained, 0.5)]
    assert [list_remaining_errors(one) for one in shares] == [
        [
            f"40 cm, 8 times the noise floor (5 cm){removed}",
            "0.57 degrees in heading, below the estimated noise floor of 1.1 degrees",
        ]
        for removed in ("", ": the effects remove 50 % of the error above it")
    ]


def test_understeer_is_told_at_a_speed_that_the_car_reaches() -> None:
    """A car of 1.5 m/s turned 58 % less at 3 m/s."""
    for name, speed in (("hunter_2", "1.5 m/s"), ("ackermann_car", "3 m/s")):
        told = draw_diagnosis({"understeer": {"K": 0.1}}, [(1.0, 0.5), (0.04, 0.01)], _PRESETS[name])
        assert f"less than ideal at {speed}" in format_verdict(told)
