"""A plan's files: `plan.toml` to read, `plan.csv`, and `plan.mcap` to play."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import msgspec
import numpy as np

from pipeline.core.arrays import Floats
from pipeline.core.toml import TomlError, parse_toml
from pipeline.logs import LogWriter
from pipeline.models.catalogue import find_effect
from pipeline.models.model_text import format_value
from pipeline.plan.errors import PlanError
from pipeline.plan.manoeuvres import RATE_HZ
from pipeline.plan.plan import SAFETY, Impossible, Plan, Promise
from pipeline.store.files import replace_file

PAGE = "plan.html"
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
"""Of wheel speeds [rad/s], a topic a side."""
_PAIR = 2
# A player shifts log times to now; stamps begin at a round moment so that the same plan has the same bytes.
_START_NS = 1_700_000_000_000_000_000
_SECOND = 1_000_000_000


def list_types(*, steered: bool) -> tuple[str, ...]:
    """Message types of body commands: of a steering angle, or of a yaw rate."""
    return tuple(name for name in _FIELDS if ("Ackermann" in name) == steered)


class Promised(msgspec.Struct, frozen=True):
    """What `plan.toml` promised, to be checked against what came out.

    Attributes:
        vehicle: id of the vehicle.
        runs: names of the runs that the plan was made from.
        promises, impossible: as of the plan.
    """

    vehicle: str
    runs: list[str] = []
    promises: list[Promise] = []
    impossible: list[Impossible] = []


def write_plan(plan: Plan, folder: Path, page: str = "") -> tuple[Path, ...]:
    """Write all files of a plan into a folder, which is made if need be.

    Args:
        plan: the plan.
        folder: for its files.
        page: the plan as a page to look at; none is written where it is empty.

    Raises:
        PlanError: ``cannot_write``, or ``wrong_type`` for a message type that cannot carry the commands.
    """
    types = [*list_types(steered=plan.steered), *([WHEELS] if plan.wheels is not None else [])]
    topics = plan.topic.split(", ")
    if plan.type_name not in types or len(topics) != (_PAIR if plan.type_name == WHEELS else 1):
        what = f"commands of this vehicle cannot be written as {plan.type_name}"
        hint = f"Give --type as one of {', '.join(types)}; {WHEELS} on --topic '/LEFT, /RIGHT'."
        raise PlanError("wrong_type", what, where=plan.topic, hint=hint)
    toml, csv, mcap = (folder / name for name in _NAMES)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write_mcap(plan, mcap)
        pages = [(folder / PAGE, page)] if page else []
        for path, text in ((csv, _format_csv(plan)), (toml, _format_toml(plan)), *pages):
            replace_file(path, text.encode())
    except OSError as error:
        what = f"the plan cannot be written ({error.strerror})"
        raise PlanError("cannot_write", what, where=str(folder), hint="Choose another --out.") from None
    return (toml, csv, mcap, *(path for path, _ in pages))


def read_promises(path: Path) -> Promised:
    """What a `plan.toml`, or the folder that holds it, promises.

    Raises:
        PlanError: ``no_plan``, it is not there or no plan.
        MotionError: ``unknown_effect``, it promises something of an effect that there is not.
    """
    file = path / _NAMES[0] if path.is_dir() else path
    try:
        promised = msgspec.convert(parse_toml(file.read_text(encoding="utf-8")), Promised)
    except OSError as error:
        what = f"the plan cannot be read ({error.strerror})"
    except TomlError as error:
        what = f"this is no plan: {error}"
    except (UnicodeDecodeError, msgspec.ValidationError):
        what = "this is no plan.toml that `slip plan` wrote"
    else:
        for effect in (name for promise in promised.promises for name in promise.effects):
            find_effect(effect)
        return promised
    raise PlanError("no_plan", what, where=str(file), hint="Give the folder that `slip plan` wrote.")


def _write_mcap(plan: Plan, path: Path) -> None:
    stamps = _START_NS + np.round(plan.commands.times * _SECOND).astype(np.int64)
    fields: list[dict[str, Floats]]
    if plan.type_name == WHEELS and plan.wheels is not None:
        fields = [{"data": side} for side in plan.wheels]
    else:
        speed, turn = _FIELDS[plan.type_name]
        fields = [{speed: plan.commands.speed, turn: plan.commands.turn}]
    header = stamps if plan.type_name.endswith("Stamped") else None
    with LogWriter(path) as writer:
        for topic, values in zip(plan.topic.split(", "), fields, strict=True):
            writer.write_columns(topic, plan.type_name, stamps, values, header_time=header)
        writer.metadata("safety", {"text": " ".join(SAFETY)})


def _format_csv(plan: Plan) -> str:
    turn = "steering_rad" if plan.steered else "yaw_rate_radps"
    rows = zip(
        plan.commands.times.tolist(), plan.commands.speed.tolist(), plan.commands.turn.tolist(), strict=True
    )
    lines = [f"time_s,speed_mps,{turn}", *(f"{t:.3f},{v:.6f},{w:.6f}" for t, v, w in rows)]
    return "\n".join(lines) + "\n"


def _format_toml(plan: Plan) -> str:
    turn = "max_steering_rad" if plan.steered else "max_yaw_rate_radps"
    lines = ["# What to drive next. `slip plan --check` compares what came out with these promises."]
    lines += [f"# {line}" for line in (*SAFETY, plan.say_rest()) if line]
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
            "max_lateral_acceleration_mps2": plan.limits.lateral_mps2,
        }
    )
    lines += ["", "# The start is the middle; the first side lies along the heading at the start.", "[area]"]
    lines += _format_table({**asdict(plan.area), "home_m": plan.home_m})
    for name, start in plan.manoeuvres:
        lines += ["", "[[manoeuvre]]", *_format_table({"name": name, "start_s": start})]
    for key, items in (("promises", plan.promises), ("impossible", plan.impossible)):
        for item in items:
            lines += ["", f"[[{key}]]", *_format_table(msgspec.to_builtins(item))]
    return "\n".join(lines) + "\n"


def _format_table(table: Mapping[str, object]) -> list[str]:
    return [f"{key} = {format_value(value)}" for key, value in table.items()]
