"""`slip compare` over results: what is said about good and bad input."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from comparison_store import Run, write_run
from store_samples import read_current

from pipeline.datasets.compare import Answer, compare_results
from pipeline.datasets.compared_runs import Question
from pipeline.datasets.equal_driving import Overlap
from pipeline.datasets.pairs import Group, SlipSamples, compare_groups
from pipeline.recording import Finding
from pipeline.report.datasets_page import _draw_levels, write_answer
from pipeline.stages.slip_stage import summarize_inputs
from pipeline.store import Store

TERRAINS = {"asphalt": 0.5, "gravel": 1.0, "ice": 2.0}


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "results")


def fill(store: Store, terrains: dict[str, float], *, runs: int) -> None:
    for terrain, median in terrains.items():
        for i in range(runs):
            name = f"{terrain}_{i}"
            factor = 1.0 + 0.03 * i
            write_run(
                store,
                Run(name=name, dataset=f"warthog_{terrain}", terrain=terrain, median=median * factor),
            )


def ask(store: Store, **asked: object) -> Answer:
    return compare_results(store, Question(**asked))  # type: ignore[arg-type]


def pick(answer: Answer, a: str, b: str) -> dict[str, object]:
    main = answer.take(answer.comparisons, answer.views[0])
    found = main.filter(pl.col("a") == a, pl.col("b") == b)
    return found.row(0, named=True)


def test_five_runs_a_side_tell_terrains_apart(store: Store) -> None:
    fill(store, TERRAINS, runs=5)
    answer = ask(store)
    pair = pick(answer, "warthog_asphalt", "warthog_ice")
    assert pair["unit_of_analysis"] == "runs"
    assert 0.0 < float(str(pair["p"])) < float(str(pair["p_adjusted"])) < 0.001
    assert (
        pair["method"] == "levels of runs with one spread of the logarithm, Tukey and Kramer over 3 datasets"
    )
    assert pair["cliffs_delta"] == 1.0
    assert pair["size"] == "large"
    assert float(str(pair["low"])) < float(str(pair["shift"])) < float(str(pair["high"]))
    rows = answer.datasets.filter(pl.col("input") == "command")
    assert rows["runs"].to_list() == [5, 5, 5]
    assert rows["interval"].to_list() == ["over runs"] * 3
    for row in rows.iter_rows(named=True):
        assert row["low"] < row["median_modulus"] < row["high"]
        assert f"{row['terrain']}_0/k0" in row["keys"]


def test_the_interval_of_a_run_alone_is_that_of_its_analysis(store: Store) -> None:
    fill(store, TERRAINS, runs=1)
    rows = ask(store).datasets
    assert rows.height == 2 * len(TERRAINS)
    for row in rows.iter_rows(named=True):
        tables = [read_current(store, f"{row['terrain']}_0", name) for name in ("aggregates", "slip")]
        told = summarize_inputs(*tables)[row["input"]]
        assert row["interval"] == "this run only"
        assert [round(row[key], 6) for key in ("low", "high")] == [
            told["median_modulus_low"],
            told["median_modulus_high"],
        ]


def test_the_figure_shows_whole_intervals_and_says_of_what_they_are(store: Store) -> None:
    fill(store, {"asphalt": 0.5, "gravel": 1.0}, runs=2)
    write_run(store, Run(name="only", dataset="warthog_ice", terrain="ice", median=2.0))
    answer = ask(store)
    levels = answer.take(answer.levels, answer.views[0])
    said = dict(levels.select("dataset", "interval").iter_rows())
    assert said == {
        "warthog_asphalt": "over runs",
        "warthog_gravel": "over runs",
        "warthog_ice": "one run, spread of the others",
    }
    picture = _draw_levels(answer, answer.views[0])
    assert picture is not None
    spans = picture.drawing.rows[f"{picture.id}_spans"]
    assert spans["low"].to_list() == levels.sort("value")["low"].to_list(), "no end is cut"
    assert spans["high"].to_list() == levels.sort("value")["high"].to_list()
    (low, high) = picture.drawing.chart["layer"][0]["encoding"]["x"]["scale"]["domain"]
    assert low <= spans["low"].min()
    assert spans["high"].max() <= high


def test_equal_runs_are_not_told_apart_where_plain_samples_are(store: Store) -> None:
    for i in range(6):
        write_run(store, Run(name=f"r{i}", dataset=f"d{i}", terrain=f"t{i}", seconds=120.0), seed=3)
    answer = ask(store)
    assert answer.comparisons["p_adjusted"].min() > 0.05  # type: ignore[operator]
    assert (answer.comparisons["p_uncorrected"] < 0.05).sum() >= 5
    assert any("not valid" in note for note in answer.notes)


def test_grave_findings_copies_and_other_scales_are_left_out_and_said(store: Store) -> None:
    fill(store, {"asphalt": 0.5, "ice": 2.0}, runs=4)
    write_run(store, Run(name="air", findings=[("not_moving", "error", 0.01)]))
    write_run(store, Run(name="copy", sha256="ice_0", dataset="warthog_ice", terrain="ice"))
    write_run(store, Run(name="scaled", length=0.5, dataset="warthog_ice", terrain="ice"))
    write_run(store, Run(name="somewhere", terrain="unknown", dataset="warthog_unknown"))
    answer = ask(store)
    told = "\n".join(answer.notes)
    assert "left out, not_moving: air" in told, "in the words of the finding"
    assert "same recording" in told
    assert "left out, its length scale" in told
    assert "not pooled: somewhere" in told
    command = answer.datasets.filter(pl.col("input") == "command")
    assert command["runs"].to_list() == [4, 4]


def test_a_scale_of_commands_that_is_told_and_not_applied_changes_no_comparison(store: Store) -> None:
    for kind in ("of the wheels", "without a unit", "not followed"):
        scale = Finding("command_scale", "warning", "command", {"kind": kind, "value": 2.0})
        write_run(store, Run(name=kind.replace(" ", "_"), noted=[scale], driven=2.0))
    (note,) = (note for note in ask(store).notes if "another scale" in note)
    assert note.endswith(": of_the_wheels, without_a_unit")
    notes = [note for note in ask(store, as_published=True).notes if note.startswith("published chain")]
    assert len(notes) == 3
    assert [note for note in notes if "command scaled by 2.00 forward" not in note] == [
        note for note in notes if "not_followed" in note
    ]


def test_a_damaged_run_costs_itself_only(store: Store) -> None:
    fill(store, {"asphalt": 0.5, "ice": 2.0}, runs=2)
    manifest = write_run(store, Run(name="broken"))
    (manifest.folder.parent / "manifest.json").write_text("{")
    answer = ask(store)
    assert any("left out" in note and "broken" in note for note in answer.notes)
    assert answer.take(answer.comparisons, answer.views[0]).height == 1


def test_measures_of_difficulty_have_their_definition(store: Store) -> None:
    write_run(store, Run(name="one", still=True, median=1.0, seconds=120.0))
    (row,) = ask(store).datasets.filter(pl.col("input") == "command").iter_rows(named=True)
    assert row["slip_energy"] == pytest.approx(0.5 * 470.0)
    assert row["transitory_slip"] == pytest.approx(0.0, abs=1e-9)
    assert row["unpredictability"] < 1.0
    assert 1.0 / 2.3 < row["relative_slip"] < 1.0 / 0.5
    assert row["height_rate"] is None
    # Slip goes 1 m/s sideways and ahead while the vehicle drives at |v|: a path over a path.
    slip = read_current(store, "one", "slip").filter(pl.col("input") == "command")
    turning = (1.08**2 + 0.914**2) / 12.0 * slip["v_w"] ** 2
    driven = (slip["v_x"] ** 2 + slip["v_y"] ** 2 + turning).sqrt()
    assert row["lost_energy"] == pytest.approx(slip.height / driven.sum())
    ideal = (slip["f_x"] ** 2 + slip["f_w"] ** 2).mean() ** 0.5  # type: ignore[operator]
    assert row["relative_unpredictability"] == pytest.approx(row["unpredictability"] / ideal)


def test_what_cannot_be_measured_is_empty_and_lost_energy_takes_no_mass(store: Store) -> None:
    for vehicle in ("a", "b"):
        for terrain in TERRAINS:
            name = f"{vehicle}_{terrain}"
            write_run(store, Run(name=name, dataset=name, vehicle=vehicle, terrain=terrain, mass_kg=None))
    write_run(store, Run(name="weighed", dataset="weighed", terrain="mud"))
    write_run(store, Run(name="of_no_size", dataset="of_no_size", terrain="mud", sized=False))
    write_run(store, Run(name="parked", dataset="parked", terrain="mud", moves=False))
    answer = ask(store)
    write_answer(store, answer)
    written = pl.read_parquet(store.root / "datasets.parquet")
    assert written.height == answer.datasets.height == 2 * 9
    command = {row["dataset"]: row for row in written.rows(named=True) if row["input"] == "command"}
    assert command["a_gravel"]["lost_energy"] > 0.0
    assert command["a_gravel"]["slip_energy"] is None
    assert command["weighed"]["lost_energy"] > 0.0
    assert command["of_no_size"]["lost_energy"] is None
    assert command["parked"]["lost_energy"] is None
    assert command["parked"]["relative_unpredictability"] is None


def test_the_same_question_gets_the_same_bytes(store: Store) -> None:
    fill(store, TERRAINS, runs=2)
    first = {name: path.read_bytes() for name, path in write_answer(store, ask(store)).items()}
    second = {name: path.read_bytes() for name, path in write_answer(store, ask(store)).items()}
    assert first == second


def make_group(name: str, *medians: float) -> Group:
    return Group.of_runs(name, [SlipSamples(np.full(40, one), np.arange(40.0)) for one in medians])


def test_a_ground_with_one_run_is_tested_by_the_spread_of_the_others() -> None:
    groups = [
        make_group("asphalt", 0.5, 0.55, 0.45),
        make_group("gravel", 0.52, 0.57, 0.5),
        make_group("ice", 2.0),
    ]
    pairs = {(one["a"], one["b"]): one for one in compare_groups(groups)}
    ice = pairs["asphalt", "ice"]
    assert (ice["unit_of_analysis"], ice["freedom"]) == ("runs", 4)
    p, low, high = (float(str(ice[key])) for key in ("p_adjusted", "ratio_low", "ratio_high"))
    assert p < 0.01
    assert 1.0 < low < 4.0 < high
    assert float(str(pairs["asphalt", "gravel"]["p_adjusted"])) > 0.5


def test_runs_alone_are_compared_by_their_parts_and_only_with_each_other() -> None:
    rng = np.random.default_rng(0)
    groups = [
        Group.of_runs(name, [SlipSamples(rng.lognormal(level, 0.5, 4_000), np.arange(0.0, 200.0, 0.05))])
        for name, level in (("a", 0.0), ("b", 1.0))
    ]
    (pair,) = compare_groups(groups)
    assert pair["unit_of_analysis"] == "blocks"
    assert float(str(pair["p_adjusted"])) < 0.01
    assert "not between terrains" in str(pair["note"])
    (levels,) = compare_groups([Group(one.name, one.values) for one in groups])
    assert levels["p"] is None, "levels of single runs have no spread"
    assert levels["ratio"] is not None
    assert levels["ratio_low"] is None


def test_without_driving_in_common_there_is_no_number() -> None:
    groups = [make_group(name, 1.0, 1.1) for name in ("a", "b", "c")]
    overlaps = {
        frozenset(names): Overlap(bins, share)
        for names, bins, share in (("ab", 3, 0.5), ("bc", 0, 0.0), ("ac", 1, 0.1))
    }
    pairs = {f"{one['a']}{one['b']}": one for one in compare_groups(groups, overlaps=overlaps)}
    assert (pairs["bc"]["ratio"], pairs["bc"]["p_adjusted"]) == (None, None)
    assert pairs["bc"]["note"] == "no driving in common, no number"
    assert pairs["ab"]["ratio"] is not None
    assert (pairs["ab"]["bins"], pairs["ab"]["overlap"]) == (3, 0.5)


def test_simulated_runs_are_never_pooled_with_recordings(store: Store) -> None:
    for i in range(3):
        write_run(store, Run(name=f"s{i}", simulated=True, median=9.0))
    alone = ask(store)
    assert alone.datasets["runs"].to_list() == [3, 3]
    assert not any("simulated" in note for note in alone.notes)
    for i in range(3):
        write_run(store, Run(name=f"r{i}"))
    mixed = ask(store)
    assert mixed.datasets["runs"].to_list() == [3, 3]
    assert all(row["keys"].split()[0].startswith("r") for row in mixed.datasets.iter_rows(named=True))
    assert "left out, simulated, and never pooled with recordings (3 runs): s0, s1 and s2" in mixed.notes


def test_features_can_be_given_away_and_put_together(store: Store) -> None:
    for number, terrain in enumerate(("gravel", "ice")):
        one = Run(name=f"secret_farm/{number}", dataset=f"warthog_{terrain}", terrain=terrain)
        write_run(store, replace(one, sha256=f"{number}" * 64))
    write_answer(store, ask(store))
    path = store.root / "features.parquet"
    assert b"secret_farm" not in path.read_bytes()
    features = pl.read_parquet(path)
    aggregates = read_current(store, "secret_farm/0", "aggregates").filter(
        pl.col("input") == "command", pl.col("subset") == "all"
    )
    own = features.filter(pl.col("sha256") == "0" * 64, pl.col("input") == "command")
    assert own["median_modulus"].item() == aggregates["median_modulus"].item()
    assert pl.concat([features, features]).unique(["sha256", "input"]).height == features.height == 4
