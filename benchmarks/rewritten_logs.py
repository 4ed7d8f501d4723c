"""Logs that are written anew with one thing changed, by the libraries of MCAP alone.

What the change does to the answer is known beforehand: nothing, or it is to be told. Nothing here knows how
the program reads a log or what it looks for.
"""

import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

TWIST = """std_msgs/Header header
geometry_msgs/Twist twist
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: geometry_msgs/Twist
Vector3 linear
Vector3 angular
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
_NUMBERS = {"type": "object", "properties": {axis: {"type": "number"} for axis in "xyzw"}}
IN_FRAME = {
    "title": "foxglove.PoseInFrame",
    "type": "object",
    "properties": {
        "timestamp": {
            "type": "object",
            "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
        },
        "frame_id": {"type": "string"},
        "pose": {"type": "object", "properties": {"position": _NUMBERS, "orientation": _NUMBERS}},
    },
}

Content: TypeAlias = Any
"""A decoded message, or a part of it."""


@dataclass(frozen=True)
class Message:
    """A decoded message, of a topic with its type."""

    topic: str
    kind: str
    content: Any
    log_time: int
    publish_time: int


@dataclass
class Log:
    """A log in memory.

    Attributes:
        messages: in the order of the file.
        definitions: text of every type.
        metadata: records by name.
    """

    messages: list[Message]
    definitions: dict[str, str]
    metadata: dict[str, dict[str, str]]

    @property
    def length(self) -> tuple[int, int]:
        """First and last log time [ns]."""
        times = [one.log_time for one in self.messages]
        return min(times), max(times)


def read(path: Path) -> Log:
    """All messages of a ROS 2 log."""
    messages, definitions = [], {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message, content in reader.iter_decoded_messages(log_time_order=False):
            definitions[schema.name] = schema.data.decode()
            messages.append(
                Message(channel.topic, schema.name, content, message.log_time, message.publish_time)
            )
        metadata = {one.name: dict(one.metadata) for one in reader.iter_metadata()}
    return Log(messages, definitions, metadata)


def write(log: Log, path: Path) -> Path:
    """Write a log; messages of the type `foxglove.PoseInFrame` are JSON."""
    with path.open("wb") as file:
        writer = Writer(file)
        schemas = {name: writer.register_msgdef(name, text) for name, text in log.definitions.items()}
        inner = writer._writer  # the library's writer of ROS 2 has no other encoding
        channels: dict[str, int] = {}
        for one in log.messages:
            if one.kind in schemas:
                writer.write_message(
                    one.topic, schemas[one.kind], one.content, one.log_time, one.publish_time
                )
                continue
            if one.topic not in channels:
                schema = inner.register_schema(one.kind, "jsonschema", json.dumps(IN_FRAME).encode())
                channels[one.topic] = inner.register_channel(one.topic, "json", schema)
            inner.add_message(
                channels[one.topic], one.log_time, json.dumps(one.content).encode(), one.publish_time
            )
        for name, content in log.metadata.items():
            writer.add_metadata(name, content)
        writer.finish()
    return path


@dataclass(frozen=True)
class Roles:
    """Topics of a log, as the unchanged one was read.

    Attributes:
        pose: topic of odometry or of poses.
        wheels: topics of the measured wheels: one of joints, or left and right.
        command: topics of the command.
    """

    pose: str
    wheels: tuple[str, ...]
    command: tuple[str, ...]


@dataclass(frozen=True)
class Change:
    """A change of a log.

    Attributes:
        name: in the table.
        make: the changed log; None where the log has nothing to change.
        told: pattern of a finding that names it; empty where the answer must stay as it was.
        never: pattern of what must not be said of it; the answer may differ, since the drive is another.
    """

    name: str
    make: Callable[[Log, Roles], Log | None]
    told: str = ""
    never: str = ""


def list_changes() -> list[Change]:
    """All changes: of the layout, and faults."""
    return [
        Change("written again", lambda log, _: log),
        Change("an arm beside the wheels", _add_arm),
        Change("20 s not recorded", _cut, "gap|too short|segment|paus|silen"),
        Change("poses turned by 90 degrees", _turn_poses, "heading_deg"),
        Change("right wheels reversed", _on_wheels(1.0, -1.0), "right wheels' encoder counts backward"),
        Change("base_link renamed", _rename),
        Change("poses in JSON", _to_json),
        Change("a measured twist beside", _add_twist),
        Change("clock back by 10 s", _step_clock, "put back|clock"),
        Change("sides exchanged", _exchange, "exchanged"),
        Change("both encoders backward", _on_wheels(-1.0, -1.0), "counts? backward"),
        Change("left encoder dead", _on_wheels(0.0, 1.0), "left wheels' encoder"),
        Change("left encoder dies", _die("left", 0.0), "left wheels' encoder reads (nothing|the same)"),
        Change("right encoder holds", _die("right", None), "right wheels' encoder reads (nothing|the same)"),
        Change("left encoder counts double", _on_wheels(2.0, 1.0), "counts? 2 times|low against the other"),
        Change("pivots about the left wheels", _pivot(0.6), never="encoder reads"),
        Change("nothing but such pivots", _pivot(0.0), never="encoder reads"),
        Change("positions of the wheels in turns", _on_joints(_turn, "position"), "position"),
        Change("a counter of the wheels jumps", _on_joints(_jump, "position"), "jump"),
        Change("counters of the wheels run over", _on_joints(_run_over, "position"), "jump"),
        Change("wheels stamped in whole seconds", _stamp_coarsely("wheels"), "whole seconds|log times"),
        Change("poses stamped in whole seconds", _stamp_coarsely("pose"), "whole seconds|log times"),
        Change("commands stamped in whole seconds", _stamp_coarsely("command"), "whole seconds|log times"),
        Change("frames with a prefix", _prefix_frames),
        Change("another robot's poses on the topic", _mix_poses, "two publishers"),
        Change("in a namespace, beside another robot", _name_robots, "robots?"),
        Change("wheels in rpm", _on_wheels(30.0 / math.pi, 30.0 / math.pi), "rpm"),
        Change("wheels x 3", _on_wheels(3.0, 3.0), "radius|unit"),
        Change("command reversed", _on_command(-1.0, 1.0), "linear.x|sign"),
        Change("command's turn reversed", _on_command(1.0, -1.0), "angular.z|exchanged|sign"),
        Change("yaw rate in degrees", _on_command(1.0, 180.0 / math.pi), "deg/s"),
    ]  # fmt: skip


def _each(log: Log, change: Callable[[Message], Message | None]) -> Log:
    made = [change(one) for one in log.messages]
    return replace(log, messages=[one for one in made if one is not None])


def _copy(content: Content) -> Content:
    """A message as nested dictionaries, which the library writes as well."""
    if hasattr(content, "__slots__"):
        return {name: _copy(getattr(content, name)) for name in content.__slots__}
    if isinstance(content, list | tuple):
        return [_copy(one) for one in content]
    return content


def _joints(log: Log, roles: Roles) -> str | None:
    """The topic of joints among the wheels."""
    kinds = {one.topic: one.kind for one in log.messages}
    return next((topic for topic in roles.wheels if kinds.get(topic, "").endswith("JointState")), None)


def _add_arm(log: Log, roles: Roles) -> Log | None:
    topic = _joints(log, roles)
    if topic is None:
        return None
    kind = next(one.kind for one in log.messages if one.topic == topic)
    made: list[Message] = []
    for index, one in enumerate(log.messages):
        made.append(one)
        if one.topic == topic and index % 2:
            content = _copy(one.content) | {
                "name": ["arm_joint_1", "gripper"], "effort": [],
                "position": [0.1, 0.2], "velocity": [0.0, 0.0],
            }  # fmt: skip
            made.append(Message(topic, kind, content, one.log_time + 1_000_000, one.publish_time + 1_000_000))
    return replace(log, messages=made)


def _cut(log: Log, _: Roles) -> Log | None:
    first, last = log.length
    if last - first < 60e9:
        return None
    start = first + 0.4 * (last - first)
    return _each(log, lambda one: None if start <= one.log_time < start + 20e9 else one)


def _find_pose(content: Content) -> Content:
    """The dictionary with position and orientation."""
    while isinstance(content, dict) and "orientation" not in content:
        content = content.get("pose")
    return content


def _turn_poses(log: Log, roles: Roles) -> Log | None:
    half = math.sqrt(0.5)

    def change(one: Message) -> Message:
        if one.topic != roles.pose:
            return one
        content = _copy(one.content)
        pose = _find_pose(content)
        x, y, z, w = (pose["orientation"][axis] for axis in "xyzw")
        turned = (half * (x + y), half * (y - x), half * (z + w), half * (w - z))
        pose["orientation"] = dict(zip("xyzw", turned, strict=True))
        return replace(one, content=content)

    return _each(log, change) if _has_pose(log, roles) else None


def _has_pose(log: Log, roles: Roles) -> bool:
    first = next((one for one in log.messages if one.topic == roles.pose), None)
    return first is not None and _find_pose(_copy(first.content)) is not None


def _on_wheels(left: float, right: float) -> Callable[[Log, Roles], Log | None]:
    return lambda log, roles: _scale_sides(log, roles.wheels, (left, right))


def _on_command(ahead: float, turn: float) -> Callable[[Log, Roles], Log | None]:
    return lambda log, roles: _scale_command(log, roles, ahead, turn)


def _on_joints(make: Callable[[float, float], float], field: str) -> Callable[[Log, Roles], Log | None]:
    """One number of all joints that do not steer, by its value and the part of the log that is past."""

    def change_all(log: Log, roles: Roles) -> Log | None:
        joints, (first, last) = _joints(log, roles), log.length

        def change(one: Message) -> Message:
            if one.topic != joints:
                return one
            content, past = _copy(one.content), (one.log_time - first) / max(last - first, 1)
            values = zip(content["name"], content[field], strict=False)
            content[field] = [value if "steer" in name else make(value, past) for name, value in values]
            return replace(one, content=content)

        known = [one.content for one in log.messages if one.topic == joints]
        moves = any(any(getattr(one, field)) for one in known) and any(any(one.velocity) for one in known)
        return _each(log, change) if moves else None

    return change_all


def _turn(value: float, _: float) -> float:
    return value / (2.0 * math.pi)


def _jump(value: float, past: float) -> float:
    return value + 2.0 * math.pi * 65536.0 / 2048.0 * (past > _HALF)


_HALF = 0.5
"""Part of a log after which a counter has jumped."""


def _run_over(value: float, _: float) -> float:
    return (value + _FULL_RAD) % (2.0 * _FULL_RAD) - _FULL_RAD


_FULL_RAD = 2.0 * math.pi * 32768.0 / 2048.0
"""Angle [rad] at which a counter of 16 bits runs over, which counts 2048 a turn."""


def _stamp_coarsely(role: str) -> Callable[[Log, Roles], Log | None]:
    """The topics of a role stamped by a clock that counts seconds."""

    def make(log: Log, roles: Roles) -> Log | None:
        topics = {"wheels": roles.wheels, "pose": (roles.pose,), "command": roles.command}[role]

        def change(one: Message) -> Message:
            if one.topic not in topics:
                return one
            content = _copy(one.content)
            for stamp in _list_stamps(content):
                stamp["nanosec"] = 0
            return replace(one, content=content)

        known = [_copy(one.content) for one in log.messages if one.topic in topics]
        return _each(log, change) if any(True for one in known for _ in _list_stamps(one)) else None

    return make


def _prefix(content: Content, space: str) -> Content:
    """A message with its frames in a namespace."""
    if isinstance(content, dict):
        return {
            name: f"{space}/{value}" if name.endswith("frame_id") and value else _prefix(value, space)
            for name, value in content.items()
        }
    return [_prefix(one, space) for one in content] if isinstance(content, list) else content


def _prefix_frames(log: Log, _: Roles) -> Log:
    """All frames with the prefix of a robot that nothing else names."""
    return _each(log, lambda one: replace(one, content=_prefix(_copy(one.content), "robot_7")))


_BESIDE_M = 25.0
"""Distance [m] of another robot."""
_BETWEEN_NS = 7_000_000
"""Time [ns] by which its poses come after those of the first one."""


def _mix_poses(log: Log, roles: Roles) -> Log | None:
    """On the topic of the poses another robot at a distance, which drives as this one backward in time."""
    if not _has_pose(log, roles):
        return None
    own = [_copy(one.content) for one in log.messages if one.topic == roles.pose]
    backward = iter([_find_pose(one) for one in reversed(own)])
    made: list[Message] = []
    for one in log.messages:
        made.append(one)
        if one.topic != roles.pose:
            continue
        content, pose = _copy(one.content), next(backward)
        _find_pose(content).update(
            pose | {"position": pose["position"] | {"x": pose["position"]["x"] + _BESIDE_M}}
        )
        for stamp in _list_stamps(content):
            stamp |= dict(zip(("sec", "nanosec"), _add(stamp, _BETWEEN_NS), strict=True))
        times = (one.log_time + _BETWEEN_NS, one.publish_time + _BETWEEN_NS)
        made.append(Message(one.topic, one.kind, content, *times))
    return replace(log, messages=made)


def _add(stamp: dict[str, int], time_ns: int) -> tuple[int, int]:
    return divmod(stamp["sec"] * 10**9 + stamp["nanosec"] + time_ns, 10**9)


def _name_robots(log: Log, roles: Roles) -> Log | None:
    """All topics and frames in a namespace; in another one a robot stands, with the same frames."""
    framed = ("Odometry", "TFMessage", "PoseStamped", "PoseWithCovarianceStamped")
    transforms = [one for one in log.messages if one.kind.endswith("TFMessage")]
    if roles.pose not in {one.topic for one in transforms}:
        return None

    made: list[Message] = []
    standing = {one.topic: _copy(one.content) for one in reversed(transforms)}
    for one in log.messages:
        content = _prefix(_copy(one.content), "robot_b") if one.kind.endswith(framed) else one.content
        topic = one.topic if one.topic in standing else f"/robot_b{one.topic}"
        made.append(replace(one, topic=topic, content=content))
        if one.topic in standing:
            stamps = [part["header"]["stamp"] for part in _copy(one.content)["transforms"]]
            still = _prefix(standing[one.topic], "robot_a")
            for part in still["transforms"]:
                part["header"] = part["header"] | {"stamp": stamps[0]}
            made.append(replace(one, content=still))
    return replace(log, messages=made)


def _exchange(log: Log, roles: Roles) -> Log | None:
    """Joint states with their names exchanged, or topics."""
    joints = _joints(log, roles)
    words = {"left": "right", "right": "left"}

    def swap(text: str) -> str:
        return re.sub("left|right", lambda found: words[found[0]], text)

    def change(one: Message) -> Message:
        if one.topic == joints:
            content = _copy(one.content)
            content["name"] = [swap(name) for name in content["name"]]
            return replace(one, content=content)
        return replace(one, topic=swap(one.topic)) if one.topic in roles.wheels else one

    if joints is None and len(roles.wheels) != 2:
        return None
    return _each(log, change)


def _scale_sides(log: Log, topics: tuple[str, ...], factors: tuple[float, float]) -> Log | None:
    """Speeds (and positions) of the sides: of joints by name, or of two topics of one number."""
    joints = _joints(log, Roles("", topics, ()))
    if joints is None and len(topics) != 2:
        return None

    def scale(one: Message) -> Message:
        if one.topic == joints:
            content = _copy(one.content)
            by_name = [_find_factor(name, factors) for name in content["name"]]
            for field in ("velocity", "position"):
                if len(content[field]) == len(by_name):
                    content[field] = [value * by for value, by in zip(content[field], by_name, strict=True)]
            return replace(one, content=content)
        if one.topic in topics:
            factor = factors[0] if "left" in one.topic else factors[1]
            return replace(one, content={"data": one.content.data * factor})
        return one

    if joints is None and not all(
        hasattr(one.content, "data") for one in log.messages if one.topic in topics
    ):
        return None
    return _each(log, scale)


def _die(side: str, reads: float | None, begins: float = 0.6) -> Callable[[Log, Roles], Log | None]:
    """One encoder reads a number after a part of the log, or its last one."""

    def make(log: Log, roles: Roles) -> Log | None:
        first, last = log.length
        dies = first + begins * (last - first)
        joints, held = _joints(log, roles), dict[str, float]()

        def read(name: str, value: float, time: int) -> float:
            if side not in name or "steer" in name or time < dies:
                held[name] = value
                return value
            return held.get(name, 0.0) if reads is None else reads

        def change(one: Message) -> Message:
            if one.topic == joints:
                content = _copy(one.content)
                for field in ("velocity", "position"):
                    if len(content[field]) == len(content["name"]):
                        content[field] = [
                            read(name if field == "velocity" else f"{name} angle", value, one.log_time)
                            for name, value in zip(content["name"], content[field], strict=True)
                        ]
                return replace(one, content=content)
            if one.topic in roles.wheels:
                return replace(one, content={"data": read(one.topic, one.content.data, one.log_time)})
            return one

        known = all(hasattr(one.content, "data") for one in log.messages if one.topic in roles.wheels)
        return _each(log, change) if joints or (len(roles.wheels) == 2 and known) else None

    return make


_ASIDE = 0.5
"""Motion to the side over that ahead of vehicles that drive to the side."""
_NOISE_M, _NOISE_RAD = 2e-3, 1e-3
"""Noise of poses that are made."""


def _pivot(begins: float) -> Callable[[Log, Roles], Log | None]:
    """After a part of the log the left wheels stand, and the body turns about them as the right ones drive.

    What a turn of the wheels is worth in metres and radians is fitted to the unchanged log.
    """

    def make(log: Log, roles: Roles) -> Log | None:
        wheels = _read_sides(log, roles)
        if wheels is None or not _has_pose(log, roles):
            return None
        own = [
            (one.log_time, _find_pose(_copy(one.content))) for one in log.messages if one.topic == roles.pose
        ]
        times = np.array([time for time, _ in own])
        x, y = (np.array([pose["position"][axis] for _, pose in own]) for axis in "xy")
        yaw = np.unwrap([_yaw(pose) for _, pose in own])
        turned = np.diff(yaw)
        left, right = (np.diff(np.interp(times, *wheels[side])) for side in ("left", "right"))
        # In the direction of the wheels' drive, wherever the headings point.
        moved = (np.diff(x) + 1j * np.diff(y)) * np.exp(-0.5j * (yaw[1:] + yaw[:-1]))
        way = complex(moved @ (left + right))
        if not way:
            return None  # It stands.
        way /= abs(way)
        moved /= way
        if moved.imag.std() > _ASIDE * moved.real.std():
            return None  # Wheels that roll to the side turn the body about no side.
        metres, turn = (
            float(rate @ drive / (drive @ drive))
            for rate, drive in ((moved.real, 0.5 * (left + right)), (turned, right - left))
        )
        first, last = log.length
        start = first + begins * (last - first)
        past = times[1:] > start
        moved, turned = np.where(past, 0.5 * metres * right, moved), np.where(past, turn * right, turned)
        headings = yaw[0] + np.cumsum(turned)
        places = x[0] + 1j * y[0] + np.cumsum(moved * way * np.exp(1j * (headings - 0.5 * turned)))
        noise = np.random.default_rng(5).normal(0.0, 1.0, (3, past.size)) * past
        places += _NOISE_M * (noise[0] + 1j * noise[1])
        headings += _NOISE_RAD * noise[2]
        speeds, rates = (one * 1e9 / np.maximum(np.diff(times), 1) for one in (moved * way, turned))
        motions = zip(places, headings, speeds, rates, strict=True)
        poses = dict(zip(times[1:].tolist(), motions, strict=True))
        stands = _die("left", None, begins)(log, roles)
        span = _fit_span(log, roles, wheels)

        def change(one: Message) -> Message | None:
            if one.topic.endswith("tf_static"):
                return one
            if one.topic in roles.wheels:
                return _stop_left(one, ("velocity",)) if one.log_time > start else one
            if one.topic == roles.pose:
                return _move(one, poses[one.log_time]) if one.log_time in poses else one
            if one.topic in roles.command:
                return _command_right(one, span) if one.log_time > start else one
            return None

        return None if stands is None else _each(stands, change)

    return make


def _fit_span(log: Log, roles: Roles, wheels: dict[str, tuple[Any, Any]]) -> float:
    """Distance [m] of the sides by which a controller turns body commands into wheel speeds."""
    asked = [
        (one.log_time, twist["linear"]["x"], twist["angular"]["z"])
        for one in log.messages
        if one.topic in roles.command and "linear" in (twist := _find_twist(_copy(one.content)))
    ]
    if len(asked) < _FEWEST:
        return 0.0
    times, ahead, turn = np.array(asked).T
    left, right = (np.diff(np.interp(times, *wheels[side])) for side in ("left", "right"))
    elapsed = np.diff(times) / 1e9
    ratios = [
        float(drive @ one / (one @ one))
        for drive, one in ((0.5 * (left + right), ahead[:-1] * elapsed), (right - left, turn[:-1] * elapsed))
    ]
    return ratios[1] / ratios[0]


_FEWEST = 100
"""Commands from which on their scale can be read."""


def _find_twist(content: Content) -> Content:
    return content.get("twist", content) if isinstance(content, dict) else {}


def _read_sides(log: Log, roles: Roles) -> dict[str, tuple[Any, Any]] | None:
    """Times [ns] and angles of the left and the right wheels of a vehicle that does not steer."""
    found: dict[str, tuple[list[int], list[float]]] = {"left": ([], []), "right": ([], [])}
    for one in log.messages:
        if one.topic not in roles.wheels:
            continue
        if hasattr(one.content, "name"):
            speeds = dict(zip(one.content.name, one.content.velocity, strict=False))
        else:
            speeds = {one.topic: getattr(one.content, "data", None)}
        for side, (times, rates) in found.items():
            own = [speed for name, speed in speeds.items() if side in name]
            if "steer" in "".join(speeds) or any(not isinstance(speed, float) for speed in own):
                return None
            if own:
                times.append(one.log_time)
                rates.append(sum(own) / len(own))
    if any(len(times) < 2 for times, _ in found.values()):
        return None
    return {
        side: (np.array(times), np.cumsum(np.array(rates) * np.gradient(np.array(times)) / 1e9))
        for side, (times, rates) in found.items()
    }


def _move(one: Message, motion: tuple[complex, float, complex, float]) -> Message:
    """A message of poses, and of speeds where it has them, with another motion."""
    content = _copy(one.content)
    pose, (place, yaw, speed, turning) = _find_pose(content), motion
    pose["position"] |= {"x": place.real, "y": place.imag}
    pose["orientation"] = {"x": 0.0, "y": 0.0, "z": math.sin(0.5 * yaw), "w": math.cos(0.5 * yaw)}
    if "twist" in content:
        twist = content["twist"]["twist"]
        twist["linear"] |= {"x": speed.real, "y": speed.imag}
        twist["angular"] |= {"z": turning}
    return replace(one, content=content)


def _command_right(one: Message, span: float) -> Message:
    """A command of which the left wheels get nothing, on wheels that are a span [m] apart."""
    content = _copy(one.content)
    if "linear" in (twist := _find_twist(content)):
        right = twist["linear"]["x"] + 0.5 * span * twist["angular"]["z"]
        twist["linear"]["x"], twist["angular"]["z"] = 0.5 * right, right / span
        return replace(one, content=content)
    return _stop_left(one, ("velocity", "position"))


def _stop_left(one: Message, fields: Sequence[str]) -> Message:
    """A message of joints, or of a side's speed, with zero for the left wheels."""
    content = _copy(one.content)
    if isinstance(content, dict) and "name" in content:
        for field in fields:
            values = zip(content["name"], content[field], strict=False)
            content[field] = [0.0 if "left" in name else value for name, value in values]
    elif "left" in one.topic:
        content = {"data": 0.0}
    return replace(one, content=content)


