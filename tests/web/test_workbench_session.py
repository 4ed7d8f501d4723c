"""A model in the making: what each step does to numbers, figures and files, and what is offered."""

import json
import re
import shutil
import time
from contextlib import closing
from hashlib import sha256
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from verbs import run_verb
from workbench_server import RUN, TRACK, Workbench, analyze_another, wait_for

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.api import Model, load
from pipeline.estimation import Input
from pipeline.estimation.prediction import predict_at
from pipeline.models import DOUBTS, TOO_SHORT, Number, read_model
from pipeline.models.formula import FormulaEffect, make_parameter
from pipeline.results import RunDiagnosis, read_result
from pipeline.results.reading import read_model as read_diagnosed_model
from pipeline.run import load_motion_run
from pipeline.simulate import simulate_case
from pipeline.sources.one_vehicle import load_vehicle
from pipeline.stages.slip_stage import find_residual_modulus
from pipeline.store import Manifest, Store
from pipeline.store.checksums import encode_checked
from pipeline.web.cards import show_parameter

Json = dict[str, Any]
ROOT = Path(__file__).parents[2]
SAMPLES = sorted((ROOT / "data_samples").glob("[!m]*.mcap"))
SHARED = sorted((ROOT.parent / "shared" / "logs").glob("*.mcap"))
WIDE = "field/wide"


def change(bench: Workbench, action: str = "open", run: str = RUN, **more: object) -> Json:
    """The session after a change."""
    return cast("Json", bench.session(run, action, **more)["session"])


def find_manifest(bench: Workbench, run: str = RUN) -> Manifest:
    manifest = Store(bench.results).manifest(run)
    assert manifest is not None
    return manifest


def read_told(bench: Workbench, run: str) -> Json:
    return cast("Json", json.loads(find_manifest(bench, run).path("diagnosis.json").read_text()))


def ids(session: Json) -> list[str]:
    return [effect["id"] for effect in session["effects"]]


def test_a_card_says_the_doubt_that_the_saved_file_has(workbench: Workbench) -> None:
    session = change(workbench, "add", effect="effective_track")
    (reason,) = {one["doubt"] for card in session["effects"] for one in card["parameters"]}
    assert reason == DOUBTS[TOO_SHORT][1]


def test_the_hidden_effect_makes_the_error_fall_and_undo_brings_it_back(workbench: Workbench) -> None:
    opened = change(workbench)
    assert (opened["errors"], opened["done"]) == (opened["ideal"], False)
    assert re.fullmatch(r"[\d.]+ degrees in heading remain, [\d.]+ times the noise floor", opened["remains"])
    added = change(workbench, "add", effect="effective_track")
    assert added["errors"]["r"] < 0.1 * opened["errors"]["r"]
    assert added["effects"][0]["parameters"][0]["value"] == pytest.approx(TRACK, rel=0.01)
    assert (added["done"], added["remains"]) == (True, "Done: at the noise floor")
    assert (added["undo"], added["redo"], added["before"]) == ("+ effective track", None, opened["errors"])
    undone = change(workbench, "undo")
    assert (undone["errors"], undone["effects"], undone["redo"]) == (
        opened["errors"],
        [],
        "+ effective track",
    )
    assert change(workbench, "redo") == added
    # Where to look first is a span of the run, of the error that is furthest above its floor.
    start, end = cast("list[float]", workbench.post("/api/figures", run=RUN, tab="first")["largest"])
    assert 0.0 <= start < end <= 62.0

    # The other side of the page has a model of its own, and every input has one.
    assert change(workbench, slot="b")["effects"] == []
    assert ids(change(workbench)) == ["effective_track"]
    assert change(workbench, input="measured")["input"] == "measured"
    assert change(workbench)["input"] == "measured"


def test_values_are_set_by_hand_held_fixed_and_fitted_again(workbench: Workbench) -> None:
    change(workbench, "add", effect="drive_lag", anyway=True)
    added = change(workbench, "add", effect="effective_track")
    assert change(workbench)["errors"] == added["errors"]
    value: Json = {"effect": "effective_track", "parameter": "k", "value": 1.3}
    shown = change(workbench, "preview", **value)
    assert (shown["by_hand"], shown["errors"] == added["errors"]) == (True, False)
    assert change(workbench)["errors"] == added["errors"]
    assert change(workbench, "set", **value)["errors"] == shown["errors"]
    change(workbench, "lock", effect="effective_track", parameter="k")
    fitted = change(workbench, "fit")
    (track,) = (one["parameters"][0] for one in fitted["effects"] if one["id"] == "effective_track")
    assert (track["value"], track["locked"], fitted["by_hand"]) == (1.3, True, False)
    change(workbench, "lock", effect="effective_track", parameter="k")
    assert change(workbench, "fit")["errors"]["r"] == pytest.approx(added["errors"]["r"], rel=1e-3)
    assert ids(change(workbench, "drop", effect="drive_lag")) == ["effective_track"]


