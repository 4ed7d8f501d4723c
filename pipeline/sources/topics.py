"""Choice of topics by configuration, type and name, for one robot at a time."""

import os.path
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Literal, TypeVar

from pipeline.core import name_first
from pipeline.logs import TRANSFORM_TYPES, ChannelInfo, find_types, wanted_transforms
from pipeline.sources.candidates import (
    CONFIGURED,
    DEAD_RECKONED,
    RANKS,
    DriveForm,
    DriveSource,
    PoseContent,
    PoseSource,
    Signal,
    Sources,
    Topics,
    TopicSource,
    is_localization,
)
from pipeline.sources.configuration import (
    Configuration,
    ConfigurationError,
    DriveSection,
    IntervalSection,
    PoseSection,
    Vehicle,
    find_preset,
)
from pipeline.sources.message_types import PoseFields, find_type, list_types, plain_type

# Several robots in one log: separated by their namespaces, so that commands and poses are of the same robot.
#
# Namespaces belong to several robots if they contain drives and poses between them and have names that differ
# only in a number or letter (``robot1``, ``robot2``), names of vehicles (``husky``, ``warthog``), or the same
# topics (``alice/cmd_vel``, ``alice/odom``, ``bob/cmd_vel``, ``bob/odom``). Anything else, such as
# ``controller`` beside ``mapping``, is one robot.

_NUMBERED = re.compile(r"\d+|_[a-d]$")
_FUNCTION = re.compile(
    r"control|platform|drive|base|nav|mux|joy|teleop|web|key|plan|map|slam|icp|lidar|laser|locali|odom|wheel|motor"
    r"|vehicle|robot$|cmd|command|sensor|imu|gnss|gps|rtk|camera|zed|status|state|ekf|filter|fusion|sim|gazebo|truth"
)
"""Words that mark a namespace as named after its function."""


def find_robots(drives: Collection[str], poses: Collection[str]) -> tuple[str, ...]:
    """Namespaces of the robots, ``/robot1/`` and so on, sorted; empty if there is only one robot.

    Args:
        drives: topics that may be commands or measured wheels.
        poses: topics that may be poses.
    """
    depths = sorted({topic.count("/") for topic in (*drives, *poses)})
    for depth in range(1, max(depths, default=0)):
        siblings: dict[str, set[str]] = defaultdict(set)
        for topic in (*drives, *poses):
            if topic.count("/") > depth:
                space = _space_of(topic, depth)
                siblings[space.rsplit("/", 2)[0]].add(space)
        for spaces in siblings.values():
            for family in _list_families(spaces, drives, poses):
                if len(family) > 1 and _holds(family, drives) and _holds(family, poses):
                    return tuple(sorted(family))
    return ()


def choose_robot(
    robots: Collection[str],
    *,
    configured: Iterable[str],
    drives: Collection[str],
    poses: Collection[str],
    where: str,
) -> str | None:
    """Namespace of the robot that the log is analyzed for.

    Args:
        robots: as `find_robots` gives them.
        configured: topics of the configuration, the most specific first.
        drives: topics that may be commands or measured wheels.
        poses: topics that may be poses.
        where: the log, for the error message.

    Returns:
        The robot whose topic is configured, else the only one with both drive and pose; None without several
        robots.

    Raises:
        ConfigurationError: ``several_robots``, the robot is ambiguous.
    """
    if not robots:
        return None
    for topic in configured:
        for robot in robots:
            if topic.startswith(robot):
                return robot
    whole = [robot for robot in robots if _holds([robot], drives) and _holds([robot], poses)]
    if len(whole) == 1:
        return whole[0]
    names = ", ".join(robot.strip("/") for robot in robots)
    why = "each has a drive and a pose" if whole else "none has both a drive and a pose"
    example = next(topic for topic in sorted(poses) if topic.startswith(tuple(robots)))
    raise ConfigurationError(
        "several_robots",
        f"the log holds several robots ({names}), and {why}",
        where=where,
        hint=f'Name one of its topics in run.toml, for example [pose] topic = "{example}" '
        "(and [command], [wheels], [imu] where they stand elsewhere)",
    )


def _space_of(topic: str, depth: int) -> str:
    return "/".join(topic.split("/")[: depth + 1]) + "/"


