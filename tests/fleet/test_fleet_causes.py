"""Deployments compared by cause: parts add up, the unit is the run, and few runs are told so."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from comparison_store import Run, write_run

from pipeline.cli import main
from pipeline.fleet.causes import compare_causes
from pipeline.fleet.pairs import BLOCKS, RUNS
from pipeline.report import theme
from pipeline.report.fleet_pages import _COLOURS, _LEFT, _format_ends
from pipeline.store import Store

ASPHALT = {"effective_track": 0.8, "turn_lag": 0.3, "disturbance": 0.1, "localization_noise": 0.05}
ICE = {"effective_track": 0.8, "wheel_radius": 1.5, "disturbance": 0.4, "localization_noise": 0.05}
LEFT = ("disturbance", "localization_noise")


def draw(
    group: str, amounts: dict[str, float], runs: int, *, spread: float = 0.1, seed: int = 0
) -> pl.DataFrame:
    """Budgets of runs whose mean squares scatter about the given ones."""
    rng = np.random.default_rng([seed, *group.encode()])
    rows = []
    for number in range(runs):
        squares = {name: amount * math.exp(spread * rng.normal()) for name, amount in amounts.items()}
        total = sum(squares.values())
        rows += [
            {
                "group": group,
                "run": f"{group}_{number}",
                "name": name,
                "kind": name if name in LEFT else "effect",
                "mean_square": square,
                "share": square / total,
                "low": square / total - 0.02,
                "high": square / total + 0.02,
            }
            for name, square in squares.items()
        ]
    return pl.DataFrame(rows)


def test_budgets_and_differences_add_up() -> None:
    rows = pl.concat([draw("asphalt", ASPHALT, 4), draw("ice", ICE, 5)])
    budgets, (difference,) = compare_causes(rows)
    totals = {}
    for budget in budgets:
        assert sum(part.share for part in budget.parts) == pytest.approx(1.0)
        own = rows.filter(pl.col("group") == budget.dataset)
        assert budget.total == pytest.approx(
            own.group_by("run").agg(pl.col("mean_square").sum())["mean_square"].mean()
        )
        assert all(part.low < part.share < part.high for part in budget.parts)
        totals[budget.dataset] = math.sqrt(budget.total)
    assert (difference.a, difference.b) == ("asphalt", "ice")
    assert difference.total == pytest.approx(totals["ice"] - totals["asphalt"])
    assert sum(part.difference for part in difference.parts) == pytest.approx(difference.total)
    assert difference.unit == RUNS


def test_what_makes_the_difference_is_named_and_what_is_alike_is_not() -> None:
    _, (difference,) = compare_causes(pl.concat([draw("asphalt", ASPHALT, 6), draw("ice", ICE, 6)]))
    parts = {part.name: part for part in difference.parts}
    assert difference.parts[0].name == "wheel_radius"
    assert parts["wheel_radius"].p_adjusted < 0.05
    assert parts["turn_lag"].high < 0.0
    assert parts["turn_lag"].p_adjusted < 0.05
    assert parts["effective_track"].low < 0.0 < parts["effective_track"].high
    assert parts["effective_track"].p_adjusted > 0.05
    assert difference.note == ""
    told = difference.describe({name: name for name in parts} | {"wheel_radius": "longitudinal_slip"})
    assert "than asphalt" in told
    assert "longitudinal_slip" in told


def test_deployments_with_the_same_budgets_are_said_to_be_the_same() -> None:
    rows = draw("a", ASPHALT, 3)
    _, (difference,) = compare_causes(pl.concat([rows, rows.with_columns(group=pl.lit("b"))]))
    told = difference.describe({part.name: part.name for part in difference.parts})
    assert told == "b and a: the same slip, and the same from each cause"


def test_equal_deployments_are_rarely_said_to_differ() -> None:
    said = 0
    for seed in range(60):
        rows = pl.concat([draw("a", ASPHALT, 5, seed=seed), draw("b", ASPHALT, 5, seed=seed)])
        _, (difference,) = compare_causes(rows)
        said += any(part.p_adjusted < 0.05 for part in difference.parts)
    # Of 60 with a chance of 5 %, more than 8 come in fewer than one of a hundred trials.
    assert said <= 8


def test_few_runs_are_told_what_would_do() -> None:
    _, (difference,) = compare_causes(pl.concat([draw("asphalt", ASPHALT, 3), draw("ice", ICE, 3)]))
    assert "no cause can be significant with 3 and 3 runs" in difference.note
    assert min(part.p_adjusted for part in difference.parts) > 0.05


def test_single_runs_speak_of_themselves() -> None:
    budgets, (difference,) = compare_causes(pl.concat([draw("asphalt", ASPHALT, 1), draw("ice", ICE, 1)]))
    assert {budget.unit for budget in budgets} == {BLOCKS}
    assert budgets[0].parts[0].high - budgets[0].parts[0].share == pytest.approx(0.02)
    assert difference.unit == BLOCKS
    assert "not between terrains" in difference.note
    assert all(math.isnan(part.p) for part in difference.parts)
    assert all(part.low <= part.difference <= part.high for part in difference.parts)


def test_parts_that_outweigh_the_difference_are_said_in_metres_per_second() -> None:
    swapped = {**ASPHALT, "turn_lag": 0.8, "effective_track": 0.31}
    _, (difference,) = compare_causes(
        pl.concat([draw("a", ASPHALT, 3, spread=0.0), draw("b", swapped, 3, spread=0.0)])
    )
    told = difference.describe({part.name: part.name for part in difference.parts})
    assert "%" not in told
    assert "+0.22 turn_lag" in told
    assert "-0.22 effective_track" in told


@pytest.fixture
def results(tmp_path: Path) -> Store:
    """Warthog on asphalt and ice, where it loses grip."""
    store = Store(tmp_path / "results")
    for terrain, amounts in (("asphalt", ASPHALT), ("ice", ICE)):
        for (run,), rows in draw(terrain, amounts, 4).partition_by("run", as_dict=True).items():
            radius = 0.7 if terrain == "ice" else 1.0
            write_run(
                store,
                Run(
                    name=str(run),
                    dataset=f"warthog_{terrain}",
                    terrain=terrain,
                    seconds=6.0,
                    budget=rows.drop("group", "run"),
                    estimates=[("wheel_radius", "k", radius + 0.01 * len(store.manifests()) % 0.02, 0.02)],
                ),
            )
    return store


def test_the_answer_is_told_and_written(results: Store, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["compare", str(results.root), "--causes", "--json", "--figures", "svg"])
    told = json.loads(capsys.readouterr().out)
    assert ended.value.code == 0
    budgets = {one["dataset"]: one for one in told["budgets"]}
    assert set(budgets) == {"warthog_asphalt", "warthog_ice"}
    ice = budgets["warthog_ice"]
    parts = [*ice["shares"], ice["disturbance"], ice["localization_noise"]]
    assert sum(part["share"] for part in parts) == pytest.approx(1.0)
    (difference,) = told["differences"]
    assert sum(part["difference"] for part in difference["by_effect"]) == pytest.approx(difference["total"])
    assert difference["unit_of_analysis"] == "runs"
    # With both grounds there, radius is not what the ice's slip is called.
    (lost,) = [part for part in difference["by_effect"] if part["effect"] == "wheel_radius"]
    assert lost["name"] == "longitudinal_slip"
    assert "longitudinal_slip" in difference["sentence"]
    assert "wheel_radius" not in difference["sentence"]

    page = Path(told["page"]).read_text(encoding="utf-8")
    assert difference["sentence"].split(":")[0].removeprefix("warthog_ice") in page
    assert "longitudinal slip" in page
    assert "longitudinal_slip" not in page
    table = pl.read_csv(results.root / "causes.csv")
    assert table.group_by("dataset").agg(pl.col("share").sum())["share"].to_list() == pytest.approx(
        [1.0, 1.0], abs=1e-4
    )
    assert "longitudinal\\_slip" in (results.root / "causes.tex").read_text(encoding="utf-8")
    assert (results.root / "cause_differences.csv").exists()
    assert (results.root / "figures" / "causes.svg").exists()


def test_results_without_budgets_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = Store(tmp_path / "results")
    write_run(store, Run(name="plain", seconds=6.0))
    with pytest.raises(SystemExit) as ended:
        main(["compare", str(store.root), "--causes"])
    told = capsys.readouterr()
    assert ended.value.code == 1
    assert "no run has a budget of its slip" in told.err
    assert told.err.count("\n") == 1
    assert not (store.root / "causes.html").exists()


def test_no_two_causes_of_the_figure_look_alike() -> None:
    colours = [*_COLOURS, theme.INK, *_LEFT.values()]
    shades = [np.array([int(one[i : i + 2], 16) for i in (1, 3, 5)]) for one in colours]
    apart = [np.abs(a - b).max() for i, a in enumerate(shades) for b in shades[:i]]
    assert min(apart) > 30


def test_an_interval_that_says_nothing_is_not_written_out() -> None:
    assert _format_ends(-0.29, 1.02) == "\u221229\u202f% to 102\u202f%"
    assert _format_ends(-0.9999, 1883.35) == "undetermined"
