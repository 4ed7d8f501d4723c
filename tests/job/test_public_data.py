"""Public data sets, a few made-up rows of each in its own format: recognized, and analyzed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fomo_session import EFFECTIVE_TRACK, write_session
from verbs import run_verb

from pipeline.job.analyze import analyze_log
from pipeline.job.options import Options


def test_fomo_is_recognized_and_what_it_lacks_is_said(tmp_path: Path) -> None:
    session = write_session(tmp_path / "red_2025-10-14-11-41", duration_s=20.0, imu=False)
    said = json.loads(run_verb("inspect", session, "--json").stdout)
    assert said["vehicle"] == "warthog"
    assert said["problem"] is None
    roles = {role: found["topic"] if found else None for role, found in said["roles"].items()}
    assert roles["pose"] == "/ppk_gnss/pose"
    assert "/warthog/platform/motor/left/cmd_velocity" in roles["command"]
    assert "/warthog/platform/motor/left/status/velocity" in roles["wheels"]
    notes = " ".join(said["notes"])
    assert "a recording of FoMo" in notes
    assert "without a heading" in notes
    assert "not in the folder: vectornav.csv, xsens.csv, metadata/cmd_velocity.csv" in notes


@pytest.mark.parametrize("imu", [True, False])
def test_a_session_of_fomo_is_analyzed(tmp_path: Path, *, imu: bool) -> None:
    session = write_session(tmp_path / "red_2025-10-14-11-41", imu=imu)
    outcome = analyze_log(session, Options(out=tmp_path / "results", report=False, diagnosis=True))
    findings = {finding["id"] for finding in outcome.manifest.read("findings").to_dicts()}
    assert ("heading_from_imu" if imu else "heading_from_course") in findings
    (effect,) = outcome.summary["diagnosis"]["effects"]
    assert effect["id"] == "effective_track"
    assert effect["parameters"]["k"]["value"] == pytest.approx(EFFECTIVE_TRACK, rel=0.02)
