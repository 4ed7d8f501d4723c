"""The verdict is one text on every face: screen, report, index page, JSON, Python, workbench."""

import html
import json
from pathlib import Path

from verbs import ask_verb

import slip
from pipeline.cli.screen import format_run
from pipeline.results import RunDiagnosis, read_result
from pipeline.web.runs import summarize_run as describe_in_workbench
from pipeline.words.diagnosis import describe
from pipeline.words.verdict import format_verdict


def test_every_face_shows_the_same_verdict(place: Path) -> None:
    results = place / "results"
    run = slip.load("field/wide", results=results)
    stored = read_result(json.loads(run.manifest.path("diagnosis.json").read_text()), RunDiagnosis)
    verdict = format_verdict(stored)
    assert verdict.startswith("Over 2 s the ideal model is ")
    assert "The robot turns at 5" in verdict
    (shown,) = ask_verb("analyze", "field/wide.mcap")["runs"]
    shown_on = {
        "JSON of the run": shown["verdict"],
        "JSON of the diagnosis": shown["diagnosis"]["verdict"],
        "run in Python": run.verdict,
        "diagnosis in Python": run.diagnose().verdict,
        "diagnosis in Python as text": repr(run.diagnose()).splitlines()[0],
        "screen": format_run(run.summary, unchanged=True).splitlines()[1],
        "whole screen": format_run(run.summary, unchanged=True, everything=True).splitlines()[1],
        "screen of the diagnosis": describe([stored]).splitlines()[1],
        "workbench": describe_in_workbench(run.manifest)["verdict"],
    }
    assert shown_on == dict.fromkeys(shown_on, verdict)
    assert run.report is not None
    for page in (run.report, results / "index.html"):
        assert f">{html.escape(verdict)}</p>" in page.read_text()
