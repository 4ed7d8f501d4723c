"""The table of deployments and the map."""

from pathlib import Path

import polars as pl
import pytest
from verbs import ask_verb, run_slip

from pipeline.datasets import ComparisonError
from pipeline.datasets.deployments import find_own_table, rate_names, read_deployments
from schemas import FEATURES

ENTRY = {
    "key": "Ours2026", "year": "2026", "vehicle": "Clearpath Warthog", "vehicle_status": "measured",
    "drive": "skid-steer", "terrain": "wet snow", "terrain_status": "measured", "mass_kg": "500",
    "mass_status": "measured", "speed_mps": "2.0", "speed_status": "measured", "kinetic_energy_j": "1000",
    "kinetic_energy_bound": "value", "slope_score": "0", "roughness_score": "1", "sinkage_score": "2",
    "friction_score": "3", "scores_status": "estimated", "temperature_c": "-4.5",
    "temperature_status": "measured",
}  # fmt: skip


def test_the_own_table_keeps_its_schema_and_says_how_well_each_value_is_known(samples: Path) -> None:
    table = read_deployments(samples / "deployments.csv")
    assert table.height == 37
    assert find_own_table().read_bytes() == (samples / "deployments.csv").read_bytes()
    for value, status in FEATURES.items():
        assert table.filter(pl.col(value).is_not_null() & pl.col(f"{status}_status").is_null()).is_empty()
    assert table["kinetic_energy_j"].count() == 20


def test_the_scale_puts_its_anchors_where_they_are() -> None:
    for terrain, wanted in [
        ("asphalt", 0.0),
        ("tile", 1.5),
        ("gravel", 3.9),
        ("ice", 6.0),
        ("Deep snow", 9.2),
        ("moon", None),
    ]:
        (found,) = rate_names([terrain])
        assert found == (None if wanted is None else pytest.approx(wanted, abs=0.05))


def test_a_table_of_ones_own_is_read_and_what_is_not_known_is_empty(tmp_path: Path) -> None:
    table = tmp_path / "own.csv"
    pl.DataFrame(ENTRY).write_csv(table)
    (row,) = read_deployments(table).iter_rows(named=True)
    assert row["kinetic_energy_j"] == pytest.approx(1000.0)
    assert row["hardness"] is None


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        ({"mass_status": ""}, "every_value_has_a_status"),
        ({"drive": "hover"}, "drive of 'Ours2026' is 'hover'"),
        ({"mass_kg": "heavy"}, "mass_kg of 'Ours2026' is 'heavy'"),
        ({"friction_score": "7"}, "friction_score"),
        ({"friction_score": ""}, "scores_are_all_there_or_none"),
        ({"kinetic_energy_j": "7"}, "mass_and_speed"),
        ({"colour": "red"}, "unknown columns: colour"),
    ],
)
def test_what_breaks_the_schema_is_refused_with_its_reason(
    spoil: dict[str, str], said: str, tmp_path: Path
) -> None:
    table = tmp_path / "own.csv"
    pl.DataFrame(ENTRY | spoil).write_csv(table)
    with pytest.raises(ComparisonError, match=said):
        read_deployments(table)


def test_the_map_needs_no_results(tmp_path: Path) -> None:
    code, _, said = run_slip("fleet", "map", tmp_path / "none", "--json")
    assert code == 1
    assert "there are no results" in said
    assert not (tmp_path / "none").exists()
    (tmp_path / "none").mkdir()
    assert len(ask_verb("fleet", "map", tmp_path / "none")["deployments"]) == 20