def test_a_model_is_saved_with_its_fit_and_the_run_stays_byte_for_byte(workbench: Workbench) -> None:
    home = workbench.results / "runs"
    before = {path: path.read_bytes() for path in home.rglob("*") if path.is_file()}
    change(workbench, "add", effect="effective_track")
    workbench.post("/api/rows", run=RUN)
    path = Path(str(workbench.post("/api/save", run=RUN)["path"]))
    saved = read_model(path)
    assert saved.model.effect("effective_track").values["k"] == pytest.approx(TRACK, rel=0.01)
    assert [run["run"] for run in saved.list_fitted("runs")] == [RUN]
    status, headers, body = workbench.request("GET", f"/model.toml?run={RUN}")
    assert (status, body.decode()) == (200, path.read_text())
    assert headers["content-disposition"] == "attachment; filename*=UTF-8''hidden.toml"
    change(workbench, "set", effect="effective_track", parameter="k", value=1.4)
    workbench.post("/api/save", run=RUN)
    assert read_model(path).fit == {}
    assert {path: path.read_bytes() for path in home.rglob("*") if path.is_file()} == before


def test_what_cannot_be_done_is_said_and_changes_nothing(workbench: Workbench) -> None:
    added = change(workbench, "add", effect="effective_track")
    for code, asked in {
        "no_such_run": {"run": "nobody"},
        "no_such_run ": {"run": "../../etc/passwd"},
        "unknown_effect": {"action": "add", "effect": "magic"},
        "no_such_effect": {"action": "drop", "effect": "lag"},
        "effect_twice": {"action": "add", "effect": "effective_track"},
        "out_of_bounds": {"action": "set", "effect": "effective_track", "parameter": "k", "value": 99.0},
        "no_help": {"action": "add", "effect": "wheel_radius"},
    }.items():
        assert workbench.refuse("/api/session", **{"run": RUN, **asked})["code"] == code.strip()
    assert change(workbench) == added


@pytest.mark.parametrize("action", ["add", "formula", "fit", "try"])
def test_no_model_is_fitted_to_a_run_that_cannot_show_slip(workbench: Workbench, action: str) -> None:
    summary = find_manifest(workbench).path("summary.json")
    still = [{"id": "not_moving", "severity": "error", "values": {"error": "it does not move"}}]
    summary.write_text(json.dumps(json.loads(summary.read_text()) | {"findings": still}))
    opened = change(workbench)
    refused = workbench.refuse("/api/session", run=RUN, action=action, effect="effective_track", anyway=True)
    assert (refused["code"], refused["message"]) == ("no_fit", "it does not move")
    assert change(workbench) == opened


def test_a_model_is_validated_on_another_run_with_the_numbers_of_this_one(
    workbench: Workbench, tmp_path: Path
) -> None:
    alike = analyze_another(workbench.results, "alike", tmp_path, effective_track=TRACK)
    other = analyze_another(workbench.results, "other", tmp_path, effective_track=1.2)
    added = change(workbench, "add", effect="effective_track")
    holds = cast("Json", workbench.post("/api/validate", run=RUN, input=added["input"], on=alike))
    fails = cast("Json", workbench.post("/api/validate", run=RUN, input=added["input"], on=other))

    assert holds["carried"]["r"] < 0.1 * holds["ideal"]["r"]
    assert holds["warning"] == ""
    assert fails["carried"]["r"] > 3.0 * fails["own"]["r"]
    assert "does not transfer to field/other" in fails["warning"]
    # They are the numbers of the verb, and nothing was fitted to this run anew.
    path = str(workbench.post("/api/save", run=RUN)["path"])
    given = (path, shutil.copy(path, tmp_path / "again.toml"), "--on", alike, "--input", added["input"])
    done = run_verb("model", "compare", *given, "--results", workbench.results, "--json")
    told = json.loads(done.stdout)["compared"][0]["carried"]
    assert told["t_mrmse_m"] == pytest.approx(holds["carried"]["t"], rel=1e-6)
    assert change(workbench) == added

    refused = workbench.refuse("/api/validate", run=RUN, on="field/none")
    assert refused["code"] == "no_such_run"
    summary = find_manifest(workbench, other).path("summary.json")
    still = [{"id": "not_moving", "severity": "error", "values": {"error": "it does not move"}}]
    summary.write_text(json.dumps(json.loads(summary.read_text()) | {"findings": still}))
    assert workbench.refuse("/api/validate", run=RUN, on=other)["message"] == "it does not move"


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


