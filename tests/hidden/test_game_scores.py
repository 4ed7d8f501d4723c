"""The scorer of the game: what counts how, and hostile answers."""

import hashlib
import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from game import score as scorer
from game.rings import list_names
from game.score import AnswerError, TaskScore, read_answer, read_truth, score_ring, score_task

pytestmark = pytest.mark.long

HERE = Path(scorer.__file__).parent
NAMES = list_names()
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
    path.write_text(json.dumps({"format": "hidden-effect-answer/2", "task": "t", **said}), "utf-8")
    return score_task("t", truth, read_answer(path, "t", WINDOWS, NAMES))


LAG = hide("drive_lag", tau=0.5)


def test_a_right_name_has_a_point_and_its_interval_is_judged(tmp_path: Path) -> None:
    number = {"value": 0.45, "low": 0.4, "high": 0.5}
    score = ask(tmp_path, make_truth([LAG]), effects=[{"name": "drive_lag", "parameters": {"tau": number}}])
    assert (score.points, score.outcomes, score.false) == (1.0, {"drive_lag": "right"}, ())
    (interval,) = score.intervals
    assert (interval.label, interval.holds, interval.scale) == ("drive_lag.tau", True, 0.5)


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


def test_another_name_is_right_where_the_answer_says_that_the_log_does_not_tell_them_apart(
    tmp_path: Path,
) -> None:
    truth = make_truth([hide("clock_offset", d=0.2)])
    number = {"value": 0.2, "low": 0.1, "high": 0.3}
    one: Json = {"name": "transport_delay", "parameters": {"d": number}}
    assert ask(tmp_path, truth, effects=[one]).points == -1.0
    score = ask(tmp_path, truth, effects=[one | {"same_as": ["clock_offset"]}])
    assert (score.points, score.intervals) == (1.0, ())
    lag = one | {"name": "drive_lag", "parameters": {}, "same_as": ["clock_offset"]}
    assert ask(tmp_path, truth, effects=[lag]).points == -1.0


def test_another_name_that_the_truth_lists_is_right(tmp_path: Path) -> None:
    truth = make_truth([hide("contact_friction", "effective_track")])
    assert ask(tmp_path, truth, effects=[{"name": "effective_track"}]).points == 1.0


def test_what_is_said_not_to_show_has_no_point_and_is_not_missed(tmp_path: Path) -> None:
    score = ask(tmp_path, make_truth([LAG]), unobservable=["drive_lag", "understeer"])
    assert (score.points, score.outcomes, score.false) == (0.0, {"drive_lag": "unobservable"}, ())
    assert ask(tmp_path, make_truth([LAG]), unobservable=["drive_lag"], none=True).points == 0.0
    assert ask(tmp_path, make_truth([LAG]), unobservable=["understeer"], none=True).points == -1.0


def test_an_empty_log_wants_to_be_called_empty(tmp_path: Path) -> None:
    assert ask(tmp_path, make_truth(), none=True).points == 1.0
    assert ask(tmp_path, make_truth()).outcomes == {"nothing": "abstained"}
    assert ask(tmp_path, make_truth(), undecided=[["drive_lag", "turn_lag"]]).points == -1.0


def test_physics_without_a_name_is_answered_by_its_channel(tmp_path: Path) -> None:
    truth = make_truth(unlisted={"about": "hunting", "channels": ["w"]})
    assert ask(tmp_path, truth, other={"channels": ["w", "x"]}).points == 1.0
    assert ask(tmp_path, truth, other={"channels": ["x"]}).points == -1.0
    named = make_truth([LAG])
    assert ask(tmp_path, named, other={"channels": ["x"]}).outcomes == {"drive_lag": "abstained"}
    assert ask(tmp_path, named, effects=[{"name": "drive_lag"}], other={"channels": ["x"]}).points == 0.0


def test_what_is_tolerated_counts_neither_way(tmp_path: Path) -> None:
    truth = make_truth([LAG], tolerated=["lateral_skid", "other"])
    said = [{"name": "drive_lag"}, {"name": "lateral_skid"}]
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


