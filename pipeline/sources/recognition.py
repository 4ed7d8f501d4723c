"""Recognition of a log's vehicle from names, robot description, parameters and wheel frames."""

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal
from xml.etree import ElementTree as ET

import msgspec
import numpy as np

from pipeline.core import Floats, rigid
from pipeline.logs import ChannelInfo, LogError, TransformBuffer
from pipeline.sources.configuration import Vehicle, list_presets, make_id

# Geometry from a robot description (URDF): wheels, their radii, track width, wheelbase and steering.
#
# A wheel is a continuous joint that turns about the body's lateral axis; a steering joint turns about its
# vertical one and carries a wheel, or its name indicates steering. Casters are excluded. Wheels are mecanum
# wheels if the text mentions mecanum or rollers. What turns alike above them, as an arm does, is none. The
# radius is that of the wheel's cylinder, else the height of its axis over base_footprint.

_LONGEST = 8_000_000
_LATERAL = 0.9
_CASTER = re.compile(r"caster|castor|swivel|rocker|suspension")
_ROLLERS = re.compile(r"mecanum|roller")
_ROLLS = ("continuous", "revolute")
_APART_M = 0.02
_HIGHER = 1.5
"""Height of an axis over the lowest one up to which it is a wheel's, in radii of that one."""


@dataclass(frozen=True)
class Description:
    """Drive of a robot description; None for values that it lacks.

    Attributes:
        name: of the robot.
        kind: ``differential``, ``ackermann`` or ``mecanum``.
        wheel_radius_m, track_width_m, wheelbase_m: geometry.
        base_to_rear_axle_m: distance of base_link ahead of the rear axle (Ackermann).
        max_steering_rad: limit of the steering joints.
        wheels: names of the wheel joints.
    """

    name: str
    kind: str
    wheel_radius_m: float | None
    track_width_m: float | None
    wheelbase_m: float | None
    base_to_rear_axle_m: float
    max_steering_rad: float | None
    wheels: tuple[str, ...]


@dataclass(frozen=True)
class _Joint:
    name: str
    kind: str
    parent: str
    child: str
    position: Floats
    turn: Floats
    axis: Floats
    largest_rad: float


def read_description(text: str) -> Description | None:
    """Read a robot description; None if the text is not a description or has no wheels."""
    # Entities can expand a short text without bound; no exporter of descriptions writes them.
    if len(text) > _LONGEST or "<!" in text.replace("<!--", ""):
        return None
    try:
        robot = ET.fromstring(text)  # noqa: S314 - without entities
    except ET.ParseError:
        return None
    joints = {joint.child: joint for element in robot.iter("joint") if (joint := _read_joint(element))}
    base = _find_base(joints)
    wheels, steering = [], []
    for joint in joints.values():
        placed = _locate_in(base, joint, joints)
        if placed is None or _CASTER.search(joint.name.lower()) or joint.kind not in _ROLLS:
            continue
        position, axis = placed
        if abs(axis[1]) > _LATERAL and abs(position[1]) > _APART_M:
            wheels.append((joint, position))
        elif abs(axis[2]) > _LATERAL and "steer" in joint.name.lower():
            steering.append((joint, position))
    links = {link.get("name", ""): link for link in robot.iter("link")}
    wheels = _take_standing(wheels, links)
    if not any(position[1] > 0.0 for _, position in wheels) or not any(
        position[1] < 0.0 for _, position in wheels
    ):
        return None
    described = _make_vehicle(robot.get("name", ""), links, wheels, steering, joints)
    has_rollers = described.kind == "differential" and bool(_ROLLERS.search(text.lower()))
    return replace(described, kind="mecanum") if has_rollers else described


def _take_standing(
    wheels: list[tuple[_Joint, Floats]], links: Mapping[str, ET.Element]
) -> list[tuple[_Joint, Floats]]:
    """The joints that are as low as wheels on one ground are, and not those of an arm above them."""
    if not wheels:
        return []
    lowest, position = min(wheels, key=lambda one: float(one[1][2]))
    # Wheels of both sides do not meet.
    radius = _read_radius(links.get(lowest.child)) or abs(float(position[1]))
    return [one for one in wheels if float(one[1][2] - position[2]) < _HIGHER * radius]


