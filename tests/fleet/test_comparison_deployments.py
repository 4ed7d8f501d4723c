"""The table of deployments and the map."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest
from comparison_store import Run, write_run

from pipeline.cli import main
from pipeline.fleet import ComparisonError
from pipeline.fleet.deployments import (
    TERRAINS,
    add_deployment,
    find_own_table,
    merge_deployments,
    rank_deployments,
    rate_name,
    rate_terrain,
    read_deployments,
    write_deployments,
)
from pipeline.job.over_runs import draw_up_map, write_map
from pipeline.report.map_page import Box, arrange_labels
from pipeline.store import Store
from schemas import FEATURES

ENTRY = """
key = "Ours2026"
year = 2026
vehicle = "Clearpath Warthog"
vehicle_status = "measured"
drive = "skid-steer"
terrain = "wet snow"
terrain_status = "measured"
mass_kg = 500
mass_status = "measured"
speed_mps = 2.0
speed_status = "measured"
slope_score = 0
roughness_score = 1
sinkage_score = 2
friction_score = 3
scores_status = "estimated"
temperature_c = -4.5
temperature_status = "measured"
"""


def test_the_own_table_keeps_its_schema_and_says_how_well_each_value_is_known(samples: Path) -> None:
    table = read_deployments(samples / "deployments.csv")
    assert table.height == 37
    assert find_own_table().read_bytes() == (samples / "deployments.csv").read_bytes()
    for value, status in FEATURES.items():
        assert table.filter(pl.col(value).is_not_null() & pl.col(f"{status}_status").is_null()).is_empty()
    assert table["kinetic_energy_j"].count() == 20


def test_those_called_high_risk_are_in_the_last_zone() -> None:
    points = rank_deployments(read_deployments(find_own_table()))
    assert set(points.filter((pl.col("zone") == "high") & pl.col("sure"))["key"]) == {
        "Djeumou2023",
        "Triest2022",
        "Han2024",
    }
    bounds = dict(points.select("key", "bound").iter_rows())
    assert bounds["Rabiee2019"] == "upper"
    assert bounds["Han2024"] == "lower"


@pytest.mark.parametrize(
    ("terrain", "wanted"),
    [("asphalt", 0.0), ("tile", 1.5), ("gravel", 3.9), ("ice", 6.0), ("Deep snow", 9.2), ("moon", None)],
)
def test_the_scale_puts_its_anchors_where_they_are(terrain: str, wanted: float | None) -> None:
    found = rate_name(terrain)
    assert found == (None if wanted is None else pytest.approx(wanted, abs=0.05))


def test_a_worse_score_is_never_easier() -> None:
    for scores in TERRAINS.values():
        for i in range(4):
            worse = [score + (j == i) for j, score in enumerate(scores)]
            if max(worse) <= 4:
                assert rate_terrain(*worse) > rate_terrain(*scores)
    assert rate_terrain(4, 4, 4, 4) == pytest.approx(9.7, abs=0.05)


def test_a_deployment_is_added_and_its_energy_worked_out(tmp_path: Path) -> None:
    entry, table = tmp_path / "ours.toml", tmp_path / "own.csv"
    entry.write_text(ENTRY, encoding="utf-8")
    write_deployments(add_deployment(table, entry), table)
    (row,) = read_deployments(table).iter_rows(named=True)
    assert row["kinetic_energy_j"] == pytest.approx(1000.0)
    assert row["kinetic_energy_bound"] == "value"
    assert row["hardness"] is None
    merged = merge_deployments(find_own_table(), table)
    assert merged.height == 38
    assert merge_deployments(table, table).height == 1


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (("mass_status", "#"), "every_value_has_a_status"),
        (('"skid-steer"', '"hover"'), "drive of 'Ours2026' is 'hover'"),
        (("mass_kg = 500", 'mass_kg = "heavy"'), "mass_kg of 'Ours2026' is 'heavy'"),
        (("friction_score = 3", "friction_score = 7"), "friction_score"),
        (("friction_score = 3", ""), "scores_are_all_there_or_none"),
        (
            ("year = 2026", "year = 2026\nkinetic_energy_j = 7\nkinetic_energy_bound = 'value'"),
            "mass_and_speed",
        ),
        (("year = 2026", "year = 2026\ncolour = 'red'"), "unknown columns: colour"),
        (("year = 2026", "year = "), "cannot be read"),
    ],
)
def test_what_breaks_the_schema_is_refused_with_its_reason(
    spoil: tuple[str, str], said: str, tmp_path: Path
) -> None:
    entry = tmp_path / "ours.toml"
    entry.write_text(ENTRY.replace(*spoil), encoding="utf-8")
    with pytest.raises(ComparisonError, match=said):
        add_deployment(tmp_path / "own.csv", entry)


def test_contradictions_are_refused(tmp_path: Path) -> None:
    entry, other = tmp_path / "a.toml", tmp_path / "b.toml"
    entry.write_text(ENTRY, encoding="utf-8")
    other.write_text(ENTRY.replace("wet snow", "dry snow"), encoding="utf-8")
    tables = [tmp_path / "a.csv", tmp_path / "b.csv"]
    for source, table in zip((entry, other), tables, strict=True):
        write_deployments(add_deployment(table, source), table)
    with pytest.raises(ComparisonError, match="the same key stands for different deployments: Ours2026"):
        merge_deployments(*tables)


def test_own_datasets_stand_on_the_map_by_their_slip(tmp_path: Path) -> None:
    store = Store(tmp_path)
    write_run(store, Run(name="a", dataset="warthog_ice", terrain="ice", median=2.0))
    write_run(store, Run(name="b", dataset="warthog_moon", terrain="moon"))
    write_run(store, Run(name="c", dataset="cart_ice", vehicle="cart", terrain="ice", mass_kg=None))
    drawn = draw_up_map(store)
    assert drawn.own["dataset"].to_list() == ["warthog_ice"]
    assert drawn.own["complexity"].to_list() == pytest.approx([6.0])
    assert any("complexity scale" in note and "warthog_moon" in note for note in drawn.notes)
    assert any("cart_ice" in note for note in drawn.notes)
    # On the command, as `slip compare` chooses it, unless something else is asked for.
    assert (drawn.input, drawn.own["value"].to_list()) == ("command", pytest.approx([2.0], rel=0.2))
    lost, wheels = draw_up_map(store, show="energy"), draw_up_map(store, fed="measured")
    assert lost.own["value"].item() > 0.0
    assert wheels.own["value"].item() == pytest.approx(0.5 * drawn.own["value"].item())
    page = write_map(store, lost).read_text(encoding="utf-8")
    assert "own runs: lost energy from commands" in page
    # A plain number has no unit.
    assert "commands [1]" not in page
    assert 'data-head="lost energy"' in page
    page = write_map(store, drawn, "svg").read_text(encoding="utf-8")
    assert "warthog_ice: a/k0" in page
    assert (tmp_path / "figures" / "deployment_map.svg").stat().st_size > 1000


def test_the_map_needs_no_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["fleet", "map", str(tmp_path / "none"), "--json"])
    assert left.value.code == 1
    assert "there are no results" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
    (tmp_path / "none").mkdir()
    with pytest.raises(SystemExit) as ended:
        main(["fleet", "map", str(tmp_path / "none"), "--json"])
    assert ended.value.code == 0
    assert len(json.loads(capsys.readouterr().out)["deployments"]) == 20


def test_tables_are_added_to_and_merged_by_commands(tmp_path: Path) -> None:
    entry, table = tmp_path / "ours.toml", tmp_path / "own.csv"
    entry.write_text(ENTRY, encoding="utf-8")
    for arguments, code in (
        (["fleet", "map", "add", str(entry), "--file", str(table), "--quiet"], 0),
        (["fleet", "map", "merge", str(find_own_table()), str(table), "--file", str(table), "--quiet"], 0),
        (["fleet", "map", "add", str(entry), "--file", str(tmp_path / "new.csv"), "--json"], 0),
    ):
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert ended.value.code == code
    assert read_deployments(table).height == 38


@pytest.mark.parametrize("width", [720.0, 260.0])
def test_labels_hide_neither_marks_nor_each_other(width: float) -> None:
    marks = [(100.0, 100.0), (104.0, 101.0), (110.0, 99.0), (width - 20.0, 50.0)]
    names = ["one", "another", "third", "at the edge"]
    obstacle = Box(120.0, 180.0, 90.0, 110.0)
    placed = arrange_labels(marks, names, width=width, obstacles=[obstacle])
    found = [(at, name) for at, name in zip(placed, names, strict=True) if at is not None]
    assert len(found) >= 3
    boxes = [Box(x, x + 6.7 * len(name), y - 6.5, y + 6.5) for (x, y), name in found]
    for i, box in enumerate(boxes):
        assert box.left >= 0.0
        assert box.right <= width
        assert not box.overlaps(obstacle)
        assert not any(box.overlaps(other) for other in boxes[:i])


def test_a_name_without_a_place_is_left_out() -> None:
    marks = [(50.0, 100.0)] * 9
    placed = arrange_labels(marks, ["a long name"] * 9, width=200.0, furthest=14.0)
    assert [at for at in placed if at is not None] != placed
    assert all(abs(at[1] - 100.0) <= 14.0 for at in placed if at is not None)
