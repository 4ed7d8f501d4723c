"""The scorer of the game: one file, Python 3.11 and numpy, and names.json beside it.

    python score.py ANSWERS --rings RINGS --truths TRUTHS [--misses] [--json scores.json]

ANSWERS is a folder of <task>.json, TRUTHS the folder of <ring>/<task>.json that the maker of the rings holds.
A truth counts only if its SHA-256 is the one that its task was published with. An answer that is missing or
broken counts as abstained, with one line on the error stream. Every score has its 95 % interval over tasks
(bootstrap of 2,000 resamples). The rules are those of benchmarks/game/hidden_effect.md. Exit code 0; 1 where
there is nothing to score with.
"""

import argparse
import hashlib
import json
import math
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Json = Mapping[str, Any]
Number = tuple[float, float | None, float | None]

ANSWER_FORMAT, TRUTH_FORMAT = "hidden-effect-answer/2", "hidden-effect-truth/2"
CHANNELS = ("x", "y", "w")
MOST_BYTES = 1_000_000  # an answer has some 5 kB
MOST_EFFECTS, MOST_GROUPS, MOST_CANDIDATES = 10, 5, 6
MOST_UNOBSERVABLE = 15  # of some 50 names: whoever lists all of them says nothing
MOST_WORDS = 2_000
MOST_TOLERATED = 4  # claims that nobody can judge; more of them dilute what is right
LARGEST = 1e9  # numbers beyond it are no quantity of a vehicle, and their squares would overflow
RESAMPLES = 2_000
_OUTCOMES, _MEDIANS = ("right", "undecided", "unobservable", "abstained", "wrong"), ("width", "cpu_s")
_KEYS = {"format", "task", "effects", "none", "undecided", "unobservable", "other", "poses", "cpu_s"}
_LEAST = 1e-6  # smaller errors [m], [rad] are as good as none

# Effects that some logs cannot tell apart: one stands for the other where the answer says that it may.
ALIKE: Mapping[str, frozenset[str]] = {
    "icr_offset": frozenset({"lever_arm"}),
    "icr_lateral": frozenset({"lever_arm"}),
    "lever_arm": frozenset({"icr_offset", "icr_lateral"}),
    "clock_offset": frozenset({"transport_delay"}),
    "transport_delay": frozenset({"clock_offset"}),
    # Where wheels slide little and nothing is slow, friction is a wider track.
    "contact_friction": frozenset({"effective_track"}),
    "drive_lag": frozenset({"body_inertia"}),
    "body_inertia": frozenset({"drive_lag"}),
    "grade_load": frozenset({"slope_creep"}),
    "slope_creep": frozenset({"grade_load"}),
}
# A point beside base_link is a centre of rotation shifted in two directions: both together, whatever is said.
TOGETHER: Mapping[str, frozenset[str]] = {"lever_arm": frozenset({"icr_offset", "icr_lateral"})}


class AnswerError(Exception):
    """What is wrong with an answer or a truth, in one line."""


@dataclass(frozen=True)
class Answer:
    """What was said of a task.

    Attributes:
        effects: numbers (value, low, high) by name and parameter; low and high may be None.
        same_as: of a named effect, others that the log does not tell apart from it.
        none: that nothing is hidden.
        undecided: groups of candidates of which one acts.
        unobservable: effects of which the log does not tell.
        other: channels of physics that no name fits; empty where none was claimed.
        poses: predicted ends of the windows, shape (n, 3); None where none were given.
        cpu_s: seconds that it took; None where not told.
    """

    effects: Mapping[str, Mapping[str, Number]] = field(default_factory=dict)
    same_as: Mapping[str, frozenset[str]] = field(default_factory=dict)
    none: bool = False
    undecided: tuple[frozenset[str], ...] = ()
    unobservable: frozenset[str] = frozenset()
    other: frozenset[str] = frozenset()
    poses: Floats | None = None
    cpu_s: float | None = None


@dataclass(frozen=True)
class Interval:
    """The 95 % interval of a number that was named by its own name, beside the truth.

    Attributes:
        label: effect and parameter.
        truth, value, low, high: in the parameter's unit.
        scale: distance of the truth from the neutral value; None where there is none.
    """

    label: str
    truth: float
    value: float
    low: float
    high: float
    scale: float | None = None

    @property
    def holds(self) -> bool:
        """Whether the truth is inside."""
        return self.low <= self.truth <= self.high


