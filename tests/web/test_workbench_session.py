"""A model in the making: what each step does to the numbers, to the files, and how long it takes."""

import json
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import cast

import pytest
from few import few
from verbs import run_slip
from workbench_server import RUN, TRACK, Workbench

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


def test_what_remains_is_one_sentence_and_done_is_said_at_the_noise_floor_alone(workbench: Workbench) -> None:
    opened = workbench.session(RUN)["session"]
    assert isinstance(opened, dict)
    assert opened["done"] is False
    assert re.fullmatch(r"[\d.]+ degrees in heading remain, [\d.]+ times the noise floor", opened["remains"])
    added = workbench.session(RUN, "add", effect="effective_track")["session"]
    assert isinstance(added, dict)
    assert (added["done"], added["remains"]) == (True, "Done: at the noise floor")
    # Where to look first is a span of the run, of the error that is furthest above its floor.
    start, end = cast("list[float]", workbench.post("/api/figures", run=RUN, tab="first")["largest"])
    assert 0.0 <= start < end <= 92.0


def test_the_signature_of_every_effect_is_a_figure_with_its_name(workbench: Workbench) -> None:
    workbench.session(RUN, "add", effect="effective_track")
    workbench.session(RUN, "add", effect="drive_lag", anyway=True)
    shown = cast("list[dict[str, str]]", workbench.post("/api/figures", run=RUN, tab="effects")["shown"])
    titles = {one["id"]: (one["title"], one["width"]) for one in shown}
    assert titles["signature-effective_track"] == ("Effective track", "half")
    assert "signature" not in titles


def test_the_workbench_opens_with_a_run_that_is_named(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    served: list[Path] = []

    def serve(folder: Path, *, notify: Callable[[str, str], None], **_: object) -> None:
        served.append(folder)
        notify("http://127.0.0.1:1/", "secret")

    monkeypatch.setattr("pipeline.web.server.serve", serve)
    for words in (["hidden"], [RUN], [str(results)], []):
        code, out, _ = run_slip("serve", *words, "--results", results)
        assert code == 0
        where = "#a=field%2Fhidden" if words in (["hidden"], [RUN]) else ""
        assert f"http://127.0.0.1:1/?token=secret{where} " in out
    assert served == [results] * 4
    code, _, said = run_slip("serve", "hiden", "--results", results)
    assert code == 1
    assert "there is no run 'hiden'" in said


def test_an_effect_that_is_switched_off_and_on_again_has_the_same_errors(workbench: Workbench) -> None:
    workbench.session(RUN, "add", effect="drive_lag", anyway=True)
    added = workbench.session(RUN, "add", effect="effective_track")
    switched_off = workbench.session(RUN, "switch", effect="effective_track")
    switched_on = workbench.session(RUN, "switch", effect="effective_track")

    assert errors(switched_off)["r"] > 2.0 * errors(added)["r"]
    assert errors(switched_on) == errors(added)


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


def test_a_damaged_session_is_begun_anew(workbench: Workbench) -> None:
    for content in [b'{"run": 3}', b'{"\xed": 1}', b"[" * 100_000, b""]:
        workbench.session(RUN, "add", effect="effective_track")
        (workbench.results / "workbench/desks/a/field/hidden.json").write_bytes(content)
        assert workbench.refuse("/api/save", run=RUN)["code"] == "no_such_desk"
        assert effects(workbench.session(RUN)) == []


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


@pytest.mark.long
def test_a_diagnosis_that_is_asked_for_is_kept_beside_the_results(workbench: Workbench) -> None:
    assert workbench.session(RUN)["diagnosis"] is None
    workbench.post("/api/diagnose", run=RUN)
    assert workbench.refuse("/api/diagnose", run=RUN)["code"] == "busy"
    (job,) = workbench.wait_for_jobs()
    assert job["error"] is None
    named = cast("dict[str, list[dict[str, object]]]", workbench.session(RUN)["diagnosis"])
    assert [effect["id"] for effect in named["effects"]] == ["effective_track"]


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


@pytest.mark.parametrize("unusual", few(UNUSUAL, 6), ids=lambda case: str(case)[:50])
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
