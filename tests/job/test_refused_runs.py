"""A run that cannot show slip: one reason, first, on every face of the program."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from verbs import run_verb

from pipeline.simulate import simulate_case
from pipeline.store import Store
from pipeline.web.stored_runs import summarize_run

if TYPE_CHECKING:
    from pathlib import Path

WHY = "vehicle does not move"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the log of a vehicle whose wheels turn in the air, and its results."""
    folder = tmp_path_factory.mktemp("air")
    simulate_case("husky_in_the_air", out=folder / "air.mcap", duration_s=60.0)
    return folder


@pytest.fixture(scope="module")
def batch(folder: Path) -> dict[str, object]:
    ended = run_verb("batch", "air.mcap", "--diagnosis", "--json", cwd=folder)
    assert ended.returncode == 3
    content: dict[str, object] = json.loads(ended.stdout)
    return content


def test_a_batch_says_why_and_ends_with_3_every_time(folder: Path, batch: dict[str, object]) -> None:
    assert (batch["done"], batch["refused"]) == (0, 1)
    (line,) = batch["logs"]  # type: ignore[misc]
    assert WHY in line["reason"]
    assert line["hint"].startswith("List what the log holds: slip inspect ")
    again = run_verb("batch", "air.mcap", "--diagnosis", cwd=folder)
    assert again.returncode == 3
    assert again.stdout.count(WHY) == 1
    assert "copies" not in again.stdout
    assert WHY in run_verb("results", "status", cwd=folder).stdout


@pytest.mark.parametrize(
    "words",
    [("fleet", "fit"), ("fleet", "predict", "--vehicle", "husky_a200", "--terrain", "ice")],
    ids=["fit", "predict"],
)
@pytest.mark.usefixtures("batch")
def test_a_fleet_of_such_runs_gets_the_reason_and_no_command_that_does_not_help(
    folder: Path, words: tuple[str, ...]
) -> None:
    ended = run_verb(*words, cwd=folder)
    assert ended.returncode == 1
    assert WHY in ended.stderr
    assert "--diagnosis" not in ended.stderr
    assert "slip inspect" in ended.stderr


@pytest.mark.usefixtures("batch")
def test_a_plan_and_the_workbench_give_the_same_reason(folder: Path) -> None:
    planned = run_verb("plan", "air.mcap", "--quiet", cwd=folder)
    assert planned.returncode == 1
    assert WHY in planned.stderr
    store = Store(folder / "results")
    (manifest,) = store.survey().manifests
    shown = summarize_run(manifest)
    assert WHY in str(shown["refusal"])
    assert str(shown["refusal"])[1:] in str(shown["verdict"])


@pytest.mark.usefixtures("batch")
def test_no_model_is_fitted_and_nothing_is_compared_with_such_a_run(folder: Path) -> None:
    """`slip model add` wrote friction 20 and track 20 of it, `slip check` a radius of .01."""
    simulate_case("ideal_husky", out=folder / "ground.mcap", seed=3, duration_s=40.0)
    (folder / "m.toml").write_text('format = 1\n\n[vehicle]\npreset = "husky_a200"\n', "utf-8")
    before = (folder / "m.toml").read_bytes()
    fitted = run_verb("model", "add", "m.toml", "contact_friction", "--on", "air.mcap", cwd=folder)
    assert (fitted.returncode, len(fitted.stderr.strip().splitlines()[-1:])) == (1, 1)
    assert WHY in fitted.stderr
    assert (folder / "m.toml").read_bytes() == before
    checked = run_verb("check", "ground.mcap", "air.mcap", cwd=folder)
    assert checked.returncode == 1
    assert "no run AFTER can be compared: " in checked.stderr
    assert WHY in checked.stderr
    mixed = run_verb("check", "ground.mcap,air.mcap", "ground.mcap", cwd=folder)
    assert "a run is on both sides" in mixed.stderr


@pytest.mark.usefixtures("batch")
def test_a_trend_leaves_its_slip_out_and_says_so(folder: Path) -> None:
    followed = json.loads(run_verb("fleet", "trend", "--json", cwd=folder).stdout)
    assert any(
        note.startswith("slip of ") and "air left out, the vehicle does not move" in note
        for note in followed["notes"]
    )
    slip = [one["points"] for one in followed["series"] if "modulus" in one["quantity"]]
    assert not [point for points in slip for point in points if point["run"].endswith("/air")]