def test_whatever_formula_is_written_the_session_stays_usable(workbench: Workbench) -> None:
    before = change(workbench)
    taken = 0
    for unusual in ({}, *UNUSUAL):
        body = json.dumps({"run": RUN, "action": "formula", **FORMULA, **unusual}).encode()
        status, _, answered = workbench.request("POST", "/api/session", body)
        if status == 200:
            taken += 1
            # What was taken can be drawn, changed, saved and read again, by the command line too.
            workbench.post("/api/rows", run=RUN)
            read_model(Path(str(workbench.post("/api/save", run=RUN)["path"])))
            change(workbench, "undo")
        else:
            assert status == 422, answered
            error = json.loads(answered)["error"]
            assert error["hint"]
            assert len(error["message"]) < 1000
        now = change(workbench)
        assert (now["effects"], now["errors"]) == ([], before["errors"])
    assert taken > 5


def test_map_and_commands_show_what_the_model_leaves_of_the_slip(workbench: Workbench) -> None:
    drawn = cast("Json", workbench.post("/api/figures", run=RUN))["rows"]
    manifest = find_manifest(workbench)
    slip = manifest.read("slip").filter(input="command")

    def finite(rows: Json, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
        return np.array([value for value in rows[name]["modulus"] if value is not None])

    assert finite(drawn, "track").max() == pytest.approx(slip["modulus"].max(), abs=1e-4)
    change(workbench, "add", effect="effective_track")
    moved = cast("Json", workbench.post("/api/rows", run=RUN))["rows"]
    model = read_model(Path(str(workbench.post("/api/save", run=RUN)["path"]))).model
    run, times = load_motion_run(manifest, load_vehicle(manifest)), slip["t"].to_numpy()
    # As `slip analyze --model` has it, on the scale of the ideal model.
    left = find_residual_modulus(predict_at(model, run, Input.COMMAND, times), slip, length=1.0)
    assert finite(moved, "track").max() == pytest.approx(np.nanmax(left), rel=0.02)
    assert np.median(finite(moved, "track")) < 0.3 * slip["modulus"].median()
    assert np.median(finite(moved, "command_cells")) < 0.3 * np.median(finite(drawn, "command_cells"))
    # The signature of every effect is a figure with its name.
    change(workbench, "add", effect="drive_lag", anyway=True)
    shown = cast("Json", workbench.post("/api/figures", run=RUN, tab="effects"))["shown"]
    titles = {one["id"]: (one["title"], one["width"]) for one in shown}
    assert titles["signature-effective_track"] == ("Effective track", "half")
    assert "signature" not in titles


def offer(bench: Workbench) -> list[Json]:
    """The rows of what could be added: of the diagnosis, and of the others that were tried."""
    bench.session(RUN, "try")
    wait_for(lambda: cast("Json", bench.session(RUN)["trial"])["done"])
    shown = bench.session(RUN)
    return [*cast("list[Json]", shown["named"]), *cast("Json", shown["trial"])["found"]]


def test_what_comes_next_is_one_answer_on_the_page_in_python_and_for_the_verb(
    workbench: Workbench, tmp_path: Path
) -> None:
    file, source = tmp_path / "husky.toml", change(workbench)["input"]
    on = ["--on", RUN, "--results", str(workbench.results), "--input", source]
    assert run_verb("model", "new", str(file), "--vehicle", "husky_a200", "--quiet").returncode == 0
    run, model = load(RUN, results=workbench.results), Model("husky_a200")
    rows = offer(workbench)
    assert rows[0]["id"] == "effective_track"
    missing = model.missing(run, input=source)
    assert {one for row in rows for one in (row["id"], *row["twins"])} == {
        one for row in missing.rows(named=True) for one in (row["effect"], *row["same_as"])
    }
    first = missing.row(0, named=True)
    assert (first["effect"], first["t_mrmse_m"], first["r_mrmse_rad"]) == (
        "effective_track",
        pytest.approx(rows[0]["to"]["t"], rel=1e-4),
        pytest.approx(rows[0]["to"]["r"], rel=1e-4),
    )
    for row in rows:
        assert run_verb("model", "add", str(file), row["id"], *on, "--json").returncode == 0
        assert run_verb("model", "drop", str(file), row["id"], *on, "--quiet").returncode == 0
    # After the last one that is accepted, nothing is next.
    change(workbench, "add", effect="effective_track")
    assert offer(workbench) == []
    assert (model + "effective_track").fit(run, input=source).model.missing(run, input=source).is_empty()


@pytest.mark.parametrize("effect", ["wheel_radius", "side_lag", "lateral_skid"])
def test_verb_page_and_card_give_one_reason_against_an_effect(
    workbench: Workbench, effect: str, tmp_path: Path
) -> None:
    model, source = tmp_path / "husky.toml", change(workbench)["input"]
    add = ["model", "add", str(model), effect, "--on", RUN, "--results", str(workbench.results)]
    add += ["--input", source]
    assert run_verb("model", "new", str(model), "--vehicle", "husky_a200", "--quiet").returncode == 0
    said = workbench.refuse("/api/session", run=RUN, action="add", effect=effect)
    asked = run_verb(*add)
    assert (said["code"], asked.returncode) == ("no_help", 1)
    reason = said["message"].partition("(")[2].partition("): the model is unchanged")[0]
    assert f"{effect} is not supported by the data ({reason}): the model is unchanged" in asked.stderr
    # The errors with it are shown all the same.
    assert f"\n+ {effect}" in asked.stdout
    added = change(workbench, "add", effect=effect, anyway=True)
    assert {one["id"]: one["refused"] for one in added["effects"]} == {effect: reason}
    assert json.loads(run_verb(*add, "--anyway", "--json").stdout)["refused"] == {effect: reason}
    # It is gone with the effect, and another one has none.
    change(workbench, "drop", effect=effect)
    assert change(workbench, "add", effect="effective_track")["effects"][0]["refused"] is None


@pytest.mark.parametrize("order", [1, -1])
def test_terminal_offer_and_workbench_give_a_model_one_number(diagnosed: Workbench, order: int) -> None:
    """What the screen says of some effects is what the page offers, and what it has once they are added."""
    told = read_told(diagnosed, WIDE)
    said = {frozenset(rung["effects"]): (rung["t_mrmse_m"], rung["r_mrmse_rad"]) for rung in told["ladder"]}
    names = told["ladder"][-1]["effects"][::order]
    shown = cast("Json", diagnosed.session(WIDE))
    assert set(shown["missing"]) == {row["id"] for row in shown["named"]} == set(names)
    assert [row["left"] for row in shown["named"]] == sorted(row["left"] for row in shown["named"])
    floor = told["noise_floor"]
    assert shown["session"]["floor"] == {"t": floor["t_mrmse_m"], "r": floor["r_mrmse_rad"]}
    for count, name in enumerate(names, 1):
        # Where the model has fewer effects than the diagnosis, offers and cards say of which fit values are.
        lacks = f"{len(names) - count + 1} effect"
        assert lacks in shown["partial"]
        others = "beside the effects of this model" if count > 1 else "with no other effect"
        assert {row["beside"] for row in shown["named"]} == {f"as fitted {others}"}
        (offer,) = [row["to"] for row in shown["named"] if row["id"] == name]
        shown = cast("Json", diagnosed.session(WIDE, "add", effect=name))
        now = shown["session"]["errors"]
        assert (now["t"], now["r"]) == pytest.approx((offer["t"], offer["r"]), rel=5e-6, abs=5e-7)
        if (known := said.get(frozenset(names[:count]))) is not None:
            assert (now["t"], now["r"]) == pytest.approx(known, rel=2e-6, abs=1e-6)
    assert (shown["named"], shown["missing"], shown["partial"]) == ([], [], "")


def test_all_of_the_diagnosis_is_its_model_whatever_was_done_before(diagnosed: Workbench) -> None:
    # Nothing else is tried before what the diagnosis named is in, unless it is asked for.
    assert diagnosed.session(WIDE, "try")["trial"] is None
    assert diagnosed.session(WIDE, "try", anyway=True)["trial"] is not None
    file = read_diagnosed_model(read_result(read_told(diagnosed, WIDE), RunDiagnosis))
    assert file is not None
    change(diagnosed, "add", WIDE, effect="effective_track")
    change(diagnosed, "set", WIDE, effect="effective_track", parameter="k", value=1.0)
    missing = diagnosed.session(WIDE)["missing"]
    cards = change(diagnosed, "add", WIDE, effects=missing)["effects"]
    found = {card["id"]: {one["name"]: one["value"] for one in card["parameters"]} for card in cards}
    assert found == {effect.id: dict(effect.values) for effect in file.model}
    assert not any(one["undetermined"] for card in cards for one in card["parameters"])


def test_a_formula_that_the_diagnosis_found_is_added(workbench: Workbench) -> None:
    formula = '[[effect]]\nid = "found_w"\nv_w = "k * w0"\n'
    formula += 'k = {value = -0.3, unit = "1", bounds = [-0.9, 0.9]}\n'
    floor = {"t_mrmse_m": 0.0123, "r_mrmse_rad": 0.0045}
    told = {"input": "command", "effects": [], "unexplained": {"formula": formula}, "noise_floor": floor}
    folder, content = find_manifest(workbench).folder, json.dumps(told).encode()
    (folder / "diagnosis.json").write_bytes(content)
    home = folder.parent
    manifest = json.loads((home / "manifest.json").read_text())
    del manifest["checksum"]
    manifest["files"]["diagnosis.json"] = {"bytes": len(content), "sha256": sha256(content).hexdigest()}
    (home / "manifest.json").write_bytes(encode_checked(manifest))

    (offer,) = cast("list[Json]", workbench.session(RUN)["named"])
    assert offer["formula"] == ["v_w += k * w0"]
    added = change(workbench, "add", effect="found_w")
    # The log turns as if its wheels stood 1.6 times as far apart.
    assert added["effects"][0]["parameters"][0]["value"] == pytest.approx(1 / TRACK - 1.0, rel=0.02)
    assert added["errors"]["r"] < 0.1 * added["ideal"]["r"]
    assert added["floor"] == {"t": 0.0123, "r": 0.0045}


@pytest.mark.parametrize("value", [0.0783, -4e-4])
def test_the_slider_of_a_formula_has_steps_that_are_small_beside_its_value(value: float) -> None:
    parameter = make_parameter("k_1", "s/m", (-100.0, 100.0))
    term = FormulaEffect("suggested_term", {"v_y": "k_1 * v0 * v0"}, (parameter,), k_1=value)
    shown: Json = show_parameter(term, parameter, Number(term.values[parameter.name]), is_fitted=True)
    assert shown["from"] < min(0.0, value) <= max(0.0, value) < shown["to"]
    assert shown["step"] < 0.05 * abs(value)


@pytest.mark.long
@pytest.mark.parametrize("log", [*SAMPLES, *SHARED], ids=lambda log: log.stem)
def test_for_every_recording_the_button_and_the_diagnosis_agree(log: Path, tmp_path: Path) -> None:
    run = analyze_log(log, Options(out=tmp_path, report=False, diagnosis=True)).manifest.run
    with closing(Workbench(tmp_path)) as bench:
        if "diagnosis.json" not in find_manifest(bench, run).files:
            pytest.skip("it was not diagnosed")
        told = read_told(bench, run)
        file = read_diagnosed_model(read_result(told, RunDiagnosis))
        named = set() if file is None else set(file.model.ids)
        pressed: set[str] = set()
        while rows := [row for row in cast("list[Json]", bench.session(run)["named"]) if not row["formula"]]:
            pressed.add(rows[0]["id"])
            change(bench, "add", run, effect=rows[0]["id"])
        assert pressed <= named
        # What the button leaves to "Add all" is refused beside what is in.
        for name in named - pressed:
            added = change(bench, "add", run, effect=name, anyway=True)["effects"]
            assert next(one for one in added if one["id"] == name)["refused"]
            change(bench, "drop", run, effect=name)


@pytest.mark.long
def test_ten_minutes_are_answered_within_half_a_second_and_fitted_within_two(tmp_path: Path) -> None:
    hidden: dict[str, object] = {"effective_track": 1.6, "drive_lag": 0.5}
    log = simulate_case(None, hidden, out=tmp_path / "field" / "long.mcap", seed=3, duration_s=600.0)
    husky = {"vehicle": {"preset": "husky_a200"}}
    run = analyze_log(log, Options(out=tmp_path / "out", report=False, overrides=husky)).manifest.run
    with closing(Workbench(tmp_path / "out")) as bench:
        change(bench, "add", run, effect="drive_lag")
        started = time.perf_counter()
        change(bench, "add", run, effect="effective_track")
        fitted = time.perf_counter() - started
        bench.post("/api/figures", run=run)
        shown = []
        for number in range(5):
            started = time.perf_counter()
            change(bench, "preview", run, effect="effective_track", parameter="k", value=1.4 + 0.02 * number)
            shown.append(time.perf_counter() - started)
    assert fitted < 2.0
    assert sorted(shown)[2] < 0.5
