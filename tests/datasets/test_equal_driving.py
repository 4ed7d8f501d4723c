"""Grounds at equal driving: what the driving did falls away, and what cannot be compared has no number."""

import itertools
import re
import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from comparison_store import Run, write_run
from few import few

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.datasets.compare import AS_DRIVEN, EQUAL_DRIVING, Answer, compare_results
from pipeline.datasets.compared_runs import Question
from pipeline.datasets.equal_driving import find_overlap, level_runs, measure_bins
from pipeline.datasets.levels import fit_levels
from pipeline.report.datasets_page import write_answer
from pipeline.store import Store
from pipeline.words import format_answer, list_answer, summarize_answer

RATE = 20.0
FACTORS = {"command": 1.0, "measured": 0.5}


def make_slip(
    run: str, commands: list[tuple[float, float]], level: float, *, seconds: float = 10.0
) -> pl.DataFrame:
    """A run that drives each command for so long; its slip grows with speed and yaw rate."""
    count = round(seconds * RATE)
    speed, turn = (np.repeat([one[k] for one in commands], count) for k in (0, 1))
    modulus = level * (0.1 + speed) * (0.5 + np.abs(turn))
    t = np.arange(speed.size) / RATE
    parts = [
        pl.DataFrame(
            {
                "run": run, "input": name, "t": t, "f_x": speed, "f_y": 0.0 * t, "f_w": turn,
                "modulus": factor * modulus, "suspect": t < 0.0, "standing": t < 0.0,
            }
        )
        for name, factor in FACTORS.items()
    ]  # fmt: skip
    return pl.concat(parts)


GENTLE = [(0.3, 0.1), (0.7, 0.1), (0.7, 0.5), (1.2, 0.5)]
HARD = [(0.7, 0.5), (1.2, 0.5), (1.2, 1.0), (2.5, 1.0), (2.5, 2.0)]


def level(*runs: pl.DataFrame, name: str = "command") -> dict[str, float]:
    bins = measure_bins(pl.concat(runs).lazy()).filter(input=name)
    return dict(level_runs(bins).runs.select("run", "level").iter_rows())


@pytest.mark.parametrize("name", FACTORS)
def test_gentle_and_hard_driving_of_one_ground_have_one_level(name: str) -> None:
    runs = [make_slip(f"gentle{i}", GENTLE, 1.0) for i in range(2)]
    runs += [make_slip(f"hard{i}", HARD, 1.0) for i in range(2)]
    runs += [make_slip("ice", HARD, 3.0)]
    levels = level(*runs, name=name)
    assert levels["hard0"] == pytest.approx(levels["gentle0"])
    assert levels["ice"] == pytest.approx(3.0 * levels["gentle1"])
    raw = pl.concat(runs).filter(input=name).group_by("run").agg(pl.col("modulus").median())
    medians = dict(raw.iter_rows())
    assert medians["hard0"] > 2.0 * medians["gentle0"]


def test_standing_suspect_and_short_stretches_do_not_count() -> None:
    run = make_slip("a", [(0.0, 0.0), (0.7, 0.5), (2.5, 2.0)], 1.0)
    late = pl.col("t") >= 24.0
    run = run.with_columns(suspect=late)
    bins = measure_bins(run.lazy())
    assert bins.filter(input="command").select("speed", "turn", "samples").rows() == [(1, 1, 200)]
    assert measure_bins(run.filter(input="measured").lazy()).is_empty(), "bins are those of the command"


def test_cells_of_fewer_than_three_runs_and_runs_apart_have_no_level() -> None:
    runs = [make_slip(f"r{i}", GENTLE, 1.0) for i in range(3)]
    runs += [make_slip(f"apart{i}", [(5.0, 0.0)], 1.0) for i in range(2)]
    levelled = level_runs(measure_bins(pl.concat(runs).lazy()).filter(input="command"))
    assert set(levelled.runs["run"]) == {"r0", "r1", "r2"}
    assert levelled.apart == ("apart0", "apart1")
    far = [make_slip(f"far{i}", [(5.0, 0.0), (8.0, 0.0)], 1.0) for i in range(4)]
    levelled = level_runs(measure_bins(pl.concat([*runs, *far]).lazy()).filter(input="command"))
    assert set(levelled.runs["run"]) == {"apart0", "apart1", "far0", "far1", "far2", "far3"}
    assert levelled.apart == ("r0", "r1", "r2"), "of sets without driving in common the larger one is kept"


def test_the_overlap_is_that_of_the_side_with_less() -> None:
    bins = measure_bins(pl.concat([make_slip("a", GENTLE, 1.0), make_slip("b", HARD, 1.0)]).lazy())
    overlap = find_overlap(bins.filter(input="command"), ["a"], ["b"])
    assert overlap.bins == 2
    assert overlap.share == pytest.approx(2 / 5)
    assert find_overlap(bins, ["a"], []).bins == 0