def _list_families(
    spaces: Collection[str], drives: Collection[str], poses: Collection[str]
) -> Iterable[set[str]]:
    """Sibling namespaces that may be robots of one log."""
    families: dict[str, set[str]] = defaultdict(set)
    for space in sorted(spaces):
        name = space.strip("/").rsplit("/", 1)[-1].lower()
        stem = _NUMBERED.sub("", name).strip("_-")
        if find_preset(stem) is not None:
            families["a vehicle"].add(space)
        elif stem != name:
            families[_NUMBERED.sub("#", name)].add(space)
        if not _FUNCTION.search(name):
            families["by its topics"].add(space)
    alike = families.pop("by its topics", set())
    yield from families.values()
    held: Mapping[str, tuple[set[str], set[str]]] = {
        space: (_inside(space, drives), _inside(space, poses)) for space in sorted(alike)
    }
    for own in held.values():
        yield {space for space, other in held.items() if own[0] & other[0] and own[1] & other[1]}


def _inside(space: str, topics: Collection[str]) -> set[str]:
    return {topic.removeprefix(space) for topic in topics if topic.startswith(space)}


def _holds(spaces: Collection[str], topics: Collection[str]) -> bool:
    return any(_inside(space, topics) for space in spaces)


# Choosing topics by configuration, type and name.
#
# Topics of the configuration are used as given. Otherwise the candidates of a role have a fitting type, and
# usual names of vehicles and words such as `cmd` or `status` rank them. The choice includes its reason. If a
# log contains several robots, all roles are filled from the namespace of one.

STRING_TYPE = "std_msgs/String"
DEFAULT_INTERVAL = ("/drive/calib_state", "calib")

_NOT_A_POSE = re.compile(r"goal|initialpose|initial_pose|target|waypoint|desired|reference|setpoint|cmd")
_PLACE = re.compile(r"pos(?!e)|station|prism|track|leica|uwb|beacon|gps|gnss")
"""Names of points that are measured, and not picked on a screen."""

Source = TypeVar("Source", DriveSource, PoseSource, TopicSource)


def choose_sources(
    channels: Sequence[ChannelInfo], configuration: Configuration, vehicle: Vehicle, *, where: str
) -> Sources:
    """Choose the topics of every role.

    Args:
        channels: channels of the log.
        configuration: configuration of the user.
        vehicle: vehicle whose usual topics are preferred.
        where: the log, for error messages.

    Raises:
        ConfigurationError: a configured topic is not in the log, or needs a field path; or the log contains
            several robots, and none is chosen.
    """
    chosen = {*list_topics(configuration.command), *list_topics(configuration.wheels)}
    misnamed = {topic: what for topic, what in vehicle.topics.misnamed.items() if topic not in chosen}
    held = [channel for channel in channels if channel.message_count != 0]
    silent = {channel.topic for channel in channels} - {channel.topic for channel in held}
    chooser = _Chooser([channel for channel in held if channel.topic not in misnamed], silent, vehicle, where)
    chooser.notes += [
        f"{channel.topic} is left out: it contains {misnamed[channel.topic]}"
        for channel in held
        if channel.topic in misnamed
    ]
    chooser.fix_robot(configuration)
    command, wheels = chooser.choose_drives(configuration)
    sources = Sources(
        command=command,
        wheels=wheels,
        pose=chooser.choose_track(configuration.pose),
        imu=chooser.choose_imu(configuration.imu.topic),
        interval=chooser.choose_interval(configuration),
        notes=tuple(chooser.notes),
        others=chooser.others,
        other_robots=chooser.other_robots,
    )
    return sources.separated()


