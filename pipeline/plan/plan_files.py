"""Files of a plan, and the comparison of its expected gains with the drive."""

import csv
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from mcap_ros2.writer import Writer

from pipeline.core import Floats, TomlError, format_share, group_by, parse_toml, read_bounded_text
from pipeline.estimation.terms import SUGGESTION
from pipeline.logs.schema import definition_text
from pipeline.models import find_effect, format_value
from pipeline.plan.manoeuvres import LONGEST_S, RATE_HZ, PlanError
from pipeline.plan.plan import SAFETY, ExpectedGain, Plan
from pipeline.results import RunDiagnosis
from pipeline.run import DriveSeries, MotionRun, name_inputs
from pipeline.sources import Vehicle
from pipeline.store import TEMPORARY, replace_file
from pipeline.words import describe_separation, suggest_drive

PAGE = "plan.html"
_CHECKED = ("question", "effects", "kind", "goal", "now", "expected", "decided_after_s", "drives")
"""What a file says of a question, which `slip plan --check` compares with the drive."""
_NAMES = ("plan.toml", "plan.csv", "plan.mcap")
FILES = (*_NAMES, PAGE)
# Fields of speed and turn by message type.
_FIELDS: Mapping[str, tuple[str, str]] = {
    "geometry_msgs/msg/Twist": ("linear.x", "angular.z"),
    "geometry_msgs/msg/TwistStamped": ("twist.linear.x", "twist.angular.z"),
    "ackermann_msgs/msg/AckermannDrive": ("speed", "steering_angle"),
    "ackermann_msgs/msg/AckermannDriveStamped": ("drive.speed", "drive.steering_angle"),
}
WHEELS = "std_msgs/msg/Float64"
"""Message type of wheel speeds [rad/s], one topic per side."""
_PAIR = 2
# A player shifts log times to the present; a fixed first stamp makes the bytes of equal plans equal.
_START_NS = 1_700_000_000_000_000_000
_SECOND = 1_000_000_000


def list_types(*, steered: bool) -> tuple[str, ...]:
    """Message types of body commands with a steering angle, or with a yaw rate."""
    return tuple(name for name in _FIELDS if ("Ackermann" in name) == steered)


class StoredPlan(msgspec.Struct, frozen=True):
    """Contents of a `plan.toml` that are compared with the outcome.

    Attributes:
        vehicle: id of the vehicle.
        runs: names of the runs that the plan is based on.
        promises: expected gains by question, for the drive alone.
    """

    vehicle: str
    runs: list[str] = []
    promises: list[ExpectedGain] = []


def write_plan(plan: Plan, folder: Path, page: str = "") -> tuple[Path, ...]:
    """Write all files of a plan into a folder, which is created if missing.

    Args:
        plan: the plan.
        folder: folder of its files.
        page: the plan as a page for viewing; not written if empty.

    Raises:
        PlanError: ``cannot_write``, or ``wrong_type`` for a message type that cannot carry the commands.
    """
    types = [*list_types(steered=plan.steered), *([WHEELS] if plan.wheels is not None else [])]
    topics = plan.topic.split(", ")
    if plan.type_name not in types or len(topics) != (_PAIR if plan.type_name == WHEELS else 1):
        what = f"commands of this vehicle cannot be written as {plan.type_name}"
        hint = f"Give --type as one of {', '.join(types)}; {WHEELS} on --topic '/LEFT, /RIGHT'."
        raise PlanError("wrong_type", what, where=plan.topic, hint=hint)
    toml, csv, mcap = _NAMES
    texts = {csv: _format_csv(plan), toml: _format_toml(plan), **({PAGE: page} if page else {})}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # All are whole before the first takes its place: an interrupted plan leaves the earlier one.
        with tempfile.TemporaryDirectory(prefix=TEMPORARY, dir=folder) as drafts:
            _write_mcap(plan, Path(drafts) / mcap)
            for name, text in texts.items():
                replace_file(Path(drafts) / name, text.encode())
            for name in (mcap, *texts):
                (Path(drafts) / name).replace(folder / name)
    except OSError as error:
        what = f"the plan cannot be written ({error.strerror})"
        raise PlanError("cannot_write", what, where=str(folder), hint="Choose another --folder.") from None
    return tuple(folder / name for name in (*_NAMES, *([PAGE] if page else [])))


