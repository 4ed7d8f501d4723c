"""A model in the making: what each step does to the numbers, to the files, and how long it takes."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import cast

import pytest
from workbench_server import RUN, TRACK, Workbench

from pipeline.core import SlipError
from pipeline.models import read_model
from pipeline.simulate import simulate_case
from pipeline.store import Store

Session = dict[str, dict[str, float]]


def errors(answer: dict[str, object], key: str = "errors") -> dict[str, float]:
    return cast("Session", answer["session"])[key]


def effects(answer: dict[str, object]) -> list[dict[str, object]]:
    session = cast("dict[str, object]", answer["session"])
    return cast("list[dict[str, object]]", session["effects"])


def value(answer: dict[str, object]) -> float:
    parameters = cast("list[dict[str, float]]", effects(answer)[0]["parameters"])
    return parameters[0]["value"]


def test_the_hidden_effect_makes_the_error_fall_and_undo_brings_it_back(workbench: Workbench) -> None:
    opened = workbench.session(RUN)
    added = workbench.session(RUN, "add", effect="effective_track")

    assert errors(opened) == errors(opened, "ideal")
    assert errors(added)["r"] < 0.1 * errors(opened)["r"]
    assert value(added) == pytest.approx(TRACK, rel=0.01)
    undone = workbench.session(RUN, "undo")
    assert errors(undone) == errors(opened)
    assert effects(undone) == []
    assert errors(workbench.session(RUN, "redo")) == errors(added)


def test_the_ladder_has_a_rung_for_each_effect_in_the_order_of_adding(workbench: Workbench) -> None:
    workbench.session(RUN, "add", effect="drive_lag", anyway=True)
    workbench.session(RUN, "add", effect="effective_track")
    drawn = workbench.post("/api/rows", run=RUN)
    ladder = cast("dict[str, dict[str, dict[str, object]]]", drawn["rows"])["ladder"]
    assert ladder["step"]["levels"] == ["ideal", "+ drive_lag", "+ effective_track"]

    dropped = workbench.session(RUN, "drop", effect="drive_lag")
    assert [effect["id"] for effect in effects(dropped)] == ["effective_track"]


def test_an_effect_that_is_switched_off_and_on_again_has_the_same_errors(workbench: Workbench) -> None:
    workbench.session(RUN, "add", effect="drive_lag", anyway=True)
    added = workbench.session(RUN, "add", effect="effective_track")
    switched_off = workbench.session(RUN, "switch", effect="effective_track")
    switched_on = workbench.session(RUN, "switch", effect="effective_track")

    assert errors(switched_off)["r"] > 2.0 * errors(added)["r"]
    assert errors(switched_on) == errors(added)


def test_a_value_set_by_hand_is_scored_and_not_fitted(workbench: Workbench) -> None:
    added = workbench.session(RUN, "add", effect="effective_track")
    wrong = workbench.session(RUN, "set", effect="effective_track", parameter="k", value=1.2)
    assert value(wrong) == 1.2
    assert errors(added)["r"] < errors(wrong)["r"] < errors(wrong, "ideal")["r"]

    assert value(workbench.session(RUN, "fit")) == pytest.approx(TRACK, rel=0.01)


def test_a_preview_shows_rows_and_keeps_nothing(workbench: Workbench) -> None:
    added = workbench.session(RUN, "add", effect="effective_track")
    before = (workbench.results / "workbench/desks/a/field/hidden.json").read_bytes()
    shown = workbench.session(RUN, "preview", effect="effective_track", parameter="k", value=1.1)

    assert errors(shown)["r"] > errors(added)["r"]
    assert {"arcs", "model_w", "reach", "residual_w", "ladder"} <= set(cast("Session", shown["rows"]))
    assert (workbench.results / "workbench/desks/a/field/hidden.json").read_bytes() == before


def test_a_locked_value_stays_in_a_fit(workbench: Workbench) -> None:
    workbench.session(RUN, "add", effect="effective_track")
    workbench.session(RUN, "set", effect="effective_track", parameter="k", value=1.3)
    workbench.session(RUN, "lock", effect="effective_track", parameter="k")
    assert value(workbench.session(RUN, "fit")) == 1.3
    workbench.session(RUN, "lock", effect="effective_track", parameter="k")
    assert value(workbench.session(RUN, "fit")) == pytest.approx(TRACK, rel=0.01)


def test_an_effect_switched_off_shows_what_it_carries(workbench: Workbench) -> None:
    added = workbench.session(RUN, "add", effect="effective_track")
    off = workbench.session(RUN, "switch", effect="effective_track")
    assert errors(off)["r"] > 5.0 * errors(added)["r"]
    assert effects(off)[0]["off"]
    assert errors(workbench.session(RUN, "switch", effect="effective_track"))["r"] == pytest.approx(
        errors(added)["r"], rel=0.3
    )


def test_a_learned_term_is_a_step_that_is_switched_off_and_taken_off(workbench: Workbench) -> None:
    opened = workbench.session(RUN)
    added = workbench.session(RUN, "add", effect="learned_term")
    assert errors(added)["r"] < 0.7 * errors(opened)["r"]
    (card,) = effects(added)
    assert card["id"] == "learned_term"
    assert str(card["sentence"]).startswith("Learned term: ")

    off = workbench.session(RUN, "switch", effect="learned_term")
    assert errors(off)["r"] == pytest.approx(errors(opened)["r"], rel=0.02)
    workbench.session(RUN, "switch", effect="learned_term")
    assert effects(workbench.session(RUN, "drop", effect="learned_term")) == []

    # With the hidden effect in the model nothing is left to learn.
    workbench.session(RUN, "add", effect="effective_track")
    refused = workbench.refuse("/api/session", run=RUN, action="add", effect="learned_term")
    assert refused["code"] == "no_help"


def test_everything_is_there_again_after_the_server_was_started_anew(results: Path) -> None:
    first = Workbench(results)
    added = first.session(RUN, "add", effect="effective_track")
    first.close()
    second = Workbench(results)
    try:
        assert second.session(RUN)["session"] == added["session"]
        assert errors(second.session(RUN, "undo")) == errors(added, "ideal")
    finally:
        second.close()


@pytest.mark.parametrize("content", [b'{"run": 3}', b'{"\xed": 1}', b"[" * 100_000, b""])
def test_a_damaged_session_is_begun_anew(workbench: Workbench, content: bytes) -> None:
    workbench.session(RUN, "add", effect="effective_track")
    (workbench.results / "workbench/desks/a/field/hidden.json").write_bytes(content)
    assert workbench.refuse("/api/save", run=RUN)["code"] == "no_such_desk"
    assert effects(workbench.session(RUN)) == []


def test_two_sessions_of_a_run_do_not_touch_each_other(workbench: Workbench) -> None:
    workbench.session(RUN, "add", effect="effective_track")
    other = workbench.session(RUN, "add", effect="wheel_radius", anyway=True, slot="b")
    assert [effect["id"] for effect in effects(other)] == ["wheel_radius"]
    assert [effect["id"] for effect in effects(workbench.session(RUN))] == ["effective_track"]


def test_a_saved_model_is_a_model_file(workbench: Workbench) -> None:
    added = workbench.session(RUN, "add", effect="effective_track")
    saved = workbench.post("/api/save", run=RUN)
    path = workbench.results / "workbench/models/field/hidden.toml"
    assert saved["path"] == str(path)
    assert read_model(path).model.change("effective_track").effect("effective_track").values[
        "k"
    ] == pytest.approx(value(added))
    status, headers, body = workbench.request("GET", "/model.toml?run=field%2Fhidden&slot=a")
    assert status == 200
    assert "hidden.toml" in headers["content-disposition"]
    assert b"effective_track" in body
    # It says what it was fitted to, and keeps its numbers; values set by hand were fitted to nothing.
    written = read_model(path)
    assert [row["run"] for row in written.list_fitted("runs")] == [RUN]
    assert written.model.effect("effective_track").values["k"] == value(added)
    workbench.session(RUN, "set", effect="effective_track", parameter="k", value=1.2)
    workbench.post("/api/save", run=RUN)
    assert read_model(path).list_fitted("runs") == []


@pytest.mark.parametrize("folder", ["models", "desks/a", "uploads"])
def test_no_link_in_the_results_leads_what_is_kept_outside(
    results: Path, tmp_path: Path, folder: str
) -> None:
    """The results may be a stranger's: no link in them chooses which file a model takes the place of."""
    victim = tmp_path / "victim"
    victim.mkdir()
    for name in ("hidden.toml", "hidden.json"):
        (victim / name).write_text("precious")
    link = results / "workbench" / (folder if folder == "uploads" else f"{folder}/field")
    link.parent.mkdir(parents=True)
    link.symlink_to(victim, target_is_directory=True)
    if folder == "uploads":
        with pytest.raises(SlipError, match="leads out of its folder"):
            Workbench(results)
    else:
        server = Workbench(results)
        assert server.refuse("/api/session", run=RUN, action="open")["code"] == "path_outside"
        server.close()
    assert {path.name: path.read_text() for path in victim.iterdir()} == {
        "hidden.toml": "precious",
        "hidden.json": "precious",
    }


