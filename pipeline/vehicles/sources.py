"""Where each role's data stand in a log: which topics, read in which form, and why."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum

_INNER_INDEX = re.compile(r"\[(\d+)\]\.([\w.]+)$")


CONFIGURED = "configured"
"""Reason of a choice that the user made."""


class DriveForm(Enum):
    """What a drive source's signals are."""

    JOINTS = "wheels by joint name"
    SIDES = "left and right wheels"
    BODY = "forward speed and yaw rate"
    STEERING = "speed and steering angle"


@dataclass(frozen=True)
class Signal:
    """A topic, or one field of it; an empty field means what the type usually offers.

    Attributes:
        topic: its name.
        field: path of the field; several joined by ``+`` are averaged.
        unit: of the field; the usual one of its form where it is empty.
        sign: -1 where the field counts the other way round.
        per_turn: field with the units a turn of the wheel.
    """

    topic: str
    field: str = ""
    unit: str = ""
    sign: int = 1
    per_turn: str = ""

    @classmethod
    def parse(cls, text: str) -> Signal:
        """Split ``/topic/name.field.path[0]`` at the first dot (topic names hold none)."""
        topic, _, path = text.partition(".")
        return cls(topic, path)

    def fields(self) -> tuple[str, ...]:
        """Paths of the fields that are averaged, an index behind the path: ``states[].rpm[1]``."""
        return tuple(_INNER_INDEX.sub(r"[].\2[\1]", path) for path in self.field.split("+"))

    def __str__(self) -> str:
        return f"{self.topic}.{self.field}" if self.field else self.topic


@dataclass(frozen=True)
class DriveSource:
    """Source of commands or of measured wheels.

    Attributes:
        form: what the signals are.
        signals: one for joints, else two.
        reason: why it was chosen.
        name: what to call it, where the signals are one message of a known type.
    """

    form: DriveForm
    signals: tuple[Signal, ...]
    reason: str
    name: str = ""

    def __str__(self) -> str:
        return self.name or ", ".join(dict.fromkeys(str(signal) for signal in self.signals))


class PoseContent(Enum):
    """What a topic of poses holds."""

    POSE = "poses"
    FIX = "places on Earth, without a heading"
    VELOCITY = "velocities over ground, without a place or a heading"


@dataclass(frozen=True)
class PoseSource:
    """Source of poses: a topic, or the transforms (then ``frames`` may name parent and child).

    Attributes:
        topic: its name.
        reason: why it was chosen.
        from_transforms: whether it holds transforms.
        frames: parent and child among the transforms.
        content: what it holds.
        velocity: topic with the velocities over ground that belong to a fix.
        name: of the body, where a message holds the poses of several.
    """

    topic: str
    reason: str
    from_transforms: bool = False
    frames: tuple[str, str] | None = None
    content: PoseContent = PoseContent.POSE
    velocity: str = ""
    name: str = ""

    def __str__(self) -> str:
        return f"{self.topic} ({' -> '.join(self.frames)})" if self.frames else self.topic


@dataclass(frozen=True)
class TopicSource:
    """A single topic in a role (gyro, interval)."""

    topic: str
    reason: str

    def __str__(self) -> str:
        return self.topic


@dataclass(frozen=True)
class Sources:
    """The choice for one log; None where the log has nothing for a role.

    Attributes:
        command, wheels, pose, imu, interval: what serves in each role.
        notes: what to say of the choice.
        others: by role, what would serve as well, the next best first.
    """

    command: DriveSource | None
    wheels: DriveSource | None
    pose: PoseSource | None
    imu: TopicSource | None
    interval: TopicSource | None
    notes: tuple[str, ...] = ()
    others: Mapping[str, tuple[DriveSource | PoseSource | TopicSource, ...]] = field(default_factory=dict)

    def separated(self) -> Sources:
        """The same, but with measured wheels from another topic than the pose."""
        pose = None if self.pose is None else self.pose.topic
        ranked = [
            one for one in (self.wheels, *self.others.get("wheels", ())) if isinstance(one, DriveSource)
        ]
        free = [one for one in ranked if {signal.topic for signal in one.signals} != {pose}]
        chosen = free[0] if free else None
        if chosen == self.wheels or (self.wheels is not None and self.wheels.reason == CONFIGURED):
            return self
        rest = tuple(one for one in ranked if one is not chosen)
        return replace(self, wheels=chosen, others={**self.others, "wheels": rest})