class _Chooser:
    """Candidates of one log."""

    def __init__(
        self, channels: list[ChannelInfo], silent: Collection[str], vehicle: Vehicle, where: str
    ) -> None:
        self.types = {topic: plain_type(kind) for topic, kind in find_types(channels).items()}
        self.counts = {channel.topic: channel.message_count or 0 for channel in channels}
        self.silent = silent
        self.vehicle = vehicle
        self.where = where
        self.notes: list[str] = []
        self.others: dict[str, tuple[DriveSource | PoseSource | TopicSource, ...]] = {}
        self.other_robots: tuple[str, ...] = ()
        self._robot: str | None = None
        self._steered = vehicle.kinematics.has_inputs("speed", "steering")

    def fix_robot(self, configuration: Configuration) -> None:
        """Determine the robot whose topics may be chosen, if the log contains several."""
        numbers = Topics(self.types)
        pairs = (*numbers.pairs_of_sides(), *numbers.pairs_of_speed_and_steering())
        drives = {
            *self.with_part("joints"),
            *(topic for topic in self.with_part("drive") if topic not in self.with_part("pose")),
            *(topic for topic, number in numbers.numbers().items() if number.quantity),
            *(side for pair in pairs for side in pair),
        }
        poses = {topic for topic in self.with_part("pose") if self._rank_pose(topic) is not None}
        poses |= {topic for topic in self.of_type(*TRANSFORM_TYPES) if "static" not in topic}
        poses |= {*self.with_part("fix"), *numbers.ground_velocities()}
        drives -= set(numbers.ground_velocities())
        robots = find_robots(drives, poses)
        named = list_named(configuration)
        self._robot = choose_robot(robots, configured=named, drives=drives, poses=poses, where=self.where)
        if self._robot is not None:
            self.other_robots = tuple(robot for robot in robots if robot != self._robot)
            others = ", ".join(robot.strip("/") for robot in self.other_robots)
            self.notes.append(f"robot: {self._robot.strip('/')}; the log holds topics of {others} as well")

    def of_type(self, *types: str) -> list[str]:
        """Topics of any of the types, of one robot."""
        return [
            topic
            for topic, kind in self.types.items()
            if kind in types and topic.startswith(self._robot or "")
        ]

    def with_part(self, part: str) -> list[str]:
        """Topics whose type has a part, of one robot."""
        return self.of_type(*list_types(part))

    def require(self, text: str, role: str) -> Signal:
        """A configured signal, or an error if its topic is not in the log."""
        signal = Signal.parse(text)
        if signal.topic not in self.types:
            lack = "without any message" if signal.topic in self.silent else "not in the log"
            what = f"the topic {signal.topic!r} configured as {role} is {lack}"
            raise self._bad(
                what, f"The log has: {', '.join(sorted(self.types)) or 'no topics'}.", "topic_not_found"
            )
        return signal

    def _unusable(self, topic: str, role: str, kind: str) -> ConfigurationError:
        what = f"the topic {topic!r} of type {self.types[topic]} cannot serve as {role}"
        return self._bad(what, f"Use a topic of type {kind}.")

    def _bad(self, what: str, hint: str, code: str = "type_not_usable") -> ConfigurationError:
        return ConfigurationError(code, what, where=self.where, hint=hint)

    def require_number(self, text: str, role: str) -> Signal:
        """A configured signal that must be one number."""
        signal = self.require(text, role)
        if signal.field:
            return signal
        number = find_type(self.types[signal.topic]).number
        if number is not None:
            return Signal(signal.topic, number.field, number.unit, number.sign, number.per_turn)
        what = f"the topic {signal.topic!r} configured as {role} is of type {self.types[signal.topic]}"
        hint = f"Name the field: {signal.topic}.field or {signal.topic}.array[0]."
        raise self._bad(what, hint, "field_needed")

    def choose_drives(self, configuration: Configuration) -> tuple[DriveSource | None, DriveSource | None]:
        """Commands and measured wheels by configuration, else by type and name; no signal is both."""
        command = self._configured_drive(configuration.command, "command")
        wheels = self._configured_drive(configuration.wheels, "wheels")
        if command is not None and configuration.command == configuration.wheels:
            what = f"{command} is configured as command and as wheels"
            raise self._bad(what, "Take it out of [command] or of [wheels] in run.toml.", "one_of_two_roles")
        return (
            command or self._choose_drive(wheels, commanded=True),
            wheels or self._choose_drive(command, commanded=False),
        )

    def _choose_drive(self, other: DriveSource | None, *, commanded: bool) -> DriveSource | None:
        """Commands (or measured wheels) by type and name, without what is configured as the other."""
        usual = self.vehicle.topics.command if commanded else self.vehicle.topics.wheels
        drives = self._own().list_drives(commanded=commanded, steered=self._steered)
        drives = [one for one in drives if other is None or one[1].signals != other.signals]
        return self._best(drives, usual, "command" if commanded else "wheels")

    def _configured_drive(self, section: DriveSection, role: str) -> DriveSource | None:
        reason = CONFIGURED
        self._require_whole(section, role)
        if section.left_topic and section.right_topic:
            sides = (section.left_topic, section.right_topic)
            return DriveSource(
                DriveForm.SIDES, tuple(self.require_number(side, role) for side in sides), reason
            )
        if section.speed_topic and (section.yaw_rate_topic or section.steering_topic):
            form = DriveForm.BODY if section.yaw_rate_topic else DriveForm.STEERING
            pair = (section.speed_topic, section.yaw_rate_topic or section.steering_topic or "")
            return DriveSource(form, tuple(self.require_number(text, role) for text in pair), reason)
        if section.topic:
            signal = self.require(section.topic, role)
            topics = Topics({signal.topic: self.types[signal.topic]})
            drives = [
                source
                for commanded in (True, False)
                for _, source in topics.list_drives(commanded=commanded, steered=self._steered)
            ]
            if not drives or (role == "command" and find_type(self.types[signal.topic]).pose is not None):
                what = f"the topic {signal.topic!r} ({self.types[signal.topic]}) cannot serve as {role} alone"
                raise self._bad(what, f"Give {role}.left_topic and {role}.right_topic with field paths.")
            if role == "command" and topics.is_measured(signal.topic, steered=self._steered):
                raise self._not_commanded(signal.topic)
            return DriveSource(drives[0].form, drives[0].signals, reason, drives[0].name)
        return None

    def _not_commanded(self, topic: str) -> ConfigurationError:
        """The error of measurements that are configured as the command."""
        kind = self.types[topic]
        what = f"the topic {topic!r} ({kind}), configured as command, holds what the wheels measured"
        drives = self._own().list_drives(commanded=True, steered=self._steered)
        known = name_first(list(dict.fromkeys(str(source) for _, source in drives)))
        hint = (
            f"Commands are in {known}. Take {topic} out of [command] in run.toml"
            if known
            else f"No topic of this log holds commands. Take {topic} out of [command] in run.toml: measured "
            "wheels alone, without commands, can be analyzed"
        )
        return self._bad(what, f"{hint}.", "command_is_measured")

    def _require_whole(self, section: DriveSection, role: str) -> None:
        """Refuse one of several keys that are used only together."""
        turns = ("yaw_rate_topic", "steering_topic")
        needs = {
            "left_topic": ("right_topic",), "right_topic": ("left_topic",),
            "left": ("right",), "right": ("left",),
            "speed_topic": turns, **dict.fromkeys(turns, ("speed_topic",)),
        }  # fmt: skip
        for key, others in needs.items():
            if getattr(section, key) and not any(getattr(section, other) for other in others):
                absent = " or ".join(f"{role}.{other}" for other in others)
                what = f"{role}.{key} is given without {absent}, and is not used alone"
                raise self._bad(what, f"Give both, or neither, under [{role}] in run.toml.", "field_needed")

    def choose_pose(self, section: PoseSection) -> PoseSource | None:
        """The localization: configured, else the best by name, else transforms, else any odometry."""
        topic, frames = section.topic, section.frames
        if section.x or section.y or section.yaw:
            return self._pose_of_fields(section)
        transforms = self._dynamic_transforms(is_configured=bool(frames))
        if frames:
            if not transforms:
                what = "pose.frames is configured, but the log has no transforms"
                raise self._bad(what, "Configure pose.topic.", "topic_not_found")
            return PoseSource(transforms, CONFIGURED, from_transforms=True, frames=(frames[0], frames[1]))
        if topic:
            name = self.require(topic, "pose").topic
            if self.types[name] in TRANSFORM_TYPES:
                return PoseSource(name, CONFIGURED, from_transforms=True)
            kind = find_type(self.types[name])
            if kind.pose is not None:
                return PoseSource(name, CONFIGURED, name=section.name or "")
            if kind.fix is not None or kind.ground_velocity is not None:
                return self._by_satellites(name, CONFIGURED)
            what = f"the topic {name!r} of type {self.types[name]} cannot serve as pose"
            usable = ", ".join((*list_types("pose"), *list_types("fix")))
            raise self._bad(
                what, f"Use one of: {usable}; or pose.frames, or pose.x, y and yaw with its fields."
            )
        candidates = [
            (ranked[0], replace(ranked[1], name=section.name or ""))
            for name in self.with_part("pose")
            if (ranked := self._rank_pose(name)) is not None
        ]
        by_satellites = {
            "fix": self.with_part("fix"), "ground_velocity": self._own().ground_velocities()
        }  # fmt: skip
        for key, names in by_satellites.items():
            rank, reason = RANKS[key]
            candidates += [(rank, self._by_satellites(name, reason)) for name in names]
        if transforms:
            rank, reason = RANKS["transforms"]
            candidates.append((rank, PoseSource(transforms, reason, from_transforms=True)))
        return self._best(candidates, self.vehicle.topics.pose, "pose")

    def choose_track(self, section: PoseSection) -> PoseSource | None:
        """The localization, with the track that is configured."""
        pose = self.choose_pose(section)
        return pose and replace(pose, track=section.track or 0)

    def _pose_of_fields(self, section: PoseSection) -> PoseSource:
        """The pose of three fields of a topic."""
        given = {"x": section.x, "y": section.y, "yaw": section.yaw}
        example = 'pose = {x = "/topic.x", y = "/topic.y", yaw = "/topic.yaw"}'
        if absent := [name for name, text in given.items() if not text]:
            what = f"a pose of fields needs x, y and yaw, and pose.{absent[0]} is not given"
            raise self._bad(what, f"Give all three: {example}.", "field_needed")
        signals = {name: self.require(text or "", f"pose.{name}") for name, text in given.items()}
        if bare := [name for name, signal in signals.items() if not signal.field]:
            what = f"pose.{bare[0]} names the topic {signals[bare[0]].topic!r} without a field"
            raise self._bad(what, f"Name the field of each: {example}.", "field_needed")
        topics = list(dict.fromkeys(signal.topic for signal in signals.values()))
        if len(topics) > 1 or section.topic not in {None, topics[0]}:
            what = f"the fields of a pose are of one topic, and {' and '.join(topics)} are several"
            if len(topics) == 1:
                what = f"pose.topic is {section.topic!r}, and the fields of the pose are of {topics[0]!r}"
            raise self._bad(what, "Name three fields of one topic.", "pose_of_several_topics")
        x, y, yaw = (signal.fields()[0] for signal in signals.values())
        unit: Literal["rad", "deg"] = "deg" if "deg" in yaw.lower() else "rad"
        fields = PoseFields(position=[x, y], angle=yaw, angle_unit=unit)
        return PoseSource(topics[0], CONFIGURED, fields=fields)

    def _own(self) -> Topics:
        """Topics of one robot."""
        return Topics({topic: self.types[topic] for topic in self.of_type(*self.types.values())})

    def _by_satellites(self, topic: str, reason: str) -> PoseSource:
        """Fixes with the velocities published with them, or velocities alone."""
        headings = self._own().headings()
        if find_type(self.types[topic]).fix is None:
            return PoseSource(topic, reason, content=PoseContent.VELOCITY, headings=headings)
        beside = self._own().ground_velocities()
        shared = [len(os.path.commonpath((topic, each))) for each in beside]
        nearest = beside[shared.index(max(shared))] if beside else ""
        return PoseSource(topic, reason, content=PoseContent.FIX, velocity=nearest, headings=headings)

    def _dynamic_transforms(self, *, is_configured: bool) -> str:
        topics = [one.topic for one in wanted_transforms(self.types) if not one.topic.endswith("static")]
        own = [name for name in topics if name.startswith(self._robot or "")]
        # Transforms of all robots together serve only if frames are configured.
        return next(iter(own or (topics if is_configured else [])), "")

    def _rank_pose(self, topic: str) -> tuple[float, PoseSource] | None:
        name = topic.lower()
        if _NOT_A_POSE.search(name):
            return None
        pose, key = find_type(self.types[topic]).pose, "pose"
        headings: tuple[Signal, ...] = ()
        if pose is not None and not (pose.orientation or pose.angle):
            if not (is_localization(name) or _PLACE.search(name)):
                return None
            key, headings = "positions", self._own().headings()
        elif is_localization(name):
            key = "localization"
        elif DEAD_RECKONED.search(name):
            key = "dead_reckoning"
        rank, reason = RANKS[key]
        return rank, PoseSource(topic, reason, headings=headings)

    def choose_imu(self, topic: str | None) -> TopicSource | None:
        """The gyro: configured, else the usual one, else the one with most messages."""
        if topic:
            name = self.require(topic, "imu").topic
            if find_type(self.types[name]).imu is None:
                raise self._unusable(name, "imu", " or ".join(list_types("imu")))
            return TopicSource(name, CONFIGURED)
        rank, reason = RANKS["imu"]
        candidates = [(rank, TopicSource(name, reason)) for name in self.with_part("imu")]
        return self._best(candidates, self.vehicle.topics.imu, "imu")

    def choose_interval(self, configuration: Configuration) -> TopicSource | None:
        """The topic that shows when commands are live."""
        sections: list[IntervalSection] = configuration.interval
        configured = sorted({section.topic for section in sections if section.topic})
        if len(configured) > 1:
            what = f"the intervals name several topics: {', '.join(configured)}"
            hint = "Give one state topic; it may have several [[interval]] with different `equals`."
            raise self._bad(what, hint, "intervals_disagree")
        if configured:
            name = self.require(configured[0], "interval").topic
            if self.types[name] != STRING_TYPE:
                raise self._unusable(name, "interval", STRING_TYPE)
            return TopicSource(name, CONFIGURED)
        topic, value = DEFAULT_INTERVAL
        if sections or configuration.use_intervals == "all" or self.types.get(topic) != STRING_TYPE:
            return None
        return TopicSource(
            topic, f"commands are live only while its value is {value!r}; --interval all uses the whole log"
        )

    def _best(self, candidates: list[tuple[float, Source]], usual: list[str], role: str) -> Source | None:
        """The candidate of highest rank; usual names break ties, then the number of messages."""
        if not candidates:
            return None

        def order(candidate: tuple[float, Source]) -> tuple[float, int, int, str]:
            rank, source = candidate
            topic = source.signals[0].topic if isinstance(source, DriveSource) else source.topic
            index = usual.index(topic) if topic in usual else len(usual)
            return -rank, index, -self.counts[topic], topic

        ranked = sorted(candidates, key=order)
        self.others[role] = tuple(source for _, source in ranked[1:])
        if others := name_first([str(source) for source in self.others[role]]):
            self.notes.append(f"{role}: {ranked[0][1]} was preferred to {others}")
        return ranked[0][1]


