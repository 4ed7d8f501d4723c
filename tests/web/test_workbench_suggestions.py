"""The button offers what the diagnosis names; what is no help is not offered, and its card says so."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest
from verbs import run_verb
from workbench_server import RUN, TRACK, Workbench

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation.additions import explain_refusal
from pipeline.models import ModelFile
from pipeline.models.formula import FormulaEffect, make_parameter
from pipeline.models.model import Model
from pipeline.results import RunDiagnosis, read_result
from pipeline.results.reading import read_model
from pipeline.simulate import simulate_case
from pipeline.sources import list_presets
from pipeline.store import Store
from pipeline.web import Ask, Limits, ServerFolders
from pipeline.web.actions import Editor
from pipeline.web.jobs import Jobs
from pipeline.web.session import Session, Step, show_effect
from pipeline.web.workbench import Sessions

ROOT = Path(__file__).parents[2]
SAMPLES = sorted((ROOT / "data_samples").glob("[!m]*.mcap"))
SHARED = sorted((ROOT.parent / "shared" / "logs").glob("*.mcap"))


def open_sessions(results: Path) -> Iterator[Sessions]:
    jobs = Jobs(results, Limits(), diagnosis=False, places=ServerFolders(results))
    yield Sessions(results, jobs)
    jobs.close()


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a log with a wide track and a drive lag, diagnosed."""
    folder = tmp_path_factory.mktemp("diagnosed")
    hidden = {"effective_track": TRACK, "drive_lag": 0.3}
    log = simulate_case(None, hidden, out=folder / "field" / "late.mcap", seed=4, duration_s=90.0)
    husky = {"vehicle": {"preset": "husky_a200"}}
    analyze_log(log, Options(out=folder / "out", report=False, diagnosis=True, overrides=husky))
    return folder / "out"


def named_in(results: Path, run: str) -> set[str]:
    """Effects of the model that the stored diagnosis wrote, without what may as well be nothing."""
    manifest = Store(results).manifest(run)
    assert manifest is not None
    if "diagnosis.json" not in manifest.files:
        return set()
    told = json.loads(manifest.path("diagnosis.json").read_text())
    file = read_model(read_result(told, RunDiagnosis))
    if file is None:
        return set()
    named = set(file.model.ids)
    refused = {effect.id for effect in file.model if explain_refusal(effect, file.intervals)}
    # Nothing is held back of which the diagnosis is certain.
    assert refused <= {name for group in told["undecided"] for name in group["candidates"]}
    return named - refused


def press_until_nothing_is_named(results: Path, run: str) -> list[str]:
    """Press the button again and again; what it was called each time."""
    pressed: list[str] = []
    for sessions in open_sessions(results):
        while rows := cast("dict[str, Any]", sessions.answer(Ask(run=run, action="open")))["named"]:
            assert [row["left"] for row in rows] == sorted(row["left"] for row in rows)
            rows = [row for row in rows if not row["formula"]]
            if not rows:
                break
            pressed.append(rows[0]["id"])
            sessions.answer(Ask(run=run, action="add", effect=pressed[-1], anyway=True))
    return pressed


def test_the_button_offers_what_the_diagnosis_named(diagnosed: Path) -> None:
    assert set(press_until_nothing_is_named(diagnosed, "field/late")) == {"effective_track", "drive_lag"}


@pytest.mark.parametrize("order", [1, -1])
def test_terminal_offer_and_workbench_give_a_model_one_number(diagnosed: Path, order: int) -> None:
    """What the screen says of some effects is what the page offers, and what it has once they are added."""
    run, slot = "field/late", "ab"[order]
    manifest = Store(diagnosed).manifest(run)
    assert manifest is not None
    told = json.loads(manifest.path("diagnosis.json").read_text())
    said = {frozenset(rung["effects"]): (rung["t_mrmse_m"], rung["r_mrmse_rad"]) for rung in told["ladder"]}
    taken: list[str] = []
    for sessions in open_sessions(diagnosed):
        shown = cast("dict[str, Any]", sessions.answer(Ask(run=run, slot=slot, action="open")))
        for card in shown["session"]["effects"]:
            shown = cast(
                "dict[str, Any]", sessions.answer(Ask(run=run, slot=slot, action="drop", effect=card["id"]))
            )
        for name in told["ladder"][-1]["effects"][::order]:
            (offer,) = [row["to"] for row in shown["named"] if row["id"] == name]
            shown = cast(
                "dict[str, Any]", sessions.answer(Ask(run=run, slot=slot, action="add", effect=name))
            )
            taken.append(name)
            now = shown["session"]["errors"]
            assert (now["t"], now["r"]) == pytest.approx((offer["t"], offer["r"]), rel=5e-6)
            if frozenset(taken) in said:
                assert (now["t"], now["r"]) == pytest.approx(said[frozenset(taken)], rel=2e-6)
        assert not shown["named"]
        for name in taken:
            sessions.answer(Ask(run=run, slot=slot, action="drop", effect=name))
    assert frozenset(taken) in said


def test_nothing_else_is_tried_before_what_the_diagnosis_named_is_in(diagnosed: Path) -> None:
    for sessions in open_sessions(diagnosed):
        tried = sessions.answer(Ask(run="field/late", slot="b", action="try"))
        assert tried["trial"] is None
        asked = sessions.answer(Ask(run="field/late", slot="b", action="try", anyway=True))
        assert asked["trial"] is not None


