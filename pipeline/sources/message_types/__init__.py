"""Message types, one file per package: meaning and unit of the fields.

Every file in this folder is read; its name is that of the package. A table in it is a message type with any
of

- ``drive``: two fields of the drive: ``sides`` (left, right), ``body`` (forward speed, yaw rate) or
  ``steering`` (speed, steering angle); fields joined by ``+`` are averaged;
- ``number``: one field; ``quantity`` or the topic's name states its meaning;
- ``numbers``: a sequence of numbers whose meaning only the user knows;
- ``joints``, ``pose``, ``imu``: fields of wheels by name, of a pose, of a gyro;
- ``fix``, ``ground_velocity``: a position on Earth, a velocity east and north;
- ``text``: a field with a JSON object, whose numbers are called ``field.key``;
- ``stamp``: time of the measurement, for types without a header;
- ``older``: the same of older layouts of the type, the newest first, which are read as the present one.

``pairs`` lists topics that belong together by name.
"""

import functools
import re
import tomllib
from collections.abc import Iterable
from importlib import resources
from typing import Literal

import msgspec

Form = Literal["sides", "body", "steering"]
Role = Literal["command", "wheels", "either", "odometry"]
Convention = Literal["flu", "ned_frd"]


class DriveFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Two fields of one message for the drive; ``sideways`` is the third of a body motion."""

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
        quantity: physical quantity; by default it follows from the topic's name.
        role: whether it is commanded or measured, if the type determines it.
        unit: of the field; by default the usual one of the quantity.
        sign: -1 if the type counts in the opposite direction.
        per_turn: field with the units per turn of the wheel.
    """

    field: str
    quantity: Literal["", "speed", "yaw_rate", "steering"] = ""
    role: Role = "either"
    unit: str = ""
    sign: Literal[1, -1] = 1
    per_turn: str = ""


