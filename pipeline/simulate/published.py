"""Topics of a platform: whose quantities they publish, and under which fields."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Source = Literal[
    "command",
    "wish",
    "wheels",
    "odometry",
    "filter",
    "localization",
    "tracking",
    "relocalization",
    "satellites",
    "correction",
    "imu",
    "battery",
    "once",
]


@dataclass(frozen=True)
class Q:
    """A quantity of the run: ``gain * quantity + offset``, cut to a whole number where one is wanted."""

    name: str
    gain: float = 1.0
    offset: float = 0.0
    whole: bool = False


@dataclass(frozen=True)
class Json:
    """A text with a JSON object of quantities by key."""

    numbers: Mapping[str, Q]


Value = Q | Json | tuple[Q, ...] | str | list[str] | float


@dataclass(frozen=True)
class Published:
    """A topic.

    Attributes:
        topic, type_name: where and what.
        source: whose times and quantities it has: ``command``; ``wheels``; ``odometry`` integrated from them,
            ``filter`` the same with the gyro's heading; ``localization``; ``tracking``, the same in a frame
            that never jumps, and ``relocalization``, where that frame is, dated ahead; ``satellites``, its
            place on Earth and the velocity of its sensor over ground; ``correction``, the transform from the
            localization's frame to the odometry's; ``imu``; ``battery``; ``once`` at the start; ``wish``, a
            body command that the controller never gets.
        fields: by field path a quantity, several for an array, a text of them, or a constant.
        every: one message in so many is published.
        stamp: ``header``; ``none``; or the field that holds the time, ``timestamp`` in microseconds.
    """

    topic: str
    type_name: str
    source: Source
    fields: Mapping[str, Value] = field(default_factory=dict)
    every: int = 1
    stamp: str = "header"