def test_all_of_the_diagnosis_is_its_model_whatever_was_done_before(
    diagnosed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, slot = "field/late", "b"
    manifest = Store(diagnosed).manifest(run)
    assert manifest is not None
    file = read_model(read_result(json.loads(manifest.path("diagnosis.json").read_text()), RunDiagnosis))
    assert file is not None
    wanted = {effect.id: dict(effect.values) for effect in file.model}
    begun: list[Model] = []
    fit = Editor.fit_anew

    def watch(editor: Editor, model: Model, *words: object, **more: object) -> Session:
        begun.append(model)
        return fit(editor, model, *words, **more)  # type: ignore[arg-type]

    for sessions in open_sessions(diagnosed):
        sessions.answer(Ask(run=run, slot=slot, action="add", effect="effective_track"))
        by_hand = Ask(run=run, slot=slot, action="set", effect="effective_track", parameter="k", value=1.0)
        sessions.answer(by_hand)
        monkeypatch.setattr(Editor, "fit_anew", watch)
        answer = cast("dict[str, Any]", sessions.answer(Ask(run=run, slot=slot, action="add_named")))
        cards = answer["session"]["effects"] if "session" in answer else answer["effects"]
        found = {card["id"]: {one["name"]: one["value"] for one in card["parameters"]} for card in cards}
        assert found == wanted
        assert {effect.id: dict(effect.values) for effect in begun[0]} == wanted
        assert not any(one["undetermined"] for card in cards for one in card["parameters"])


@pytest.mark.parametrize("value", [0.0783, -4e-4])
def test_the_slider_of_a_formula_has_steps_that_are_small_beside_its_value(value: float) -> None:
    parameter = make_parameter("k_1", "s/m", (-100.0, 100.0))
    term = FormulaEffect("suggested_term", {"v_y": "k_1 * v0 * v0"}, (parameter,), k_1=value)
    file = ModelFile(Model(next(iter(list_presets())), (term,)))
    card: Any = show_effect(file, "suggested_term", Step(said="", model=""))
    (shown,) = card["parameters"]
    assert shown["from"] < min(0.0, value) <= max(0.0, value) < shown["to"]
    assert shown["step"] < 0.05 * abs(value)


@pytest.mark.long
@pytest.mark.parametrize("log", [*SAMPLES, *SHARED], ids=lambda log: log.stem)
def test_for_every_recording_the_button_and_the_diagnosis_agree(log: Path, tmp_path: Path) -> None:
    outcome = analyze_log(log, Options(out=tmp_path, report=False, diagnosis=True))
    run = outcome.manifest.run
    named = named_in(tmp_path, run)
    if not named:
        pytest.skip("the diagnosis named nothing")
    pressed = press_until_nothing_is_named(tmp_path, run)
    assert set(pressed) <= named
    # What the button leaves to "Add all" raises the errors beside what is in, where it stands last.
    for name in named - set(pressed):
        for sessions in open_sessions(tmp_path):
            before = cast("dict[str, Any]", sessions.answer(Ask(run=run, action="open")))["session"]
            add = Ask(run=run, action="add", effect=name, anyway=True)
            after = cast("dict[str, Any]", sessions.answer(add))["session"]
            now, then = before["errors"], after["errors"]
            assert then["t"] > now["t"] or then["r"] > now["r"]
            sessions.answer(Ask(run=run, action="drop", effect=name))


def test_an_effect_that_is_no_help_says_why_on_its_card(workbench: Workbench) -> None:
    workbench.session(RUN, "add", effect="effective_track")
    added = cast("dict[str, Any]", workbench.session(RUN, "add", effect="side_lag", anyway=True)["session"])
    why = {effect["id"]: effect["refused"] for effect in added["effects"]}
    assert why["effective_track"] is None
    assert why["side_lag"]
    # It is remembered, and gone with the effect.
    again = cast("dict[str, Any]", workbench.session(RUN)["session"])
    assert again == added
    dropped = cast("dict[str, Any]", workbench.session(RUN, "drop", effect="side_lag")["session"])
    assert [effect["refused"] for effect in dropped["effects"]] == [None]


@pytest.mark.parametrize("effect", ["wheel_radius", "side_lag", "lateral_skid"])
def test_verb_page_and_json_give_one_reason_against_an_effect(
    workbench: Workbench, effect: str, tmp_path: Path
) -> None:
    source = cast("dict[str, Any]", workbench.session(RUN)["session"])["input"]
    model, results = tmp_path / "husky.toml", str(workbench.results)
    add = ["model", "add", str(model), effect, "--on", RUN, "--results", results, "--input", source]
    assert run_verb("model", "new", str(model), "--vehicle", "husky_a200", "--quiet").returncode == 0

    said = workbench.refuse("/api/session", run=RUN, action="add", effect=effect)
    asked = run_verb(*add)
    assert (said["code"], asked.returncode) == ("no_help", 1)
    clause = f"{effect} is not supported by the data ("
    assert asked.stderr.count(clause) == str(said["message"]).count(clause) == 1
    reason = str(said["message"]).partition(clause)[2].partition("): the model is unchanged")[0]
    assert f"{clause}{reason}): the model is unchanged" in asked.stderr

    added = cast("dict[str, Any]", workbench.session(RUN, "add", effect=effect, anyway=True)["session"])
    assert {one["id"]: one["refused"] for one in added["effects"]} == {effect: reason}
    assert json.loads(run_verb(*add, "--anyway", "--json").stdout)["refused"] == {effect: reason}
