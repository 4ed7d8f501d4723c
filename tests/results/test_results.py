"""A diagnosis is data: what is stored is read back as it was, also with effects that are not loaded."""

import json
import math
from typing import Any

import msgspec
import polars as pl
import pytest
from drawn_diagnoses import draw_diagnosis

from pipeline.core import SlipError
from pipeline.models import Interval, Number
from pipeline.recording import Finding
from pipeline.results import DataNeed, Growth, Named, Narrowing, Region, RunDiagnosis, read_result, to_json
from pipeline.results.reading import (
    find_refusal,
    has_no_pose,
    measure_excess,
    read_finding_table,
    read_findings,
    read_model,
)
from pipeline.words import format_finding
from pipeline.words.objects import diagnosis_as_json
from pipeline.words.verdict import format_verdict

DRAWN = draw_diagnosis({"effective_track": {"k": 1.79}}, [(1.06, 0.96), (0.44, 0.14)])
OPEN = Named(
    "drive_lag",
    {"tau": Number(0.3, unit="s", another_run=Interval(0.1, 0.5))},
    growth=Growth(None, {"tau": Narrowing((10.0, 20.0), (math.nan, 0.1))}),
)


def store(run: RunDiagnosis) -> dict[str, Any]:
    stored: dict[str, Any] = json.loads(json.dumps(to_json(run)))
    return stored


def test_what_is_stored_is_read_back_as_it_was() -> None:
    """NaN is no equal of itself: compared as text."""
    run = msgspec.structs.replace(
        DRAWN,
        run="field/run",
        effects=(*DRAWN.effects, OPEN),
        where=(Region("w", "time", "between", (0.0, 30.0), 0.9, 0.2),),
        need=DataNeed(known=("effective_track.k",), since_s=20.0, driven_s=60.0),
        findings=(Finding("stuck", "warning", values={"value": 1.0}, t_start=1.0, t_end=2.0),),
    )
    assert repr(read_result(store(run), RunDiagnosis)) == repr(run)
    stored = store(run)
    assert stored["effects"][1]["parameters"]["tau"]["low"] is None
    assert stored["effects"][1]["growth"]["parameters"]["tau"]["half_width"] == [None, 0.1]


def test_no_sentence_is_stored() -> None:
    run = msgspec.structs.replace(DRAWN, findings=(Finding("stuck", "warning", t_start=1.0, t_end=2.0),))
    stored, shown = store(run), diagnosis_as_json(run)
    assert "text" not in stored["findings"][0]
    assert shown["findings"][0]["text"].startswith("the wheels turned and the body did not move")
    assert {"verdict", "enough"} & stored.keys() == set()
    assert {"sentence", "clause"} & stored["effects"][0].keys() == set()
    assert shown["verdict"] == format_verdict(run)
    assert shown["effects"][0]["sentence"].startswith("Effective track ")


def test_what_people_get_is_read_back_too() -> None:
    """As `slip watch` does with the answer of `slip analyze --json`."""
    shown = json.loads(json.dumps(diagnosis_as_json(DRAWN)))
    assert format_verdict(read_result(shown, RunDiagnosis)) == format_verdict(DRAWN)


def test_a_diagnosis_that_names_effects_which_are_not_loaded_is_read_with_what_it_has() -> None:
    stored = {
        "run": "field/run",
        "verdict": "Over 2 s the ideal model is 1.06 m off.",
        "input": "command",
        "effects": [
            {
                "id": "gone_effect",
                "sentence": "It did something that no effect here does.",
                "parameters": {"k": {"value": 1.8, "low": None, "high": None, "unit": "1"}},
                "gain": None,
                "growth": None,
            }
        ],
        "unobservable": ["slope_creep"],
        "ladder": [
            {"effects": [], "t_mrmse_m": 1.06, "r_mrmse_rad": 0.96},
            {"effects": ["gone_effect"], "t_mrmse_m": 0.1, "r_mrmse_rad": 0.02, "explained_share": None},
        ],
        "noise_floor": {"t_mrmse_m": 0.05, "r_mrmse_rad": 0.02},
        "model": "this is no model file",
    }
    run = read_result(stored, RunDiagnosis)
    assert [one.id for one in run.effects] == ["gone_effect"]
    assert measure_excess(run) == pytest.approx(2.0)
    assert read_model(run) is None
    assert "With one effect in the model 10 cm" in format_verdict(run)
    assert diagnosis_as_json(run)["effects"][0]["sentence"] == "gone effect"


def test_a_file_that_is_no_diagnosis_is_refused() -> None:
    with pytest.raises(SlipError, match="ladder"):
        read_result({"ladder": 5}, RunDiagnosis)


def test_findings_of_untrusted_results_are_texts() -> None:
    untrusted = [{"id": 5, "text": None}, "no object", {"id": "not_moving", "severity": [], "values": 3}]
    findings = read_findings({"findings": untrusted})
    assert findings == (Finding("5", "info"), Finding("not_moving", "info"))
    assert find_refusal(findings) == Finding("not_moving", "info")
    # Of values that are not those of its sentence, its id is shown.
    assert [format_finding(one) for one in findings] == ["5", "not moving"]
    assert not has_no_pose(findings)
    table = pl.DataFrame(
        {"id": "stuck", "severity": "warning", "values": [text]} for text in ("{", "[1]", "[" * 10**5)
    )
    assert set(map(format_finding, read_finding_table(table))) == {
        format_finding(Finding("stuck", "warning"))
    }


def test_findings_of_tables_with_sentences_alone_are_said_by_them() -> None:
    row = {"id": "pose_gap", "severity": "info", "where": "", "text": "1 gap in the poses"}
    assert list(map(format_finding, read_finding_table(pl.DataFrame([row])))) == ["1 gap in the poses"]