def _make_vehicle(
    name: str,
    links: Mapping[str, ET.Element],
    wheels: list[tuple[_Joint, Floats]],
    steering: list[tuple[_Joint, Floats]],
    joints: Mapping[str, _Joint],
) -> Description:
    radii = [radius for joint, _ in wheels if (radius := _read_radius(links.get(joint.child)))]
    if not radii:
        footprint = [_locate_in("base_footprint", joint, joints) for joint, _ in wheels]
        radii = [float(placed[0][2]) for placed in footprint if placed is not None and placed[0][2] > 0.0]
    steered = {joint.child for joint, _ in steering}
    driven = [position for joint, position in wheels if joint.parent not in steered] or [p for _, p in wheels]
    left = [position[1] for position in driven if position[1] > 0.0]
    right = [position[1] for position in driven if position[1] < 0.0]
    ahead = [position[0] for _, position in steering]
    rear = min(position[0] for position in driven)
    front = float(np.mean(ahead)) if ahead else max(position[0] for position in driven)
    return Description(
        name=name,
        kind="ackermann" if steering else "differential",
        wheel_radius_m=float(np.median(radii)) if radii else None,
        track_width_m=float(np.mean(left) - np.mean(right)) if left and right else None,
        wheelbase_m=float(front - rear) if front - rear > _APART_M else None,
        base_to_rear_axle_m=-float(rear) if steering else 0.0,
        max_steering_rad=max((joint.largest_rad for joint, _ in steering), default=0.0) or None,
        wheels=tuple(joint.name for joint, _ in wheels),
    )


def _read_joint(element: ET.Element) -> _Joint | None:
    parent, child, origin = element.find("parent"), element.find("child"), element.find("origin")
    axis, limits = element.find("axis"), element.findall("limit")
    if parent is None or child is None:
        return None
    try:
        position = _numbers(origin, "xyz", (0.0, 0.0, 0.0))
        turn = rigid.quaternions_from_euler(*_numbers(origin, "rpy", (0.0, 0.0, 0.0)))
        along = _numbers(axis, "xyz", (1.0, 0.0, 0.0))
        ends = [abs(float(limit.get(name, "nan"))) for limit in limits for name in ("lower", "upper")]
    except ValueError:
        return None
    name, kind = element.get("name", ""), element.get("type", "")
    largest = max((end for end in ends if end < math.pi / 2.0), default=0.0)
    return _Joint(name, kind, parent.get("link", ""), child.get("link", ""), position, turn, along, largest)


def _numbers(element: ET.Element | None, name: str, usual: tuple[float, float, float]) -> Floats:
    text = None if element is None else element.get(name)
    values = np.array(usual if text is None else [float(part) for part in text.split()])
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ValueError(name)
    return values


def _find_base(joints: Mapping[str, _Joint]) -> str:
    frames = {joint.parent for joint in joints.values()} | set(joints)
    named = [
        frame for word in ("base_link", "base_footprint") for frame in sorted(frames) if frame.endswith(word)
    ]
    return named[0] if named else next(iter(sorted(frames - set(joints))), "")


def _locate_in(base: str, joint: _Joint, joints: Mapping[str, _Joint]) -> tuple[Floats, Floats] | None:
    """Position of a joint and its axis in a frame above it, all joints at zero; None if it is not below."""
    position, turn = joint.position, joint.turn
    frame, seen = joint.parent, {joint.child}
    while frame != base:
        above = joints.get(frame)
        if above is None or frame in seen:
            return None
        seen.add(frame)
        position = above.position + rigid.rotate(above.turn, position)
        turn = rigid.multiply_quaternions(above.turn, turn)
        frame = above.parent
    length = float(np.linalg.norm(joint.axis))
    return position, rigid.rotate(turn, joint.axis) / (length or 1.0)


def _read_radius(link: ET.Element | None) -> float | None:
    """Radius [m] of a wheel's cylinder or sphere; the collision shape precedes the visual one."""
    for part in ("collision", "visual"):
        for shape in link.iterfind(f"{part}/geometry/*") if link is not None else ():
            try:
                radius = (
                    float(shape.get("radius", "nan")) if shape.tag in {"cylinder", "sphere"} else math.nan
                )
            except ValueError:
                continue
            if radius > 0.0:
                return radius
    return None