@dataclass(frozen=True)
class TaskScore:
    """What an answer to one task is worth.

    Attributes:
        task: its id.
        points: -1 to 1.
        outcomes: of each hidden effect, of `unlisted` or of `nothing`: right, undecided, unobservable,
            abstained or wrong.
        named: names of the answer.
        groups: candidates of what it left undecided, joined by `|`.
        flagged: channels of `other`.
        false: claims that are not true.
        intervals: of every number that was named by its own name.
        over_floor: errors of position and yaw over those of the true physics; None where these are not known.
        over_ideal: the same over those of the ideal model; None without held-out windows.
        cpu_s: as told.
    """

    task: str
    points: float
    outcomes: Mapping[str, str]
    named: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    flagged: str = ""
    false: tuple[str, ...] = ()
    intervals: tuple[Interval, ...] = ()
    over_floor: tuple[float, float] | None = None
    over_ideal: tuple[float, float] | None = None
    cpu_s: float | None = None

    @property
    def is_empty(self) -> bool:
        """Whether nothing was hidden."""
        return "nothing" in self.outcomes

    @property
    def wrong_names(self) -> tuple[str, ...]:
        """Names that are not true: claims of the gravest kind."""
        return tuple(name for name in self.named if name in self.false)

    def list_hidden(self, *outcomes: str) -> tuple[str, ...]:
        """Hidden effects that came out in one of these ways."""
        listed = set(self.outcomes) - {"nothing", "unlisted"}
        return tuple(name for name in sorted(listed) if self.outcomes[name] in outcomes)


def read_answer(path: Path, task: str, windows: int, names: Mapping[str, Any]) -> Answer:
    """Read an answer and check it.

    Args:
        path: its file.
        task: which task it must be of.
        windows: how many poses it may predict.
        names: the published list.

    Raises:
        AnswerError: what is wrong, in one line.
    """
    if not path.is_file():
        raise AnswerError("no file of that name")
    with path.open("rb") as stream:
        raw = stream.read(MOST_BYTES + 1)
    if len(raw) > MOST_BYTES:
        raise AnswerError(f"larger than {MOST_BYTES} bytes")
    try:
        content = json.loads(raw.decode("utf-8"), object_pairs_hook=_read_object)
    except (ValueError, RecursionError) as problem:
        raise AnswerError(f"not JSON: {_shorten(problem)}") from problem
    if not isinstance(content, dict):
        raise AnswerError("not a JSON object")
    _check_keys(content, _KEYS, "the answer")
    for key, wanted in (("format", ANSWER_FORMAT), ("task", task)):
        if content.get(key) != wanted:
            raise AnswerError(f"{key} is {_shorten(content.get(key))}, not {wanted!r}")
    effects, same_as = _read_effects(content.get("effects", []), names)
    undecided = _read_groups(content.get("undecided", []), names, set(effects))
    other = _read_other(content.get("other"))
    unobservable = frozenset(
        _read_name(one, names)
        for one in _read_list(content.get("unobservable", []), MOST_UNOBSERVABLE, "unobservable")
    )
    none = content.get("none", False)
    if not isinstance(none, bool):
        raise AnswerError(f"none is {_shorten(none)}, not true or false")
    if none and (effects or undecided or other):
        raise AnswerError("none is true, but something is named")
    cpu_s = content.get("cpu_s")
    if cpu_s is not None and _read_number(cpu_s, "cpu_s") < 0.0:
        raise AnswerError("cpu_s is below zero")
    poses = _read_poses(content.get("poses"), windows)
    return Answer(effects, same_as, none, undecided, unobservable, other, poses, cpu_s)


def _read_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key stands twice in an object")
    return found


def _shorten(what: object) -> str:
    text = repr(what) if isinstance(what, str | None) else str(what)
    text = " ".join(text.split()).encode("ascii", "replace").decode()
    return text if len(text) <= 60 else f"{text[:57]}..."