_ALONG = re.compile(r"(?:p|pos|pose|position)?_?(x)(?:_m)?|(east)(?:ing)?")
_ACROSS = {"x": "y", "east": "north"}
_ANGLE = re.compile(r"(?:theta|yaw|heading|psi|phi|bearing)(?!.*(?:rate|vel|acc|cov)).*")
_NOT_A_POSITION = re.compile(r"vel|twist|linear|angular|accel|cov|gyro|mag|goal|target|cmd|error|std")
_TURN = re.compile(r"orient|quat|rotation")


def find_pose_fields(topic: str, fields: Collection[str]) -> tuple[str, str, str] | None:
    """Fields of a topic of any type that by their names are a position in the plane and a heading.

    Args:
        topic: name of the topic.
        fields: its leaf fields.

    Returns:
        x, y and the heading, which is empty if there is none; None without a position.
    """
    if _NOT_A_POSE.search(topic.lower()):
        return None
    usable = [path for path in fields if not _NOT_A_POSITION.search(path.lower()) and "[]" not in path]
    angles = [path for path in usable if _ANGLE.fullmatch(path.rpartition(".")[2].lower())]
    for path in usable:
        space, dot, name = path.rpartition(".")
        match = _ALONG.fullmatch(name.lower())
        if match is None or _TURN.search(space.lower()):
            continue
        start = match.start(match.lastindex or 0)
        along = match[match.lastindex or 0]
        other = f"{space}{dot}{name[:start]}{_ACROSS[along]}{name[start + len(along) :]}"
        if other in usable:
            beside = [angle for angle in angles if angle.rpartition(".")[0] == space]
            return path, other, next(iter((*beside, *angles)), "")
    return None


def list_named(configuration: Configuration) -> list[str]:
    """Topics that the configuration names, those of drives first."""
    pose = configuration.pose
    given = (pose.topic, pose.x, pose.y, pose.yaw, configuration.imu.topic)
    drives = (*list_topics(configuration.command), *list_topics(configuration.wheels))
    return [Signal.parse(text).topic for text in (*drives, *given) if text]


def list_topics(section: DriveSection) -> Iterable[str]:
    """Topics in the configuration of a drive."""
    pairs = (section.left_topic, section.right_topic, section.speed_topic, section.steering_topic)
    return filter(None, (section.topic, *pairs, section.yaw_rate_topic))