def test_working_on_a_model_leaves_the_run_byte_for_byte(workbench: Workbench) -> None:
    home = workbench.results / "runs"
    before = {path: path.read_bytes() for path in home.rglob("*") if path.is_file()}

    workbench.get("/api/runs")
    for action, more in (("open", {}), ("add", {"effect": "effective_track"}), ("undo", {})):
        workbench.session(RUN, action, **more)
    workbench.post("/api/rows", run=RUN)
    workbench.post("/api/save", run=RUN)
    assert workbench.request("GET", "/report?run=field%2Fhidden")[0] == 200
    assert {path: path.read_bytes() for path in home.rglob("*") if path.is_file()} == before


def test_a_formula_is_parsed_with_its_units_and_never_run(workbench: Workbench) -> None:
    typed = {"effect": "my_track", "channel": "v_w", "formula": "c * w0", "parameters": "c [1] -0.9 .. 0.5"}
    opened = workbench.session(RUN)
    added = workbench.session(RUN, "formula", **typed)
    assert errors(added)["r"] < 0.1 * errors(opened)["r"]
    assert value(added) == pytest.approx(1.0 / TRACK - 1.0, abs=0.01)
    workbench.session(RUN, "drop", effect="my_track")

    for wrong in (
        {"formula": "c * v0"},
        {"formula": "__import__('os').system('true')"},
        {"formula": "c * w0.__class__"},
        {"formula": "open * w0"},
        {"parameters": "c [1]"},
        {"parameters": "c [1] 2 .. 1"},
        {"effect": "../x"},
        {"channel": "v_z"},
        {"formula": "c * w0 +" + " w0 +" * 200},
    ):
        error = workbench.refuse("/api/session", run=RUN, action="formula", **{**typed, **wrong})
        assert error["hint"]
    assert effects(workbench.session(RUN)) == []