def _find_factor(joint: str, factors: tuple[float, float]) -> float:
    """Factor of a joint by its side; those that steer keep their angle."""
    sides = {"left": factors[0], "right": factors[1]}
    found = [factor for side, factor in sides.items() if side in joint and "steer" not in joint]
    return found[0] if found else 1.0


def _scale_command(log: Log, roles: Roles, ahead: float, turn: float) -> Log | None:
    """A body command of Twist or TwistStamped."""
    kinds = {one.topic: one.kind for one in log.messages}
    topics = [topic for topic in roles.command if "Twist" in kinds.get(topic, "")]
    if not topics:
        return None

    def change(one: Message) -> Message:
        if one.topic != topics[0]:
            return one
        content = _copy(one.content)
        twist = _find_twist(content)
        twist["linear"]["x"] *= ahead
        twist["angular"]["z"] *= turn
        return replace(one, content=content)

    return _each(log, change)


def _rename(log: Log, _: Roles) -> Log | None:
    def rename(content: Content) -> Content:
        if isinstance(content, dict):
            return {name: rename(value) for name, value in content.items()}
        if isinstance(content, list):
            return [rename(value) for value in content]
        return content.replace("base_link", "chassis") if isinstance(content, str) else content

    framed = ("Odometry", "TFMessage", "PoseStamped", "PoseWithCovarianceStamped")

    def change(one: Message) -> Message:
        return replace(one, content=rename(_copy(one.content))) if one.kind.endswith(framed) else one

    return _each(log, change)