def test_random_halves_of_one_ground_alarm_once_in_twenty() -> None:
    """Runs that differ in their level and in how hard they were driven, split at random."""
    rng = np.random.default_rng(4)
    alarms = {"as driven": 0, "equal": 0}
    draws, splits = 20, 15
    for _ in range(draws):
        runs = []
        for i in range(7):
            drive = [HARD[k] for k in sorted(rng.choice(5, 4, replace=False))]
            runs.append(make_slip(f"r{i}", drive, float(np.exp(rng.normal(0.0, 0.2))), seconds=6.0))
        slip = pl.concat(runs)
        medians = slip.filter(input="command").group_by("run").agg(pl.col("modulus").median()).sort("run")
        for what, values in (
            ("equal", np.array([one for _, one in sorted(level(*runs).items())])),
            ("as driven", medians["modulus"].to_numpy()),
        ):
            for _ in range(splits):
                fit = fit_levels(rng.permutation(np.log(values)), ["a"] * 3 + ["b"] * 4)
                alarms[what] += fit.compare("a", "b").p <= 0.05
    for what, count in alarms.items():
        # Splits of the same runs are not independent: the error is that of the draws, at most.
        assert 0.01 <= count / (draws * splits) <= 0.05 + 2.6 * np.sqrt(0.05 * 0.95 / draws / 5), what