# Recognition of the vehicle from a log: words of names, and a robot description.
#
# A platform is recognized by a word of a namespace, a host or the robot's name, or by the package of its own
# message types. A description gives the geometry of a vehicle that is not a known platform.

VehicleSource = Literal[
    "flag",
    "configuration",
    "metadata",
    "robot_description",
    "namespace",
    "message_types",
    "parameters",
    "transforms",
    "folder",
    "fitted",
]
"""What says which vehicle it is: ``folder`` are other recordings of the same folder, and of a vehicle that is
``fitted`` only its signals show the geometry."""
_DIFFERS = 0.1
_SAME_WHEEL = 0.02
"""Share by which a wheel radius may differ from that of its platform: tyres give way as much under a load."""
_OTHER_TRACK = 0.25
_GEOMETRY = ("wheel_radius_m", "track_width_m", "wheelbase_m")


@dataclass(frozen=True)
class Recognized:
    """A vehicle recognized from the log.

    Attributes:
        vehicle: the vehicle.
        source: source of the recognition.
        notes: values of findings `vehicle_choice`.
    """

    vehicle: Vehicle
    source: VehicleSource
    notes: tuple[Mapping[str, object], ...] = ()


def recognize_vehicle(
    channels: Iterable[ChannelInfo],
    metadata: Mapping[str, Mapping[str, str]],
    description: Description | None,
    configured: Iterable[str] = (),
) -> Recognized | None:
    """The vehicle of a log; None if it is not recognized.

    Args:
        channels: channels of the log.
        metadata: its metadata records.
        description: its robot description.
        configured: topics of the configuration, which select one of several robots.
    """
    held = [channel for channel in channels if channel.message_count != 0]
    named = {part for topic in configured for part in topic.split("/")[1:-1]}
    spaces = {part for channel in held for part in channel.topic.split("/")[1:-1]}
    hosts = {text for record in metadata.values() for key, text in record.items() if "host" in key.lower()}
    packages = {channel.type_name.split("/")[0] for channel in held}
    hints: tuple[tuple[VehicleSource, set[str]], ...] = (
        ("robot_description", {description.name} if description is not None else set()),
        ("namespace", named),
        ("namespace", spaces | hosts),
        ("message_types", packages),
    )
    for source, words in hints:
        preset = _find_platform(words)
        if preset is not None:
            return _compare(preset, source, description)
    return None if description is None else _build(description)


def _find_platform(words: Iterable[str]) -> Vehicle | None:
    """The platform in some words, the longest of nested matches; None if they name several."""
    matching: dict[str, Vehicle] = {}
    for preset in list_presets():
        for word in preset.recognized_by:
            pattern = re.compile(rf"(^|[^a-z0-9]){re.escape(word)}([^a-z]|$)")
            if any(pattern.search(text.lower()) for text in words):
                matching[word] = preset
    longest = {
        word: preset
        for word, preset in matching.items()
        if not any(word in other for other in matching if other != word)
    }
    presets = {preset.id: preset for preset in longest.values()}
    return next(iter(presets.values())) if len(presets) == 1 else None


def _compare(preset: Vehicle, source: VehicleSource, description: Description | None) -> Recognized:
    """A platform with the values of its preset; deviations of the description are reported."""
    if description is None:
        return Recognized(preset, source)
    notes = list[Mapping[str, object]]()
    for name in _GEOMETRY:
        known, said = getattr(preset, name), getattr(description, name)
        if known and said and abs(said / known - 1.0) > _DIFFERS:
            values = {"kind": "description", "key": name, "described": said, "preset": preset.id}
            notes.append({**values, "known": known})
    return Recognized(preset, "robot_description", tuple(notes))


def _build(description: Description) -> Recognized | None:
    """A vehicle from a description alone, if it is complete."""
    values = {
        name: getattr(description, name) for name in (*_GEOMETRY, "base_to_rear_axle_m", "max_steering_rad")
    }
    vehicle = make_vehicle(description.name or "robot", description.kind, values)
    return None if vehicle is None else Recognized(vehicle, "robot_description")


