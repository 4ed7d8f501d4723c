"""Numbers of a fleet by level: the vehicle's, the ground's, a run's own, or open."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from comparison_store import Run, write_run
from few import few
from verbs import ask_verb

from pipeline.datasets.compare import compare_results
from pipeline.datasets.compared_runs import Question
from pipeline.datasets.fleet import FleetNumber, expect_numbers, fit_fleet, fit_results
from pipeline.datasets.pooling import ComparisonError
from pipeline.datasets.trend import follow_trend
from pipeline.store import Store
from pipeline.words.fleet import format_fleet

ERROR = 0.02
ICE_AND_OTHERS = {"asphalt": 1.0, "gravel": 0.98, "ice": 0.7}
ALIKE = {"asphalt": 0.9, "gravel": 0.9, "ice": 0.9}


def draw(
    means: dict[str, float],
    *,
    effect: str = "wheel_radius",
    parameter: str = "k",
    runs: int = 3,
    vehicle: str = "warthog",
    spread: float = 0.01,
    seed: int = 0,
    **more: object,
) -> pl.DataFrame:
    """Estimates of a number on several terrains."""
    rng = np.random.default_rng(seed)
    rows = [
        {
            "run": f"{vehicle}_{terrain}_{number}",
            "dataset": f"{vehicle}_{terrain}",
            "vehicle": vehicle,
            "terrain": terrain,
            "input": "measured",
            "effect": effect,
            "parameter": parameter,
            "unit": "1",
            "value": mean + float(np.hypot(spread, ERROR) * rng.normal()),
            "standard_error": ERROR,
            "named": True,
            "at_bound": False,
            "in_model": more.get("named", True),
            **more,
        }
        for terrain, mean in means.items()
        for number in range(runs)
    ]
    return pl.DataFrame(rows)


def fit_one(estimates: pl.DataFrame) -> FleetNumber:
    (number,) = fit_fleet(estimates).numbers
    return number


def test_wheels_that_are_small_are_so_on_every_ground() -> None:
    number = fit_one(draw(ALIKE))
    assert (number.level, number.name) == ("vehicle", "wheel_radius")
    assert float(str(number.whole.low)) < 0.9 < float(str(number.whole.high))
    assert "3 terrains not shown to differ by more than runs do" in number.because


def test_wheels_that_slip_on_ice_are_not_small() -> None:
    number = fit_one(draw(ICE_AND_OTHERS))
    assert (number.level, number.name) == ("terrain", "longitudinal_slip")
    assert number.terrains["ice"].value == pytest.approx(0.7, abs=0.05)
    assert "ice 0.7" in number.because


@pytest.mark.parametrize("seed", few(range(8), 4))
def test_radius_is_never_named_for_slip_where_two_terrains_are_there(seed: int) -> None:
    for runs in (1, 2, 3):
        number = fit_one(draw({"asphalt": 1.0, "ice": 0.7}, runs=runs, seed=seed))
        assert number.level in {"terrain", None}
        assert number.name in {"longitudinal_slip", "wheel_radius or longitudinal_slip"}


def test_what_comes_and_goes_is_the_runs_own() -> None:
    number = fit_one(
        draw(
            dict.fromkeys(ICE_AND_OTHERS, 0.0), effect="yaw_misalignment", parameter="psi", spread=0.2, runs=5
        )
    )
    assert number.level == "run"
    assert number.spread_run == pytest.approx(0.2, rel=0.5)


def test_one_terrain_leaves_it_open_and_says_what_would_tell() -> None:
    number = fit_one(draw({"ice": 0.7}))
    assert number.level is None
    assert number.name == "wheel_radius or longitudinal_slip"
    expected = "only runs on ice determine it: runs on another terrain separate vehicle and terrain"
    assert number.because == expected


def test_only_what_is_named_counts_and_of_the_runs_whose_model_holds_it() -> None:
    elsewhere = {"asphalt": 1.0, "gravel": 1.0}
    quiet = draw(elsewhere, named=False)
    assert fit_fleet(quiet).numbers == ()
    number = fit_one(pl.concat([quiet, draw({"ice": 0.7})]))
    assert (number.named, number.whole.runs, number.level) == (3, 3, None)
    held = fit_one(pl.concat([draw(elsewhere, named=False, in_model=True), draw({"ice": 0.7})]))
    assert (held.named, held.whole.runs, held.name) == (3, 9, "longitudinal_slip")


def test_an_interval_of_a_fleet_takes_three_runs() -> None:
    for runs, known in ((1, False), (2, False), (3, True)):
        number = fit_one(draw({"ice": 0.7}, runs=runs))
        assert (number.whole.low is not None) == known
        assert (number.terrains["ice"].low is not None) == known
    mixed = fit_one(pl.concat([draw(ALIKE), draw({"mud": 0.7}, runs=2)]))
    assert mixed.terrains["mud"].low is None
    assert mixed.terrains["ice"].low is not None


def test_a_band_of_another_run_is_wider_than_the_level_and_that_of_another_ground_wider_still() -> None:
    number = fit_one(draw(ICE_AND_OTHERS, spread=0.05, runs=5))
    ice, whole = number.terrains["ice"], number.whole
    low, high, another_low, another_high = (
        float(str(getattr(ice, key))) for key in ("low", "high", "another_low", "another_high")
    )
    assert another_low < low < ice.value < high < another_high
    assert float(str(whole.another_low)) < another_low
    assert float(str(whole.another_high)) > 1.0


def test_bands_hold_other_runs_as_often_as_they_say() -> None:
    rng, inside, fleets = np.random.default_rng(2), 0, 200
    for seed in range(fleets):
        number = fit_one(draw(ICE_AND_OTHERS, spread=0.05, seed=seed))
        ice = number.terrains["ice"]
        another = 0.7 + 0.05 * rng.normal()
        inside += float(str(ice.another_low)) <= another <= float(str(ice.another_high))
    assert 0.91 <= inside / fleets <= 0.99


def test_what_is_expected_of_another_run_is_the_level_of_its_ground() -> None:
    estimates = draw(ICE_AND_OTHERS)
    ice, mud = (expect_numbers(estimates, "warthog", terrain, "measured") for terrain in ("ice", "mud"))
    assert ice.effects[0].values["k"] == pytest.approx(0.7, abs=0.03)
    assert mud.effects[0].values["k"] == pytest.approx(0.89, abs=0.03)
    assert mud.prior["wheel_radius.k"][1] > 2.0 * ice.prior["wheel_radius.k"][1]
    with pytest.raises(ComparisonError, match="no other run of jackal"):
        expect_numbers(estimates, "jackal", "ice")


def test_the_expected_model_has_what_half_of_the_runs_there_have_and_no_clock() -> None:
    skid = {"effect": "lateral_skid", "parameter": "c", "unit": "s"}
    lag = {"effect": "drive_lag", "parameter": "tau", "unit": "s", "input": "command"}
    parts = [
        draw(ALIKE),
        draw({"ice": 0.1}, **skid),
        draw({"asphalt": 0.0, "gravel": 0.0}, **skid, named=False),
        draw(dict.fromkeys(ALIKE, 0.3), **lag),
        draw(dict.fromkeys(ALIKE, 0.2), effect="clock_offset", parameter="d", unit="s"),
        draw(dict.fromkeys(ALIKE, 5.0), effect="terrain_change", parameter="at_s", unit="s"),
    ]
    ids = {
        (terrain, source): [
            one.id for one in expect_numbers(pl.concat(parts), "warthog", terrain, source).effects
        ]
        for terrain in ("ice", "gravel", "mud")
        for source in ("command", "measured")
    }
    assert ids["ice", "command"] == ["drive_lag", "wheel_radius", "lateral_skid"]
    assert ids["ice", "measured"] == ["wheel_radius", "lateral_skid"]
    assert ids["gravel", "command"] == ids["mud", "command"] == ["drive_lag", "wheel_radius"]


def test_numbers_of_the_controller_are_the_vehicles_and_friction_is_the_grounds() -> None:
    servo = pl.concat(
        [
            draw(
                dict.fromkeys(("asphalt", "gravel"), value),
                effect="wheel_servo",
                parameter=name,
                input="command",
            )
            for name, value in (("tau", 0.7), ("scrub", 0.8))
        ]
    )
    gravel, mud = (expect_numbers(servo, "warthog", terrain).prior for terrain in ("gravel", "mud"))
    assert mud["wheel_servo.tau"] == pytest.approx(gravel["wheel_servo.tau"])
    assert mud["wheel_servo.scrub"][1] > 1.2 * gravel["wheel_servo.scrub"][1]
    (tau,) = (one for one in fit_fleet(servo).numbers if one.parameter == "tau")
    assert (tau.level, tau.because) == ("vehicle", "by its nature the vehicle's")


def test_runs_that_disagree_are_said_to_and_their_mean_is_no_property_of_the_vehicle() -> None:
    limit = {"effect": "body_turn_limit", "parameter": "limit", "unit": "rad/s", "spread": 0.0, "runs": 1}
    apart = fit_one(draw({"asphalt": 1.99, "ice": 0.985}, **limit))
    assert (apart.level, apart.disagreeing) == (None, pytest.approx((0.985, 1.99), abs=0.1))
    assert apart.because.startswith("runs disagree by more than 0.")
    assert "warthog_ice_0 0.9" in apart.because
    near = fit_one(draw({"asphalt": 1.0, "ice": 0.985}, **limit))
    assert (near.level, near.disagreeing) == ("vehicle", ())

    fleet = fit_fleet(draw({"asphalt": 1.99, "ice": 0.985}, **limit))
    assert "1 on which runs disagree" in fleet.summary
    assert "of the vehicle" not in fleet.summary
    (row,) = (line for line in format_fleet(fleet, everything=False) if line.startswith("body_turn_limit"))
    assert row.endswith("runs disagree")
    assert not re.search(r"\b1\.[45]", row), "no mean of what disagrees"


def test_a_number_of_one_run_is_no_property_of_the_vehicle() -> None:
    limit = {"effect": "body_turn_limit", "parameter": "limit", "unit": "rad/s", "runs": 1}
    alone = fit_one(draw({"asphalt": 1.0}, **limit))
    assert alone.level is None
    assert alone.because.startswith("only one run determines it")


def test_poses_that_gyros_have_dated_are_no_body_that_is_late() -> None:
    names = {}
    for in_model in (False, True):
        clock = {"effect": "clock_offset", "parameter": "d", "unit": "s", "in_model": in_model}
        (number,) = fit_fleet(draw({"asphalt": 0.1, "ice": 0.4}, **clock)).numbers
        names[in_model] = (number.name, number.candidates)
    assert names[False] == ("clock_offset", ("clock_offset",))
    assert names[True] == ("body_inertia", ("clock_offset", "body_inertia"))


def fill_slippery(store: Store, *, sibling: float, radius: float = 0.3) -> None:
    """Six runs on ice with half the distance of their wheels, and three on asphalt."""
    for terrain, gain in (("ice", 0.5), ("asphalt", sibling)):
        for i in range(3):
            findings = [("wheel_radius_wrong", "error", radius * gain)] if terrain == "ice" else []
            numbers = [("wheel_radius", "k", gain + 0.01 * i, 0.02)]
            run = Run(name=f"{terrain}_{i}", terrain=terrain, estimates=numbers, findings=findings, gain=gain)
            write_run(store, replace(run, dataset=f"warthog_{terrain}"))


def test_a_data_sheet_is_judged_over_the_runs_of_a_robot(tmp_path: Path) -> None:
    store = Store(tmp_path / "results")
    fill_slippery(store, sibling=0.9)
    model = fit_results(store)
    assert len(model.runs["warthog"]) == 6
    why = "slippery ground and no wrong wheel radius, by other runs of the same vehicle"
    assert f"{why}: ice_0, ice_1 and ice_2" in model.notes
    answer = compare_results(store, Question())
    assert set(answer.datasets["runs"]) == {3}
    assert f"{why}: ice_0, ice_1 and ice_2" in answer.notes


@pytest.mark.parametrize("sibling", [0.6, 1.4, 0.0])
def test_siblings_that_do_not_contradict_it_leave_a_wrong_radius_wrong(
    tmp_path: Path, sibling: float
) -> None:
    """With .6 the radius may be the cause of both, 1.4 is no grip, and with 0 the gain is not known."""
    store = Store(tmp_path / "results")
    fill_slippery(store, sibling=sibling)
    assert len(fit_results(store).runs["warthog"]) == 3
    notes = compare_results(store, Question()).notes
    assert "left out, finding wheel_radius_wrong (3 runs): ice_0, ice_1 and ice_2" in notes


def test_simulated_runs_enter_no_fleet_and_no_trend_of_recordings(results: Store) -> None:
    write_run(
        results,
        Run(name="made", terrain="mud", estimates=[("wheel_radius", "k", 0.1, ERROR)], simulated=True),
    )
    said = "left out, simulated, and never pooled with recordings: made"
    model = fit_results(results)
    assert "made" not in model.runs["warthog"]
    assert said in model.notes
    trend = follow_trend(results, ("vehicle",))
    assert said in trend.notes
    assert not any("made" in key for key in trend.keys)


@pytest.fixture
def results(tmp_path: Path) -> Store:
    """Results of nine runs on three grounds, one of them ice."""
    store = Store(tmp_path / "results")
    for (run, terrain), rows in draw(ICE_AND_OTHERS).partition_by("run", "terrain", as_dict=True).items():
        estimates = [
            (row["effect"], row["parameter"], row["value"], row["standard_error"])
            for row in rows.iter_rows(named=True)
        ]
        write_run(store, Run(name=str(run), terrain=str(terrain), seconds=6.0, estimates=estimates))
    return store


def test_the_verb_writes_the_table_that_it_shows(results: Store) -> None:
    shown = ask_verb("fleet", "show", results.root)
    assert not (results.root / "fleet.parquet").exists()
    written = ask_verb("fleet", "fit", results.root)
    assert written["parameters"] == shown["parameters"]
    table = pl.read_parquet(results.root / "fleet.parquet")
    assert table["terrain"].to_list() == ["*", "asphalt", "gravel", "ice"]
    assert set(shown["parameters"][0]["terrains"]) == {"asphalt", "gravel", "ice"}
    (resolved,) = shown["resolved"]
    assert (resolved["candidates"], resolved["answer"]) == (
        ["wheel_radius", "longitudinal_slip"],
        "longitudinal_slip",
    )
