"""One run, one answer: the number that one verb says, every other verb, file and page says too."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from few import few

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import EstimationData, Input, carry_over, diagnose_runs, load_recording
from pipeline.estimation.estimates import list_values
from pipeline.estimation.ladder import assess_model
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.models import Number, read_model, write_model
from pipeline.report.motion_view import view_diagnosis
from pipeline.report.page import render_report
from pipeline.report.scene import RunReport
from pipeline.report.sections import format_remaining
from pipeline.results import RunDiagnosis, read_result, to_json
from pipeline.results.reading import read_model as read_diagnosed_model
from pipeline.simulate import simulate_case
from pipeline.web.prepared import prepare_run
from pipeline.web.session import open_session
from pipeline.words.diagnosis import describe
from pipeline.words.effects import format_value
from pipeline.words.objects import diagnosis_as_json

if TYPE_CHECKING:
    from pipeline.models import ModelFile
    from pipeline.store import Manifest

Json = dict[str, Any]

ROOT = Path(__file__).parents[2]
LOGS = ROOT / ".." / "shared" / "logs"
SAMPLES = ROOT / "data_samples"
ERRORS = ("t_mrmse_m", "r_mrmse_rad")
# Estimates have six digits: those of two fits of the same model differ by one of the last at most.
SAME = 1e-5
# A recording drives motors over dents of the likelihood: another fit of its model ends within a tenth of half
# an interval, and its errors agree to three digits.
NEAR, THREE_DIGITS = 0.1, 1e-3


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("one") / "results"


def analyze(log: Path, results: Path) -> Manifest:
    return analyze_log(log, Options(out=results, report=False)).manifest


def hash_results(results: Path) -> dict[str, str]:
    files = (path for path in results.rglob("*") if path.is_file())
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def same(one: object, other: object, tolerance: float = SAME) -> bool:
    if isinstance(one, float | int) and isinstance(other, float | int):
        return math.isclose(one, other, rel_tol=tolerance, abs_tol=2e-6)
    return one == other


def compare_everywhere(
    log: Path, source: Input, results: Path, tmp_path: Path, *, is_recorded: bool = False
) -> None:
    manifest = analyze(log, results)
    before = hash_results(results)
    vehicle, recording = read_recording(manifest)
    diagnosis = diagnose_runs([recording], vehicle, inputs=(source.value,))
    told = json.loads(json.dumps(diagnosis_as_json(diagnosis.runs[0])))
    proposal = diagnosis.proposal
    if proposal is None:
        assert not told["effects"]
        return
    path = tmp_path / "model.toml"
    write_model(proposal, path)
    file = read_model(path)
    check_written(told, file, describe(diagnosis.runs, everything=True))
    check_page(told, describe(diagnosis.runs), describe(diagnosis.runs, everything=True))
    data = EstimationData([load_recording(recording, vehicle)], file.model.vehicle, source)
    own = check_model_verbs(told, file, data, is_recorded=is_recorded)
    require_no_rise(told["ladder"])
    if file.model.effects:
        check_workbench(told, file, own, manifest, is_recorded=is_recorded)
        view = view_diagnosis(recording.tables, vehicle, diagnosis.runs[0])
        assert view is not None
        assert set(view.effects) == set(file.model.ids)
        assert view.ladder == diagnosis.runs[0].ladder
    assert hash_results(results) == before


def check_page(told: Json, screen: str, everything: str) -> None:
    """The report counts the smaller effects as the screen does, and says the same of what remains."""
    report = RunReport({"run": told["run"]}, diagnosis=read_result(told, RunDiagnosis))
    page, shown, whole = render_report(report), *(" ".join(text.split()) for text in (screen, everything))
    # A screen has five effects, a page all that matter.
    if len(told["ladder"]) <= 6:
        smaller = re.compile(r"(\d+ smaller effects?(?:, and \d+ undecided)?)")
        assert smaller.findall(page) == smaller.findall(shown)
    remaining = format_remaining(report)
    assert remaining in page
    # One sentence on the page is a row an error on the screen.
    assert all(clause in whole for clause in remaining.removeprefix("remaining error ").split("; "))


def list_numbers(told: Json) -> list[tuple[str, str, Json]]:
    """Effect, name and number of all that was said and is no clock that was put right beforehand."""
    return [
        (effect["id"], name, number)
        for effect in told["effects"]
        if not effect["corrected"]
        for name, number in effect["parameters"].items()
    ]


def check_written(told: Json, file: ModelFile, screen: str) -> None:
    """What is written, and what is on the screen, is what was said."""
    assert read_diagnosed_model(read_result(told, RunDiagnosis)) == file
    found = {effect["id"] for effect in told["effects"] if not effect["corrected"]}
    found |= {item["in_model"] for item in told["undecided"] if item["in_model"] is not None}
    assert set(file.model.ids) == found
    if told["timing"]["wheel_delay_s"] is not None:
        written = file.find_wheel_delay(told["run"])
        assert written is not None
        assert told["timing"]["wheel_delay_s"] == round(written, 4)
    assert set(file.model.ids) == set(told["ladder"][-1]["effects"])
    for written, rung in zip(file.list_fitted("ladder"), told["ladder"], strict=True):
        assert {key: written[key] for key in ERRORS} == {key: rung[key] for key in ERRORS}
    unknown = re.findall(r"\w+", " ".join(re.findall(r"not determined by this log: (.*)", screen)))
    for effect, name, number in list_numbers(told):
        assert same(file.model.effect(effect).values[name], number["value"])
        if effect in unknown and name in unknown:
            continue
        low, high = (math.nan if number[end] is None else number[end] for end in ("low", "high"))
        shown = re.escape(format_value(Number(number["value"], low, high, "1")).split()[0])
        assert re.search(rf"{name} = {shown}(?![\d.])", screen), (effect, name)


def check_model_verbs(told: Json, file: ModelFile, data: EstimationData, *, is_recorded: bool) -> Json:
    """What the model verbs find on the run is what was written; returns the errors of the whole model."""
    judged = assess_model(data, file.model)
    for effect, name, number in list_numbers(told):
        entry: Json = list_values(judged.fitted.model.effect(effect), judged.estimates)[name].to_json()
        assert number["at_bound"] == entry["at_bound"]
        for end in ("value", "low", "high"):
            assert same(number[end], entry[end], find_tolerance(number, is_recorded)), (effect, name, end)
    floor = to_json(judged.floor)
    ladder = [to_json(step) for step in judged.ladder.as_result(judged.floor)]
    (carried,) = carry_over(file.model, list(data.runs), data.source)
    ideal, own = to_json(carried.ideal.pooled), to_json(carried.own.pooled)
    digits = THREE_DIGITS if is_recorded else SAME
    for key in ERRORS:
        assert same(told["ladder"][0][key], ladder[0][key])
        assert same(told["ladder"][0][key], ideal[key])
        assert same(told["ladder"][-1][key], ladder[-1][key], digits)
        assert same(told["ladder"][-1][key], own[key], digits)
        assert same(told["noise_floor"][key], floor[key], digits)
    return own


def find_tolerance(number: Json, is_recorded: bool) -> float:  # noqa: FBT001 - a fact about the log
    """By how much of its value an end of a number, or the number, may differ in another fit."""
    if not is_recorded or None in (number["low"], number["high"]) or number["value"] == 0.0:
        return SAME
    return max(SAME, abs(NEAR * 0.5 * (number["high"] - number["low"]) / number["value"]))


def check_workbench(told: Json, file: ModelFile, own: Json, manifest: Manifest, *, is_recorded: bool) -> None:
    """*Add all* enters the fit of the diagnosis."""
    session = open_session(prepare_run(manifest, str(told["input"])), None)
    assert all(same(getattr(session.step.ladder[0], key), told["ladder"][0][key]) for key in ERRORS)
    session = session.add(file.model.effects, anyway=True)
    digits = THREE_DIGITS if is_recorded else SAME
    assert all(same(getattr(session.step.ladder[-1], key), own[key], digits) for key in ERRORS)
    kept = session.step.model
    for effect, name, number in list_numbers(told):
        there = kept.effect(effect).values[name]
        assert same(there, number["value"], find_tolerance(number, is_recorded)), (effect, name)


def require_no_rise(ladder: list[Json]) -> None:
    """A step that raises one of the errors says so; the last one does not raise both together."""
    for below, rung in itertools.pairwise(ladder):
        for key in ERRORS:
            assert (key in rung.get("rises", [])) == (rung[key] > 1.001 * below[key])
    for below, last in itertools.pairwise(ladder[-2:]):
        assert math.prod(last[key] / below[key] for key in ERRORS) <= 1.015**2


@pytest.mark.parametrize("source", few(list(Input), 2))
def test_every_verb_file_and_page_says_the_same_of_a_sample(
    source: Input, results: Path, tmp_path: Path
) -> None:
    compare_everywhere(SAMPLES / "husky_tile.mcap", source, results, tmp_path)


def test_every_verb_file_and_page_says_the_same_of_a_simulated_log(results: Path, tmp_path: Path) -> None:
    hidden = {"effective_track": {"k": 1.7}, "drive_lag": {"tau": 0.3}, "lateral_skid": {"c": 0.15}}
    log = simulate_case("ideal_husky", hidden, out=tmp_path / "log" / "hidden.mcap", duration_s=90.0)
    compare_everywhere(log, Input.COMMAND, results, tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("source", list(Input))
@pytest.mark.parametrize("name", ["warthog_ice", "ackermann_gravel"])
def test_every_verb_file_and_page_says_the_same_of_the_other_samples(
    name: str, source: Input, results: Path, tmp_path: Path
) -> None:
    compare_everywhere(SAMPLES / f"{name}.mcap", source, results, tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("source", list(Input))
@pytest.mark.parametrize("name", sorted(path.stem for path in LOGS.glob("*.mcap")) or ["none"])
def test_every_verb_file_and_page_says_the_same_of_a_recording(
    name: str, source: Input, results: Path, tmp_path: Path
) -> None:
    log = LOGS / f"{name}.mcap"
    if not log.is_file():
        pytest.skip("../shared/logs is not here: the real recordings are not part of the repository")
    if "plank" in name and source is Input.MEASURED:
        pytest.skip("the measured wheels of this recording are zero throughout")
    compare_everywhere(log, source, results, tmp_path, is_recorded=True)