def make_vehicle(name: str, kind: str, geometry: Mapping[str, float | None]) -> Vehicle | None:
    """A vehicle of that name and geometry; None if its kind needs more values."""
    name = name.strip("/")
    values = {"id": make_id(name), "name": name, "kind": kind, **geometry}
    try:
        vehicle = msgspec.convert(values, Vehicle)
    except msgspec.ValidationError:
        return None
    required = [quantity.name for quantity in vehicle.kinematics.geometry if quantity.required]
    return vehicle if all(getattr(vehicle, each) is not None for each in required) else None


def find_alike_vehicles(radius_m: float, track_m: float) -> dict[str, tuple[str, float]]:
    """Platforms with wheels of this radius that may turn as if these stood so far apart, the nearest first.

    A skid-steered platform turns less than its wheels ask for, as if its track were wider; none turns more.

    Returns:
        By id of the platform: its name, and the share of its ideal yaw rate at which it then turns.
    """
    shares = {
        vehicle.id: (vehicle.name, (vehicle.track_width_m or 0.0) / track_m)
        for vehicle in list_presets()
        if vehicle.kind == "differential" and abs(vehicle.wheel_radius_m / radius_m - 1.0) < _SAME_WHEEL
    }
    alike = [(one, named) for one, named in shares.items() if 0.0 < named[1] < 1.0 + _DIFFERS]
    return dict(sorted(alike, key=lambda item: abs(item[1][1] - 1.0)))


def list_contradictions(recognized: Vehicle, chosen: Vehicle) -> dict[str, str]:
    """Keys in which the recognized and the chosen vehicle differ too much to be the same, and how."""
    # A description of four wheels does not show whether they have rollers; the commands do.
    steered, is_car = (one.kinematics.has_inputs("steering") for one in (recognized, chosen))
    differing = {} if steered == is_car else {"kind": f"kind {recognized.kind}, not {chosen.kind}"}
    for name, limit in (
        ("wheel_radius_m", _DIFFERS),
        ("track_width_m", _OTHER_TRACK),
        ("wheelbase_m", _OTHER_TRACK),
    ):
        said, taken = getattr(recognized, name), getattr(chosen, name)
        if said and taken and abs(said / taken - 1.0) > limit:
            differing[name] = f"{name} {said:.4g}, not {taken:g}"
    return differing


_QUANTITIES: Final = {
    "wheel_separation": "track_width_m",
    "wheels.separation": "track_width_m",
    "traction_track_width": "track_width_m",
    "rear_wheel_track": "track_width_m",
    "RD_WHEEL_TRACK": "track_width_m",
    "wheel_radius": "wheel_radius_m",
    "wheels.radius": "wheel_radius_m",
    "traction_wheels_radius": "wheel_radius_m",
    "rear_wheels_radius": "wheel_radius_m",
    "wheelbase": "wheelbase_m",
    "RA_WHEEL_BASE": "wheelbase_m",
    "wheel_separation_multiplier": "controller_track_multiplier",
    "left_wheel_radius_multiplier": "left_radius",
    "right_wheel_radius_multiplier": "right_radius",
}
"""By the end of a parameter's name. Sources: ros-controls/ros2_controllers, diff_drive_controller and
steering_controllers_library; ROBOTIS-GIT/turtlebot3, turtlebot3_node; PX4/PX4-Autopilot, rover modules."""
_RADIUS_MULTIPLIERS: Final = ("left_radius", "right_radius")
_PARAMETER_DIFFERS: Final = 0.01


@dataclass(frozen=True)
class Controller:
    """Vehicle parameters of a controller.

    Attributes:
        name: of its node, or of the record.
        values: keys of `Vehicle`.
    """

    name: str
    values: Mapping[str, float]

    @property
    def kind(self) -> str:
        """Kind of the vehicle: only a steered one has a wheelbase parameter."""
        return "ackermann" if "wheelbase_m" in self.values else "differential"

    @property
    def geometry(self) -> dict[str, float]:
        """Lengths alone."""
        return {key: value for key, value in self.values.items() if key.endswith("_m")}


