"""The verdict is one text on every face: screen, report, index page, JSON, Python, workbench."""

from __future__ import annotations

import html
import json
from pathlib import Path

import pytest
from verbs import run_verb

import pipeline as slip
from pipeline.cli.screen import format_run
from pipeline.estimation.diagnosis_lines import format_stored
from pipeline.estimation.verdict import format_verdict, rank_effects
from pipeline.report.scene import RunReport
from pipeline.simulate import simulate_case
from pipeline.web.stored_runs import summarize_run as describe_in_workbench


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> slip.Run:
    folder = tmp_path_factory.mktemp("faces")
    log = simulate_case("husky_tile", out=folder / "field" / "run.mcap", duration_s=100.0)
    return slip.analyze(log, results=folder / "results")


def test_every_face_shows_the_same_verdict(run: slip.Run) -> None:
    results = run.manifest.folder.parents[3]
    stored = json.loads(run.manifest.path("diagnosis.json").read_text())
    verdict = format_verdict(stored)
    assert verdict.startswith("Over 2 s the ideal model is ")
    assert "The robot turns at 5" in verdict
    told = run_verb("analyze", run.summary["log"]["path"], "--out", results, "--json")  # type: ignore[index]
    (shown,) = json.loads(told.stdout)["runs"]
    shown_on = {
        "stored diagnosis": stored["verdict"],
        "JSON of the run": shown["verdict"],
        "JSON of the diagnosis": shown["diagnosis"]["verdict"],
        "run in Python": run.verdict,
        "diagnosis in Python": run.diagnose().verdict,
        "diagnosis in Python as text": repr(run.diagnose()).splitlines()[0],
        "screen": format_run(run.summary, unchanged=True).splitlines()[1],
        "whole screen": format_run(run.summary, unchanged=True, everything=True).splitlines()[1],
        "screen of the diagnosis": format_stored(stored).splitlines()[1],
        "workbench": describe_in_workbench(run.manifest)["verdict"],
    }
    assert shown_on == dict.fromkeys(shown_on, verdict)
    assert run.report is not None
    for page in (run.report, results / "index.html"):
        assert f">{html.escape(verdict)}</p>" in page.read_text()


def test_effects_stand_in_one_order_on_every_face(run: slip.Run) -> None:
    stored = json.loads(run.manifest.path("diagnosis.json").read_text())
    effects = {effect["id"]: effect for effect in stored["effects"]}
    ids = [*rank_effects(stored["ladder"])]
    assert ids == [*effects] == ["effective_track", "drive_lag"]
    assert [step["effects"] for step in stored["ladder"][:2]] == [[], ids[:1]]
    screen, page = format_stored(stored), RunReport(run.summary, diagnosis=stored)
    assert [entry["id"] for entry in page.effects[0]] == ids
    for shown in (
        [run.verdict.index(effects[name]["clause"]) for name in ids],
        [screen.index(f" {name}  ") for name in ids],
    ):
        assert shown == sorted(shown)


def test_the_short_screen_has_one_slip_and_one_interval_a_number(run: slip.Run) -> None:
    short = format_run(run.summary, unchanged=False)
    whole = format_run(run.summary, unchanged=False, everything=True)
    labels = [line.split()[0] for line in short.splitlines()[2:] if not line.startswith(" ")]
    assert labels == ["slip", "effects", "remaining", "next", "report"]
    # The verdict comes before any slip, and that is defined once.
    assert short.count("m/s from") == 2
    assert "window norm" not in short
    assert "expected range between runs" not in short
    for word in (
        "window norm",
        "expected range between runs",
        "\nwhere ",
        "\nbudget ",
        "\nlimits ",
        "\ntopics ",
    ):
        assert word in whole
    assert set(short.splitlines()) < set(whole.splitlines())


def test_a_vehicle_that_stands_is_refused_in_the_first_line(tmp_path: Path) -> None:
    log = simulate_case(
        None, {"wheel_radius": 0.0}, out=tmp_path / "field" / "run.mcap", duration_s=40.0, vehicle="husky"
    )
    for more in ((), ("--no-diagnosis",)):
        done = run_verb("analyze", log, "--out", tmp_path / "results", "--no-report", *more)
        first, head, *rest = done.stdout.splitlines()
        assert first.startswith("The vehicle does not move: ")
        assert first.endswith(" No effect can be estimated.")
        assert head.startswith("field/run ")
        # The poses' noise is no distance, and the verdict is as grave as the report says.
        assert head.endswith("40 s    log complete, 1 error")
        # No number that means nothing, and nothing twice.
        assert not any(line.startswith(("slip ", "effects")) for line in rest)
        assert done.stdout.lower().count("does not move") == 1
        assert f"next      slip inspect {log}" in rest