def _check_keys(given: Json, known: set[str], where: str) -> None:
    odd = sorted(set(given) - known)
    if odd:
        raise AnswerError(f"{where} has no key {_shorten(odd[0])}; it may have {', '.join(sorted(known))}")


def _read_list(given: object, most: int, what: str) -> list[Any]:
    if not isinstance(given, list) or len(given) > most:
        raise AnswerError(f"{what} is not a list of at most {most}")
    return given


def _read_name(given: object, names: Mapping[str, Any]) -> str:
    if not isinstance(given, str) or given not in names:
        raise AnswerError(f"{_shorten(given)} is not a name of the published list")
    return given


def _read_number(given: object, what: str) -> float:
    if isinstance(given, bool) or not isinstance(given, int | float) or not abs(given) <= LARGEST:
        raise AnswerError(f"{what} is {_shorten(given)}, not a finite number up to {LARGEST:g}")
    return float(given)


def _read_effects(
    given: object, names: Mapping[str, Any]
) -> tuple[dict[str, dict[str, Number]], dict[str, frozenset[str]]]:
    found: dict[str, dict[str, Number]] = {}
    same_as: dict[str, frozenset[str]] = {}
    for entry in _read_list(given, MOST_EFFECTS, "effects"):
        if not isinstance(entry, dict):
            raise AnswerError("an effect is not an object")
        _check_keys(entry, {"name", "parameters", "same_as"}, "an effect")
        name = _read_name(entry.get("name"), names)
        if name in found:
            raise AnswerError(f"{name} is named twice")
        parameters = entry.get("parameters", {})
        if not isinstance(parameters, dict):
            raise AnswerError(f"parameters of {name} are not an object")
        _check_keys(parameters, set(names[name]["parameters"]), name)
        found[name] = {key: _read_interval(value, f"{name}.{key}") for key, value in parameters.items()}
        alike = _read_list(entry.get("same_as", []), MOST_CANDIDATES, f"same_as of {name}")
        same_as[name] = frozenset(_read_name(one, names) for one in alike)
    return found, same_as


def _read_interval(given: object, what: str) -> Number:
    if not isinstance(given, dict):
        raise AnswerError(f"{what} is not an object")
    _check_keys(given, {"value", "low", "high"}, what)
    value = _read_number(given.get("value"), f"{what}.value")
    if given.get("low") is None and given.get("high") is None:
        return value, None, None
    low, high = _read_number(given.get("low"), f"{what}.low"), _read_number(given.get("high"), f"{what}.high")
    if not low <= value <= high:
        raise AnswerError(f"{what}: low, value and high are not in order")
    return value, low, high


def _read_groups(given: object, names: Mapping[str, Any], named: set[str]) -> tuple[frozenset[str], ...]:
    groups = []
    for group in _read_list(given, MOST_GROUPS, "undecided"):
        candidates = [_read_name(one, names) for one in _read_list(group, MOST_CANDIDATES, "a group")]
        if len(set(candidates)) < 2 or len(set(candidates)) < len(candidates):
            raise AnswerError("a group of undecided needs two different names or more")
        if named & set(candidates):
            raise AnswerError(f"{min(named & set(candidates))} is named and undecided")
        groups.append(frozenset(candidates))
    return tuple(groups)


def _read_other(given: object) -> frozenset[str]:
    if given is None:
        return frozenset()
    if not isinstance(given, dict):
        raise AnswerError("other is not an object")
    _check_keys(given, {"channels", "formula"}, "other")
    channels, formula = given.get("channels"), given.get("formula", "")
    if not isinstance(channels, list) or not channels or not all(one in CHANNELS for one in channels):
        raise AnswerError(f"channels of other are not a list of {', '.join(CHANNELS)}")
    if not isinstance(formula, str) or len(formula) > MOST_WORDS:
        raise AnswerError(f"formula of other is not a text of at most {MOST_WORDS} characters")
    return frozenset(channels)


def _read_poses(given: object, windows: int) -> Floats | None:
    if given is None:
        return None
    if not isinstance(given, list) or len(given) != windows:
        raise AnswerError(f"poses are not a list of {windows}, one a window")
    rows = []
    for row in given:
        if not isinstance(row, list) or len(row) != 3:
            raise AnswerError("a pose is not [x, y, yaw]")
        rows.append([_read_number(value, "a pose") for value in row])
    return np.array(rows)