def _to_json(log: Log, roles: Roles) -> Log | None:
    if not _has_pose(log, roles):
        return None

    def change(one: Message) -> Message:
        if one.topic != roles.pose:
            return one
        content = _copy(one.content)
        stamp = content["header"]["stamp"]
        made = {
            "timestamp": {"sec": stamp["sec"], "nsec": stamp["nanosec"]},
            "frame_id": content["header"]["frame_id"],
            "pose": _find_pose(content),
        }
        return replace(one, kind="foxglove.PoseInFrame", content=made)

    return _each(log, change)


def _yaw(pose: Content) -> float:
    x, y, z, w = (pose["orientation"][axis] for axis in "xyzw")
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _add_twist(log: Log, roles: Roles) -> Log | None:
    """The velocity of the poses themselves, under a name that says nothing."""
    if not _has_pose(log, roles):
        return None
    made: list[Message] = []
    before: tuple[int, Any] | None = None
    for one in log.messages:
        made.append(one)
        if one.topic != roles.pose:
            continue
        content = _copy(one.content)
        stamp = content["header"]["stamp"]
        time, pose = stamp["sec"] * 10**9 + stamp["nanosec"], _find_pose(content)
        if before is not None and time > before[0]:
            elapsed, yaw = (time - before[0]) / 1e9, _yaw(before[1])
            x, y = (pose["position"][axis] - before[1]["position"][axis] for axis in "xy")
            turned = math.remainder(_yaw(pose) - yaw, 2.0 * math.pi)
            ahead = x * math.cos(yaw + 0.5 * turned) + y * math.sin(yaw + 0.5 * turned)
            twist = {
                "linear": {"x": ahead / elapsed, "y": 0.0, "z": 0.0},
                "angular": {"x": 0.0, "y": 0.0, "z": turned / elapsed},
            }
            header = {"stamp": stamp, "frame_id": "base_link"}
            kind = "geometry_msgs/msg/TwistStamped"
            made.append(
                Message(
                    "/body_motion", kind, {"header": header, "twist": twist}, one.log_time, one.publish_time
                )
            )
        before = (time, pose)
    definitions = {"geometry_msgs/msg/TwistStamped": TWIST} | log.definitions
    return replace(log, messages=made, definitions=definitions)


def _step_clock(log: Log, _: Roles) -> Log | None:
    first, last = log.length
    if last - first < 60e9:
        return None
    middle = first + 0.5 * (last - first)

    def change(one: Message) -> Message:
        if one.log_time < middle:
            return one
        content = _copy(one.content)
        for stamp in _list_stamps(content):
            stamp["sec"] -= 10
        return replace(
            one, content=content, log_time=one.log_time - 10**10, publish_time=one.publish_time - 10**10
        )

    return _each(log, change)


def _list_stamps(content: Content) -> Iterator[dict[str, int]]:
    if isinstance(content, dict):
        for name, value in content.items():
            if name == "stamp" and isinstance(value, dict):
                yield value
            else:
                yield from _list_stamps(value)
    elif isinstance(content, list) and content and isinstance(content[0], dict):
        for value in content:
            yield from _list_stamps(value)