def read_parameters(parameters: Iterable[tuple[str, str, float]]) -> Controller | None:
    """Vehicle parameters in a log.

    Args:
        parameters: node, name and value in order of time; the last value is used.

    Returns:
        The node with the most geometry parameters; None without any.
    """
    by_node: dict[str, dict[str, float]] = defaultdict(dict)
    for node, name, value in parameters:
        for ending, quantity in _QUANTITIES.items():
            if (name == ending or name.endswith(f".{ending}")) and 0.0 < value < float("inf"):
                by_node[node][quantity] = value
    if not by_node:
        return None
    node = max(sorted(by_node), key=lambda each: len(by_node[each]))
    values = by_node[node]
    multipliers = [values.pop(key) for key in _RADIUS_MULTIPLIERS if key in values]
    if multipliers and "wheel_radius_m" in values:
        values["wheel_radius_m"] *= sum(multipliers) / len(multipliers)
    return Controller(node, values) if values else None


def list_metadata(metadata: Mapping[str, Mapping[str, str]]) -> list[tuple[str, str, float]]:
    """Numbers of metadata records as parameters of a node with the record's name."""
    records = []
    for record, entries in metadata.items():
        for key, text in entries.items():
            try:
                records.append((record, key, float(text)))
            except ValueError:
                continue
    return records


def apply_parameters(recognized: Recognized, controller: Controller) -> Recognized:
    """A recognized vehicle with the geometry of its controller's parameters, which have priority."""
    geometry = controller.geometry
    notes = [
        {
            "kind": "parameters",
            "controller": controller.name,
            "key": key,
            "set": value,
            "source": recognized.source,
            "known": getattr(recognized.vehicle, key),
        }
        for key, value in geometry.items()
        if getattr(recognized.vehicle, key)
        and abs(value / getattr(recognized.vehicle, key) - 1.0) > _PARAMETER_DIFFERS
    ]
    vehicle = msgspec.structs.replace(recognized.vehicle, **geometry)
    return Recognized(vehicle, recognized.source, (*recognized.notes, *notes))


_NO_WHEEL: Final = re.compile(r"caster|castor|swivel|cam|lidar|imu")
_WHEELS_APART_M: Final = 0.02


def read_frames(buffer: TransformBuffer) -> tuple[str, dict[str, float]]:
    """Kind of the vehicle and its geometry from wheel frames: keys of `Vehicle`, none without wheels.

    Track width and wheelbase are between the centres of frames with wheel names; the radius is their height
    over base_footprint.

    Args:
        buffer: the transforms.
    """
    names = [name for name in buffer.frames() if not _NO_WHEEL.search(name.lower())]
    base = next((name for name in names if name.rsplit("/", 1)[-1] == "base_link"), "")
    ground = next((name for name in names if name.rsplit("/", 1)[-1] == "base_footprint"), "")
    base = base or ground
    steering = _locate(buffer, base, [name for name in names if "steer" in name.lower()])
    wheels = _locate(buffer, base, [name for name in names if "wheel" in name.lower()])
    wheels = [position for position in wheels if abs(position[1]) > _WHEELS_APART_M]
    sides = [[position for position in wheels if sign * position[1] > 0.0] for sign in (1.0, -1.0)]
    if not all(sides):
        return "differential", {}
    rear = min(position[0] for position in wheels)
    geometry: dict[str, float] = {}
    if steering:
        front = float(np.mean([position[0] for position in steering]))
        geometry = (
            {"wheelbase_m": front - rear, "base_to_rear_axle_m": -rear}
            if front - rear > _WHEELS_APART_M
            else {}
        )
    geometry["track_width_m"] = float(np.mean([p[1] for p in sides[0]]) - np.mean([p[1] for p in sides[1]]))
    heights = _locate(buffer, ground, [name for name in names if "wheel" in name.lower()]) if ground else []
    radii = [position[2] for position in heights if position[2] > 0.0]
    if radii:
        geometry["wheel_radius_m"] = float(np.median(radii))
    return ("ackermann" if "wheelbase_m" in geometry else "differential"), geometry


def _locate(buffer: TransformBuffer, base: str, frames: list[str]) -> list[Floats]:
    """Positions of frames in a base [m], without those that no transform gives.

    The rotation of a wheel does not change its position.
    """
    positions = []
    for frame in frames:
        try:
            position = buffer.lookup_series(base, frame).position
        except LogError:
            continue
        if position.shape[0]:
            positions.append(np.median(position, axis=0))
    return positions