def score_task(task: str, truth: Json, answer: Answer) -> TaskScore:
    """Compare an answer with the truth of its task.

    Args:
        task: its id.
        truth: its effects (name, parameters, same_as), unlisted (channels) or None, names that are tolerated,
            and held_out or None.
        answer: what was said.
    """
    hidden, tolerated, unlisted = truth["effects"], set(truth["tolerated"]), truth["unlisted"]
    outcomes: dict[str, str] = {}
    credit, answering, accepted = 0.0, set[str](), set[str]()
    for effect in hidden:
        name = effect["name"]
        words = {name, *effect["same_as"]}
        match = _find_match(name, words, answer)
        answering |= match | (TOGETHER.get(name, frozenset()) & set(answer.effects))
        words |= ALIKE.get(name, frozenset())
        accepted |= words
        groups = [group for group in answer.undecided if group & words]
        if match:
            outcomes[name] = "right"
            credit += 1.0
        elif groups:
            outcomes[name] = "undecided"
            credit += 1.0 / min(map(len, groups))
        elif answer.unobservable & words:
            outcomes[name] = "unobservable"
    is_open = any(outcomes.get(effect["name"]) not in {"right", "undecided"} for effect in hidden)
    odd = [frozenset([name]) for name in answer.effects if name not in answering]
    odd += [group for group in answer.undecided if not group & accepted]
    false = ["|".join(sorted(group)) for group in odd if not group & tolerated]
    diluted = MOST_TOLERATED / max(len(odd) - len(false), MOST_TOLERATED)
    if answer.other and unlisted is not None and answer.other & set(unlisted["channels"]):
        outcomes["unlisted"] = "right"
        credit += 1.0
    elif answer.other and "other" not in tolerated and (unlisted is not None or not is_open):
        false.append("other")
    things = [effect["name"] for effect in hidden] + ["unlisted"] * (unlisted is not None) or ["nothing"]
    if answer.none and things == ["nothing"]:
        outcomes["nothing"] = "right"
        credit = 1.0
    elif answer.none:
        # It denies each of them, but what it says does not show.
        false += ["none"] * sum(outcomes.get(one) != "unobservable" for one in things)
    silent = "wrong" if false else "abstained"
    over_floor, over_ideal = _judge_poses(truth.get("held_out"), answer.poses)
    return TaskScore(
        task,
        max((diluted * credit - len(false)) / len(things), -1.0),
        {name: outcomes.get(name, silent) for name in things},
        tuple(answer.effects),
        tuple("|".join(sorted(group)) for group in answer.undecided),
        "".join(sorted(answer.other)),
        tuple(false),
        tuple(list_intervals(hidden, answer)),
        over_floor,
        over_ideal,
        answer.cpu_s,
    )


def _find_match(name: str, words: set[str], answer: Answer) -> set[str]:
    """Names of the answer that stand for a hidden effect."""
    if words & set(answer.effects):
        return words & set(answer.effects)
    together = TOGETHER.get(name)
    if together is not None:
        return set(together) if together <= set(answer.effects) else set()
    alike = ALIKE.get(name, frozenset())
    said = [one for one, same in answer.same_as.items() if name in same and one in alike]
    return set(sorted(said)[:1])


def list_intervals(hidden: Sequence[Json], answer: Answer) -> Iterator[Interval]:
    """Intervals of numbers of effects that were named by their own name."""
    for effect in hidden:
        told = answer.effects.get(effect["name"], {})
        for name, true in effect["parameters"].items():
            value, low, high = told.get(name, (0.0, None, None))
            if low is not None and high is not None and true["value"] is not None:
                label = f"{effect['name']}.{name}"
                yield Interval(label, true["value"], value, low, high, true["scale"])


