"""`slip compare` over results: what is said about good and bad input."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from comparison_store import Run, write_run

from pipeline.cli import main
from pipeline.fleet import ComparisonError
from pipeline.fleet.pairs import Answer, Group, Samples, compare_groups, compare_orders, count_pairs
from pipeline.job import JobError
from pipeline.job.compare import Question, compare_results, summarize_answer, write_answer
from pipeline.report import label_names
from pipeline.report.comparison_page import list_pictures
from pipeline.report.scene import format_ends
from pipeline.store import Store, StoreError
from schemas import list_contracts
from schemas.run_tables import Slip

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
    found = answer.comparisons.filter(pl.col("a") == a, pl.col("b") == b)
    return found.row(0, named=True)


def test_four_runs_a_side_tell_terrains_apart(store: Store) -> None:
    fill(store, TERRAINS, runs=4)
    answer = ask(store)
    pair = pick(answer, "warthog_asphalt", "warthog_ice")
    assert pair["unit_of_analysis"] == "runs"
    assert pair["p"] == pytest.approx(2 / 70)
    assert pair["p_adjusted"] == pytest.approx(2 / 70)
    assert pair["smallest_p"] == pytest.approx(2 / 70)
    assert "exact permutation of whole runs, max-T over 3 pairs" in str(pair["method"])
    assert pair["cliffs_delta"] == 1.0
    assert pair["size"] == "large"
    assert float(str(pair["low"])) < float(str(pair["shift"])) < float(str(pair["high"]))
    rows = answer.datasets.filter(pl.col("input") == "command")
    assert rows["runs"].to_list() == [4, 4, 4]
    assert rows["interval"].to_list() == ["over runs"] * 3
    for row in rows.iter_rows(named=True):
        assert row["low"] < row["median_modulus"] < row["high"]
        assert f"{row['terrain']}_0/k0" in row["keys"]


def test_three_runs_a_side_are_told_what_would_do(store: Store) -> None:
    fill(store, {"asphalt": 0.5, "ice": 2.0}, runs=3)
    answer = ask(store)
    pair = pick(answer, "warthog_asphalt", "warthog_ice")
    assert pair["smallest_p"] == pytest.approx(0.1)
    assert pair["note"] == "cannot be significant with 3 runs per side; 4 per side are needed"
    told = (
        "warthog_asphalt and warthog_ice: cannot be significant with 3 runs per side; 4 per side are needed"
    )
    assert told in answer.notes
    assert count_pairs(answer.comparisons.to_dicts()) == "The pair of datasets has too few runs for a test."


def test_one_run_a_side_is_labelled_run_against_run(store: Store) -> None:
    fill(store, {"asphalt": 0.5, "ice": 2.0}, runs=1)
    answer = ask(store)
    pair = pick(answer, "warthog_asphalt", "warthog_ice")
    assert pair["unit_of_analysis"] == "blocks"
    assert "a difference between two runs, not between terrains" in str(pair["note"])
    assert answer.datasets.filter(pl.col("input") == "command")["interval"].to_list() == ["this run only"] * 2


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


def test_tables_of_another_contract_are_left_out_and_said(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Slip, "VERSION", 999)
    list_contracts.cache_clear()
    write_run(store, Run(name="future", dataset="warthog_ice", terrain="ice"))
    monkeypatch.undo()
    list_contracts.cache_clear()
    fill(store, {"asphalt": 0.5, "gravel": 1.0}, runs=2)
    answer = ask(store)
    assert any("contract version 999" in note for note in answer.notes)
    assert answer.datasets["dataset"].unique().sort().to_list() == ["warthog_asphalt", "warthog_gravel"]


def test_a_side_that_does_not_vary_is_said_and_compared(store: Store) -> None:
    write_run(store, Run(name="flat", dataset="flat", terrain="a", still=True))
    write_run(store, Run(name="live", dataset="live", terrain="b"))
    pair = pick(ask(store), "flat", "live")
    assert "one side has no variation" in str(pair["note"])


def test_a_damaged_run_costs_itself_only(store: Store) -> None:
    fill(store, {"asphalt": 0.5, "ice": 2.0}, runs=2)
    manifest = write_run(store, Run(name="broken"))
    (manifest.folder.parent / "manifest.json").write_text("{")
    answer = ask(store)
    assert any("left out" in note and "broken" in note for note in answer.notes)
    assert answer.comparisons.height == 1


def test_a_command_that_is_scaled_wrongly_is_said(store: Store) -> None:
    fill(store, {"asphalt": 0.5}, runs=1)
    write_run(
        store, Run(name="snow", dataset="snow", terrain="s", findings=[("command_scale", "warning", 1.8)])
    )
    assert any("another scale" in note and "snow" in note for note in ask(store).notes)
    assert not any("another scale" in note for note in ask(store, input="measured").notes)


def test_groups_may_be_any_labels(store: Store) -> None:
    fill(store, TERRAINS, runs=2)
    assert ask(store, by=("vehicle",)).datasets["dataset"].unique().to_list() == ["warthog"]
    assert ask(store, by=("vehicle", "terrain")).comparisons["a"][0] == "warthog / asphalt"
    assert ask(store, by=("run",)).comparisons.height == 15
    with pytest.raises(ComparisonError, match="cannot be grouped by colour"):
        ask(store, by=("colour",))


def test_nothing_to_compare_is_one_clear_line(store: Store) -> None:
    with pytest.raises(StoreError, match="there is no such folder") as caught:
        ask(store)
    assert caught.value.code == "no_results"
    store.root.mkdir()
    with pytest.raises(JobError, match="no run whose numbers can be compared"):
        ask(store)


def test_measures_of_difficulty_have_their_definition(store: Store) -> None:
    write_run(store, Run(name="one", still=True, median=1.0, seconds=120.0))
    (row,) = ask(store).datasets.filter(pl.col("input") == "command").iter_rows(named=True)
    assert row["slip_energy"] == pytest.approx(0.5 * 470.0)
    assert row["transitory_slip"] == pytest.approx(0.0, abs=1e-9)
    assert row["unpredictability"] < 1.0
    assert 1.0 / 2.3 < row["relative_slip"] < 1.0 / 0.5
    assert row["height_rate"] is None
    # Slip goes 1 m/s sideways and ahead while the vehicle drives at |v|: a path over a path.
    slip = store.read("one", "slip").filter(pl.col("input") == "command")
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
    found = compare_orders(answer.datasets.filter(input="command"))
    orders = {one.measure: one for one in found if (one.a, one.b) == ("a", "b")}
    assert orders["energy"].tau is not None


def test_vehicles_agree_on_the_order_of_grounds_or_there_are_too_few(store: Store) -> None:
    for vehicle, scale in (("warthog", 1.0), ("husky_a200", 0.2)):
        for place, terrain in enumerate(("asphalt", "gravel", "grass", "sand", "ice")):
            name = f"{vehicle}_{terrain}"
            made = Run(name=name, dataset=name, vehicle=vehicle, terrain=terrain, median=scale * 2.0**place)
            write_run(store, made, seed=place)
    orders = {
        one.measure: one for one in compare_orders(ask(store).datasets.filter(pl.col("input") == "command"))
    }
    assert orders["slip"].tau == pytest.approx(1.0)
    assert orders["slip"].p == pytest.approx(2 / 120)
    assert orders["slip"].terrains[0] == "asphalt"
    few = ask(store).datasets.filter(pl.col("terrain").is_in(["asphalt", "ice"]))
    assert (
        "too few terrains for significance"
        in compare_orders(few.filter(pl.col("input") == "command"))[0].text
    )
    one = few.filter(pl.col("dataset").is_in(["warthog_ice", "husky_a200_asphalt"]))
    assert (
        compare_orders(one)[0].text
        == "husky_a200 and warthog have no terrain in common: no order of terrains to compare"
    )


def test_files_and_json_keep_their_promises(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    fill(store, TERRAINS, runs=2)
    answer = ask(store)
    written = write_answer(store, answer, "svg")
    page = written["comparison.html"].read_text(encoding="utf-8")
    assert "http://" not in page.split("<script>")[0]
    assert "Median over runs" in page
    assert "warthog_ice" in page
    assert written["run_medians_by_dataset.svg"].stat().st_size > 1000
    table = pl.read_parquet(store.root / "comparisons.parquet")
    assert table["keys"].str.contains("ice_0/k0").any()
    assert (store.root / "datasets.tex").read_text().startswith("\\begin{tabular}")
    promised = summarize_answer(answer)
    assert {"datasets", "pairs", "notes"} <= set(promised)
    pair = promised["pairs"][0]  # type: ignore[index]
    assert {
        "a", "b", "shift", "low", "high", "cliffs_delta", "p", "p_adjusted", "smallest_p", "method",
        "unit_of_analysis", "p_uncorrected",
    } <= set(pair)  # fmt: skip
    with pytest.raises(SystemExit) as ended:
        main(["compare", str(store.root), "--json"])
    assert ended.value.code == 0
    spoken = json.loads(capsys.readouterr().out)
    assert {
        "dataset", "vehicle", "terrain", "runs", "samples", "median_modulus", "low", "high",
        "median_window_norm",
    } <= set(spoken["datasets"][0])  # fmt: skip


def test_the_same_question_gets_the_same_bytes(store: Store) -> None:
    fill(store, TERRAINS, runs=2)
    first = {name: path.read_bytes() for name, path in write_answer(store, ask(store)).items()}
    second = {name: path.read_bytes() for name, path in write_answer(store, ask(store)).items()}
    assert first == second


def test_more_groups_than_closed_testing_takes_are_corrected_after_holm(store: Store) -> None:
    fill(store, {f"terrain{i}": 1.0 for i in range(9)}, runs=2)
    (row, *_) = ask(store).comparisons.iter_rows(named=True)
    assert row["method"] == "exact permutation of whole runs", "no pair counts"
    assert row["note"] == "cannot be significant with 2 runs per side; 7 per side are needed"


@pytest.mark.parametrize("others", [6, 7])
def test_pairs_with_too_few_runs_take_nothing_from_those_with_enough(others: int) -> None:
    """By closed testing of eight groups, and after Holm for nine."""
    rng = np.random.default_rng(0)
    ticks = np.arange(40)

    def make(level: float) -> Samples:
        median = level * float(np.exp(rng.normal(0.0, 0.3)))
        return Samples(np.full(40, median), ticks, np.zeros_like(ticks), 40.0)

    many = [Group(name, tuple(make(level) for _ in range(7))) for name, level in (("a", 0.5), ("b", 0.9))]
    few = [Group(f"few{i}", (make(10.0 ** (i % 3 - 1)),)) for i in range(others)]
    pairs = compare_groups([*many, *few])
    (pair,) = (one for one in pairs if {one.a.name, one.b.name} == {"a", "b"})
    assert pair.p_adjusted == pair.comparison.test.p < 0.05
    hopeless = [one for one in pairs if one.unit == "runs" and one is not pair]
    assert len(hopeless) == 2 * others
    assert all(one.p_adjusted > 0.05 and "cannot be significant" in one.note for one in hopeless)


def test_what_differs_in_vehicle_and_terrain_is_tested_where_it_is_named(
    store: Store, capsys: pytest.CaptureFixture[str]
) -> None:
    fill(store, {"asphalt": 0.5, "ice": 2.0}, runs=4)
    for i in range(4):
        write_run(store, Run(name=f"husky_{i}", dataset="husky_ice", vehicle="husky_a200", terrain="ice"))
        write_run(store, Run(name=f"mud_{i}", dataset="husky_mud", vehicle="husky_a200", terrain="mud"))
    answer = ask(store)
    found = {frozenset((row["a"], row["b"])) for row in answer.comparisons.iter_rows(named=True)}
    assert found == {
        frozenset(pair)
        for pair in (
            ("warthog_asphalt", "warthog_ice"), ("husky_ice", "husky_mud"), ("husky_ice", "warthog_ice"),
        )
    }  # fmt: skip
    (note,) = (note for note in answer.notes if "vehicle" in note)
    assert note == (
        "3 pairs of datasets with neither vehicle nor terrain in common: no test, unless named, as in: "
        "slip compare husky_ice warthog_asphalt"
    )
    root = str(store.root)
    named = json.loads(run(capsys, "husky_mud", "warthog_asphalt", "--results", root, "--json"))
    (pair,) = named["pairs"]
    assert {pair["a"], pair["b"]} == {"husky_mud", "warthog_asphalt"}
    assert {row["dataset"] for row in named["datasets"]} == {"husky_mud", "warthog_asphalt"}
    assert not any("vehicle" in note for note in named["notes"])
    own = json.loads(run(capsys, root, "--vehicle", "husky_a200", "--json"))
    assert [row["vehicle"] for row in own["datasets"]] == ["husky_a200"] * 2
    before = json.loads(run(capsys, root, "husky_ice", "husky_mud", "--json"))
    assert before["pairs"] == own["pairs"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("warthog_ice", "warthog_icy"), "no dataset is called warthog_icy. Did you mean warthog_ice"),
        (("warthog_ice", "warthog_ice"), "warthog_ice is one dataset"),
        (("--vehicle", "warthogg"), "no run is of warthogg. Did you mean warthog?"),
    ],
)
def test_a_name_that_no_run_has_is_said_in_one_line(
    store: Store, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], words: str
) -> None:
    fill(store, {"asphalt": 0.5, "ice": 2.0}, runs=1)
    with pytest.raises(SystemExit) as ended:
        main(["compare", *arguments, "--results", str(store.root)])
    error = capsys.readouterr().err
    assert ended.value.code == 1
    assert words in error
    assert error.count("\n") == 1


def test_an_interval_takes_three_runs(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    for terrain, runs in (("asphalt", 1), ("gravel", 2), ("ice", 3)):
        fill(store, {terrain: 0.5}, runs=runs)
    rows = {row["dataset"]: row for row in json.loads(run(capsys, str(store.root), "--json"))["datasets"]}
    assert rows["warthog_gravel"]["low"] is rows["warthog_gravel"]["high"] is None
    assert rows["warthog_gravel"]["interval"] == ""
    assert rows["warthog_ice"]["low"] < rows["warthog_ice"]["median_modulus"] < rows["warthog_ice"]["high"]
    assert rows["warthog_asphalt"]["interval"] == "this run only"
    (line,) = (line for line in run(capsys, str(store.root)).splitlines() if "warthog_gravel  " in line)
    assert line.split()[3] == "-"


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
    assert "left out, simulated, and never pooled with recordings (3 runs): s0, s1, s2" in mixed.notes


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What `slip compare` prints."""
    with pytest.raises(SystemExit) as ended:
        main(["compare", *arguments])
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_many_single_runs_say_that_they_are_too_many() -> None:
    rng = np.random.default_rng(1)
    ticks = np.arange(1200)
    groups = [
        Group(f"r{i}", (Samples(rng.uniform(0.5, 1.5, 1200), ticks, np.zeros_like(ticks), 40.0),))
        for i in range(21)
    ]
    pairs = compare_groups(groups)
    assert len(pairs) == 210
    assert all("cannot be significant among 210 pairs" in pair.note for pair in pairs)


