"""Topics that may fill a role, ranked by type and name, and the fields of each role."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Literal

from pipeline.sources.message_types import NumberField, PoseFields, find_type, list_pairs

ELECTRIC = {
    "current": re.compile(r"current(_battery|_input|_motor)?$"),
    "voltage": re.compile(r"voltage(_battery|_input)?$"),
}
"""Ends of names of topics with one electric quantity; `current_position` has another meaning."""

_INNER_INDEX = re.compile(r"\[(\d+)\]\.([\w.]+)$")


CONFIGURED = "configured"
"""Reason of a choice by the user."""


class DriveForm(Enum):
    """Form of a drive source's signals."""

    JOINTS = "wheels by joint name"
    SIDES = "left and right wheels"
    BODY = "forward speed and yaw rate"
    STEERING = "speed and steering angle"


@dataclass(frozen=True)
class Signal:
    """A topic, or one field of it; an empty field means the default of the type.

    Attributes:
        topic: its name.
        field: path of the field; several joined by ``+`` are averaged.
        unit: of the field; the usual one of its form if empty.
        sign: -1 if the field counts in the opposite direction.
        per_turn: field with the units per turn of the wheel.
    """

    topic: str
    field: str = ""
    unit: str = ""
    sign: int = 1
    per_turn: str = ""

    @classmethod
    def parse(cls, text: str) -> Signal:
        """Split ``/topic/name.field.path[0]`` at the first dot (topic names contain none)."""
        topic, _, path = text.partition(".")
        return cls(topic, path)

    def fields(self) -> tuple[str, ...]:
        """Paths of the averaged fields, an index after the path: ``states[].rpm[1]``."""
        return tuple(_INNER_INDEX.sub(r"[].\2[\1]", path) for path in self.field.split("+"))

    def __str__(self) -> str:
        return f"{self.topic}.{self.field}" if self.field else self.topic


@dataclass(frozen=True)
class DriveSource:
    """Source of commands or of measured wheels.

    Attributes:
        form: form of the signals.
        signals: one for joints, else two.
        reason: why it was chosen.
        name: display name, if the signals are one message of a known type.
    """

    form: DriveForm
    signals: tuple[Signal, ...]
    reason: str
    name: str = ""

    def __str__(self) -> str:
        return self.name or ", ".join(dict.fromkeys(str(signal) for signal in self.signals))


class PoseContent(Enum):
    """Content of a pose topic."""

    POSE = "poses"
    FIX = "places on Earth, without a heading"
    VELOCITY = "velocities over ground, without a place or a heading"
    WHEELS = "measured wheels, whose motion stands in for a pose that is not recorded"


