"""The verdict is one text on every face: screen, report, index page, JSON, Python, workbench."""

import html
import json
from pathlib import Path

from verbs import ask_verb

import slip
from pipeline.cli.screen import format_run
from pipeline.report.scene import RunReport
from pipeline.report.sections import summarise_health
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


def test_a_dead_encoder_stands_in_the_first_line_of_a_screen_and_at_the_head_of_a_page(place: Path) -> None:
    summary = slip.load("field/wide", results=place / "results").summary
    dead = {"id": "wheel_dead", "severity": "error", "where": "wheels", "count": None, "value": None}
    values = {"side": "left", "other": "right", "has_pose": True}
    faulty = {**summary, "findings": [*summary["findings"], {**dead, "values": values}]}
    assert "a dead encoder" not in format_run(summary, unchanged=True).splitlines()[0]
    assert "a dead encoder" in "\n".join(format_run(faulty, unchanged=True).splitlines()[:2])
    for one, is_told in ((summary, False), (faulty, True)):
        assert (("error", "a dead encoder") in summarise_health(RunReport(one))) == is_told
