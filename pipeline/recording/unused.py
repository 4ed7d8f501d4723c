"""Numbers that may be the wheels or the command of a log, of types that do not say so: how to use them."""

import json
import re
from collections.abc import Collection, Iterator, Mapping
from itertools import islice

import numpy as np

from pipeline.logs import LogIndex, Ragged, Wanted, list_fields, read_topics
from pipeline.recording.readings import SIDES
from pipeline.recording.units import JOYSTICK
from pipeline.sources import COMMANDED, MEASURED, MessageType, Sources, find_type, plain_type
from pipeline.stages import Finding, Severity

_RIGHT_OF: Mapping[str, str] = {
    "left": "right", "port": "starboard", "l": "r",
    "fl": "fr", "rl": "rr", "bl": "br", "lf": "rf", "lr": "rr",
}  # fmt: skip
"""The word of the right side for one of the left."""
_LEFT = re.compile(
    r"(?i:left)|(?<![A-Za-z])(?i:port|fl|rl|bl|lf|lr|l)(?![A-Za-z])|(?<![A-Za-z])[lL](?=(?i:wheel|motor|enc))"
    r"|(?<=[a-z])(?:FL|RL|BL|LF|LR|L)(?![A-Za-z])"
)
_OF_A_WHEEL = re.compile("wheel|motor|rpm|tick|enc|count|speed|vel|pwm|duty|throttle")
_NOT_OF_TURNING = re.compile("curr|volt|temp|torque|effort|error|fault|power|status|radius|diameter|pressure")
_COMMANDED = re.compile(COMMANDED.pattern + "|pwm|duty|throttle")
_SPEED = re.compile(r"^(speed|velocity|linear(_velocity|_speed|_x)?|forward(_speed)?|v|vx|v_x|throttle)$")
_TURN = re.compile(r"^(yaw_?rate|turn_?rate|omega|angular(_velocity|_speed|_z)?|turn|w|wz|w_z)$")
_STEER = re.compile(r"^(steering(_angle)?|steer|delta)$")
_UNITS: Mapping[str, str] = {
    "tick|count|enc": '; unit = "ticks"; per_turn = 1000 (ticks of a whole turn)',
    "rpm": '; unit = "rpm"',
}
_ANY_UNIT = ' (the motion shows their unit; unit = "rad/s", "m/s", "rpm" or "rad" gives it)'
_WHEELS = {2: "two", 4: "four", 6: "six"}
"""Numbers of wheels of a vehicle that turns by the speeds of its sides."""
_SEVERAL = (
    "wheels of both sides (put the number of a left one for 0 and that of a right one for 1, counted from 0)"
)
_MOST = 3
"""Maximum number of lines that are offered for a role."""


def list_unused(index: LogIndex, sources: Sources) -> list[Finding]:
    """Findings on numbers that may be wheels or a command where the log has none, or on pairs of numbers."""
    drives = [drive for drive in (sources.command, sources.wheels) if drive is not None]
    used = {signal.topic for drive in drives for signal in drive.signals}
    findings = _list_pairs(index, sources, used)
    if sources.wheels is not None and sources.command is not None:
        return findings
    unknown = {
        topic: paths
        for topic, paths in list_fields(index).items()
        if topic not in used and find_type(index.types.get(topic, "")) == MessageType()
    }
    missing = {role for role in ("command", "wheels") if getattr(sources, role) is None}
    sides = list(_list_sides(unknown))
    for role in sorted(missing):
        findings += islice((finding for of, finding in sides if of == role), _MOST)
    if "command" in missing:
        findings += islice(_list_commands(unknown, index), _MOST)
    return findings


