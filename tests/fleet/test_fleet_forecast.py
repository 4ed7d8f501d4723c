"""What the runs of a vehicle let expect of its numbers on a terrain."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from comparison_store import Run, write_run
from test_fleet_levels import ALIKE, ICE_AND_OTHERS, draw

from pipeline.cli.verbs_fleet import _format_expected
from pipeline.fleet import ComparisonError
from pipeline.fleet.confidence import Interval
from pipeline.fleet.forecast import Forecast, fit_fleet, forecast_vehicle, join_evidence
from pipeline.fleet.joint_levels import RunEvidence
from pipeline.job.over_runs import follow_trend
from pipeline.job.prediction import (
    Expected,
    Prediction,
    _note_terrain,
    find_estimates,
    fit_results,
    make_model_file,
    summarize_prediction,
)
from pipeline.models import find_effect
from pipeline.models.parameter import Level
from pipeline.sources import find_preset
from pipeline.store import Store


def test_on_known_ground_its_own_runs_count_most() -> None:
    estimates = draw(ICE_AND_OTHERS)
    ice = forecast_vehicle(estimates, "warthog", "ice", "measured")
    (number,) = ice.numbers
    assert number.label == "wheel_radius.k"
    assert not number.at_bound
    assert number.ends[0] < 0.7 < number.ends[1] < 0.9
    assert (len(ice.here), len(ice.elsewhere)) == (3, 6)
    mud = forecast_vehicle(estimates, "warthog", "mud", "measured").numbers[0]
    assert mud.deviation > 2.0 * number.deviation
    assert mud.ends[0] < 0.7
    assert mud.ends[1] > 1.0
    assert forecast_vehicle(estimates, "warthog", "ice", "measured").effects[0].values["k"] == number.value


def test_the_model_has_what_most_runs_there_name() -> None:
    skid = {"effect": "lateral_skid", "parameter": "c", "unit": "s"}
    lag = {"effect": "drive_lag", "parameter": "tau", "unit": "s", "input": "command"}
    estimates = pl.concat(
        [
            draw(ALIKE),
            draw({"ice": 0.1}, **skid),
            draw({"asphalt": 0.0, "gravel": 0.0}, **skid, named=False),
            draw(dict.fromkeys(ALIKE, 0.3), **lag),
            draw(dict.fromkeys(ALIKE, 5.0), effect="terrain_change", parameter="at_s", unit="s"),
        ]
    )
    ids = {
        (terrain, source): [e.id for e in forecast_vehicle(estimates, "warthog", terrain, source).effects]
        for terrain in ("ice", "gravel", "mud")
        for source in ("command", "measured")
    }
    assert ids["ice", "command"] == ["drive_lag", "wheel_radius", "lateral_skid"]
    assert ids["ice", "measured"] == ["wheel_radius", "lateral_skid"]
    assert ids["gravel", "command"] == ids["mud", "command"] == ["drive_lag", "wheel_radius"]


def test_a_run_that_stands_apart_does_not_move_what_is_expected() -> None:
    rows = draw(ALIKE, runs=4)
    odd = rows["run"][2]
    hurt = rows.with_columns(pl.when(pl.col("run") == odd).then(0.3).otherwise("value").alias("value"))
    number = forecast_vehicle(hurt, "warthog", "asphalt", "measured").numbers[0]
    assert number.value == pytest.approx(0.9, abs=0.03)
    assert number.runs == 11


def test_draws_stay_within_the_bounds_of_the_search() -> None:
    lag = draw({"ice": 0.01}, effect="body_inertia", parameter="tau", runs=1)
    (number,) = forecast_vehicle(lag, "warthog", "ice").numbers
    assert number.draws.min() == 0.0
    assert number.at_bound
    assert forecast_vehicle(lag, "warthog", "ice").draw(0)[0].id == "body_inertia"


def test_an_interval_that_a_bound_cuts_is_none_of_the_written_model() -> None:
    lag = draw({"ice": 0.01}, effect="body_inertia", parameter="tau", runs=1)
    some = Expected(1.0, Interval(0.5, 2.0, 0.95))
    kept: dict[str, bool] = {}
    for estimates, source in ((lag, "command"), (draw(ICE_AND_OTHERS), "measured")):
        forecast = forecast_vehicle(estimates, "warthog", "ice", source)  # type: ignore[arg-type]
        vehicle = find_preset("warthog")
        assert vehicle is not None
        prediction = Prediction(forecast, vehicle, some, some, some, ())
        (number,) = forecast.numbers
        kept[number.label] = number.label in make_model_file(prediction).intervals
        assert f"'at_bound': {not kept[number.label]}" in str(summarize_prediction(prediction))
    assert kept == {"body_inertia.tau": False, "wheel_radius.k": True}


def test_a_limit_that_no_run_reaches_is_said_to_be_none() -> None:
    limit = find_effect("acceleration_limit")().parameter("limit")
    number = {"value": 500.0, "low": 4.23, "high": 500.0, "at_bound": True, "default_spread": False}
    assert _format_expected(number, limit) == "no limit, or one of at least 4.23 rad/s^2"
    unknown = {**number, "low": None, "high": None, "default_spread": True}
    assert _format_expected(unknown, limit) == "no limit"
    unknown["value"] = number["value"] = 18.0
    assert _format_expected(unknown, limit) == "18 rad/s^2 (no interval: fewer than three runs)"
    assert _format_expected(number, limit) == (
        "18 rad/s^2 [4, 500] (the interval ends at a limit of the search)"
    )


def test_a_terrain_of_other_vehicles_is_no_unknown_one() -> None:
    labels = pl.DataFrame(
        [("w0", "warthog", "asphalt"), ("w1", "warthog", "gravel"), ("h", "husky", "snow")],
        schema=["run", "vehicle", "terrain"],
        orient="row",
    )
    forecast = Forecast("warthog", "snow", "command", (), (), ("w0", "w1"))
    assert _note_terrain(labels, forecast) == (
        "no run of warthog is on snow: the prediction is for another terrain, from runs on asphalt, gravel"
    )


def test_a_vehicle_without_runs_is_refused_in_one_line() -> None:
    with pytest.raises(ComparisonError) as told:
        forecast_vehicle(draw(ALIKE), "husky_a200", "ice")
    assert told.value.code == "no_such_vehicle"
    assert "warthog" in str(told.value)


def test_the_member_of_an_undecided_group_that_written_models_hold_is_expected() -> None:
    skid = draw({"ice": 0.1}, effect="lateral_skid", parameter="c", unit="s", named=False, in_model=True)
    rival = draw({"ice": 0.2}, effect="body_inertia", parameter="tau", unit="s", named=False)
    forecast = forecast_vehicle(pl.concat([draw(ALIKE), skid, rival]), "warthog", "ice", "measured")
    assert [effect.id for effect in forecast.effects] == ["wheel_radius", "lateral_skid"]


def test_spreads_of_few_runs_are_said_to_be_defaults() -> None:
    vehicle = find_preset("warthog")
    assert vehicle is not None
    some = Expected(1.0, Interval(0.5, 2.0, 0.95))
    for runs, is_default in ((2, True), (3, False)):
        forecast = forecast_vehicle(draw({"ice": 0.9}, runs=runs), "warthog", "ice", "measured")
        told = summarize_prediction(Prediction(forecast, vehicle, some, some, some, ()))
        assert f"'default_spread': {is_default}" in str(told)
        ((effect,), error) = told["effects"], told["t_mrmse_m"]  # type: ignore[misc]
        assert (effect["parameters"]["k"]["low"] is None) == is_default
        used = Prediction(forecast, vehicle, some, some, some, forecast.runs)
        assert (summarize_prediction(used)["t_mrmse_m"]["low"] is None) == is_default  # type: ignore[index]
        assert error["value"] == 1.0  # type: ignore[call-overload]
        assert ("wheel_radius.k" in make_model_file(used).intervals) != is_default


def test_of_two_runs_that_hold_different_effects_both_are_expected() -> None:
    skid = draw({"ice": 0.1}, effect="lateral_skid", parameter="c", unit="s", runs=2)
    once = skid.with_columns(in_model=pl.col("run").str.ends_with("_0"))
    forecast = forecast_vehicle(pl.concat([draw(ALIKE, runs=2), once]), "warthog", "ice", "measured")
    assert [effect.id for effect in forecast.effects] == ["wheel_radius", "lateral_skid"]


def test_numbers_of_the_controller_are_the_vehicles_and_friction_is_the_grounds() -> None:
    servo = [
        draw(
            dict.fromkeys(("asphalt", "gravel"), value), effect="wheel_servo", parameter=name, input="command"
        )
        for name, value in (("tau", 0.7), ("scrub", 0.8))
    ]
    widths = {}
    for terrain in ("gravel", "mud"):
        numbers = forecast_vehicle(pl.concat(servo), "warthog", terrain).numbers
        widths[terrain] = {number.parameter: number.deviation for number in numbers}
    assert widths["mud"]["tau"] == pytest.approx(widths["gravel"]["tau"])
    assert widths["mud"]["scrub"] > 1.5 * widths["gravel"]["scrub"]
    (tau,) = (one for one in fit_fleet(pl.concat(servo)).numbers if one.parameter == "tau")
    assert (tau.level, tau.because) == (Level.VEHICLE, "by its nature the vehicle's")


def test_runs_joined_by_their_equations_tell_what_none_of_them_tells() -> None:
    """One run knows only the sum of two numbers, the other their difference, a third only the first."""
    (lag,) = forecast_vehicle(
        draw({"ice": 0.5}, effect="body_inertia", parameter="tau", runs=2), "warthog", "ice"
    ).numbers
    labels = (("lateral_skid", "c"), ("turning_resistance", "k"))
    start = Forecast(
        "warthog", "ice", "command",
        tuple(replace(lag, effect=effect, parameter=name) for effect, name in labels),
        (), (),
    )  # fmt: skip
    rows = [np.array([1.0, 1.0]), np.array([1.0, -1.0]), np.array([1.0, 0.0])]
    truth = np.array([0.15, 0.05])
    evidence = [
        RunEvidence(f"r{place}", "ice", np.outer(row, row) / 0.002**2, row * float(row @ truth) / 0.002**2)
        for place, row in enumerate(rows)
    ]
    joined = join_evidence(start, evidence, {})
    assert [number.value for number in joined.numbers] == pytest.approx(truth.tolist(), abs=0.02)
    apart = join_evidence(start, evidence[:1], {})
    assert apart.numbers[1].deviation > 2.0 * joined.numbers[1].deviation
    # What the fit to all runs found on this terrain is what is expected there.
    fitted = join_evidence(start, evidence, {"lateral_skid.c": 0.18})
    assert [number.value for number in fitted.numbers] == pytest.approx([0.18, 0.05], abs=0.02)


def test_estimates_of_effects_that_the_catalogue_no_longer_has_so_are_left_out(tmp_path: Path) -> None:
    """An effect that is gone, and one that has another parameter in place of tau."""
    store = Store(tmp_path / "results")
    for number in range(3):
        estimates = [
            ("effective_track", "k", 1.7 + 0.01 * number, 0.01), ("turn_servo", "tau", 0.6, 0.05),
            ("contact_friction", "friction", 0.6, 0.05), ("contact_friction", "tau", 0.06, 0.05),
        ]  # fmt: skip
        write_run(store, Run(name=f"run{number}", seconds=6.0, sha256=f"{number}" * 64, estimates=estimates))
    assert find_estimates(store)["effect"].unique().to_list() == ["effective_track"]
    model, _ = fit_results(store)
    assert [number.effect for number in model.numbers] == ["effective_track"]
    follow_trend(store, ("vehicle",), threshold=0.05, limits={})
