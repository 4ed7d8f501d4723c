"""HiddenEffect's scorer: what counts how, hostile answers, and the same scores by a second implementation."""

from __future__ import annotations

import json
import math
import os
import random
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import score_answers
import second_scorer
from score_answers import Answer, AnswerError, TaskScore, read_answer, score_ring, score_task

HERE = Path(score_answers.__file__).parent
NAMES = tomllib.loads((HERE / "names.toml").read_text("utf-8"))
WINDOWS = 3
Json = dict[str, Any]


def make_truth(effects: list[Json] | None = None, **changes: object) -> Json:
    """The truth of a task of three windows."""
    truth: Json = {
        "effects": effects or [],
        "unlisted": None,
        "tolerated": [],
        "held_out": {
            "poses": [[0.0, 0.0, 0.0], [1.0, 1.0, 3.1], [2.0, -1.0, -3.1]],
            "floor": {"position_m": 0.01, "yaw_rad": 0.02},
            "ideal": {"position_m": 0.1, "yaw_rad": 0.1},
        },
    }
    return truth | changes


def hide(name: str, *same_as: str, **values: float) -> Json:
    parameters = {key: {"value": value, "scale": abs(value) or None} for key, value in values.items()}
    return {"name": name, "parameters": parameters, "same_as": list(same_as)}


def ask(tmp_path: Path, truth: Json, **said: object) -> TaskScore:
    """Write an answer, read it and score it."""
    path = tmp_path / "t.json"
    path.write_text(json.dumps({"format": "hidden-effect-answer/1", "task": "t", **said}), "utf-8")
    return score_task("t", truth, read_answer(path, "t", WINDOWS, NAMES))


LAG = hide("drive_lag", tau=0.5)


def test_a_right_name_has_a_point_and_its_interval_is_judged(tmp_path: Path) -> None:
    number = {"value": 0.45, "low": 0.4, "high": 0.5}
    score = ask(tmp_path, make_truth([LAG]), effects=[{"name": "drive_lag", "parameters": {"tau": number}}])
    assert (score.points, score.outcomes, score.false) == (1.0, {"drive_lag": "right"}, ())
    assert score.covered == (True,)
    assert score.widths == pytest.approx((0.2,))


def test_abstaining_stands_above_a_wrong_name_and_below_an_undecided_one(tmp_path: Path) -> None:
    truth = make_truth([LAG])
    silent = ask(tmp_path, truth)
    wrong = ask(tmp_path, truth, effects=[{"name": "understeer"}])
    undecided = ask(tmp_path, truth, undecided=[["drive_lag", "turn_lag"]])
    denied = ask(tmp_path, truth, none=True)
    assert silent.outcomes == {"drive_lag": "abstained"}
    assert wrong.outcomes == denied.outcomes == {"drive_lag": "wrong"}
    assert undecided.outcomes == {"drive_lag": "undecided"}
    assert wrong.points < silent.points < undecided.points < 1.0
    assert denied.points == -1.0


def test_listing_every_name_does_not_pay(tmp_path: Path) -> None:
    most = [{"name": name} for name in sorted(NAMES) if name != "drive_lag"][:9]
    assert ask(tmp_path, make_truth([LAG]), effects=[{"name": "drive_lag"}, *most]).points == -1.0


def test_another_name_for_the_same_motion_is_right_but_has_no_number(tmp_path: Path) -> None:
    truth = make_truth([hide("position_offset", "rotation_centre_forward", "rotation_centre_left", l_x=0.2)])
    number = {"value": -0.2, "low": -0.3, "high": -0.1}
    one = {"name": "rotation_centre_forward", "parameters": {"x_icr": number}}
    score = ask(tmp_path, truth, effects=[one, {"name": "rotation_centre_left"}])
    assert (score.points, score.covered) == (1.0, ())


def test_an_empty_log_wants_to_be_called_empty(tmp_path: Path) -> None:
    assert ask(tmp_path, make_truth(), none=True).points == 1.0
    assert ask(tmp_path, make_truth()).outcomes == {"nothing": "abstained"}
    assert ask(tmp_path, make_truth(), undecided=[["drive_lag", "turn_lag"]]).points == -1.0


