"""A fleet of public recordings whose answers are published: a robot that drives straight on four floors."""

import shutil
import string
from pathlib import Path

import pytest
from verbs import ask_verb, print_verb

FLOORS = Path(__file__).parents[3] / "shared/published/robotino_surfaces"
KNOWN = {"table": 0.892, "gray": 0.720, "green": 0.447}
"""Distance of the body over distance of the wheels, as the recordings' own README measures it."""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of the 48 runs, each a folder of its own, as their names would make them parts of a split."""
    if not FLOORS.is_dir():
        pytest.skip(f"there are no recordings in {FLOORS}")
    folder = tmp_path_factory.mktemp("floors")
    for floor in ("table", "brown", "gray", "green"):
        logs = sorted(FLOORS.glob(f"{floor}_*.mcap"))
        (folder / floor).mkdir()
        (folder / floor / "fleet.toml").write_text(
            f'[vehicle]\nkind = "omni"\nname = "robotino"\n[run]\nterrain = "{floor}"\n', encoding="utf-8"
        )
        for letter, log in zip(string.ascii_lowercase, logs, strict=False):
            (folder / floor / letter).mkdir()
            shutil.copy(log, folder / floor / letter / f"run-{floor}-{letter}.mcap")
    out = folder / "results"
    print_verb("batch", "run", folder, "--diagnosis", "--results", out, "--quiet")
    return out


@pytest.mark.long
def test_four_floors_are_told_apart_as_published(results: Path) -> None:
    fleet = ask_verb("fleet", "fit", str(results))
    (gain,) = (one for one in fleet["parameters"] if one["effect"] == "wheel_radius")
    assert gain["level"] == "terrain"
    assert gain["name"] == "longitudinal_slip"
    means = {floor: mean["value"] for floor, mean in gain["terrains"].items()}
    assert sorted(means, key=means.__getitem__) == ["green", "gray", "table"]
    for floor, known in KNOWN.items():
        assert means[floor] == pytest.approx(known, abs=0.06), floor
    notes = "\n".join(fleet["notes"])
    assert "wheel_radius_wrong" not in notes
    assert "left out, too short to be diagnosed alone (12 runs): " in notes
    assert sum(map(len, fleet["runs"].values())) == 36


@pytest.mark.long
def test_no_run_on_a_slippery_floor_is_left_out(results: Path) -> None:
    compared = ask_verb("compare", str(results))
    rows = sorted(compared["datasets"], key=lambda row: row["median_modulus"])
    assert [row["terrain"] for row in rows] == ["table", "brown", "gray", "green"]
    assert [row["runs"] for row in rows] == [12] * 4
    assert all(pair["p_adjusted"] <= 0.05 for pair in compared["pairs"])
