"""A search ends when its time is up, with the best answer so far, and says so."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from msgspec import structs

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import diagnose_runs, parse_budget
from pipeline.estimation.estimation_data import DiagnosisError
from pipeline.estimation.floor import estimate_floor
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.words.diagnosis import describe
from pipeline.words.verdict import format_verdict

SAMPLE = Path(__file__).parents[2] / "data_samples" / "husky_tile.mcap"


def test_a_search_that_is_cut_says_so_and_gives_the_best_answer_so_far(tmp_path: Path) -> None:
    manifest = analyze_log(SAMPLE, Options(out=tmp_path / "results", report=False)).manifest
    vehicle, recording = read_recording(manifest)
    told: list[str] = []
    cut = diagnose_runs([recording], vehicle, budget_s=0.0, notify=told.append).runs[0]
    whole = diagnose_runs([recording], vehicle, notify=told.append).runs[0]

    assert [finding.id for finding in cut.findings].count("search_cut") == 1
    verdict = format_verdict(cut)
    assert "budget ended the search" in verdict
    assert "o known effect" not in verdict
    assert "search_cut" not in [finding.id for finding in whole.findings]
    assert len(cut.effects) < len(whole.effects)
    assert cut.ladder[-1].t_mrmse_m <= cut.ladder[0].t_mrmse_m
    assert cut.ladder[0] == whole.ladder[0]
    assert any(": effective_track (" in line for line in told)


def test_a_budget_is_a_time() -> None:
    assert [parse_budget(text) for text in ("60", "60s", "1.5 min", "2m", "1h")] == [
        60.0,
        60.0,
        90.0,
        120.0,
        3600.0,
    ]
    for text in ("", "soon", "-5s", "0s", "1e3", "5 days"):
        with pytest.raises(DiagnosisError, match="is not a duration"):
            parse_budget(text)


def test_a_run_without_a_noise_floor_is_diagnosed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The floor is zero where hardly any windows can be compared: no sentence divides by it."""
    manifest = analyze_log(SAMPLE, Options(out=tmp_path / "results", report=False)).manifest
    vehicle, recording = read_recording(manifest)
    monkeypatch.setattr(
        "pipeline.estimation.ladder.estimate_floor",
        lambda *given: structs.replace(estimate_floor(*given), t_mrmse_m=0.0, r_mrmse_rad=0.0),
    )
    monkeypatch.setattr("pipeline.estimation.conclude.find_main_region", lambda *_: None)
    diagnosis = diagnose_runs([recording], vehicle)
    (run,) = diagnosis.runs
    assert run.noise_floor.t_mrmse_m == 0.0
    assert run.effects
    text = describe(diagnosis.runs, everything=True)
    assert not {"inf", "nan"} & set(re.findall(r"[a-z]+", text))
