"""Where each role's data stand in a log: which topics, read in which form, and why."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class DriveForm(Enum):
    """How a topic (or a pair) speaks of the drive."""

    JOINTS = "wheels by joint name"
    SIDES = "one signal a side"
    BODY = "body command"
    BODY_SIGNALS = "forward speed and yaw rate"
    ACKERMANN = "speed and steering angle"
    STEERING_SIGNALS = "speed and steering angle, a signal each"


@dataclass(frozen=True)
class Signal:
    """A topic, or one field of it; an empty field means what the type usually offers."""

    topic: str
    field: str = ""

    @classmethod
    def parse(cls, text: str) -> Signal:
        """Split ``/topic/name.field.path[0]`` at the first dot (topic names hold none)."""
        topic, _, field = text.partition(".")
        return cls(topic, field)

    def __str__(self) -> str:
        return f"{self.topic}.{self.field}" if self.field else self.topic


@dataclass(frozen=True)
class DriveSource:
    """Source of commands or of measured wheels."""

    form: DriveForm
    signals: tuple[Signal, ...]
    reason: str

    def __str__(self) -> str:
        return ", ".join(dict.fromkeys(str(signal) for signal in self.signals))


@dataclass(frozen=True)
class PoseSource:
    """Source of poses: a topic, or the transforms (then ``frames`` may name parent and child)."""

    topic: str
    reason: str
    from_transforms: bool = False
    frames: tuple[str, str] | None = None

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
    """The choice for one log; None where the log has nothing for a role."""

    command: DriveSource | None
    wheels: DriveSource | None
    pose: PoseSource | None
    imu: TopicSource | None
    interval: TopicSource | None
    notes: tuple[str, ...] = ()