@dataclass(frozen=True)
class PoseSource:
    """Source of poses: a topic, or the transforms (``frames`` may then name parent and child).

    Attributes:
        topic: its name.
        reason: why it was chosen.
        from_transforms: whether the topic contains transforms.
        frames: parent and child among the transforms.
        content: content of the topic.
        velocity: topic with the velocities over ground that belong to a fix.
        headings: numbers that may be the heading of positions alone.
        name: of the body, if a message contains the poses of several.
        fields: the fields of the pose, if the configuration names them.
        wheels: the measured wheels whose motion stands in for a pose; None of a recorded pose.
        track: which of the two tracks between which its poses alternate, 1 or 2; zero takes all poses.
    """

    topic: str
    reason: str
    from_transforms: bool = False
    frames: tuple[str, str] | None = None
    content: PoseContent = PoseContent.POSE
    velocity: str = ""
    headings: tuple[Signal, ...] = ()
    name: str = ""
    fields: PoseFields | None = None
    wheels: DriveSource | None = None
    track: int = 0

    def __str__(self) -> str:
        if self.wheels is not None:
            return str(self.wheels)
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
    """The choice for one log; None if the log has nothing for a role.

    Attributes:
        command, wheels, pose, imu, interval: source of each role.
        notes: remarks on the choice.
        others: by role, the alternatives, the best first.
        other_robots: namespaces of the robots that are not analyzed.
    """

    command: DriveSource | None
    wheels: DriveSource | None
    pose: PoseSource | None
    imu: TopicSource | None
    interval: TopicSource | None
    notes: tuple[str, ...] = ()
    others: Mapping[str, tuple[DriveSource | PoseSource | TopicSource, ...]] = field(default_factory=dict)
    other_robots: tuple[str, ...] = ()

    @property
    def topics(self) -> set[str]:
        """Names of the topics that are used."""
        drives = [self.command, self.wheels, None if self.pose is None else self.pose.wheels]
        signals = [signal for one in drives if one is not None for signal in one.signals]
        named = [one.topic for one in (self.pose, self.imu, self.interval) if one is not None]
        velocity = (
            [] if self.pose is None else [self.pose.velocity, *(one.topic for one in self.pose.headings)]
        )
        return {*(signal.topic for signal in signals), *named, *velocity} - {""}

    def rank_drives(self, role: Literal["command", "wheels"]) -> list[DriveSource]:
        """The choice for a role and its alternatives, the best first."""
        chosen = self.command if role == "command" else self.wheels
        return [one for one in (chosen, *self.others.get(role, ())) if isinstance(one, DriveSource)]

    @property
    def body_beside(self) -> DriveSource | None:
        """The body command that is recorded beside commanded wheels; None where there is none."""
        if self.command is None or self.command.form not in {DriveForm.SIDES, DriveForm.JOINTS}:
            return None
        drives = (self.command, self.wheels, None if self.pose is None else self.pose.wheels)
        taken = {signal.topic for one in drives if one is not None for signal in one.signals}
        for one in self.rank_drives("command")[1:]:
            if one.form is DriveForm.BODY:
                topics = {signal.topic for signal in one.signals}
                if len(topics) == 1 and not topics & taken and not MEASURED.search(min(topics).lower()):
                    return one
        return None

    def separated(self, *copies: str) -> Sources:
        """The same, but with measured wheels from another topic than the pose, or than copies of it."""
        poses = {*copies, *(() if self.pose is None else (self.pose.topic,))}
        ranked = self.rank_drives("wheels")
        free = [one for one in ranked if not {signal.topic for signal in one.signals} <= poses]
        chosen = free[0] if free else None
        if chosen == self.wheels or (self.wheels is not None and self.wheels.reason == CONFIGURED):
            return self
        rest = tuple(one for one in ranked if one is not chosen)
        return replace(self, wheels=chosen, others={**self.others, "wheels": rest})


# Topics that may serve as command or as measured wheels, ranked by type and name.
#
# Wheel commands precede body commands, since the drive received them; measured wheels precede quantities that
# the publisher derived from them.

COMMANDED = re.compile(r"cmd|command|setpoint|target|desired|reference|control_input")
MEASURED = re.compile(r"status|state|feedback|measured|encoder|actual|report")
DEAD_RECKONED = re.compile(
    r"controller|wheel|encoder|diff_drive|drive_odom|platform/odom|dead|unfiltered|/odom$"
)
_LOCALIZED = re.compile(
    r"icp|slam|lidar|laser|map|locali|local_position|global_position|loam|gnss|gps|rtk|ground_truth|truth|mocap|vicon|optitrack|amcl|vio|lio"
    r"|kiss|/pf/|particle|qualisys"
)
_ODOMETRY_OF_WHEELS = re.compile(
    r"(?:controller|wheels?|encoders?|diff_drive)[/_]?odom|odom(?:etry)?[/_](?:wheel|encoder)"
)
FILTERED = re.compile(r"(?<!un)filter|ekf|ukf|fused|merged|combined")
_OF_WHEELS = re.compile(r"wheel|unfiltered|controller|raw")
_BY_WHEELS = re.compile(r"wheel|encoder")
_RECEIVED = re.compile(r"controller|mux/cmd|cmd_vel_out|platform/cmd|drive/cmd|base/cmd|vehicle/")
_UPSTREAM = re.compile(
    r"joy|teleop|nav|web|key|interactive|marker|plan|raw|key_vel|smoothed|manual|autonomous|safe|unsmoothed"
)
_EXECUTED = re.compile(r"executed|cmd_vel_out|limited")
_SATELLITES = re.compile(r"gps|gnss|navsat|nmea|rtk|ublox|septentrio|novatel|fix[_/]?vel")
_HEADING = re.compile(r"heading|hdg|yaw|compass|azimuth|bearing")
_NO_HEADING = re.compile(r"rate|err|vel|speed|offset|acc|cov|std|gyro|init")
_LEFT = re.compile(r"left|(?<![a-z])(?:l|fl|rl|bl|ml|lf|lr|lb|lm)(?![a-z])|(?<![a-z])l(?=wheel|motor)")
_FORMS = {"sides": DriveForm.SIDES, "body": DriveForm.BODY, "steering": DriveForm.STEERING}

