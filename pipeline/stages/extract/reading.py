"""Which fields of which topics a run needs, and the plain arrays behind them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.logs import Strings, TopicColumns, Wanted, wanted_transforms
from pipeline.stages.errors import StageError
from pipeline.stages.extract.drive import ACKERMANN_FIELDS, BODY_FIELDS
from pipeline.vehicles import DriveForm, DriveSource, Signal, Sources
from pipeline.vehicles.topics import TRANSFORM_TYPES, plain_type

Floats = NDArray[np.float64]

_POSE_PREFIX = {
    "nav_msgs/Odometry": "pose.pose.",
    "geometry_msgs/PoseStamped": "pose.",
    "geometry_msgs/PoseWithCovarianceStamped": "pose.pose.",
}
_LONGEST_NAME = 200
_POSITION = ("position.x", "position.y", "position.z")
_ORIENTATION = ("orientation.x", "orientation.y", "orientation.z", "orientation.w")
_RATES = tuple(f"angular_velocity.{axis}" for axis in "xyz")
_FORCES = tuple(f"linear_acceleration.{axis}" for axis in "xyz")


def drive_fields(source: DriveSource, types: dict[str, str]) -> list[Signal]:
    """Every field that a drive source needs."""
    topic = source.signals[0].topic
    kind = plain_type(types[topic])
    if source.form is DriveForm.JOINTS:
        return [Signal(topic, name) for name in ("name", "velocity", "position")]
    if source.form is DriveForm.BODY:
        prefix = BODY_FIELDS[kind]
        return [Signal(topic, f"{prefix}linear.x"), Signal(topic, f"{prefix}angular.z")]
    if source.form is DriveForm.ACKERMANN:
        prefix = ACKERMANN_FIELDS[kind]
        return [Signal(topic, f"{prefix}speed"), Signal(topic, f"{prefix}steering_angle")]
    return list(source.signals)


def list_wanted(sources: Sources, types: dict[str, str]) -> list[Wanted]:
    """What to read for the chosen sources.

    Args:
        sources: the choice.
        types: type name by topic.
    """
    signals: list[Signal] = []
    for drive in (sources.command, sources.wheels):
        if drive is not None:
            signals += drive_fields(drive, types)
    if sources.pose is not None and not sources.pose.from_transforms:
        topic = sources.pose.topic
        kind = plain_type(types[topic])
        names = ["header.frame_id", *(f"{_POSE_PREFIX[kind]}{name}" for name in (*_POSITION, *_ORIENTATION))]
        if kind == "nav_msgs/Odometry":
            names.append("child_frame_id")
        signals += [Signal(topic, name) for name in names]
    if sources.imu is not None:
        signals += [Signal(sources.imu.topic, name) for name in (*_RATES, *_FORCES)]
    if sources.interval is not None:
        signals.append(Signal(sources.interval.topic, "data"))
    by_topic: dict[str, list[str]] = {}
    for signal in signals:
        fields = by_topic.setdefault(signal.topic, [])
        if signal.field not in fields:
            fields.append(signal.field)
    wanted = [Wanted(topic, tuple(fields)) for topic, fields in by_topic.items()]
    return wanted + _list_wanted_transforms(sources, types)


def _list_wanted_transforms(sources: Sources, types: dict[str, str]) -> list[Wanted]:
    """All transforms where poses come from them; else the static ones, which may place the pose's frame."""
    if sources.pose is None:
        return []
    transforms = [topic for topic, kind in types.items() if plain_type(kind) in TRANSFORM_TYPES]
    wanted = wanted_transforms(transforms)
    if sources.pose.from_transforms:
        return wanted
    return [one for one in wanted if "static" in one.topic]


@dataclass(frozen=True)
class PoseArrays:
    """Poses as recorded: position (n, 3) [m], quaternion (n, 4), and their frames."""

    position: Floats
    quaternion: Floats
    parent: str
    child: str


def read_pose_topic(columns: TopicColumns) -> PoseArrays:
    """Poses of an Odometry, PoseStamped or PoseWithCovarianceStamped topic."""
    kind = plain_type(columns.type_name)
    prefix = _POSE_PREFIX[kind]
    return PoseArrays(
        np.stack([numbers(columns, f"{prefix}{name}") for name in _POSITION], axis=-1),
        np.stack([numbers(columns, f"{prefix}{name}") for name in _ORIENTATION], axis=-1),
        first_text(columns, "header.frame_id"),
        first_text(columns, "child_frame_id") if kind == "nav_msgs/Odometry" else "",
    )


def read_imu(columns: TopicColumns) -> tuple[Floats, Floats]:
    """Angular velocity [rad/s] and specific force [m/s^2] of an IMU topic, each (n, 3)."""
    return (
        np.stack([numbers(columns, name) for name in _RATES], axis=-1),
        np.stack([numbers(columns, name) for name in _FORCES], axis=-1),
    )


def numbers(columns: TopicColumns, name: str) -> Floats:
    """A column of plain numbers as float64.

    Raises:
        StageError: the field is a sequence or a text.
    """
    column = columns.fields[name]
    if not isinstance(column, np.ndarray) or column.ndim != 1:
        raise StageError(
            "field_not_a_number",
            f"the field {name!r} is not one number a message",
            where=columns.topic,
            hint="Name one element: field[0].",
        )
    return column.astype(np.float64)


def first_text(columns: TopicColumns, name: str) -> str:
    """The text that a column of strings starts with, no longer than a sentence about it can bear."""
    column = columns.fields.get(name)
    if isinstance(column, Strings) and len(column) and column.codes[0] >= 0:
        text: str = column.values[int(column.codes[0])]
        return text[:_LONGEST_NAME]
    return ""


def texts(columns: TopicColumns, name: str) -> list[str]:
    """A column of strings."""
    column = columns.fields[name]
    return column.to_list() if isinstance(column, Strings) else []
