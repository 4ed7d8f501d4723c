"""What the runs of a vehicle let expect of its numbers on a terrain."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from test_fleet_levels import ALIKE, ICE_AND_OTHERS, draw

from pipeline.datasets.forecast import Forecast, fit_fleet, forecast_vehicle, join_evidence
from pipeline.datasets.levels import RunEvidence
from pipeline.models.parameter import Level


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


def test_the_member_of_an_undecided_group_that_written_models_hold_is_expected() -> None:
    skid = draw({"ice": 0.1}, effect="lateral_skid", parameter="c", unit="s", named=False, in_model=True)
    rival = draw({"ice": 0.2}, effect="body_inertia", parameter="tau", unit="s", named=False)
    forecast = forecast_vehicle(pl.concat([draw(ALIKE), skid, rival]), "warthog", "ice", "measured")
    assert [effect.id for effect in forecast.effects] == ["wheel_radius", "lateral_skid"]


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