def test_physics_without_a_name_is_answered_by_its_channel(tmp_path: Path) -> None:
    truth = make_truth(unlisted={"about": "hunting", "channels": ["yaw"]})
    assert ask(tmp_path, truth, other={"channels": ["yaw", "x"]}).points == 1.0
    assert ask(tmp_path, truth, other={"channels": ["x"]}).points == -1.0
    named = make_truth([LAG])
    assert ask(tmp_path, named, other={"channels": ["x"]}).outcomes == {"drive_lag": "abstained"}
    assert ask(tmp_path, named, effects=[{"name": "drive_lag"}], other={"channels": ["x"]}).points == 0.0


def test_what_is_tolerated_counts_neither_way(tmp_path: Path) -> None:
    truth = make_truth([LAG], tolerated=["outward_skid", "other"])
    said = [{"name": "drive_lag"}, {"name": "outward_skid"}]
    assert ask(tmp_path, truth, effects=said, other={"channels": ["x"]}).points == 1.0


def test_many_tolerated_names_dilute_the_right_one(tmp_path: Path) -> None:
    truth = make_truth([LAG], tolerated=[*NAMES])
    names = [name for name in sorted(NAMES) if name != "drive_lag"]
    points = [
        ask(tmp_path, truth, effects=[{"name": name} for name in ("drive_lag", *names[:count])]).points
        for count in (4, 5, 9)
    ]
    assert points == [1.0, 0.8, pytest.approx(4 / 9)]


def test_poses_are_judged_round_the_circle_and_none_count_as_the_ideal_model(tmp_path: Path) -> None:
    turned = [[0.0, 0.01, 0.0], [1.0, 1.01, 3.1 - math.tau], [2.0, -0.99, -3.1 + math.tau]]
    score = ask(tmp_path, make_truth(), poses=turned)
    assert score.over_floor is not None
    assert score.over_floor[0] == pytest.approx(1.0)
    assert score.over_floor[1] < 1e-4
    assert ask(tmp_path, make_truth()).over_ideal == (1.0, 1.0)


GOOD = b'{"format": "hidden-effect-answer/1", "task": "t"'
HOSTILE = {
    "not JSON": b"effects: drive_lag",
    "not text": b"\xff\xfe\x00",
    "not an object": b"[]",
    "nested too deep": b"[" * 200_000,
    "no number": GOOD + b', "cpu_s": NaN}',
    "infinite": GOOD + b', "cpu_s": 1e999}',
    "a number of many digits": GOOD + b', "cpu_s": ' + b"9" * 5000 + b"}",
    "too large": GOOD + b', "cpu_s": 1' + b" " * 1_000_000 + b"}",
    "another task": b'{"format": "hidden-effect-answer/1", "task": "u"}',
    "another format": b'{"format": "hidden-effect-answer/2", "task": "t"}',
    "a key that is not listed": GOOD + b', "points": 1}',
    "a key twice": GOOD + b', "none": false, "none": true}',
    "an unknown name": GOOD + b', "effects": [{"name": "gremlins"}]}',
    "a name that is no text": GOOD + b', "effects": [{"name": ["drive_lag"]}]}',
    "a name twice": GOOD + b', "effects": [{"name": "drive_lag"}, {"name": "drive_lag"}]}',
    "an unknown parameter": GOOD
    + b', "effects": [{"name": "drive_lag", "parameters": {"k": {"value": 1}}}]}',
    "half an interval": GOOD
    + b', "effects": [{"name": "drive_lag", "parameters": {"tau": {"value": 1, "low": 0}}}]}',
    "an interval upside down": GOOD
    + b', "effects": [{"name": "drive_lag", "parameters": {"tau": {"value": 1, "low": 2, "high": 0}}}]}',
    "true for a number": GOOD
    + b', "effects": [{"name": "drive_lag", "parameters": {"tau": {"value": true}}}]}',
    "none and a name": GOOD + b', "none": true, "effects": [{"name": "drive_lag"}]}',
    "a group of one": GOOD + b', "undecided": [["drive_lag"]]}',
    "named and undecided": GOOD
    + b', "effects": [{"name": "drive_lag"}], "undecided": [["drive_lag", "turn_lag"]]}',
    "a channel that is none": GOOD + b', "other": {"channels": ["z"]}}',
    "a pose too few": GOOD + b', "poses": [[0, 0, 0], [0, 0, 0]]}',
    "a pose of two numbers": GOOD + b', "poses": [[0, 0], [0, 0], [0, 0]]}',
    "a pose without end": GOOD + b', "poses": [[1e300, 0, 0], [0, 0, 0], [0, 0, 0]]}',
    "negative CPU": GOOD + b', "cpu_s": -1}',
}