def wait_for_trial(workbench: Workbench) -> dict[str, object]:
    end = time.monotonic() + 60.0
    while True:
        trial = cast("dict[str, object]", workbench.session(RUN)["trial"])
        if trial["done"]:
            return trial
        assert time.monotonic() < end
        time.sleep(0.2)


def test_the_evidence_ranks_the_hidden_effect_first_and_offers_nothing_once_it_is_in(
    workbench: Workbench,
) -> None:
    workbench.session(RUN, "try")
    found = cast("list[dict[str, object]]", wait_for_trial(workbench)["found"])
    assert found[0]["id"] == "effective_track"

    workbench.session(RUN, "add", effect="effective_track")
    workbench.session(RUN, "try")
    assert wait_for_trial(workbench)["found"] == []


def test_what_a_diagnosis_named_is_shown(workbench: Workbench) -> None:
    home = workbench.results / "runs/field/hidden"
    manifest = json.loads((home / "manifest.json").read_text())
    del manifest["checksum"]
    named = {
        "input": "command",
        "effects": [{"id": "effective_track", "gain": 0.9}],
        "undecided": [],
    }
    (home / manifest["folder"] / "diagnosis.json").write_text(json.dumps(named))
    manifest["files"]["diagnosis.json"] = manifest["files"]["summary.json"]
    (home / "manifest.json").write_text(json.dumps(manifest))
    opened = workbench.session(RUN)
    assert opened["diagnosis"] == named


@pytest.mark.long
def test_a_diagnosis_that_is_asked_for_is_kept_beside_the_results(workbench: Workbench) -> None:
    assert workbench.session(RUN)["diagnosis"] is None
    workbench.post("/api/diagnose", run=RUN)
    assert workbench.refuse("/api/diagnose", run=RUN)["code"] == "busy"
    (job,) = workbench.wait_for_jobs()
    assert job["error"] is None
    named = cast("dict[str, list[dict[str, object]]]", workbench.session(RUN)["diagnosis"])
    assert [effect["id"] for effect in named["effects"]] == ["effective_track"]


def test_a_plan_that_is_not_there_is_one_clear_error(workbench: Workbench) -> None:
    assert workbench.session(RUN)["plan"] is None
    for run, name, code in (
        (RUN, "plan.mcap", "no_plan"),
        (RUN, "../../manifest.json", "no_plan"),
        ("nobody", "plan.mcap", "no_such_run"),
    ):
        status, _, body = workbench.request("GET", f"/plan?run={run}&file={name}")
        assert status >= 400
        assert json.loads(body)["error"]["code"] == code