RANKS: Mapping[str, tuple[float, str]] = {
    # Commands and measured wheels: what the drive received, or measured, before what was derived of it.
    "named_pair": (3.3, "a pair of topics by their names"),
    "sides": (3.2, "left and right wheels"),
    "steering": (3.2, "speed and steering angle"),
    "speed_and_steering": (3.0, "speed and steering by their types"),
    "speed_and_yaw_rate": (3.0, "speed and yaw rate by their types"),
    "joints": (3.0, ""),
    "fitting_pair": (3.0, "a pair of topics whose names fit the role"),
    "ticks": (2.9, "left and right wheels"),
    "neutral_pair": (2.5, "a pair of topics whose names do not say that they are measured"),
    "pair_beside_command": (2.5, "a pair of topics beside one named as the command"),
    "joints_of_a_car": (2.0, ""),
    "measured_by_base": (2.0, "the body motion that the base measured by its wheels"),
    "received": (2.0, "the body command that the controller received"),
    "body": (1.5, "a body command"),
    "upstream": (1.0, "a body command upstream of the controller"),
    "wheel_odometry": (1.0, "the body motion of an odometry of the wheels"),
    "measured_twist": (0.5, "a twist whose name says it is measured"),
    # Poses: a localization before what may be one, and places before velocities.
    "localization": (3.0, "a localization by its name"),
    "transforms": (2.5, "the chain of transforms"),
    "pose": (2.0, "a pose by its type"),
    "fix": (1.2, "fixes of satellites"),
    "ground_velocity": (1.1, "velocities over ground"),
    "positions": (1.0, "positions by its type and name"),
    "dead_reckoning": (0.5, "an odometry whose name says it comes from the wheels"),
    # The gyro: the one that is usual on the vehicle, or has most messages.
    "imu": (1.0, "an IMU by its type"),
}
"""Ranks of all that may fill a role by type and name, the higher the likelier, and the reason of each, empty
where it names the type. The content decides later: `recording.pose_choice` among poses,
`recording.roles` among commands."""
_NEARER = 0.1
"""Step of rank between topics that are alike but for their names."""

Ranked = tuple[float, DriveSource]


def is_localization(topic: str) -> bool:
    """Whether a topic's name says that it localizes, and no later part of it that it is wheel odometry."""
    name = topic.lower()
    if not (matches := list(_LOCALIZED.finditer(name))):
        return False
    later = name[matches[-1].end() :].partition("/")[2]
    return not _ODOMETRY_OF_WHEELS.search(later)