GOOD = b'{"format": "hidden-effect-answer/2", "task": "t"'
HOSTILE = {
    "not JSON": b"effects: drive_lag",
    "not text": b"\xff\xfe\x00",
    "not an object": b"[]",
    "nested too deep": b"[" * 200_000,
    "no number": GOOD + b', "cpu_s": NaN}',
    "infinite": GOOD + b', "cpu_s": 1e999}',
    "a number of many digits": GOOD + b', "cpu_s": ' + b"9" * 5000 + b"}",
    "too large": GOOD + b', "cpu_s": 1' + b" " * 1_000_000 + b"}",
    "another task": b'{"format": "hidden-effect-answer/2", "task": "u"}',
    "another format": b'{"format": "hidden-effect-answer/1", "task": "t"}',
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
    "all effects said not to show": GOOD + f', "unobservable": {json.dumps(sorted(NAMES))}}}'.encode(),
}


@pytest.mark.parametrize("fault", HOSTILE)
def test_a_broken_answer_is_one_clear_line_and_counts_as_abstained(fault: str, tmp_path: Path) -> None:
    (tmp_path / "t.json").write_bytes(HOSTILE[fault])
    with pytest.raises(AnswerError) as caught:
        read_answer(tmp_path / "t.json", "t", WINDOWS, NAMES)
    assert "\n" not in str(caught.value)
    lines: list[str] = []
    (score,) = score_ring(tmp_path, {"t": make_truth([LAG])}, NAMES, lines.append)
    assert len(lines) == 1
    assert len(lines[0]) < 300 + len(str(tmp_path))
    assert score.points == 0.0
    assert score.outcomes == {"drive_lag": "abstained"}


def test_an_answer_that_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "t.json")
    with pytest.raises(AnswerError, match="no file"):
        read_answer(tmp_path / "t.json", "t", WINDOWS, NAMES)


def write_ring(folder: Path, truth: Json) -> tuple[Path, Path]:
    """A ring of one task, and its truth."""
    task, held = folder / "rings" / "open" / "t", folder / "truths" / "open"
    task.mkdir(parents=True)
    held.mkdir(parents=True)
    text = json.dumps({"format": "hidden-effect-truth/2", **truth}).encode()
    (held / "t.json").write_bytes(text)
    (task / "task.toml").write_text(f'truth_sha256 = "{hashlib.sha256(text).hexdigest()}"\n', "utf-8")
    (folder / "rings" / "names.json").write_text(json.dumps(NAMES), "utf-8")
    return task, held / "t.json"


def test_only_the_truth_that_was_published_counts(tmp_path: Path) -> None:
    task, path = write_ring(tmp_path, make_truth([LAG]))
    assert read_truth(path, task)["effects"] == [LAG]
    path.write_bytes(path.read_bytes() + b" ")
    with pytest.raises(AnswerError, match="not the truth whose hash"):
        read_truth(path, task)


def test_the_scorer_runs_outside_the_repository(tmp_path: Path) -> None:
    write_ring(tmp_path, make_truth([LAG]))
    shutil.copyfile(HERE / "score.py", tmp_path / "score.py")
    (tmp_path / "answers").mkdir()
    (tmp_path / "answers" / "t.json").write_bytes(GOOD + b', "effects": [{"name": "drive_lag"}]}')
    # Nothing of this project, and no package but numpy, may be found.
    blocked = (
        "import sys\n"
        "class Refuse:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name.split('.')[0] in {'game', 'pipeline', 'msgspec', 'polars', 'scipy', 'mcap'}:\n"
        "            raise ImportError(name)\n"
        "sys.meta_path.insert(0, Refuse())\n"
        "import runpy\n"
        "sys.argv = ['score.py', 'answers', '--misses', '--json', 'scores.json']\n"
        "runpy.run_path('score.py', run_name='__main__')\n"
    )
    command = [sys.executable, "-P", "-c", blocked]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads((tmp_path / "scores.json").read_text("utf-8"))["open"]["points"] == [1.0, 1.0, 1.0]


def test_without_a_truth_the_scorer_says_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, truth = write_ring(tmp_path, make_truth([LAG]))
    truth.unlink()
    words = ["--rings", str(tmp_path / "rings"), "--truths", str(tmp_path / "truths")]
    assert scorer.main([str(tmp_path), *words]) == 1
    assert capsys.readouterr().err.endswith("make the rings, or give --truths FOLDER\n")