def test_what_cannot_be_done_is_said_and_changes_nothing(workbench: Workbench) -> None:
    assert workbench.refuse("/api/session", run="nobody")["code"] == "no_such_run"
    assert workbench.refuse("/api/session", run=RUN, action="add_found")["code"] == "no_formula"
    assert workbench.refuse("/api/session", run=RUN, action="add", effect="magic")["code"] == "unknown_effect"
    assert workbench.refuse("/api/session", run=RUN, action="drop", effect="lag")["code"] == "no_such_effect"
    assert workbench.refuse("/api/session", run=RUN, action="burn")["code"] == "bad_request"
    assert workbench.refuse("/api/session", run=RUN, slot="../a")["code"] == "bad_request"
    assert workbench.refuse("/api/session", run="../../etc/passwd")["code"] == "no_such_run"
    workbench.session(RUN, "add", effect="effective_track")
    assert (
        workbench.refuse("/api/session", run=RUN, action="add", effect="effective_track")["code"]
        == "effect_twice"
    )
    far = {"effect": "effective_track", "parameter": "k", "value": 99.0}
    assert workbench.refuse("/api/session", run=RUN, action="set", **far)["code"] == "out_of_bounds"
    assert len(effects(workbench.session(RUN))) == 1


FORMULA = {"effect": "own", "channel": "v_w", "formula": "c * w0", "parameters": "c [1] -0.9 .. 0.5"}
WORDS = (
    "where", "id", "note", "v_x", "v_y", "v_w", "self", "name", "formulas", "parameters", "fixed", "values",
    "value", "effect", "t", "yaw", "w0", "pi", "lambda", "__class__", "true", "inf", "nan", "sin",
    "\u00e9", "\u212b",
)  # fmt: skip
DIGITS = "9" * 350
UNUSUAL = (
    *({"formula": f"{word} * w0", "parameters": f"{word} [1] -0.9 .. 0.5"} for word in WORDS),
    *({"effect": word} for word in ("where", "v_x", "pi", "effective_track", "../x")),
    {"formula": f"c * w0 * {DIGITS}"},
    {"formula": f"c * w0 * 0.{DIGITS}"},
    {"formula": f"c * w0 + {DIGITS} * w0 - {DIGITS} * w0"},
    {"parameters": f"c [1] -{DIGITS} .. {DIGITS}"},
    {"parameters": "c [1] -1e999 .. 1e999"},
    {"parameters": f"c [1] {DIGITS} .. 1{DIGITS}"},
    {"parameters": f"c [m^{DIGITS}] 0 .. 1"},
    {"parameters": f"c [m^{'9' * 5000}] 0 .. 1"},
    {"parameters": "c [1] 0 .. 1, c [1] 0 .. 1"},
    {"parameters": f"c [{'m*' * 200}m] 0 .. 1"},
    {"formula": "(" * 190 + "c * w0" + ")" * 190},
    {"formula": "-" * 380 + "c * w0"},
    {"formula": "c * w0" + "**1" * 120},
    {"formula": "abs(" * 70 + "c * w0" + ")" * 70},
    {"formula": "c * w0 * exp(exp(exp(exp(w0 + 9))))"},
    {"formula": "c * w0 / (w0 - w0)"},
    {"formula": "c * w0 * log(-1 - abs(yaw))"},
    {"formula": "c * w0 * (0 - 1) ** 0.5"},
    {"formula": "c ** 0.5 * w0"},
    {"formula": "c * w0\n"},
    {"formula": 'c * w0 # """'},
    {"formula": "c * w0\x00"},
    {"formula": '"'},
    {"formula": "True * c * w0"},
    {"formula": "1j * c * w0"},
)  # fmt: skip


@pytest.mark.parametrize("unusual", UNUSUAL, ids=lambda case: str(case)[:50])
def test_whatever_formula_is_written_the_session_stays_usable(
    shared_workbench: Workbench, unusual: dict[str, str]
) -> None:
    before = shared_workbench.session(RUN)["session"]
    body = json.dumps({"run": RUN, "action": "formula", **FORMULA, **unusual}).encode()
    status, _, answered = shared_workbench.request("POST", "/api/session", body)
    if status == 200:
        # What was taken can be opened, drawn, changed, saved and read again, by the command line too.
        for action in ("undo", "redo"):
            shared_workbench.session(RUN, action)
        shared_workbench.post("/api/rows", run=RUN)
        saved = shared_workbench.post("/api/save", run=RUN)
        read_model(Path(str(saved["path"])))
        shared_workbench.session(RUN, "undo")
    else:
        assert status == 422, answered
        error = json.loads(answered)["error"]
        assert error["hint"]
        assert len(error["message"]) < 1000
    assert shared_workbench.session(RUN)["session"]["effects"] == before["effects"]  # type: ignore[index]
    assert errors(shared_workbench.session(RUN)) == cast("Session", before)["errors"]


