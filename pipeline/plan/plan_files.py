"""Files of a plan, and the comparison of its expected gains with the drive."""

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from mcap_ros2.writer import Writer

from pipeline.core import (
    Floats,
    TomlError,
    format_digits,
    format_share,
    group_by,
    mapping_in,
    objects_in,
    parse_toml,
    pick,
    read_bounded_text,
    suffix_unit,
)
from pipeline.logs.schema import definition_text
from pipeline.models import find_effect, format_value
from pipeline.plan.manoeuvres import LONGEST_S, RATE_HZ, PlanError, is_steered
from pipeline.plan.plan import SAFETY, Plan
from pipeline.results import RunDiagnosis
from pipeline.run import MotionRun, name_inputs
from pipeline.sources import Fault, Vehicle, convert_to
from pipeline.store import Manifest, read_choices, replace_file
from pipeline.words import describe_separation, suggest_drive

FILES = ("plan.toml", "plan.csv", "plan.mcap", "plan.html")
# Fields of speed and turn by message type.
_FIELDS: Mapping[str, tuple[str, str]] = {
    "geometry_msgs/msg/Twist": ("linear.x", "angular.z"),
    "geometry_msgs/msg/TwistStamped": ("twist.linear.x", "twist.angular.z"),
    "ackermann_msgs/msg/AckermannDrive": ("speed", "steering_angle"),
    "ackermann_msgs/msg/AckermannDriveStamped": ("drive.speed", "drive.steering_angle"),
}
# A player shifts log times to the present; a fixed first stamp makes the bytes of equal plans equal.
_START_NS = 1_700_000_000_000_000_000
_SECOND = 1_000_000_000


def choose_topic(vehicle: Vehicle, manifest: Manifest | None = None) -> tuple[str, str]:
    """Topic and type of the body command of a stored run; the vehicle's usual one if it has none."""
    types = list_types(steered=is_steered(vehicle))
    chosen = None if manifest is None else read_choices(manifest).get("choices")
    command = chosen.get("command") if isinstance(chosen, dict) else None
    if isinstance(command, dict) and command.get("type") in types:
        return str(command["topic"]), str(command["type"])
    # The topic of a single motor does not accept body commands.
    usual = [topic for topic in vehicle.topics.command if "cmd" in topic and "motor" not in topic]
    return (usual or ["/cmd_vel"])[0], types[-1] if is_steered(vehicle) else types[0]


def list_commands(manifest: Manifest) -> list[str]:
    """Names of the topics of a stored run that may be its command, the chosen one first."""
    chosen = mapping_in(mapping_in(read_choices(manifest), "choices"), "command")
    return [str(one["topic"]) for one in (chosen, *objects_in(chosen, "others")) if "topic" in one]


def list_types(*, steered: bool) -> tuple[str, ...]:
    """Message types of body commands with a steering angle, or with a yaw rate."""
    return tuple(name for name in _FIELDS if ("Ackermann" in name) == steered)


Amount = Annotated[float, msgspec.Meta(ge=0.0, le=1e9)]
"""In SI units; no quantity of a model is larger."""


