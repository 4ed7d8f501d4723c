"""What the runs of a vehicle let expect of its numbers on a terrain."""

from __future__ import annotations

import polars as pl
import pytest
from test_fleet_levels import ALIKE, ICE_AND_OTHERS, draw

from pipeline.fleet.confidence import Interval
from pipeline.fleet.forecast import forecast_vehicle
from pipeline.fleet.runs import ComparisonError
from pipeline.job.prediction import Expected, Prediction, describe_prediction, make_model_file
from pipeline.sources import find_preset


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
        assert f"'at_bound': {not kept[number.label]}" in str(describe_prediction(prediction))
    assert kept == {"body_inertia.tau": False, "wheel_radius.k": True}


def test_a_vehicle_without_runs_is_refused_in_one_line() -> None:
    with pytest.raises(ComparisonError) as told:
        forecast_vehicle(draw(ALIKE), "husky_a200", "ice")
    assert told.value.code == "no_such_vehicle"
    assert "warthog" in str(told.value)