def draw_bins(
    rng: np.random.Generator, cells: list[int], levels: list[float], between: float
) -> pl.DataFrame:
    """Runs with so many of 28 bins each, whose slip scatters by .3 about the levels of run and bin."""
    parts = []
    for run, (count, level) in enumerate(zip(cells, levels, strict=True)):
        chosen = rng.choice(28, count, replace=False)
        logs = level + rng.normal(0.0, between) + 0.1 * chosen + rng.normal(0.0, 0.3, count)
        parts.append(
            pl.DataFrame({"speed": chosen // 4, "turn": chosen % 4, "modulus": np.exp(logs)}).with_columns(
                pl.lit(f"r{run}").alias("run"), pl.lit(300).alias("samples")
            )
        )
    return pl.concat(parts)


@pytest.mark.parametrize("between", few([0.0, 0.2], 2))
def test_a_ground_with_one_run_of_two_cells_alarms_once_in_twenty(between: float) -> None:
    """Its level is known much less than those of others: a spread pooled over runs alarmed in a third."""
    rng, draws = np.random.default_rng(6), 150
    cells, groups = [25, 25, 25, 25, 25, 25, 2], ["a", "a", "a", "b", "b", "b", "c"]
    truth = {"a": 0.0, "b": 0.7, "c": -0.4}
    missed = {"weighed": 0, "alike": 0}
    for _ in range(draws):
        levelled = level_runs(draw_bins(rng, cells, [truth[name] for name in groups], between))
        values = np.log(levelled.runs["level"].to_numpy())
        for what, errors in (("weighed", levelled.errors), ("alike", None)):
            fit = fit_levels(values, groups, errors)
            pairs = [(a, b, fit.compare(a, b, 3)) for a, b in ("ab", "ac", "bc")]
            missed[what] += any(not one.low <= truth[b] - truth[a] <= one.high for a, b, one in pairs)
    assert missed["weighed"] / draws <= 0.05 + 2.6 * np.sqrt(0.05 * 0.95 / draws)
    if not between:
        assert missed["alike"] > 5 * missed["weighed"], "which is what errors of cells are for"


def test_runs_of_few_cells_hide_nothing_that_the_others_tell() -> None:
    """Of three runs of each ground one has three cells: a factor of 1.5 is found nearly always."""
    rng, draws, groups = np.random.default_rng(8), 40, ["a"] * 3 + ["b"] * 3 + ["c"] * 3
    found = {"weighed": 0, "alike": 0}
    for _ in range(draws):
        bins = draw_bins(rng, [25, 25, 3, 25, 25, 3, 25, 25, 3], [0.0] * 3 + [0.1] * 3 + [0.4] * 3, 0.02)
        levelled = level_runs(bins)
        for what, errors in (("weighed", levelled.errors), ("alike", None)):
            fit = fit_levels(np.log(levelled.runs["level"].to_numpy()), groups, errors)
            found[what] += fit.compare("a", "c", 3).p_adjusted <= 0.05
    assert found["weighed"] >= 0.9 * draws
    assert found["alike"] < found["weighed"]


@pytest.fixture
def answer(tmp_path: Path) -> Answer:
    """Ice slips three times as much as gravel, and asphalt as much: it was driven gently."""
    store = Store(tmp_path / "results")
    for i in range(3):
        for terrain, median in (("asphalt", 0.5), ("gravel", 0.5), ("ice", 1.5)):
            run = Run(
                name=f"{terrain}_{i}", dataset=f"warthog_{terrain}", terrain=terrain, seconds=300.0,
                median=median * (1.0 + 0.03 * i),
            )  # fmt: skip
            write_run(store, run, seed=i)
        write_run(
            store,
            Run(name=f"husky_{i}", dataset="husky_tile", vehicle="husky", terrain="tile", seconds=300.0),
        )
    return compare_results(store, Question())


def test_both_questions_are_answered_on_both_inputs_within_a_vehicle(answer: Answer) -> None:
    rows = list_answer(answer)
    kinds = ("as driven", "at equal driving", "ground alone", "ground alone, as driven")
    assert [(row.of, row.driving) for row in rows] == [
        (f"{vehicle}, from commands", kind) for vehicle in ("husky", "warthog") for kind in kinds
    ]
    assert [row.input for row in rows] == ["command", "command", "measured", "measured"] * 2
    texts = {(row.of, row.driving): row.text for row in rows}
    assert texts["husky, from commands", "as driven"].endswith(" m/s")
    assert texts["warthog, from commands", "as driven"].startswith("warthog_ice (1.5 m/s) hardest, ")
    assert texts["warthog, from commands", "as driven"].endswith("; 2 of 3 pairs significant")
    assert texts["warthog, from commands", "at equal driving"].startswith("warthog_ice 3.")
    assert set(answer.views) == {(name, kind) for name in FACTORS for kind in (AS_DRIVEN, EQUAL_DRIVING)}
    pairs = answer.take(answer.comparisons, ("command", EQUAL_DRIVING))
    names = [f"warthog_{name}" for name in ("asphalt", "gravel", "ice")]
    assert set(pairs.select("a", "b").rows()) == set(itertools.combinations(names, 2)), "of one vehicle"
    sure = pairs.filter(pl.col("p_adjusted") <= 0.05)
    assert set(sure["b"]) == {"warthog_ice"}
    assert sure.height == 2


def test_the_answer_is_one_table_on_the_screen_in_json_and_on_the_page(
    answer: Answer, tmp_path: Path
) -> None:
    written = write_answer(Store(tmp_path / "pages"), answer)
    page = written["comparison.html"].read_text(encoding="utf-8")
    content = summarize_answer(answer)["answer"]
    screen = [" ".join(line.split()) for line in format_answer(answer, everything=True)]
    rows = list_answer(answer)
    assert content == [asdict(row) for row in rows]
    for row in rows:
        assert f"{row.driving} {row.text}" in screen
        cells = (f"<td[^>]*>{re.escape(text)}</td>" for text in (row.driving, row.text))
        assert re.search(f"{re.escape(row.of)}</th>{''.join(cells)}", page)
    # In short, the screen has of the other input what everybody asks: the ground alone.
    short = [" ".join(line.split()) for line in format_answer(answer, everything=False)]
    kinds = [row.driving for row in rows if f"{row.driving} {row.text}" in short]
    assert kinds == ["as driven", "at equal driving", "ground alone"] * 2


def test_a_pair_has_one_driving_in_common_whichever_call_asks(tmp_path: Path) -> None:
    store = Store(tmp_path / "results")
    for i, terrain in enumerate(("asphalt", "gravel", "asphalt", "gravel", "ice", "ice", "ice")):
        run = Run(name=f"{terrain}_{i}", dataset=f"warthog_{terrain}", terrain=terrain, seconds=60.0)
        write_run(store, run, seed=i)

    def find_common(*datasets: str) -> tuple[object, ...]:
        found = compare_results(store, Question(datasets=datasets))
        rows = found.take(found.comparisons, ("command", EQUAL_DRIVING))
        return rows.filter(a="warthog_asphalt", b="warthog_gravel").select("bins", "overlap").row(0)

    assert find_common("warthog_asphalt", "warthog_gravel") == find_common()


def test_the_levels_stand_in_the_table_of_datasets(answer: Answer) -> None:
    rows = {(row["dataset"], row["input"]): row for row in answer.datasets.iter_rows(named=True)}
    for name in FACTORS:
        ice, gravel = (rows[f"warthog_{terrain}", name] for terrain in ("ice", "gravel"))
        assert ice["equal_modulus"] / gravel["equal_modulus"] == pytest.approx(3.0, rel=0.25)
        assert ice["equal_low"] < ice["equal_modulus"] < ice["equal_high"]


@pytest.mark.long
def test_runs_of_one_ground_agree_better_at_equal_driving_on_recordings(
    shared_logs: Path, recorded_results: Path, tmp_path: Path
) -> None:
    store = Store(tmp_path)
    for log in sorted(shared_logs.glob("warthog_*.mcap")):
        run = analyze_log(log, Options(out=recorded_results, report=False)).manifest.folder.parent
        shutil.copytree(run, store.root / run.relative_to(recorded_results), symlinks=True)
    answer = compare_results(store, Question(vehicle="warthog"))
    views = {
        view: (answer.take(answer.levels, view), answer.take(answer.comparisons, view))
        for view in answer.views
    }
    for name, ratio in (("command", 0.4), ("measured", 0.6)):
        (_, driven), (levels, equal) = (views[name, kind] for kind in (AS_DRIVEN, EQUAL_DRIVING))
        assert equal["spread"][0] < ratio * driven["spread"][0]
        assert levels.sort("value")["dataset"][-1] == "warthog_ice"
    order = levels.sort("value", descending=True)["dataset"].to_list()
    assert order == [f"warthog_{ground}" for ground in ("ice", "sand", "gravel", "asphalt", "grass")]
    grass = driven.filter(pl.col("a") == "warthog_grass", pl.col("b") == "warthog_ice")
    assert grass["p_adjusted"].item() <= 0.05, "driven gently, grass looks easier"