class NumbersField(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sequence of numbers without a stated meaning."""

    field: str


class JointFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Wheels by name.

    Attributes:
        names: of the joints.
        velocity, position: one value per joint; with ``interfaces``, the names of these quantities.
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
        position: [m]; of two fields they are x and y, and z is zero.
        orientation: quaternion; empty, as ``angle``, of positions alone.
        angle: field of the heading in place of a quaternion, counterclockwise from x.
        angle_unit: unit of the heading.
        parent: field with the name of the reference frame.
        child: field with the name of the frame whose pose is given.
        velocity: fields of how fast the position moves [m/s], along axes of any frame.
        names: field with the names of several bodies; position and orientation are sequences of equal length.
        fixed: name of the frame if no field contains it.
        convention: axes of the frames.
    """

    position: str | list[str]
    orientation: str | list[str] = ""
    angle: str = ""
    angle_unit: Literal["rad", "deg"] = "rad"
    parent: str = ""
    child: str = ""
    velocity: list[str] = []
    names: str = ""
    fixed: str = ""
    convention: Convention = "flu"


class FixFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A position on Earth; a status below the least one is no fix, without a status each is one.

    Attributes:
        latitude, longitude: in degrees; integers count 1e-7 degrees.
        altitude: in metres; in millimetres where latitudes are integers.
        status: what kind of fix it is.
        least: status of a fix.
        frame: field with the name of the antenna's frame; empty if there is none.
    """

    latitude: str
    longitude: str
    altitude: str
    status: str = ""
    least: int = 0
    frame: str = "header.frame_id"


class GroundVelocityFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A velocity east and north [m/s], on topics whose names indicate a satellite receiver."""

    east: str
    north: str


class ImuFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Angular velocity [rad/s] and specific force [m/s^2]; optionally an attitude, and the sensor's frame."""

    rate: str | list[str]
    force: str | list[str]
    orientation: str = ""
    frame: str = ""
    convention: Convention = "flu"


class TextFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A field with a JSON object that has some `keys`.

    Messages are ignored if the field `tag` is another number, or a key is not a number.
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
    """Known fields of a message type."""

    drive: DriveFields | None = None
    number: NumberField | None = None
    numbers: NumbersField | None = None
    joints: JointFields | None = None
    pose: PoseFields | None = None
    fix: FixFields | None = None
    ground_velocity: GroundVelocityFields | None = None
    imu: ImuFields | None = None
    text: TextFields | None = None
    stamp: StampField | None = None
    older: list["MessageType"] = []


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
    """Normalize ROS 1, ROS 2 and protobuf spellings of a type: `sensor_msgs/Imu`."""
    if "/" not in type_name and "." in type_name:
        return "/".join(type_name.rsplit(".", 1))
    return type_name.replace("/msg/", "/")


def find_type(type_name: str) -> MessageType:
    """Known fields of a message type; empty for an unknown one."""
    return read_tables()[0].get(plain_type(type_name), MessageType())


def describe_types(type_names: Iterable[str]) -> dict[str, object]:
    """What is known of some message types, in JSON; results depend on it."""
    known = {name: find_type(name) for name in sorted({plain_type(name) for name in type_names})}
    return {name: msgspec.to_builtins(kind) for name, kind in known.items() if kind != MessageType()}


def list_types(part: str) -> tuple[str, ...]:
    """Types that have a part (``pose``, ``drive``, ...)."""
    return tuple(name for name, kind in read_tables()[0].items() if getattr(kind, part) is not None)


_AXES = {"position": "xyz", "orientation": "xyzw", "rate": "xyz", "force": "xyz"}
_PATHS = {
    "drive": ("first", "second", "sideways"),
    "number": ("field", "per_turn"),
    "joints": ("names", "velocity", "position"),
    "pose": ("position", "orientation", "angle", "velocity", "parent", "child"),
    "imu": ("rate", "force", "orientation"),
    "fix": ("latitude", "longitude", "altitude", "status", "frame"),
}
"""Fields of a part that are paths; its other values state what these mean."""
_OPTIONAL = re.compile(r"pose .*(?:velocity|parent|child)$")


def _spell_fields(kind: MessageType) -> dict[str, str]:
    """Paths of the fields of a type by their meaning."""
    spelled: dict[str, str] = {}
    for part, names in _PATHS.items():
        values = msgspec.to_builtins(getattr(kind, part)) or {}
        said = " ".join(f"{key}={value}" for key, value in values.items() if key not in names)
        for name in names:
            given = values.get(name) or []
            if part != "joints" and isinstance(given, str) and name in _AXES:
                given = [f"{given}.{axis}" for axis in _AXES[name]]
            for number, path in enumerate([given] if isinstance(given, str) else given):
                spelled[f"{part} {said} {number} {name}"] = path
    if kind.stamp is not None:
        parts = ("",) if kind.stamp.tick_ns else (".sec", ".nanosec")
        spelled |= {f"stamp {kind.stamp.tick_ns} 0 {part}": f"{kind.stamp.field}{part}" for part in parts}
    return spelled


@functools.cache
def _spell_known() -> dict[str, dict[str, str]]:
    """The same of every type whose fields are not texts, by its name."""
    return {name: _spell_fields(kind) for name, kind in read_tables()[0].items() if not kind.text}


def find_alike(type_name: str, fields: Iterable[str]) -> dict[str, dict[str, str]]:
    """Other types with fields of the same meaning and unit.

    Args:
        type_name: a message type.
        fields: paths of some of its fields.

    Returns:
        By type, its own path of each of the fields. Of a pose, the names of frames may be missing.
    """
    own = find_type(type_name)
    meanings = {path: meaning for meaning, path in _spell_fields(own).items()}
    wanted = {path: meanings[path] for path in fields if path in meanings}
    alike: dict[str, dict[str, str]] = {}
    for name, theirs in _spell_known().items() if wanted and not own.text else ():
        if name != plain_type(type_name) and all(
            meaning in theirs or _OPTIONAL.fullmatch(meaning) for meaning in wanted.values()
        ):
            alike[name] = {path: theirs[meaning] for path, meaning in wanted.items() if meaning in theirs}
    return alike


def list_layouts(type_name: str, fields: Iterable[str]) -> tuple[dict[str, str], ...]:
    """Layouts of a type in which fields of the same meaning and unit are found, the present one first.

    Args:
        type_name: a message type.
        fields: paths of some of its fields, as in the present layout.

    Returns:
        By layout, its path of each of the fields that the type is known to have; none of an unknown type.
        Names of frames and stamps may be missing in an older one.
    """
    own = find_type(type_name)
    meanings = {path: meaning for meaning, path in _spell_fields(own).items()}
    wanted = {path: meanings[path] for path in fields if path in meanings}
    spelled = [_spell_fields(kind) for kind in (own, *own.older)] if wanted else []
    return tuple(
        {path: layout[meaning] for path, meaning in wanted.items() if meaning in layout}
        for layout in spelled
        if all(
            meaning in layout or _OPTIONAL.fullmatch(meaning) or meaning.startswith("stamp ")
            for meaning in wanted.values()
        )
    )


def list_pairs() -> tuple[Pair, ...]:
    """Topics that belong together by name."""
    return read_tables()[1]


@functools.cache
def read_tables() -> tuple[dict[str, MessageType], tuple[Pair, ...]]:
    """All message types by name, and the pairs of topics."""
    kinds: dict[str, MessageType] = {}
    pairs: list[Pair] = []
    folder = resources.files("pipeline.sources") / "message_types"
    for entry in sorted(folder.iterdir(), key=lambda item: item.name):
        if entry.name.endswith(".toml"):
            content = tomllib.loads(entry.read_text(encoding="utf-8"))
            pairs += msgspec.convert(content.pop("pairs", []), list[Pair])
            package = entry.name.removesuffix(".toml")
            for name, fields in content.items():
                try:
                    kinds[f"{package}/{name}"] = msgspec.convert(fields, MessageType)
                except msgspec.ValidationError as error:
                    what = f"[{name}] of message_types/{entry.name}: {error}"
                    raise msgspec.ValidationError(what) from None
    return kinds, tuple(pairs)
