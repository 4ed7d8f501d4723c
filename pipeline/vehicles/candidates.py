"""Topics that may serve as command or as measured wheels, ranked by type and name.

Wheel commands come before body commands, since the drive received them; measured wheels come before what the
publisher made of them.
"""

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from pipeline.vehicles.message_types import NumberField, find_type, list_pairs
from pipeline.vehicles.sources import DriveForm, DriveSource, Signal

COMMANDED = re.compile(r"cmd|command|setpoint|target|desired|reference|control_input")
MEASURED = re.compile(r"status|state|feedback|measured|encoder|actual|report")
DEAD_RECKONED = re.compile(
    r"controller|wheel|encoder|diff_drive|drive_odom|platform/odom|dead|unfiltered|/odom$"
)
LOCALIZED = re.compile(
    r"icp|slam|lidar|laser|map|locali|loam|gnss|gps|rtk|ground_truth|truth|mocap|vicon|optitrack|amcl|vio|lio"
    r"|kiss|/pf/|particle|qualisys"
)
FILTERED = re.compile(r"(?<!un)filter|ekf|ukf|fused|merged|combined")
_OF_WHEELS = re.compile(r"wheel|unfiltered|controller|raw")
_RECEIVED = re.compile(r"controller|mux/cmd|cmd_vel_out|platform/cmd|drive/cmd|base/cmd|vehicle/")
_UPSTREAM = re.compile(
    r"joy|teleop|nav|web|key|interactive|marker|plan|raw|key_vel|smoothed|manual|autonomous|safe|unsmoothed"
)
_EXECUTED = re.compile(r"executed|cmd_vel_out|limited")
_SATELLITES = re.compile(r"gps|gnss|navsat|nmea|rtk|ublox|septentrio|novatel|fix[_/]?vel")
_FORMS = {"sides": DriveForm.SIDES, "body": DriveForm.BODY, "steering": DriveForm.STEERING}

Ranked = tuple[float, DriveSource]


@dataclass(frozen=True)
class Topics:
    """Topics of one robot that are not empty, with their types (``package/Name``)."""

    types: Mapping[str, str]

    def numbers(self) -> dict[str, NumberField]:
        """Topics of one number."""
        found = {topic: find_type(kind).number for topic, kind in self.types.items()}
        return {topic: number for topic, number in found.items() if number is not None}

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
            commanded: whether commands are looked for, or measured wheels.
            steered: whether the vehicle is told speed and steering rather than a speed a side.
        """
        found = [
            *self._single_topics(commanded=commanded, steered=steered),
            *self._pairs_by_type(commanded=commanded, steered=steered),
            *self._pairs_by_table(commanded=commanded, steered=steered),
        ]
        pairs = self.pairs_of_speed_and_steering() if steered else self.pairs_of_sides()
        form = DriveForm.STEERING if steered else DriveForm.SIDES
        numbers = self.numbers()
        for rank, pair, reason in _rank_pairs(pairs, commanded=commanded):
            found.append(
                (rank, DriveSource(form, tuple(_signal(each, numbers[each]) for each in pair), reason))
            )
        return found

    def _single_topics(self, *, commanded: bool, steered: bool) -> Iterator[Ranked]:
        measured = self.ground_velocities()
        for topic, kind in self.types.items():
            known = find_type(kind)
            name = topic.lower()
            says_command = bool(COMMANDED.search(name))
            if known.joints is not None and says_command == commanded:
                word = "says command" if says_command else "does not say command"
                reason = f"{kind.rsplit('/', 1)[-1]} whose name {word}"
                rank = (2.0 if steered else 3.0) - 0.1 * bool(known.joints.interfaces)
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
            if (role == "command") != commanded:
                continue
            made_of_more = LOCALIZED.search(name) or FILTERED.search(name)
            if role == "odometry" and (made_of_more or not DEAD_RECKONED.search(name)):
                continue
            signals = (Signal(topic, drive.first, drive.unit), Signal(topic, drive.second, drive.unit))
            if drive.form == "steering" and drive.unit:
                signals = (signals[0], Signal(topic, drive.second))
            rank, reason = self._rank_single(name, drive.form, role, drive.unit)
            yield rank, DriveSource(_FORMS[drive.form], signals, reason, topic)

    def _rank_single(self, name: str, form: str, role: str, unit: str) -> tuple[float, str]:
        if role == "odometry":
            return 1.0 + 0.1 * bool(_OF_WHEELS.search(name)), "the body motion of an odometry of the wheels"
        if form != "body":
            what = "speed and steering angle" if form == "steering" else "left and right wheels"
            return 2.9 if unit == "ticks" else 3.2 + 0.1 * bool(_EXECUTED.search(name)), what
        if role == "wheels":
            return 2.0, "the body motion that the base measured by its wheels"
        return self._rank_body(name)

    def _rank_body(self, name: str) -> tuple[float, str]:
        if MEASURED.search(name):
            return 0.5, "a twist whose name says it is measured"
        if _RECEIVED.search(name) and not _UPSTREAM.search(name):
            return 2.0 + 0.1 * bool(_EXECUTED.search(name)), "the body command that the controller received"
        if _UPSTREAM.search(name):
            return 1.0, "a body command upstream of the controller"
        return 1.5, "a body command"

    def _pairs_by_type(self, *, commanded: bool, steered: bool) -> Iterator[Ranked]:
        """Speed and yaw rate, or speed and steering, where the types say which is which."""
        by_quantity: dict[str, list[Signal]] = {}
        for topic, number in self.numbers().items():
            if number.quantity and (number.role == "command") == commanded:
                by_quantity.setdefault(number.quantity, []).append(_signal(topic, number))
        for speed, (turn, form) in itertools.product(
            by_quantity.get("speed", []), (("steering", DriveForm.STEERING), ("yaw_rate", DriveForm.BODY))
        ):
            for other in by_quantity.get(turn, []) if steered or form is DriveForm.BODY else []:
                yield (
                    3.0,
                    DriveSource(form, (speed, other), f"speed and {turn.replace('_', ' ')} by their types"),
                )

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
                    yield 3.3, DriveSource(_FORMS[pair.form], signals, "a pair of topics by their names")

    def pairs_of_sides(self) -> list[tuple[str, str]]:
        """Topics of one number whose names differ in left and right."""
        free = {topic for topic, number in self.numbers().items() if not number.quantity}
        return [
            (topic, topic.replace("left", "right"))
            for topic in sorted(free)
            if "left" in topic and topic.replace("left", "right") in free
        ]

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


def _signal(topic: str, number: NumberField) -> Signal:
    return Signal(topic, number.field, number.unit, number.sign, number.per_turn)


def _rank_pairs(
    pairs: Sequence[tuple[str, str]], *, commanded: bool
) -> Iterable[tuple[float, tuple[str, str], str]]:
    """Pairs of topics that may serve in a role, ranked by what their names say.

    A pair that says nothing is a command, unless another pair says that it is the command.
    """
    wanted, unwanted = (COMMANDED, MEASURED) if commanded else (MEASURED, COMMANDED)
    command_is_named = any(
        COMMANDED.search(pair[0].lower()) and not MEASURED.search(pair[0].lower()) for pair in pairs
    )
    for pair in pairs:
        name = pair[0].lower()
        if unwanted.search(name):
            continue
        if wanted.search(name):
            yield 3.0, pair, "a pair of topics whose names fit the role"
        elif commanded and not command_is_named:
            yield 2.5, pair, "a pair of topics that do not say they are measured"
        elif not commanded and command_is_named:
            yield 2.5, pair, "a pair of topics beside one that says command"
