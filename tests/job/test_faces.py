"""The verdict is one text on every face: screen, report, index page, JSON, Python, workbench."""

from __future__ import annotations

import html
import json

import pytest
from verbs import run_verb

import pipeline as slip
from pipeline.cli.screen import format_run
from pipeline.estimation.diagnosis_lines import format_stored
from pipeline.estimation.verdict import format_verdict
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