class Expectation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a file says of a `Question`, which `slip plan --check` compares with the drive."""

    question: str
    effects: list[str]
    kind: Literal["separation", "presence", "interval"]
    goal: Amount
    expected: Amount
    now: Amount = 0.0
    unit: str = "1"
    at_most: Amount = 0.0


class StoredPlan(msgspec.Struct, frozen=True):
    """Contents of a `plan.toml` that are compared with the outcome.

    Attributes:
        vehicle: id of the vehicle.
        runs: names of the runs that the plan is based on.
        promises: what is expected by question.
    """

    vehicle: str
    runs: list[str] = []
    promises: list[Expectation] = []


def write_plan(plan: Plan, folder: Path, page: str = "") -> tuple[Path, ...]:
    """Write all files of a plan into a folder, which is created if missing.

    Args:
        plan: the plan.
        folder: folder of its files.
        page: the plan as a page for viewing; not written if empty.

    Raises:
        PlanError: ``cannot_write``, or ``wrong_type`` for a message type that cannot carry the commands.
    """
    types = list_types(steered=plan.steered)
    if plan.type_name not in types:
        what = f"commands of this vehicle cannot be written as {plan.type_name}"
        hint = f"Give --type as one of {', '.join(types)}."
        raise PlanError("wrong_type", what, where=plan.topic, hint=hint)
    texts = (_format_toml(plan).encode(), _format_csv(plan).encode(), _format_mcap(plan), page.encode())
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # All are whole before the first takes its place: an interrupted plan leaves the earlier one.
        for name, text in zip(FILES, texts, strict=True):
            if text:
                replace_file(folder / name, text)
    except OSError as error:
        what = f"the plan cannot be written ({error.strerror})"
        raise PlanError("cannot_write", what, where=str(folder), hint="Choose another --folder.") from None
    return tuple(folder / name for name, text in zip(FILES, texts, strict=True) if text)


def read_plan(path: Path) -> StoredPlan:
    """Read a `plan.toml`, given itself or the folder that contains it.

    Raises:
        PlanError: ``no_plan``, the file is missing or is not a plan.
        MotionError: ``unknown_effect``, a question concerns an unknown effect.
    """
    file = path / FILES[0] if path.is_dir() else path
    try:
        stored = convert_to(StoredPlan, parse_toml(read_bounded_text(file)))
    except OSError as error:
        what = f"the plan cannot be read ({error.strerror})"
    except (TomlError, UnicodeDecodeError) as error:
        what = f"this is not a plan.toml that `slip plan` wrote: {error}"
    else:
        if not isinstance(stored, Fault):
            for effect in (name for answer in stored.promises for name in answer.effects):
                find_effect(effect)
            return stored
        what = f"this is not a plan.toml that `slip plan` wrote: {stored.what}"
    raise PlanError("no_plan", what, where=str(file), hint="Give the folder that `slip plan` wrote.")


def _format_mcap(plan: Plan) -> bytes:
    definition, content = definition_text(plan.type_name), io.BytesIO()
    if definition is None:
        raise AssertionError(plan.type_name)
    with Writer(content) as writer:
        schema = writer.register_msgdef(plan.type_name, definition)
        rows = zip(plan.commands.times, plan.commands.speed, plan.commands.turn, strict=True)
        for number, (time, *values) in enumerate(rows):
            at = _START_NS + round(float(time) * _SECOND)
            message: dict[str, Any] = {"header": {"stamp": {"sec": at // _SECOND, "nanosec": at % _SECOND}}}
            for path, value in zip(_FIELDS[plan.type_name], values, strict=True):
                *outer, name = path.split(".")
                inner = message
                for key in outer:
                    inner = inner.setdefault(key, {})
                inner[name] = float(value)
            writer.write_message(plan.topic, schema, message, at, at, number)
        writer.add_metadata("safety", {"text": " ".join(SAFETY)})
    return content.getvalue()


def _format_csv(plan: Plan) -> str:
    turn = "steering_rad" if plan.steered else "yaw_rate_radps"
    rows = zip(
        plan.commands.times.tolist(), plan.commands.speed.tolist(), plan.commands.turn.tolist(), strict=True
    )
    lines = [f"time_s,speed_mps,{turn}", *(f"{t:.3f},{v:.6f},{w:.6f}" for t, v, w in rows)]
    return "\n".join(lines) + "\n"


def _format_toml(plan: Plan) -> str:
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
    limits = {name: value for name, value in asdict(plan.limits).items() if math.isfinite(value)}
    lines += ["", "[limits]", *_format_table(limits)]
    lines += ["", "# The start is the middle; the first side lies along the heading at the start.", "[area]"]
    lines += _format_table({**asdict(plan.area), "home_m": plan.home_m})
    for name, start in plan.manoeuvres:
        lines += ["", "[[manoeuvre]]", *_format_table({"name": name, "start_s": start})]
    for one in plan.informative:
        lines += ["", "[[promises]]", *_format_table(pick(one, *Expectation.__struct_fields__))]
    return "\n".join(lines) + "\n"


def _format_table(table: Mapping[str, object]) -> list[str]:
    return [f"{key} = {format_value(value)}" for key, value in table.items()]


@dataclass(frozen=True)
class CheckedPlan:
    """Outcomes of a plan.

    Attributes:
        outcomes: ``question``, ``promised`` and ``measured`` as text, and ``kept``, for each promise.
        open: what remains open, with what would decide it, as text.
    """

    outcomes: tuple[dict[str, str | bool], ...]
    open: tuple[str, ...]


def check_plan(plan: StoredPlan, diagnosis: RunDiagnosis) -> CheckedPlan:
    """Compare what a plan promised with the joint diagnosis of the earlier logs and those of the plan.

    An interval is kept if it is as narrow as promised. What else was open is decided if one of the effects is
    identified and no ambiguous group contains all of them, or if all are observable and none acts.
    """
    values = {
        f"{effect.id}.{name}": value
        for effect in diagnosis.effects
        for name, value in effect.parameters.items()
    }
    outcomes: list[dict[str, str | bool]] = []
    for one in plan.promises:
        expected, asked = f"t = {one.expected:.1f}", set(one.effects)
        if one.kind == "interval":
            unit = suffix_unit(one.unit)
            expected = f"±{format_digits(one.expected)}{unit}, at most ±{format_digits(one.at_most)}{unit}"
            value = values.get(one.question.partition(" ")[0])
            measured = "not found" if value is None else f"{value.value:.3g} ±{format_digits(value.half)}"
            is_met = value is not None and value.half <= one.at_most
        else:
            named = [effect.id for effect in diagnosis.effects if effect.id in asked]
            is_ambiguous = any(asked <= set(group.candidates) for group in diagnosis.undecided)
            # What is identified explains the motion, which excludes its rival.
            is_met = not is_ambiguous and bool(named or not asked & diagnosis.unobservable_why.keys())
            # With more data what two effects share may vanish: that is a decision, too.
            measured = (" and ".join(named) or "decided: no effect") if is_met else "still open"
        outcomes.append(
            {"question": one.question, "promised": expected, "measured": measured, "kept": is_met}
        )
    still = [
        f"{' or '.join(group.candidates)}: {describe_separation(group)}" for group in diagnosis.undecided
    ]
    hidden = group_by((suggest_drive(name), name) for name in diagnosis.unobservable_why)
    still += [f"{', '.join(names)}: {advice}" for advice, names in hidden.items()]
    return CheckedPlan(tuple(outcomes), tuple(still))


_ALIKE = 0.6
"""Least similarity of the commands: a drive stopped at a third reaches it, other driving does not."""


def require_played(path: Path, runs: Sequence[MotionRun], vehicle: Vehicle) -> None:
    """Reject logs that do not contain the drive of the plan.

    Args:
        path: `plan.csv`; if it is missing, or a log has no commands, nothing is rejected.
        runs: of the drive.
        vehicle: their vehicle.

    Raises:
        PlanError: ``not_played``; ``no_plan``, the file cannot be read.
    """
    if not path.is_file() or any(run.commands is None for run in runs):
        return
    try:
        _, speed, turn = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2).T
    except (OSError, ValueError) as error:
        what = "this is not a plan.csv that `slip plan` wrote"
        hint = "Give the folder that `slip plan` wrote."
        raise PlanError("no_plan", what, where=str(path), hint=hint) from error
    if is_steered(vehicle):
        _, _, turn = vehicle.kinematics.asked({"speed": speed, "steering": turn}, vehicle)
    likeness = []
    for series in (run.commands for run in runs if run.commands):
        ahead, _, turned = vehicle.kinematics.asked(name_inputs(series, vehicle), vehicle)
        # A silence is as long as the longest plan at most.
        at = np.append(0.0, np.cumsum(np.minimum(np.diff(series.times), LONGEST_S)))
        held = np.searchsorted(at, np.arange(0.0, at[-1], 1.0 / RATE_HZ), side="right") - 1
        seen = np.column_stack((ahead, turned))[held]
        likeness.append(find_likeness(np.column_stack((speed, turn)), seen))
    if max(likeness) < _ALIKE:
        what = f"no stretch of these commands matches the plan (similarity {format_share(max(likeness))})"
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
