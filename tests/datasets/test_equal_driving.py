"""Grounds at equal driving: what the driving did falls away, and what cannot be compared has no number."""

import shutil
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from comparison_store import Run, make_budget, write_run

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.datasets.compare import compare_results
from pipeline.datasets.compared_runs import Question
from pipeline.datasets.equal_driving import find_overlap, level_runs, measure_bins
from pipeline.datasets.pairs import Answer
from pipeline.datasets.pooled_tests import compare_means
from pipeline.store import Store
from pipeline.words.comparison import list_lines, list_pairs

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
                "modulus": factor * modulus, "suspect": t < 0.0,
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
                a, b = np.split(rng.permutation(np.log(values)), [3])
                alarms[what] += compare_means([a, b], [(0, 1)]).differences[0].p_adjusted <= 0.05
    for what, count in alarms.items():
        # Splits of the same runs are not independent: the error is that of the draws, at most.
        assert 0.01 <= count / (draws * splits) <= 0.05 + 2.6 * np.sqrt(0.05 * 0.95 / draws / 5), what


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
    lines = list_lines(answer)
    kinds = ("as driven", "at equal driving", "the difference")
    assert [(line.family, line.input, line.driving) for line in lines] == [
        *(("husky", name, "as driven") for name in FACTORS),
        *(("warthog", name, kind) for name in FACTORS for kind in kinds),
    ]
    assert lines[0].text.endswith(" m/s")
    assert lines[2].text.startswith("ice (1.5 m/s) hardest, ")
    assert "; 2 of 3 pairs significant" in lines[2].text
    assert lines[3].text.startswith("ice 3.")
    assert {(view.input, view.quantity) for view in answer.views} == {
        (name, quantity) for name in FACTORS for quantity in ("median_modulus", "equal_modulus")
    }
    pairs = list_pairs(answer, "command")
    assert [one.is_equal_sure for one in pairs] == [True, True, False]
    assert {one.hard for one in pairs[:2]} == {"warthog_ice"}
    assert {frozenset((one.hard, one.easy)) for one in pairs} == {
        frozenset(f"warthog_{name}" for name in names)
        for names in (("asphalt", "gravel"), ("asphalt", "ice"), ("gravel", "ice"))
    }, "no pair of two vehicles"


def test_the_effect_that_carries_a_difference_is_named_with_and_without_estimates(tmp_path: Path) -> None:
    store = Store(tmp_path / "results")
    for i in range(2):
        for terrain, skid in (("gravel", 0.1), ("ice", 2.1)):
            budget = make_budget({"effective_track": 0.3, "lateral_skid": skid, "disturbance": 0.1})
            dataset = f"warthog_{terrain}"
            write_run(
                store, Run(name=f"{terrain}_{i}", dataset=dataset, terrain=terrain, budget=budget), seed=i
            )
    (pair,) = list_pairs(compare_results(store, Question()), "measured")
    # sqrt(2.5) - sqrt(0.5) = 0.87 m/s, and skid is all of it.
    assert pair.carrier == "lateral skid +0.87 m/s"
    assert list_pairs(compare_results(store, Question()), "command")[0].carrier == ""


def test_the_levels_stand_in_the_table_of_datasets(answer: Answer) -> None:
    rows = {(row["dataset"], row["input"]): row for row in answer.datasets.iter_rows(named=True)}
    for name in FACTORS:
        ice, gravel = (rows[f"warthog_{terrain}", name] for terrain in ("ice", "gravel"))
        assert ice["equal_modulus"] / gravel["equal_modulus"] == pytest.approx(3.0, rel=0.25)
        assert ice["equal_low"] < ice["equal_modulus"] < ice["equal_high"]


def test_runs_of_one_ground_agree_better_at_equal_driving_on_recordings(
    shared_logs: Path, recorded_results: Path, tmp_path: Path
) -> None:
    store = Store(tmp_path)
    for log in sorted(shared_logs.glob("warthog_*.mcap")):
        run = analyze_log(log, Options(out=recorded_results, report=False)).manifest.folder.parent
        shutil.copytree(run, store.root / run.relative_to(recorded_results), symlinks=True)
    answer = compare_results(store, Question(vehicle="warthog"))
    for name, ratio in (("command", 0.4), ("measured", 0.6)):
        driven, equal = (answer.find_view(name, equal=one) for one in (False, True))
        assert driven is not None
        assert equal is not None
        assert equal.comparisons["spread"][0] < ratio * driven.comparisons["spread"][0]
        assert equal.levels.sort("value")["dataset"][-1] == "warthog_ice"
    order = equal.levels.sort("value", descending=True)["dataset"].to_list()
    assert order == [f"warthog_{ground}" for ground in ("ice", "sand", "gravel", "asphalt", "grass")]
    grass = {frozenset((row["a"], row["b"])): row for row in driven.comparisons.iter_rows(named=True)}
    pair = frozenset(("warthog_grass", "warthog_ice"))
    assert grass[pair]["p_adjusted"] <= 0.05, "driven gently, grass looks easier"
    assert equal.comparisons["p_adjusted"].min() > 0.05  # type: ignore[operator]
