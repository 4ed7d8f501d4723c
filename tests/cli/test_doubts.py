"""A number in doubt is in doubt on every face: screen, page, JSON, model file, exports, workbench, Python."""

import json
import re
from pathlib import Path

import pytest
from exported_files import HUSKY, make, read
from verbs import run_verb

from pipeline.api.fitted_model import Model
from pipeline.export import export_model, list_omitted, list_targets
from pipeline.models import (
    DOUBTS,
    TOO_SHORT,
    find_effect,
    format_model,
    parse_model,
    read_model,
)

LABELS = {"drive_lag.tau", "effective_track.k"}
MARK, REASON = DOUBTS[TOO_SHORT]
RUN = "field/wide"
FIT = {"input": "command", "runs": [{"run": "a"}]}


def show(*words: str, cwd: Path) -> str:
    done = run_verb(*words, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def list_doubtful(effects: list[dict[str, object]]) -> dict[str, str]:
    """The doubts in JSON by label."""
    return {
        f"{effect['id']}.{name}": number["doubt"]
        for effect in effects
        for name, number in effect["parameters"].items()  # type: ignore[attr-defined]
    }


def test_each_face_says_of_the_same_numbers_that_the_run_is_too_short(place: Path) -> None:
    told = json.loads(show("diagnose", RUN, "--json", "--apply", "m.toml", cwd=place))["runs"][0]
    (stored,) = (place / "results" / "runs").rglob("diagnosis.json")
    kept = json.loads(stored.read_text())
    shown = json.loads(show("model", "show", "m.toml", "--json", cwd=place))
    file = read_model(place / "m.toml")
    frame = Model.read(place / "m.toml").parameters
    exported = run_verb("model", "export", "m.toml", "--to", "json", cwd=place)
    fitted = json.loads(show("model", "fit", "m.toml", "--on", RUN, "--json", cwd=place))["parameters"]
    expected = dict.fromkeys(LABELS, TOO_SHORT)
    answers = {
        "diagnose": list_doubtful(told["effects"]),
        "diagnosis.json": list_doubtful(
            next(iter(kept["runs"]))["effects"] if "runs" in kept else kept["effects"]
        ),
        "model show": list_doubtful(shown["effects"]),
        "model file": {label: number.doubt for label, number in file.list_doubtful().items()},
        "fit": {label: entry["doubt"] for label, entry in fitted.items()},
        "Python": dict(zip(frame["parameter"], frame["doubt"], strict=True)),
    }
    assert answers == dict.fromkeys(answers, expected)
    omitted = dict.fromkeys(LABELS, REASON)
    assert json.loads(exported.stdout)["omitted"] == omitted
    assert all(f"left out: {label}: {REASON}" in exported.stderr for label in LABELS)
    for words in (["diagnose", RUN], ["diagnose", RUN, "--all"]):
        screen = show(*words, cwd=place)
        assert all(re.search(rf"{name} = [^\n]*\({MARK}\)", screen) for name in ("k", "tau")), screen
    assert show("model", "show", "m.toml", cwd=place).count(f"({REASON})") == len(LABELS)


@pytest.mark.parametrize("target", ["nav2", "ros2_control", "px4", "gazebo"])
def test_what_depends_on_a_value_in_doubt_is_a_comment_with_the_reason(target: str) -> None:
    effects = (find_effect("drive_lag")(tau=2.7331), find_effect("effective_track")(k=1.8))
    intervals = {"drive_lag.tau": (2.6, 2.8), "effective_track.k": (1.7, 1.9)}
    known = intervals | {"wheel_speed_limit.limit": (5.9, 6.1)}
    sure = make(
        *effects,
        find_effect("wheel_speed_limit")(limit=6.0),
        fit=FIT,
        intervals=known,
    )
    doubts = dict.fromkeys(known, (TOO_SHORT, 0))
    doubtful = parse_model(
        format_model(make(*sure.model, fit=FIT, intervals=known, doubts=doubts)), Path("m")
    )
    assert {label: one.doubt for label, one in doubtful.numbers.items()} == dict.fromkeys(known, TOO_SHORT)
    text, plain = export_model(doubtful, target), export_model(sure, target)
    there, known = (read(target, one) for one in (plain, text))
    measured = set(there) - set(known)
    assert measured
    # A file of comments alone is an empty one.
    assert set(known) - {""} < set(there)
    for path in measured:
        name = path.rpartition(".")[2]
        assert re.search(rf"(#|<!--) .*{name}\b", text), name
    assert text.count(REASON) >= len(doubts)
    assert REASON not in plain


def test_every_target_lists_what_it_leaves_out() -> None:
    file = make(
        find_effect("drive_lag")(tau=0.3), fit=FIT,
        intervals={"drive_lag.tau": (0.2, 0.4)}, doubts={"drive_lag.tau": ("few_stretches", 3)},
    )  # fmt: skip
    for target in list_targets():
        assert list_omitted(file, target.name) == ({} if target.takes_doubtful else file.list_doubtful()), (
            target.name
        )
    assert "only 3 of the driven stretches of 20 s tell it" in export_model(file, "python")


def test_a_value_that_somebody_fixes_is_theirs() -> None:
    effect = find_effect("drive_lag")(tau=0.3).fix("tau")
    file = make(effect, vehicle=HUSKY, fit=FIT, doubts={"drive_lag.tau": (TOO_SHORT, 0)})
    assert not list_omitted(file, "nav2")
    assert read("nav2", export_model(file, "nav2"))