def _judge_poses(
    held_out: Json | None, told: Floats | None
) -> tuple[tuple[float, float] | None, tuple[float, float] | None]:
    """Errors over those of the true physics and of the ideal model; no poses count as the ideal's."""
    if held_out is None:
        return None, None
    ideal = (held_out["ideal"]["position_m"], held_out["ideal"]["yaw_rad"])
    errors = ideal
    if told is not None:
        away = told - np.array(held_out["poses"])
        turned = np.angle(np.exp(1j * away[:, 2]))
        errors = (
            float(np.sqrt(np.mean(np.sum(away[:, :2] ** 2, axis=1)))),
            float(np.sqrt(np.mean(turned**2))),
        )
    floor = held_out["floor"]
    over_floor = None if floor is None else _divide(errors, (floor["position_m"], floor["yaw_rad"]))
    return over_floor, _divide(errors, ideal)


def _divide(errors: tuple[float, float], by: tuple[float, float]) -> tuple[float, float]:
    position, yaw = (max(one, _LEAST) / max(other, _LEAST) for one, other in zip(errors, by, strict=True))
    return position, yaw


def measure_scores(scores: Sequence[TaskScore]) -> dict[str, tuple[float, float, float]]:
    """Every score of a ring: value and the ends of its 95 % interval over tasks; NaN where nothing tells."""
    each = [_list_values(score) for score in scores]
    draws = np.random.default_rng(0).integers(len(scores), size=(RESAMPLES, len(scores))).tolist()
    measured = {}
    for name in _WORDS:
        parts = [values[name] for values in each]
        found = np.array([_join(name, [parts[task] for task in draw]) for draw in draws])
        found = found[np.isfinite(found)]
        low, high = np.percentile(found, [2.5, 97.5]) if found.size else (math.nan, math.nan)
        measured[name] = (_join(name, parts), float(low), float(high))
    return measured


def _list_values(score: TaskScore) -> dict[str, list[float]]:
    """What a task adds to each score; nothing where it tells nothing."""
    outcomes = list(score.outcomes.values())
    over_floor, over_ideal = score.over_floor or (None, None), score.over_ideal or (None, None)
    given = {
        "position_over_floor": over_floor[0],
        "position_over_ideal": over_ideal[0],
        "yaw_over_floor": over_floor[1],
        "yaw_over_ideal": over_ideal[1],
        "cpu_s": score.cpu_s,
    }
    return {
        "points": [score.points],
        **{kind: [float(kind == said) for said in outcomes] for kind in _OUTCOMES},
        "false_in_empty": [float(len(score.false))] if score.is_empty else [],
        "coverage": [float(one.holds) for one in score.intervals],
        "width": [(one.high - one.low) / one.scale for one in score.intervals if one.scale],
        **{name: [] if value is None else [value] for name, value in given.items()},
    }


def _join(name: str, parts: Sequence[Sequence[float]]) -> float:
    """One score of many tasks: the mean of all values, of ratios the geometric one, or the median."""
    values = [value for part in parts for value in part]
    if not values:
        return math.nan
    if name in _MEDIANS:
        return float(np.median(values))
    if "_over_" in name:
        return math.exp(sum(map(math.log, values)) / len(values))
    return sum(values) / len(values)


def score_ring(
    answers: Path, truths: Mapping[str, Json], names: Mapping[str, Any], tell: Callable[[str], None]
) -> list[TaskScore]:
    """Score every task of a ring; an answer with a fault counts as abstained, and a line tells the fault."""
    scores, missing = [], 0
    for task, truth in truths.items():
        path = answers / f"{task}.json"
        answer = Answer()
        if not path.exists():
            missing += 1
        else:
            try:
                answer = read_answer(path, task, len(truth["held_out"]["poses"]), names)
            except (AnswerError, OSError) as problem:
                tell(f"{path}: {problem}; it counts as abstained")
        scores.append(score_task(task, truth, answer))
    if missing:
        tell(f"{missing} of {len(scores)} tasks have no answer; they count as abstained")
    return scores


_WORDS = {
    "points": "points a task, -1 to 1",
    "right": "names: right",
    "undecided": "names: undecided, right one among them",
    "unobservable": "names: said not to show in the log",
    "abstained": "names: abstained",
    "wrong": "names: wrong",
    "false_in_empty": "false claims in an empty log",
    "coverage": "95 % intervals that hold the truth",
    "width": "width of intervals over the effect, median",
    "position_over_floor": "held-out position error over the floor",
    "position_over_ideal": "held-out position error over the ideal's",
    "yaw_over_floor": "held-out heading error over the floor",
    "yaw_over_ideal": "held-out heading error over the ideal's",
    "cpu_s": "CPU [s], median",
}