@pytest.mark.parametrize(
    "broken",
    ["not = [toml", '[[effect]]\nid = "magic"\n', "", "x = " + "[" * 5000, "x = " + "9" * 5000, "\u0000"],
    ids=["no_toml", "unknown_effect", "empty", "deep", "digits", "null"],
)
def test_a_step_that_cannot_be_opened_any_more_is_left_out(workbench: Workbench, broken: str) -> None:
    added = workbench.session(RUN, "add", effect="effective_track")
    path = workbench.results / "workbench/desks/a/field/hidden.json"
    kept = json.loads(path.read_text())
    kept["steps"].append({**kept["steps"][-1], "model": broken, "said": "broken"})
    kept["at"] = 2
    path.write_text(json.dumps(kept))
    assert errors(workbench.session(RUN)) == errors(added)
    assert effects(workbench.session(RUN, "undo")) == []
    assert errors(workbench.session(RUN, "redo")) == errors(added)

    # Also where it stands in the way of undo.
    kept["steps"] = [kept["steps"][0], kept["steps"][2], kept["steps"][1]]
    path.write_text(json.dumps(kept))
    assert errors(workbench.session(RUN)) == errors(added)
    assert effects(workbench.session(RUN, "undo")) == []
    assert errors(workbench.session(RUN, "redo")) == errors(added)


@pytest.mark.parametrize(
    "content",
    [
        "[" * 100_000, '{"run": ' + '{"a":' * 100_000, '{"value": ' + "9" * 350 + "}", '{"run": "\\ud800"}',
        "", "null", "[]", '"x"', "{", '{"run": "x", "run": 3}', '{"value": NaN}', "\u0000",
        '{"run": "' + "x" * 90_000 + '"}', '{"run": "\\u0000"}', '{"x": 1}',
    ],
    ids=lambda content: content[:20],
)  # fmt: skip
def test_a_request_that_cannot_be_read_is_one_sentence(shared_workbench: Workbench, content: str) -> None:
    for path in ("/api/session", "/api/figures", "/api/rows", "/api/save", "/api/diagnose"):
        status, _, body = shared_workbench.request("POST", path, content.encode())
        assert status in {404, 422}, body
        assert len(json.loads(body)["error"]["message"]) < 1000


@pytest.mark.long
def test_ten_minutes_are_answered_within_half_a_second_and_fitted_within_two(tmp_path: Path) -> None:
    log = tmp_path / "long.mcap"
    simulate_case(None, {"effective_track": 1.6, "drive_lag": 0.5}, out=log, seed=3, duration_s=600.0)
    server = Workbench(tmp_path / "results")
    try:
        body = log.read_bytes()
        status, _, _ = server.request("POST", "/api/upload?name=long.mcap", body)
        assert status == 200
        run = str(server.wait_for_jobs()[0]["run"])
        server.session(run)
        server.session(run, "add", effect="drive_lag")
        started = time.perf_counter()
        server.session(run, "add", effect="effective_track")
        fitted = time.perf_counter() - started
        server.post("/api/figures", run=run)
        shown = []
        for number in range(5):
            started = time.perf_counter()
            server.session(run, "preview", effect="effective_track", parameter="k", value=1.4 + 0.02 * number)
            shown.append(time.perf_counter() - started)
    finally:
        server.close()
    assert fitted < 2.0
    assert sorted(shown)[2] < 0.5


@pytest.mark.parametrize("action", ["add", "formula", "fit", "try"])
def test_no_model_is_fitted_to_a_run_that_cannot_show_slip(workbench: Workbench, action: str) -> None:
    manifest = Store(workbench.results).manifest(RUN)
    assert manifest is not None
    summary = manifest.path("summary.json")
    still = [{"id": "not_moving", "severity": "error", "text": "it does not move"}]
    summary.write_text(json.dumps(json.loads(summary.read_text()) | {"findings": still}))

    opened = workbench.session(RUN)
    refused = workbench.refuse("/api/session", run=RUN, action=action, effect="effective_track", anyway=True)

    assert refused["code"] == "no_fit"
    assert "it does not move" in str(refused["message"])
    assert errors(workbench.session(RUN)) == errors(opened)