@pytest.mark.parametrize("fault", HOSTILE)
def test_a_broken_answer_is_one_clear_line_and_counts_as_abstained(fault: str, tmp_path: Path) -> None:
    (tmp_path / "t.json").write_bytes(HOSTILE[fault])
    with pytest.raises(AnswerError) as caught:
        read_answer(tmp_path / "t.json", "t", WINDOWS, NAMES)
    assert "\n" not in str(caught.value)
    lines: list[str] = []
    (score,) = score_ring(tmp_path, {"ring": "open", "tasks": {"t": make_truth([LAG])}}, NAMES, lines.append)
    assert len(lines) == 1
    assert len(lines[0]) < 300 + len(str(tmp_path))
    assert score.points == 0.0
    assert score.outcomes == {"drive_lag": "abstained"}


def test_an_answer_that_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "t.json")
    with pytest.raises(AnswerError, match="no file"):
        read_answer(tmp_path / "t.json", "t", WINDOWS, NAMES)


def draw_truth(dice: random.Random) -> Json:
    """A task that could be in a ring: all kinds of truths, more often than in one."""
    names = dice.sample(sorted(NAMES), dice.choice([0, 1, 1, 2, 3]))
    effects = [
        hide(
            name,
            *NAMES[name].get("same_as", ()),
            **{key: round(dice.uniform(-1.0, 1.0), 2) for key in NAMES[name]["parameters"]},
        )
        for name in names
    ]
    truth = make_truth(effects)
    if not names and dice.random() < 0.5:
        truth["unlisted"] = {"about": "", "channels": dice.sample(["x", "y", "yaw"], dice.randint(1, 2))}
    if dice.random() < 0.3:
        truth["tolerated"] = dice.sample([*NAMES, "other"], dice.choice([8, 46]))
    if dice.random() < 0.2:
        truth["held_out"]["floor"] = None
    return truth


def draw_answer(dice: random.Random, truth: Json) -> bytes:
    """An answer that is right in parts, and now and then broken."""
    if dice.random() < 0.15:
        return dice.choice(list(HOSTILE.values()))
    hidden = [effect["name"] for effect in truth["effects"]]
    candidates = list(dict.fromkeys(dice.sample(hidden, min(len(hidden), 2)) + dice.sample(sorted(NAMES), 6)))
    content: Json = {"format": "hidden-effect-answer/1", "task": "t"}
    if dice.random() < 0.7:
        content["effects"] = []
        for name in candidates[: dice.choice([0, 1, 2, 2, 8])]:
            numbers = {}
            for key in NAMES[name]["parameters"]:
                value = dice.uniform(-1.0, 1.0)
                half = dice.choice([None, dice.uniform(0.0, 1.0)])
                ends = {} if half is None else {"low": value - half, "high": value + half}
                numbers[key] = {"value": value, **ends}
            content["effects"].append({"name": name, "parameters": numbers})
    if dice.random() < 0.4:
        content["undecided"] = [
            dice.sample(candidates[2:], dice.randint(2, 4)) for _ in range(dice.randint(1, 2))
        ]
    if dice.random() < 0.3:
        content["other"] = {"channels": dice.sample(["x", "y", "yaw"], dice.randint(1, 3)), "formula": "a"}
    if dice.random() < 0.3:
        content["none"] = True
    if dice.random() < 0.7:
        content["poses"] = [[dice.uniform(-2.0, 2.0) for _ in range(3)] for _ in range(WINDOWS)]
    if dice.random() < 0.8:
        content["cpu_s"] = dice.uniform(0.0, 9.0)
    return json.dumps(content).encode()