def _list_pairs(index: LogIndex, sources: Sources, used: Collection[str]) -> list[Finding]:
    """Messages of a number a wheel, as two of a left and a right one."""
    fields = {
        topic: numbers.field
        for topic, kind in index.types.items()
        if topic not in used and (numbers := find_type(kind).numbers) is not None
    }
    wanted = [Wanted(topic, (field,)) for topic, field in fields.items()]
    findings = []
    for columns in read_topics(index, wanted, sha256="unused", skip_unfit=True).topics if wanted else ():
        topic, field = columns.topic, fields[columns.topic]
        column = columns.fields.get(field)
        values = column.fixed() if isinstance(column, Ragged) else None
        count = 0 if values is None else values.shape[1]
        is_side = count == len(SIDES) or (count in _WHEELS and _OF_A_WHEEL.search(topic.lower()))
        if values is None or not is_side or not np.ptp(values, axis=0).all():
            continue
        role = "command" if COMMANDED.search(topic.lower()) else "wheels"
        left, right = (_quote(f"{topic}.{field}[{number}]") for number in range(len(SIDES)))
        text = (
            f"not used: {topic} ({_WHEELS[count]} numbers a message), whose meaning is not known; if they "
            f"are {'the left and right wheels' if count == len(SIDES) else _SEVERAL}, in run.toml: [{role}] "
            f"left_topic = {left}; right_topic = {right}{_ANY_UNIT}"
        )
        severity: Severity = "info" if getattr(sources, role) else "warning"
        findings.append(Finding("numbers_not_used", severity, text, where=topic))
    return findings


def _list_sides(unknown: Mapping[str, Collection[str]]) -> Iterator[tuple[str, Finding]]:
    """Pairs of numbers that are named as those of left and right wheels, of unknown types, by role."""
    numbers = {f"{topic}.{path}": topic for topic, paths in unknown.items() for path in paths}
    for left, topic in numbers.items():
        right, lower = _LEFT.sub(_name_right, left), left.lower()
        if right == left or right not in numbers or _NOT_OF_TURNING.search(lower):
            continue
        if not _OF_A_WHEEL.search(lower):
            continue
        role = "command" if _COMMANDED.search(lower) and not MEASURED.search(lower) else "wheels"
        unit = next((text for word, text in _UNITS.items() if re.search(word, lower)), _ANY_UNIT)
        text = (
            f"not used: {left} and {right}, whose meaning is not known; if they are the left and right "
            f"wheels, in run.toml: [{role}] left_topic = {_quote(left)}; right_topic = {_quote(right)}{unit}"
        )
        yield role, Finding("numbers_not_used", "warning", text, where=topic)


def _quote(name: str) -> str:
    """A string of TOML."""
    return json.dumps(name, ensure_ascii=False)


def _name_right(match: re.Match[str]) -> str:
    word = match[0]
    right = _RIGHT_OF[word.lower()]
    return right.upper() if word.isupper() else right.capitalize() if word[0].isupper() else right


def _list_commands(unknown: Mapping[str, Collection[str]], index: LogIndex) -> Iterator[Finding]:
    """Messages with a speed and a turn that may be a command, and joysticks."""
    for topic, paths in unknown.items():
        if MEASURED.search(topic.lower()):
            continue
        if plain_type(index.types[topic]) == JOYSTICK:
            text = (
                f"not used: {topic} (a joystick); if two of its axes are the command, in run.toml: "
                f"[command] speed_topic = {_quote(f'{topic}.axes[1]')}; "
                f"yaw_rate_topic = {_quote(f'{topic}.axes[0]')} (which axes, the set-up of its driver says)"
            )
            yield Finding("numbers_not_used", "warning", text, where=topic)
            continue
        ends = {path: path.rpartition(".")[2].lower() for path in paths}
        speeds = [path for path, end in ends.items() if _SPEED.search(end)]
        turns = [("yaw_rate_topic", path) for path, end in ends.items() if _TURN.search(end)]
        turns += [("steering_topic", path) for path, end in ends.items() if _STEER.search(end)]
        if speeds and turns:
            key, turn = turns[0]
            speed, turn = (_quote(f"{topic}.{path}") for path in (speeds[0], turn))
            text = (
                f"not used: {topic} (a speed and a turn), whose meaning is not known; if it is the command, "
                f"in run.toml: [command] speed_topic = {speed}; {key} = {turn}"
            )
            yield Finding("numbers_not_used", "warning", text, where=topic)