def test_runs_without_wheels_have_no_published_number_and_that_is_said(store: Store) -> None:
    for terrain in ("ice", "sand"):
        write_run(store, Run(name=terrain, dataset=f"d_{terrain}", terrain=terrain, wheels=False))
    answer = ask(store, as_published=True)
    assert any("ice, sand not compared: no published norm" in note for note in answer.notes)
    assert answer.comparisons.is_empty()
    assert "comparison.html" in write_answer(store, answer)


def test_pages_and_terminal_count_pairs_alike(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    def row(p: float, smallest: float, unit: str = "runs") -> dict[str, object]:
        return {"p_adjusted": p, "smallest_p": smallest, "unit_of_analysis": unit}

    rows = [row(0.3, 0.02), *[row(0.3, 0.1)] * 3, *[row(0.01, 0.01, "blocks")] * 2]
    assert count_pairs(rows) == (
        "Of 6 pairs of datasets, none differs significantly, 2 differ, but as two single runs only, "
        "1 shows no significant difference, 3 have too few runs for a test."
    )
    assert count_pairs([*rows, row(0.01, 0.01)]).startswith(
        "Of 7 pairs of datasets, 1 differs significantly, 2"
    )

    fill(store, TERRAINS, runs=2)
    with pytest.raises(SystemExit):
        main(["compare", str(store.root)])
    shown = capsys.readouterr().out
    counted = count_pairs(ask(store).comparisons.to_dicts())
    assert counted in shown
    assert counted in (store.root / "comparison.html").read_text("utf-8")
    # Only the files have the plain test, which is not valid.
    assert "p_uncorrected" not in shown
    assert not re.search(
        "plain p|not valid|p_uncorrected", (store.root / "comparison.html").read_text("utf-8")
    )
    assert "p_uncorrected" in (store.root / "comparisons.csv").read_text("utf-8")


def test_runs_with_long_names_have_different_labels(store: Store) -> None:
    start = "logs/warthog_wheels_of_the_second_robot_on_"
    names = [
        f"{start}{ground}_2024_8_7_11h30s{second}" for ground in ("gravel", "ice") for second in (30, 31)
    ]
    for number, name in enumerate(names):
        write_run(store, Run(name=name, median=1.0 + number, seconds=30.0))
    for picture in list_pictures(compare_results(store, Question(by=("run",)))):
        rows = next(rows for rows in picture.drawing.rows.values() if "label" in rows.columns)
        labels = rows["label"].to_list()
        assert len(set(labels)) == len(names)
        assert all(label.startswith("warthog_wheels") and label[-2:] in {"30", "31"} for label in labels)


@pytest.mark.parametrize(
    ("names", "labels"),
    [
        (["husky_tile", "warthog_ice"], ["husky_tile", "warthog_ice"]),
        (["husky / tile", "husky / ice"], ["husky / tile", "husky / ice"]),
        (["logs/a", "logs/ab"], ["a", "ab"]),
        (["logs/a", "field/a"], ["logs/a", "field/a"]),
        (["logs/a"], ["a"]),
        ([], []),
        (["x" * 30 + "1" + "y" * 30, "x" * 30 + "2" + "y" * 30], None),
    ],
)
def test_labels_of_an_axis_are_short_and_differ(names: list[str], labels: list[str] | None) -> None:
    made = list(label_names(names).values())
    assert labels is None or made == labels
    assert len(set(made)) == len(names)


def test_an_end_that_rounds_to_zero_has_no_sign() -> None:
    assert format_ends({"low": -0.0003, "high": 1.01}) == "0.000 to 1.01"
