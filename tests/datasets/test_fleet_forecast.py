"""What the runs of a vehicle let expect of its numbers on a terrain."""

import numpy as np
import polars as pl
import pytest
from test_fleet_levels import ALIKE, ICE_AND_OTHERS, draw

from pipeline.datasets.forecast import expect_values, fit_fleet, forecast_vehicle
from pipeline.models import find_effect
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


def test_where_no_two_runs_share_an_effect_none_is_expected() -> None:
    effects = (
        ("wheel_radius", "k"),
        ("effective_track", "k"),
        ("icr_offset", find_effect("icr_offset").parameters[0].name),
    )
    rows = [
        draw({"ice": 1.1}, effect=effect, parameter=name).filter(pl.int_range(pl.len()) == index)
        for index, (effect, name) in enumerate(effects)
    ]
    forecast = forecast_vehicle(pl.concat(rows), "warthog", "ice", "measured")
    assert forecast.numbers == ()
    assert forecast.effects == ()


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


def test_what_the_fit_to_all_runs_found_is_expected_within_what_runs_differ_by() -> None:
    start = forecast_vehicle(draw({"ice": 0.9, "mud": 0.7}), "warthog", "ice")
    (k,) = start.numbers
    (fitted,) = expect_values(start, {k.label: k.ends[1] + 0.01}).numbers
    assert fitted.value == pytest.approx(k.ends[1] + 0.01)
    low, high = fitted.ends
    assert low < fitted.value < high
    assert low < k.value < high
    assert high - fitted.value > 0.3 * (high - k.value)
    (bounded,) = expect_values(start, {k.label: 1e9}).numbers
    assert bounded.value == k.bounds[1]
    assert expect_values(start, {"drive_lag.tau": 1.0}) == start


def test_numbers_that_vary_together_from_run_to_run_are_drawn_together() -> None:
    track = draw({"ice": 1.8}, effect="effective_track", parameter="k", runs=20)
    radius = draw({"ice": 0.9}, effect="wheel_radius", parameter="k", runs=20, seed=1)
    trading = radius.with_columns(value=0.9 - (track["value"] - track["value"].mean()))
    correlations = {}
    for name, second, runs in (("many", trading, 20), ("few", trading, 2), ("apart", radius, 20)):
        both = pl.concat([one.filter(pl.int_range(pl.len()) < runs) for one in (track, second)])
        numbers = forecast_vehicle(both, "warthog", "ice", "measured").numbers
        own = [forecast_vehicle(rows, "warthog", "ice", "measured").numbers[0] for rows in (track, second)]
        if runs == 20:
            assert sorted(one.value for one in numbers) == sorted(one.value for one in own)
        correlations[name] = float(np.corrcoef([number.draws for number in numbers])[0, 1])
    assert correlations["many"] < -0.75
    assert abs(correlations["few"]) < 0.5
    assert abs(correlations["apart"]) < 0.5


def test_an_outlying_run_has_no_part_in_how_numbers_vary_together() -> None:
    track = draw({"ice": 1.8}, effect="effective_track", parameter="k", runs=9)
    odd = pl.col("run").str.ends_with("_4")
    radius = draw({"ice": 0.9}, runs=9, seed=1)
    hurt = radius.with_columns(value=pl.when(odd).then(0.3).otherwise("value"))
    draws = [
        [one.draws.tolist() for one in forecast_vehicle(rows, "warthog", "ice", "measured").numbers]
        for rows in (pl.concat([track, hurt]), pl.concat([track, radius.filter(~odd)]))
    ]
    assert draws[0] == draws[1]