def test_a_second_implementation_of_the_scorer_gives_the_same_scores(tmp_path: Path) -> None:
    dice = random.Random(11)  # noqa: S311 - for a test
    ours, theirs = [], []
    for number in range(600):
        task, truth = f"t{number}", draw_truth(dice)
        raw = draw_answer(dice, truth).replace(b'"task": "t"', f'"task": "{task}"'.encode())
        path = tmp_path / f"{task}.json"
        path.write_bytes(raw)
        try:
            answer = read_answer(path, task, WINDOWS, NAMES)
        except AnswerError:
            answer = Answer()
        said = second_scorer.decode(raw, task, WINDOWS, NAMES)
        said = said or second_scorer.Said("hidden-effect-answer/1", task)
        ours.append(score_task(task, truth, answer))
        theirs.append(second_scorer.judge(truth, said))
        assert ours[-1].points == pytest.approx(theirs[-1]["points"][0]), raw
    few = slice(0, 150)
    first, second = score_answers.measure_scores(ours[few]), second_scorer.score(theirs[few])
    assert set(first) == set(second)
    for name, (value, low, high) in first.items():
        assert value == pytest.approx(second[name][0]), name
        # Each draws resamples of its own: the ends of 2,000 agree to a fifth of the width, those of a median,
        # which jumps from one value to the next, to a half.
        within = (0.5 if name in {"width", "cpu_s"} else 0.2) * (high - low)
        assert (low, high) == pytest.approx(second[name][1:], abs=within), name
    for name in first:
        assert second_scorer.pool(name, theirs) == pytest.approx(score_answers.pool_scores(name, ours)), name


def test_both_implementations_refuse_the_same_answers() -> None:
    for fault, raw in HOSTILE.items():
        assert second_scorer.decode(raw, "t", WINDOWS, NAMES) is None, fault


def test_the_scorer_runs_outside_the_repository(tmp_path: Path) -> None:
    for name in ("score_answers.py", "names.toml"):
        shutil.copyfile(HERE / name, tmp_path / name)
    ring = tmp_path / "rings" / "open"
    ring.mkdir(parents=True)
    truth = {"format": "hidden-effect-truth/1", "ring": "open", "tasks": {"t": make_truth([LAG])}}
    (ring / "truth.json").write_text(json.dumps(truth), "utf-8")
    (tmp_path / "answers").mkdir()
    (tmp_path / "answers" / "t.json").write_bytes(GOOD + b', "effects": [{"name": "drive_lag"}]}')
    # Nothing of this project, and no package but numpy, may be found.
    blocked = (
        "import sys\n"
        "class Refuse:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name.split('.')[0] in {'pipeline', 'schemas', 'msgspec', 'polars', 'scipy', 'mcap'}:\n"
        "            raise ImportError(name)\n"
        "sys.meta_path.insert(0, Refuse())\n"
        "import runpy\n"
        "sys.argv = ['score_answers.py', 'answers', '--misses', '--json', 'scores.json']\n"
        "runpy.run_path('score_answers.py', run_name='__main__')\n"
    )
    command = [sys.executable, "-P", "-c", blocked]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads((tmp_path / "scores.json").read_text("utf-8"))["open"]["points"] == [1.0, 1.0, 1.0]


def test_without_a_truth_the_scorer_says_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert score_answers.main([str(tmp_path), "--rings", str(tmp_path)]) == 1
    assert capsys.readouterr().err.endswith("make the rings, or give --truth FILE\n")
    (tmp_path / "truth.json").write_text("{}", "utf-8")
    assert score_answers.main([str(tmp_path), "--truth", str(tmp_path / "truth.json")]) == 1
    assert capsys.readouterr().err.count("\n") == 1