def read_plan(path: Path) -> StoredPlan:
    """Read a `plan.toml`, given itself or the folder that contains it.

    Raises:
        PlanError: ``no_plan``, the file is missing or is not a plan.
        MotionError: ``unknown_effect``, a question concerns an unknown effect.
    """
    file = path / _NAMES[0] if path.is_dir() else path
    try:
        stored = msgspec.convert(parse_toml(read_bounded_text(file)), StoredPlan)
    except OSError as error:
        what = f"the plan cannot be read ({error.strerror})"
    except TomlError as error:
        what = f"this is not a plan: {error}"
    except (UnicodeDecodeError, msgspec.ValidationError):
        what = "this is not a plan.toml that `slip plan` wrote"
    else:
        for effect in (name for answer in stored.promises for name in answer.effects):
            find_effect(effect)
        return stored
    raise PlanError("no_plan", what, where=str(file), hint="Give the folder that `slip plan` wrote.")


def _write_mcap(plan: Plan, path: Path) -> None:
    topics = plan.topic.split(", ")
    definition = definition_text(plan.type_name)
    if definition is None:
        raise AssertionError(plan.type_name)
    with path.open("wb") as file, Writer(file) as writer:
        schema = writer.register_msgdef(plan.type_name, definition)
        for number, row in enumerate(zip(plan.commands.times, *_list_values(plan), strict=True)):
            at = _START_NS + round(float(row[0]) * _SECOND)
            header = {"header": {"stamp": {"sec": at // _SECOND, "nanosec": at % _SECOND}}}
            for topic, message in zip(topics, row[1:], strict=True):
                writer.write_message(topic, schema, header | message, at, at, number)
        writer.add_metadata("safety", {"text": " ".join(SAFETY)})


def _list_values(plan: Plan) -> list[list[dict[str, object]]]:
    """Messages of every topic, without header; fields that they lack are zero."""
    if plan.type_name == WHEELS and plan.wheels is not None:
        return [[{"data": float(value)} for value in side] for side in plan.wheels]
    paths = _FIELDS[plan.type_name]
    pairs = zip(plan.commands.speed.tolist(), plan.commands.turn.tolist(), strict=True)
    return [[_nest(dict(zip(paths, pair, strict=True))) for pair in pairs]]


def _nest(values: Mapping[str, float]) -> dict[str, object]:
    """Nested fields of a message from values by path, for example ``twist.linear.x``."""
    message: dict[str, object] = {}
    for path, value in values.items():
        *outer, name = path.split(".")
        inner: dict[str, Any] = message
        for key in outer:
            inner = inner.setdefault(key, {})
        inner[name] = value
    return message


def _format_csv(plan: Plan) -> str:
    turn = "steering_rad" if plan.steered else "yaw_rate_radps"
    rows = zip(
        plan.commands.times.tolist(), plan.commands.speed.tolist(), plan.commands.turn.tolist(), strict=True
    )
    lines = [f"time_s,speed_mps,{turn}", *(f"{t:.3f},{v:.6f},{w:.6f}" for t, v, w in rows)]
    return "\n".join(lines) + "\n"


def _format_toml(plan: Plan) -> str:
    turn = "max_steering_rad" if plan.steered else "max_yaw_rate_radps"
    faster = "max_steering_rate_radps" if plan.steered else "max_yaw_acceleration_radps2"
    lines = ["# What to drive next. `slip plan --check` compares the drive with these expectations."]
    lines += [f"# {line}" for line in SAFETY]
    lines += _format_table(
        {
            "vehicle": plan.vehicle,
            "runs": list(plan.runs),
            "topic": plan.topic,
            "type": plan.type_name,
            "rate_hz": RATE_HZ,
            "duration_s": plan.commands.duration_s,
        }
    )
    lines += ["", "[limits]"]
    lines += _format_table(
        {
            "max_speed_mps": plan.limits.speed_mps,
            turn: plan.limits.turn,
            "max_acceleration_mps2": plan.limits.acceleration_mps2,
            faster: plan.limits.turn_rate,
            "max_lateral_acceleration_mps2": plan.limits.lateral_mps2,
        }
    )
    lines += ["", "# The start is the middle; the first side lies along the heading at the start.", "[area]"]
    lines += _format_table({**asdict(plan.area), "home_m": plan.home_m})
    for name, start in plan.manoeuvres:
        lines += ["", "[[manoeuvre]]", *_format_table({"name": name, "start_s": start})]
    for one in plan.informative:
        # Another diagnosis may suggest another term: what is said of it cannot be checked.
        if math.isfinite(one.decided_after_s) and SUGGESTION not in one.effects:
            lines += ["", "[[promises]]", *_format_table({name: getattr(one, name) for name in _CHECKED})]
    return "\n".join(lines) + "\n"


def _format_table(table: Mapping[str, object]) -> list[str]:
    return [f"{key} = {format_value(value)}" for key, value in table.items()]


@dataclass(frozen=True)
class CheckedAnswer:
    """An expected gain and its outcome.

    Attributes:
        question: as text.
        expected: as text.
        measured: as text.
        is_met: whether the outcome is as expected.
    """

    question: str
    expected: str
    measured: str
    is_met: bool


@dataclass(frozen=True)
class Check:
    """All expected gains with their outcomes, and the questions that remain open, as text."""

    answers: tuple[CheckedAnswer, ...]
    open: tuple[str, ...]

    def to_json(self) -> dict[str, object]:
        """The documented keys of `slip plan --check --json`."""
        rows = [
            {"question": one.question, "promised": one.expected, "measured": one.measured, "kept": one.is_met}
            for one in self.answers
        ]
        return {"kept": rows, "open": list(self.open)}


def check_plan(plan: StoredPlan, diagnosis: RunDiagnosis) -> Check:
    """Compare expected gains with the joint diagnosis of the earlier logs and those of the plan.

    A separation is fulfilled if no ambiguous group contains all of its effects any more and one of them is
    identified, or all are observable and none acts; an interval if it is as narrow as expected.
    """
    answers = tuple(
        _check_interval(one, diagnosis) if one.kind == "interval" else _check_separation(one, diagnosis)
        for one in plan.promises
    )
    still = [
        f"{' or '.join(group.candidates)}: {describe_separation(group)}" for group in diagnosis.undecided
    ]
    hidden = group_by((suggest_drive(name), name) for name in diagnosis.unobservable_why)
    still += [f"{', '.join(names)}: {advice}" for advice, names in hidden.items()]
    return Check(answers, tuple(still))


def _check_separation(answer: ExpectedGain, diagnosis: RunDiagnosis) -> CheckedAnswer:
    text = f"decided after {answer.decided_after_s:g} s (t = {answer.expected:.1f})"
    named = [effect.id for effect in diagnosis.effects if effect.id in answer.effects]
    asked = set(answer.effects)
    is_ambiguous = any(asked <= set(group.candidates) for group in diagnosis.undecided)
    if named and not is_ambiguous:
        # The identified effect explains the motion, which excludes its rival.
        return CheckedAnswer(answer.question, text, " and ".join(named), is_met=True)
    if is_ambiguous or asked & diagnosis.unobservable_why.keys():
        return CheckedAnswer(answer.question, text, "still open", is_met=False)
    # With more data the shared part of two effects may vanish: that is a decision, too.
    return CheckedAnswer(answer.question, text, "decided: no effect", is_met=True)


def _check_interval(answer: ExpectedGain, diagnosis: RunDiagnosis) -> CheckedAnswer:
    text = f"±{answer.goal:.2g} after {answer.decided_after_s:g} s"
    label = answer.question.partition(" ")[0]
    for effect in diagnosis.effects:
        for name, value in effect.parameters.items():
            if f"{effect.id}.{name}" == label:
                half = value.half
                return CheckedAnswer(
                    answer.question,
                    text,
                    f"{value.value:.3g} ±{half:.2g}",
                    is_met=half <= answer.goal,
                )
    return CheckedAnswer(answer.question, text, "not found", is_met=False)


_ALIKE = 0.6
"""Least similarity of the commands: a drive stopped at a third reaches it, other driving does not."""


def require_played(path: Path, runs: Sequence[MotionRun], vehicle: Vehicle) -> None:
    """Reject logs that do not contain the drive of the plan.

    Args:
        path: `plan.csv`; if it is missing, or a log has no commands, nothing is rejected.
        runs: of the drive.
        vehicle: their vehicle.

    Raises:
        PlanError: ``not_played``.
    """
    if not path.is_file() or any(run.commands is None for run in runs):
        return
    asked = _read_plan(path, vehicle)
    likeness = max(find_likeness(asked, _sample(run.commands, vehicle)) for run in runs if run.commands)
    if likeness < _ALIKE:
        what = f"no stretch of these commands matches the plan (similarity {format_share(likeness)})"
        hint = "Give the log in which the plan was driven."
        raise PlanError("not_played", what, where=", ".join(run.name for run in runs), hint=hint)


def find_likeness(asked: Floats, seen: Floats) -> float:
    """Highest correlation of a command sequence with any stretch of a recording.

    Args:
        asked: forward speed and yaw rate, shape (n, 2).
        seen: the same of the recording, at the same rate, shape (m, 2).
    """
    scale = np.sqrt(np.mean(asked**2, axis=0)) + 1e-9
    asked, seen = asked / scale, np.pad(seen / scale, ((len(asked), len(asked)), (0, 0)))
    together = sum(np.correlate(seen[:, axis], asked[:, axis], "valid") for axis in (0, 1))
    energy = np.concatenate(([0.0], np.cumsum(np.sum(seen**2, axis=1))))
    sizes = np.sqrt(np.maximum(energy[len(asked) :] - energy[: -len(asked)], 1e-9) * np.sum(asked**2))
    return float(np.max(together / sizes))


def _read_plan(path: Path, vehicle: Vehicle) -> Floats:
    try:
        names, *rows = csv.reader(read_bounded_text(path).splitlines())
        _, speed, turn = np.array(rows, dtype=np.float64).T
    except (OSError, ValueError, csv.Error) as error:
        what = "this is not a plan.csv that `slip plan` wrote"
        hint = "Give the folder that `slip plan` wrote."
        raise PlanError("no_plan", what, where=str(path), hint=hint) from error
    if names[-1].startswith("steering"):
        _, _, turn = vehicle.kinematics.asked({"speed": speed, "steering": turn}, vehicle)
    return np.column_stack((speed, turn))


def _sample(series: DriveSeries, vehicle: Vehicle) -> Floats:
    """Forward speed and yaw rate of a log's commands, each held, at the plan's rate."""
    speed, _, turn = vehicle.kinematics.asked(name_inputs(series, vehicle), vehicle)
    # A silence is as long as the longest plan at most.
    played = np.append(0.0, np.cumsum(np.minimum(np.diff(series.times), LONGEST_S)))
    times = np.arange(0.0, played[-1], 1.0 / RATE_HZ)
    held = np.maximum(np.searchsorted(played, times, side="right") - 1, 0)
    return np.column_stack((speed[held], turn[held]))
