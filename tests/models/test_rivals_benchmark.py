"""The benchmark `rivals`: where a model comes from, who is marked as better, and no recordings."""

import argparse
from dataclasses import dataclass
from pathlib import Path

import pytest
import rivals
from motion_runs import vehicle_of

from pipeline.sources import Vehicle

pytestmark = pytest.mark.long


@dataclass(eq=False)
class Drive:
    """What `choose_donors` reads of a recording."""

    vehicle: Vehicle
    terrain: str


def make_row(*, low: float, high: float, run: str = "one") -> dict[str, object]:
    def entry(value: float, behind: list[float]) -> dict[str, object]:
        metrics = dict.fromkeys(rivals.METRICS, value)
        return {
            "numbers": 2,
            "fit_s": 0.1,
            "band_holds": None,
            **metrics,
            **{f"{metric}_over_named": behind for metric in metrics},
        }

    models = {
        rivals.NAMED: entry(0.2, [0.0, 0.0, 0.0]),
        rivals.IDEAL: entry(0.5, [0.3, 0.2, 0.4]),
        "drive": entry(0.25, [0.05, low, high]),
    }
    return {
        "run": run, "vehicle": "v", "terrain": "ice", "input": "command", "minutes": 1.0,
        "place": rivals.PLACES[0], "donor": "", "donor_terrain": "", "models": models,
    }  # fmt: skip


def test_a_model_comes_from_another_run_of_the_same_ground_and_from_one_of_another() -> None:
    husky, warthog = vehicle_of("husky_a200"), vehicle_of("warthog")
    tile, ice = Drive(husky, "tile"), Drive(warthog, "ice")
    asphalt, again = Drive(warthog, "asphalt"), Drive(warthog, "asphalt")
    drives = [tile, asphalt, ice, again]
    found = rivals.choose_donors(asphalt, drives)  # type: ignore[arg-type]
    assert list(found.items()) == [("in the run", None), ("same ground", again), ("other ground", ice)]
    assert list(rivals.choose_donors(tile, drives)) == ["in the run"]  # type: ignore[arg-type]
    assert rivals.choose_donors(ice, drives)["other ground"] is again  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("low", "high", "sign"), [(0.01, 0.09, "-"), (-0.02, 0.12, "="), (-0.09, -0.01, "+")]
)
def test_a_difference_within_its_interval_is_no_win(
    low: float, high: float, sign: str, capsys: pytest.CaptureFixture[str]
) -> None:
    row = make_row(low=low, high=high)
    assert rivals.list_cells(row, rivals.METRICS[0])[4] == f"drive 0.250 {sign}"
    rivals.print_tables([row])
    printed = capsys.readouterr().out
    counts = {"-": (0, 1, 0), "=": (0, 0, 1), "+": (1, 0, 0)}[sign]
    assert (
        "- Position: the best model of the literature is better than the named physics on "
        f"{counts[0]} of 1, worse on {counts[1]}, not significantly different on {counts[2]}."
    ) in printed


def test_without_recordings_it_says_so_and_does_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rivals, "RECORDINGS", tmp_path / "logs")
    parser = argparse.ArgumentParser()
    rivals.add_arguments(parser)
    rivals.run(parser.parse_args(["--results", str(tmp_path / "results")]))
    assert capsys.readouterr().out == "skipped: no recordings in logs\n"
    assert not (tmp_path / "results").exists()
