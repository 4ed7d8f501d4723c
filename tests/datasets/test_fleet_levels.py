"""Numbers of a fleet by level: the vehicle's, the ground's, a run's own, or open."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from comparison_store import Run, write_run
from verbs import run_slip

from pipeline.batch.batch_plan import refresh_pools
from pipeline.datasets.compare import compare_results
from pipeline.datasets.compared_runs import Question
from pipeline.datasets.forecast import FleetNumber, fit_fleet
from pipeline.datasets.prediction import fit_results
from pipeline.datasets.trend import follow_trend
from pipeline.models.parameter import Level
from pipeline.store import Store

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
    assert (number.level, number.name) == (Level.VEHICLE, "wheel_radius")
    assert number.fit.interval is not None
    assert number.fit.interval.low < 0.9 < number.fit.interval.high
    assert "3 terrains not shown to differ by more than runs do" in number.because


def test_wheels_that_slip_on_ice_are_not_small() -> None:
    number = fit_one(draw(ICE_AND_OTHERS))
    assert (number.level, number.name) == (Level.TERRAIN, "longitudinal_slip")
    assert number.fit.groups["ice"].value == pytest.approx(0.7, abs=0.05)
    assert "ice 0.7" in number.because


@pytest.mark.parametrize("seed", range(8))
def test_radius_is_never_named_for_slip_where_two_terrains_are_there(seed: int) -> None:
    for runs in (1, 2, 3):
        number = fit_one(draw({"asphalt": 1.0, "ice": 0.7}, runs=runs, seed=seed))
        assert number.level in {Level.TERRAIN, None}
        assert number.name in {"longitudinal_slip", "wheel_radius or longitudinal_slip"}


def test_what_comes_and_goes_is_the_runs_own() -> None:
    number = fit_one(
        draw(
            dict.fromkeys(ICE_AND_OTHERS, 0.0), effect="yaw_misalignment", parameter="psi", spread=0.2, runs=5
        )
    )
    assert number.level is Level.RUN
    assert number.fit.spread_run == pytest.approx(0.2, rel=0.5)


def test_one_terrain_leaves_it_open_and_says_what_would_tell() -> None:
    number = fit_one(draw({"ice": 0.7}))
    assert number.level is None
    assert number.name == "wheel_radius or longitudinal_slip"
    expected = "only runs on ice determine it: runs on another terrain separate vehicle and terrain"
    assert number.because == expected


def test_a_damaged_run_is_told_apart_and_leaves_the_others_as_they_are() -> None:
    rows = draw(ALIKE, runs=4)
    damaged = rows["run"][2]
    hurt = rows.with_columns(pl.when(pl.col("run") == damaged).then(0.5).otherwise("value").alias("value"))
    number = fit_one(hurt)
    assert number.odd == (damaged,)
    assert damaged not in number.runs
    assert number.level is Level.VEHICLE
    assert number.fit.value == pytest.approx(0.9, abs=0.02)
    assert fit_one(rows).odd == ()


def test_only_what_is_named_counts_and_of_the_runs_whose_model_holds_it() -> None:
    elsewhere = {"asphalt": 1.0, "gravel": 1.0}
    quiet = draw(elsewhere, named=False)
    assert fit_fleet(quiet).numbers == ()
    number = fit_one(pl.concat([quiet, draw({"ice": 0.7})]))
    assert (number.named, len(number.runs)) == (3, 3)
    assert number.level is None
    assert number.because.endswith("; not in the models of 6 other runs")
    held = fit_one(pl.concat([draw(elsewhere, named=False, in_model=True), draw({"ice": 0.7})]))
    assert (held.named, len(held.runs), held.name) == (3, 9, "longitudinal_slip")


def test_an_interval_of_a_fleet_takes_three_runs() -> None:
    for runs, known in ((1, False), (2, False), (3, True)):
        number = fit_one(draw({"ice": 0.7}, runs=runs))
        assert (number.fit.interval is not None) == known
        assert (number.fit.groups["ice"].interval is not None) == known
    mixed = fit_one(pl.concat([draw(ALIKE), draw({"mud": 0.7}, runs=2)]))
    assert mixed.fit.groups["mud"].interval is None
    assert mixed.fit.groups["ice"].interval is not None


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
    model, _ = fit_results(store)
    assert len(model.runs["warthog"]) == 6
    said = "slippery ground and no wrong wheel radius, by other runs of the same vehicle: ice_0, ice_1, ice_2"
    assert said in model.notes
    answer = compare_results(store, Question())
    assert set(answer.datasets["runs"]) == {3}
    assert said in answer.notes


@pytest.mark.parametrize("sibling", [0.6, 1.4, 0.0])
def test_siblings_that_do_not_contradict_it_leave_a_wrong_radius_wrong(
    tmp_path: Path, sibling: float
) -> None:
    """With .6 the radius may be the cause of both, 1.4 is no grip, and with 0 the gain is not known."""
    store = Store(tmp_path / "results")
    fill_slippery(store, sibling=sibling)
    assert len(fit_results(store)[0].runs["warthog"]) == 3
    notes = compare_results(store, Question()).notes
    assert "left out, finding wheel_radius_wrong (3 runs): ice_0, ice_1, ice_2" in notes


def test_simulated_runs_enter_no_fleet_and_no_trend_of_recordings(results: Store) -> None:
    write_run(
        results,
        Run(name="made", terrain="mud", estimates=[("wheel_radius", "k", 0.1, ERROR)], simulated=True),
    )
    said = "left out, simulated, and never pooled with recordings: made"
    model, _ = fit_results(results)
    assert "made" not in model.runs["warthog"]
    assert said in model.notes
    trend = follow_trend(results, ("vehicle",), threshold=0.05, limits={})
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


def test_a_batch_keeps_a_fleet_that_was_fitted_up_to_date(
    results: Store,
) -> None:
    refresh_pools(results)
    assert not (results.root / "fleet.json").exists()
    run_slip("fleet", "fit", str(results.root))
    write_run(
        results, Run(name="new", terrain="mud", seconds=6.0, estimates=[("wheel_radius", "k", 0.9, ERROR)])
    )
    refresh_pools(results)
    shown = json.loads(run_slip("fleet", "show", str(results.root), "--json")[1])
    assert "mud" in shown["parameters"][0]["terrains"]
    assert not any("have changed since" in note for note in shown["notes"])