def format_scores(ring: str, count: int, measured: Mapping[str, tuple[float, float, float]]) -> list[str]:
    """The table of a ring."""
    lines = [f"{ring}: {count} tasks{'':<32}value      95 % interval over tasks"]
    for name, (value, low, high) in measured.items():
        said = "-" if math.isnan(value) else f"{value:>8.3f}   [{low:.3f}, {high:.3f}]"
        lines.append(f"  {_WORDS[name]:<44}{said}")
    return lines


def list_misses(scores: Sequence[TaskScore]) -> list[str]:
    """A line for each task that is not all right."""
    lines = []
    for score in scores:
        if score.false or set(score.outcomes.values()) != {"right"}:
            said = ", ".join(f"{name} {outcome}" for name, outcome in score.outcomes.items())
            lines.append(
                f"  {score.task}: {said}{'; false: ' + ', '.join(score.false) if score.false else ''}"
            )
    return lines


def read_truth(path: Path, task: Path) -> Json:
    """The truth of a task.

    Args:
        path: its file, which the maker holds.
        task: folder of the task, which has had its hash since it was published.

    Raises:
        AnswerError: it is none, or not the one that was published.
    """
    try:
        text = path.read_bytes()
        published = tomllib.loads((task / "task.toml").read_text("utf-8"))["truth_sha256"]
    except (OSError, KeyError, ValueError) as problem:
        raise AnswerError(f"{task.name}: no truth can be read: {_shorten(problem)}") from None
    if hashlib.sha256(text).hexdigest() != published:
        raise AnswerError(f"{path}: not the truth whose hash its task was published with")
    truth: Json = json.loads(text)
    if truth.get("format") != TRUTH_FORMAT:
        raise AnswerError(f"{path}: not a truth of the format {TRUTH_FORMAT}")
    return truth


def read_truths(rings: Path, truths: Path) -> dict[str, dict[str, Json]]:
    """Truths by ring and task, of the tasks that have one.

    Raises:
        AnswerError: there is none, or one is not what was published.
    """
    found: dict[str, dict[str, Json]] = {}
    for task in sorted(path.parent for path in rings.glob("*/*/task.toml")):
        path = truths / task.parent.name / f"{task.name}.json"
        if path.exists():
            found.setdefault(task.parent.name, {})[task.name] = read_truth(path, task)
    if not found:
        raise AnswerError(f"{truths}: no truth of a task of {rings}; make the rings, or give --truths FOLDER")
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Score a folder of answers."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("answers", type=Path)
    parser.add_argument("--rings", type=Path, default=Path("rings"), help="folder of the rings")
    parser.add_argument("--truths", type=Path, default=Path("truths"), help="folder of their truths")
    parser.add_argument("--misses", action="store_true", help="a line for each task that is not all right")
    parser.add_argument("--json", type=Path, help="write the scores there")
    given = parser.parse_args(arguments)
    if not given.answers.is_dir():
        parser.error(f"{given.answers}: no folder; give the folder of the answers")
    try:
        names = json.loads((given.rings / "names.json").read_text("utf-8"))
        truths = read_truths(given.rings, given.truths)
        written = {ring: _show_ring(given, ring, tasks, names) for ring, tasks in truths.items()}
        if given.json:
            given.json.write_text(json.dumps(written, indent=1) + "\n", encoding="utf-8")
    except (AnswerError, OSError) as problem:
        print(problem, file=sys.stderr)
        return 1
    return 0


def _show_ring(
    given: argparse.Namespace, ring: str, truths: Mapping[str, Json], names: Mapping[str, Any]
) -> dict[str, list[float | None]]:
    scores = score_ring(given.answers, truths, names, lambda line: print(line, file=sys.stderr))
    measured = measure_scores(scores)
    print(*format_scores(ring, len(scores), measured), sep="\n")
    if given.misses:
        print(*list_misses(scores), sep="\n")
    return {name: [None if math.isnan(one) else one for one in values] for name, values in measured.items()}


if __name__ == "__main__":
    sys.exit(main())