@dataclass(frozen=True)
class Topics:
    """Nonempty topics of one robot, with their types (``package/Name``)."""

    types: Mapping[str, str]

    def numbers(self) -> dict[str, NumberField]:
        """Topics of one number."""
        kinds = {topic: find_type(kind).number for topic, kind in self.types.items()}
        return {topic: number for topic, number in kinds.items() if number is not None}

    def headings(self) -> tuple[Signal, ...]:
        """Numbers that are headings by their names, of a compass or of two antennas."""
        return tuple(
            _signal(topic, number)
            for topic, number in self.numbers().items()
            if not number.quantity
            and _HEADING.search(topic.lower())
            and not _NO_HEADING.search(topic.lower())
            and not COMMANDED.search(topic.lower())
        )

    def ground_velocities(self) -> list[str]:
        """Topics of velocities east and north, by type and name: of a receiver, or beside its fixes."""
        spaces = {
            topic.rpartition("/")[0] for topic, kind in self.types.items() if find_type(kind).fix is not None
        }
        return [
            topic
            for topic, kind in self.types.items()
            if find_type(kind).ground_velocity is not None
            and not COMMANDED.search(topic.lower())
            and (
                _SATELLITES.search(topic.lower())
                or (topic.endswith(("/vel", "/velocity")) and topic.rpartition("/")[0] in spaces)
            )
        ]

    def list_drives(self, *, commanded: bool, steered: bool) -> list[Ranked]:
        """Candidates with their rank.

        Args:
            commanded: whether commands are wanted, or measured wheels.
            steered: whether the drive's inputs are speed and steering rather than a speed per side.
        """
        drives = [
            *self._single_topics(commanded=commanded, steered=steered),
            *self._pairs_by_type(commanded=commanded, steered=steered),
            *self._pairs_by_table(commanded=commanded, steered=steered),
        ]
        pairs = self.pairs_of_speed_and_steering() if steered else self.pairs_of_sides()
        form = DriveForm.STEERING if steered else DriveForm.SIDES
        numbers = self.numbers()
        for rank, pair, reason in _rank_pairs(pairs, commanded=commanded):
            drives.append(
                (rank, DriveSource(form, tuple(_signal(each, numbers[each]) for each in pair), reason))
            )
        return drives

    def is_measured(self, topic: str, *, steered: bool) -> bool:
        """Whether a drive is measured by its name, and no command by its type and name."""
        drives = self.list_drives(commanded=True, steered=steered)
        commands = {signal.topic for _, source in drives for signal in source.signals}
        return bool(MEASURED.search(topic.lower())) and topic not in commands

    def _single_topics(self, *, commanded: bool, steered: bool) -> Iterator[Ranked]:
        measured = self.ground_velocities()
        for topic, kind in self.types.items():
            known = find_type(kind)
            name = topic.lower()
            is_command = bool(COMMANDED.search(name))
            if known.joints is not None and is_command == commanded:
                word = "contains command" if is_command else "does not contain command"
                reason = f"{kind.rsplit('/', 1)[-1]} whose name {word}"
                rank = RANKS["joints_of_a_car" if steered else "joints"][0]
                rank -= _NEARER * bool(known.joints.interfaces)
                yield rank, DriveSource(DriveForm.JOINTS, (Signal(topic),), reason)
            drive = known.drive
            if (
                drive is None
                or topic in measured
                or (drive.form == "steering" and not steered)
                or (drive.form == "sides" and steered)
            ):
                continue
            role = drive.role
            if role == "either":
                role = "wheels" if MEASURED.search(name) else "command"
            if role == "command" and drive.form == "body" and not is_command and _BY_WHEELS.search(name):
                role = "wheels"
            if (role == "command") != commanded:
                continue
            is_derived = is_localization(name) or FILTERED.search(name)
            if role == "odometry" and (is_derived or not DEAD_RECKONED.search(name)):
                continue
            signals = (Signal(topic, drive.first, drive.unit), Signal(topic, drive.second, drive.unit))
            if drive.form == "steering" and drive.unit:
                signals = (signals[0], Signal(topic, drive.second))
            rank, reason = self._rank_single(name, drive.form, role, drive.unit)
            yield rank, DriveSource(_FORMS[drive.form], signals, reason, topic)

    def _rank_single(self, name: str, form: str, role: str, unit: str) -> tuple[float, str]:
        is_nearer = bool(_EXECUTED.search(name))
        if role == "odometry":
            key, is_nearer = "wheel_odometry", bool(_OF_WHEELS.search(name))
        elif form != "body":
            key = "ticks" if unit == "ticks" else form
            is_nearer = is_nearer and key != "ticks"
        elif role == "wheels":
            key, is_nearer = "measured_by_base", False
        elif MEASURED.search(name):
            key, is_nearer = "measured_twist", False
        elif _UPSTREAM.search(name):
            key, is_nearer = "upstream", False
        else:
            key = "received" if _RECEIVED.search(name) else "body"
            is_nearer = is_nearer and key == "received"
        rank, reason = RANKS[key]
        return rank + _NEARER * is_nearer, reason

    def _pairs_by_type(self, *, commanded: bool, steered: bool) -> Iterator[Ranked]:
        """Speed and yaw rate, or speed and steering, if the types distinguish them."""
        by_quantity: dict[str, list[Signal]] = {}
        for topic, number in self.numbers().items():
            if number.quantity and (number.role == "command") == commanded:
                by_quantity.setdefault(number.quantity, []).append(_signal(topic, number))
        for speed, (turn, form) in itertools.product(
            by_quantity.get("speed", []), (("steering", DriveForm.STEERING), ("yaw_rate", DriveForm.BODY))
        ):
            for other in by_quantity.get(turn, []) if steered or form is DriveForm.BODY else []:
                rank, reason = RANKS[f"speed_and_{turn}"]
                yield rank, DriveSource(form, (speed, other), reason)

    def _pairs_by_table(self, *, commanded: bool, steered: bool) -> Iterator[Ranked]:
        for pair in list_pairs():
            if (pair.role == "command") != commanded or (pair.form == "steering") != steered:
                continue
            for topic in self.types:
                other = topic.removesuffix(pair.first.topic) + pair.second.topic
                if topic.endswith(f"/{pair.first.topic}") and other in self.types:
                    signals = (
                        Signal(topic, pair.first.field, pair.first.unit),
                        Signal(other, pair.second.field, pair.second.unit),
                    )
                    rank, reason = RANKS["named_pair"]
                    yield rank, DriveSource(_FORMS[pair.form], signals, reason)

    def pairs_of_sides(self) -> list[tuple[str, str]]:
        """Topics of one number whose names differ in left and right, or in fl and fr, rl and rr."""
        free = {
            topic
            for topic, number in self.numbers().items()
            if not number.quantity and not any(end.search(topic.lower()) for end in ELECTRIC.values())
        }
        pairs = [(topic, _LEFT.sub(_name_right, topic)) for topic in sorted(free)]
        return [pair for pair in pairs if pair[0] != pair[1] and pair[1] in free]

    def pairs_of_speed_and_steering(self) -> list[tuple[str, str]]:
        """Topics of one number whose names differ in speed (or velocity) and steering."""
        free = {topic for topic, number in self.numbers().items() if not number.quantity}
        return [
            (speed, topic)
            for topic in sorted(free)
            for word in ("speed", "velocity")
            for turn in ("steering_angle", "steering", "steer")
            if turn in topic and (speed := topic.replace(turn, word)) in free
        ]


def _name_right(left: re.Match[str]) -> str:
    """The word for the right side in place of one for the left."""
    return "right" if left[0] == "left" else left[0].replace("l", "r")


def _signal(topic: str, number: NumberField) -> Signal:
    return Signal(topic, number.field, number.unit, number.sign, number.per_turn)


def _rank_pairs(
    pairs: Sequence[tuple[str, str]], *, commanded: bool
) -> Iterator[tuple[float, tuple[str, str], str]]:
    """Pairs of topics that may fill a role, ranked by their names.

    A pair with a neutral name is a command, unless another pair is named as the command.
    """
    wanted, unwanted = (COMMANDED, MEASURED) if commanded else (MEASURED, COMMANDED)
    command_is_named = any(
        COMMANDED.search(pair[0].lower()) and not MEASURED.search(pair[0].lower()) for pair in pairs
    )
    for pair in pairs:
        name = pair[0].lower()
        if unwanted.search(name):
            continue
        is_fitting = wanted.search(name) is not None
        if is_fitting or commanded != command_is_named:
            neutral = "neutral_pair" if commanded else "pair_beside_command"
            rank, reason = RANKS["fitting_pair" if is_fitting else neutral]
            yield rank, pair, reason
