"""Message types, one file a package: which fields say what, in which unit.

A file is found by being in this folder; its name is the package's. A table in it is a message type with any
of

- ``drive``: two fields that speak of the drive: ``sides`` (left, right), ``body`` (forward speed, yaw rate)
  or ``steering`` (speed, steering angle); fields joined by ``+`` are averaged;
- ``number``: one field; what it is of says ``quantity`` or the topic's name;
- ``joints``, ``pose``, ``imu``: fields of wheels by name, of a pose, of a gyro;
- ``fix``, ``ground_velocity``: a place on Earth, a velocity east and north;
- ``power``: voltage and current of a battery, for the map of what to expect;
- ``text``: a field with a JSON object, whose numbers are called ``field.key``;
- ``stamp``: when the data were taken, where there is no header.

``pairs`` lists topics that belong together by name.
"""

import functools
import tomllib
from importlib import resources
from typing import Literal

import msgspec

Form = Literal["sides", "body", "steering"]
Role = Literal["command", "wheels", "either", "odometry"]
Convention = Literal["flu", "ned_frd"]


class DriveFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Two fields of one message that speak of the drive; ``sideways`` is the body motion's third."""

    form: Form
    role: Role
    first: str
    second: str
    unit: str = ""
    sideways: str = ""


class NumberField(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One field; half of a pair of topics.

    Attributes:
        field: its path.
        quantity: what it is; where it is not said, the topic's name tells.
        role: whether it was asked for or measured, where the type says it.
        unit: of the field; the usual one of the quantity where it is not said.
        sign: -1 where the type counts the other way round.
        per_turn: field with the units a turn of the wheel.
    """

    field: str
    quantity: Literal["", "speed", "yaw_rate", "steering"] = ""
    role: Role = "either"
    unit: str = ""
    sign: Literal[1, -1] = 1
    per_turn: str = ""


class JointFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Wheels by name.

    Attributes:
        names: of the joints.
        velocity, position: a value a joint; where ``interfaces`` is given, the names of these quantities.
        interfaces: names of the quantities of every joint, one joint after the other.
        values: the quantities.
    """

    names: str
    velocity: str
    position: str
    interfaces: str = ""
    values: str = ""


class PoseFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A pose: structures with x, y, z(, w), or their fields one by one, the quaternion's w last.

    Attributes:
        position: [m].
        orientation: quaternion.
        parent: field with the name of the frame it is given in.
        child: field with the name of the frame it places.
        names: field with the names of several bodies; position and orientation are sequences of as many.
        fixed: name of the frame where no field says it.
        convention: axes of the frames.
    """

    position: str | list[str]
    orientation: str | list[str]
    parent: str = ""
    child: str = ""
    names: str = ""
    fixed: str = ""
    convention: Convention = "flu"


class FixFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A place on Earth [deg], [m]; a status below zero is no fix."""

    latitude: str
    longitude: str
    altitude: str
    status: str


class GroundVelocityFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A velocity east and north [m/s], on topics whose names say that satellites told it."""

    east: str
    north: str


class ImuFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Angular velocity [rad/s] and specific force [m/s^2]; perhaps an attitude."""

    rate: str | list[str]
    force: str | list[str]
    orientation: str = ""
    convention: Convention = "flu"


class PowerFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is drawn from a battery: voltage [V] and current [A], negative while it is discharged."""

    voltage: str
    current: str


class TextFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A field with a JSON object that has some `keys`.

    Messages in which the field `tag` is another number, or a key is not a number, say something else.
    """

    field: str
    keys: tuple[str, ...]
    tag: str
    value: int


class StampField(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A time: a structure of seconds and nanoseconds, or a count of ticks."""

    field: str
    tick_ns: int = 0


class MessageType(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is known of a message type."""

    drive: DriveFields | None = None
    number: NumberField | None = None
    joints: JointFields | None = None
    pose: PoseFields | None = None
    fix: FixFields | None = None
    ground_velocity: GroundVelocityFields | None = None
    imu: ImuFields | None = None
    power: PowerFields | None = None
    text: TextFields | None = None
    stamp: StampField | None = None


class PairedTopic(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A topic of a pair, by the end of its name."""

    topic: str
    field: str
    unit: str = ""


class Pair(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Two topics that belong together by name."""

    first: PairedTopic
    second: PairedTopic
    form: Form
    role: Role


def plain_type(type_name: str) -> str:
    """ROS 1, ROS 2 and protobuf spellings of a type made one: `sensor_msgs/Imu`."""
    if "/" not in type_name and "." in type_name:
        return "/".join(type_name.rsplit(".", 1))
    return type_name.replace("/msg/", "/")


def find_type(type_name: str) -> MessageType:
    """What is known of a message type; nothing of an unknown one."""
    return _read()[0].get(plain_type(type_name), MessageType())


def list_types(part: str) -> tuple[str, ...]:
    """Types that have a part (``pose``, ``drive``, ...)."""
    return tuple(name for name, kind in _read()[0].items() if getattr(kind, part) is not None)


def list_pairs() -> tuple[Pair, ...]:
    """Topics that belong together by name."""
    return _read()[1]


@functools.cache
def _read() -> tuple[dict[str, MessageType], tuple[Pair, ...]]:
    kinds: dict[str, MessageType] = {}
    pairs: list[Pair] = []
    folder = resources.files("pipeline.sources") / "message_types"
    for entry in sorted(folder.iterdir(), key=lambda item: item.name):
        if entry.name.endswith(".toml"):
            content = tomllib.loads(entry.read_text(encoding="utf-8"))
            pairs += msgspec.convert(content.pop("pairs", []), list[Pair])
            package = entry.name.removesuffix(".toml")
            kinds |= {
                f"{package}/{name}": msgspec.convert(fields, MessageType) for name, fields in content.items()
            }
    return kinds, tuple(pairs)
