"""Fields that a run needs from its topics, their arrays, and spans of live commands."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.core import LONGEST_NAME, Flags, Floats, Ints, rigid, shorten
from pipeline.logs import Loss, Ragged, Strings, TopicColumns, Wanted, wanted_transforms
from pipeline.logs.columns import complete_stamps, join_times
from pipeline.recording.findings import Finding, StageError
from pipeline.run import STILL_MPS
from pipeline.sources import (
    DEFAULT_INTERVAL,
    LENGTH_UNITS,
    DriveForm,
    DriveSource,
    IntervalSection,
    PoseContent,
    PoseFields,
    PoseSection,
    PoseSource,
    Signal,
    Sources,
    find_type,
)
from pipeline.sources.message_types import find_alike, list_layouts

_LARGEST = 1e12
"""Largest number in SI units, above any position, angle, speed and acceleration; its powers stay finite."""


def remove_absurd(topics: Sequence[TopicColumns]) -> tuple[tuple[TopicColumns, ...], list[Finding]]:
    """Replace numbers that are infinite or larger than 1e12 by NaN.

    Args:
        topics: columns as they were read.

    Returns:
        The columns, and a finding for each topic that had such numbers.
    """
    cleaned, findings = [], []
    for columns in topics:
        fields, count = dict(columns.fields), 0
        for name, column in columns.fields.items():
            values = column.values if isinstance(column, Ragged) else column
            if not isinstance(values, np.ndarray) or values.dtype.kind != "f":
                continue
            wrong = np.abs(values) > _LARGEST
            if wrong.any():
                count += int(wrong.sum())
                good = _without(values, wrong)
                fields[name] = replace(column, values=good) if isinstance(column, Ragged) else good
        cleaned.append(replace(columns, fields=fields) if count else columns)
        if count:
            findings.append(Finding("absurd_values", "warning", columns.topic, {"count": count}))
    return tuple(cleaned), findings


def _without(values: NDArray[np.generic], wrong: Flags) -> NDArray[np.generic]:
    good = values.copy()
    good[wrong] = np.nan
    return good


Span = tuple[float, float]


def forget_states(
    times: Floats, states: Sequence[str], log_time: Ints, losses: Iterable[Loss]
) -> tuple[Floats, list[str | None]]:
    """The messages of a state topic, and None from each loss of the log until the next of them.

    What was lost may have been another state.

    Args:
        times: of the messages [s], increasing, shape (n,).
        states: their texts.
        log_time: when they were recorded [ns], shape (n,).
        losses: of the log.
    """
    edges = {edge for loss in losses for edge in (loss.start_ns, loss.end_ns) if edge is not None}
    lost = np.array(sorted(edges), dtype=np.int64)
    recorded = np.maximum.accumulate(log_time)
    after = np.searchsorted(recorded, lost, side="right")
    lost, after = lost[after > 0], after[after > 0]
    since = times[after - 1] + (lost - recorded[after - 1]) / 1e9
    begins = np.minimum(since, np.append(times, np.inf)[after])
    known = np.insert(np.arange(times.size), after, -1).tolist()
    return np.insert(times, after, begins), [None if one < 0 else states[one] for one in known]


def find_spans_of_state(times: Floats, states: Sequence[str | None], section: IntervalSection) -> list[Span]:
    """Spans [s] in which a state topic has the section's text, within the section's own times.

    The last span is open: the topic need not repeat a state that persists.

    Args:
        times: from which on each state holds [s], shape (n,).
        states: None where it is unknown.
        section: what is asked for.
    """
    value = section.equals or DEFAULT_INTERVAL[1]
    spans: list[Span] = []
    begin: float | None = None
    for time, state in zip(times.tolist(), states, strict=True):
        if state == value and begin is None:
            begin = time
        elif state != value and begin is not None:
            spans.append((begin, time))
            begin = None
    if begin is not None:
        spans.append((begin, np.inf))
    earliest, latest = _limits_of(section)
    cut = [(max(start, earliest), min(end, latest)) for start, end in spans]
    return [(start, end) for start, end in cut if start < end]


def _limits_of(section: IntervalSection) -> Span:
    start = -np.inf if section.start_s is None else section.start_s
    end = np.inf if section.end_s is None else section.end_s
    return start, end


def find_spans_given(sections: Sequence[IntervalSection], where: str) -> list[Span]:
    """Spans [s] that the configuration gives by time.

    Raises:
        StageError: a span ends before it starts.
    """
    spans = []
    for section in sections:
        start, end = _limits_of(section)
        if end <= start:
            what = f"an interval ends at {end} s, before it starts at {start} s"
            hint = "Give [[interval]] a start_s below its end_s, in seconds from the run's start."
            raise StageError("bad_interval", what, where=where, hint=hint)
        if section.topic is None:
            spans.append((start, end))
    return spans


def is_inside(times: Floats, spans: Sequence[Span] | None) -> Flags:
    """Whether each time lies in any of the spans; True everywhere without spans (None)."""
    if spans is None:
        return np.ones(times.size, dtype=bool)
    inside = np.zeros(times.size, dtype=bool)
    for start, end in spans:
        inside |= (times >= start) & (times < end)
    return inside


FEWEST_MESSAGES = 20
"""Least number of messages, poses or fixes for a conclusion: two seconds of a localization at 10 Hz."""
_SIDEWAYS_SHARE = 0.01
"""Fraction of sideways commands above which they are not accidental joystick motion."""
_NED_IN_ENU = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
_FRAME = "header.frame_id"
_POLE_DEG = 90.0  # latitude of a pole
_COUNTED = (1e-7, 1e-3)
"""What integers of receivers count: degrees and metres."""
_FLU_IN_FRD = np.array([1.0, 0.0, 0.0, 0.0])


def axis_fields(fields: str | list[str], axes: str) -> list[str]:
    """Fields of a vector: those listed, or the axes of a structure."""
    return fields if isinstance(fields, list) else [f"{fields}.{axis}" for axis in axes]


def _turn_fields(pose: PoseFields) -> list[str]:
    """Fields of the orientation: the heading, or the four of the quaternion; none of positions alone."""
    if not pose.angle and not pose.orientation:
        return []
    return [pose.angle] if pose.angle else axis_fields(pose.orientation, "xyzw")


def drive_fields(source: DriveSource, types: dict[str, str]) -> list[Signal]:
    """All fields of a drive source."""
    if source.form is DriveForm.JOINTS:
        topic = source.signals[0].topic
        joints = find_type(types[topic]).joints
        if joints is None:
            return []
        values = (
            (joints.interfaces, joints.values) if joints.interfaces else (joints.velocity, joints.position)
        )
        names = (joints.names, *values)
        return [Signal(topic, name) for name in names]
    fields = [Signal(signal.topic, path) for signal in source.signals for path in signal.fields()]
    fields += [Signal(signal.topic, signal.per_turn) for signal in source.signals if signal.per_turn]
    sideways = sideways_field(source, types)
    return fields if sideways is None else [*fields, sideways]


def is_of_base(source: DriveSource, types: Mapping[str, str]) -> bool:
    """Whether the base measured a body motion; odometry comes from the controller, with its own track."""
    drive = find_type(types[source.signals[0].topic]).drive
    return drive is None or drive.role != "odometry"


def sideways_field(source: DriveSource, types: Mapping[str, str]) -> Signal | None:
    """Field with the sideways speed of a body motion of a known type."""
    topic = source.signals[0].topic
    drive = find_type(types[topic]).drive
    if source.form is not DriveForm.BODY or not source.name or drive is None or not drive.sideways:
        return None
    return Signal(topic, drive.sideways)


def asks_sideways(speeds: Floats) -> float:
    """Fraction of body commands with sideways motion [m/s]; zero if it is accidental joystick motion."""
    share = float(np.mean(np.abs(speeds) > STILL_MPS)) if speeds.size else 0.0
    return share if share >= _SIDEWAYS_SHARE else 0.0


def find_sideways_share(topics: Iterable[TopicColumns], source: DriveSource | None) -> float:
    """As `asks_sideways`, for a source among topics that were read; zero if it is not a body command."""
    for columns in topics:
        if source is not None and columns.topic == source.signals[0].topic:
            signal = sideways_field(source, {columns.topic: columns.type_name})
            return asks_sideways(numbers(with_texts(columns), signal.field)) if signal is not None else 0.0
    return 0.0


def pose_fields(source: PoseSource, types: dict[str, str]) -> list[Signal]:
    """All fields of a pose topic; empty if poses come from transforms."""
    if source.from_transforms:
        return []
    if source.wheels is not None:
        return drive_fields(source.wheels, types)
    kind = find_type(types[source.topic])
    pose = source.fields or kind.pose
    if source.content is PoseContent.POSE and pose is not None:
        axes = (*axis_fields(pose.position, "xyz"), *_turn_fields(pose))
        named = (*axes, *pose.velocity, pose.parent, pose.child, pose.names)
        return [*(Signal(source.topic, name) for name in named if name), *source.headings]
    frame = _frame_field(types[source.topic])
    fields = [*([Signal(source.topic, frame)] if frame else []), *source.headings]
    if kind.fix is not None:
        names = (kind.fix.latitude, kind.fix.longitude, kind.fix.altitude, kind.fix.status)
        fields += [Signal(source.topic, name) for name in names if name]
    for topic in (source.topic, source.velocity):
        velocity = find_type(types.get(topic, "")).ground_velocity
        if velocity is not None:
            fields += [Signal(topic, velocity.east), Signal(topic, velocity.north)]
    return fields


def _fields_of(source: DriveSource | PoseSource, types: dict[str, str]) -> list[Signal]:
    return drive_fields(source, types) if isinstance(source, DriveSource) else pose_fields(source, types)


def _list_optional(source: DriveSource | PoseSource, types: dict[str, str]) -> list[Signal]:
    """Fields that a topic in this role may lack, as JSON messages do: height, sideways speed, frames."""
    if isinstance(source, DriveSource) and source.form is DriveForm.JOINTS:
        # Of joints, velocities or positions are enough.
        return drive_fields(source, types)[1:]
    if isinstance(source, DriveSource):
        sideways = sideways_field(source, types)
        return [] if sideways is None else [sideways]
    if source.from_transforms or source.wheels is not None:
        return []
    kind = find_type(types[source.topic])
    pose = source.fields or kind.pose
    if source.content is PoseContent.POSE and pose is not None:
        names = (*axis_fields(pose.position, "xyz")[2:], *pose.velocity, pose.parent, pose.child)
        return [Signal(source.topic, name) for name in names if name]
    fixed = () if kind.fix is None else (kind.fix.latitude, kind.fix.longitude)
    return [one for one in pose_fields(source, types) if one.field not in fixed]


def list_wanted(
    sources: Sources, types: dict[str, str], rivals: Iterable[DriveSource | PoseSource] = ()
) -> list[Wanted]:
    """Fields to read for the chosen sources.

    Args:
        sources: the choice.
        types: type name by topic.
        rivals: other sources to read for comparison.
    """
    roles = (sources.command, sources.wheels, sources.pose, sources.body_beside, *rivals)
    every = [source for source in roles if source is not None]
    signals: list[Signal] = []
    for source in every:
        signals += _fields_of(source, types)
    if sources.imu is not None:
        imu = find_type(types[sources.imu.topic]).imu
        if imu is not None:
            names = [*axis_fields(imu.rate, "xyz"), *axis_fields(imu.force, "xyz")]
            if imu.orientation:
                names += [*axis_fields(imu.orientation, "xyzw"), *filter(None, [imu.frame])]
            signals += [Signal(sources.imu.topic, name) for name in names]
    if sources.interval is not None:
        signals.append(Signal(sources.interval.topic, "data"))
    used = [source for source in every if source in (sources.command, sources.wheels, sources.pose)]
    spared = {signal for source in used for signal in _list_optional(source, types)}
    needed = {signal for source in used for signal in _fields_of(source, types)} - spared
    beside = {signal for source in every for signal in _fields_of(source, types)} - needed
    by_topic: dict[str, list[str]] = {}
    for signal in signals:
        fields = by_topic.setdefault(signal.topic, [])
        if signal.field not in fields:
            fields.append(signal.field)
    wanted = [
        Wanted(
            topic,
            _recorded_fields(types[topic], fields),
            find_alike(types[topic], fields),
            frozenset((*_stamp_fields(types[topic]), *(one.field for one in beside if one.topic == topic))),
            list_layouts(types[topic], _recorded_fields(types[topic], fields)),
        )
        for topic, fields in by_topic.items()
    ]
    return wanted + [
        one for one in _list_wanted_transforms(every, types) if not one.topic.startswith(sources.other_robots)
    ]


def _recorded_fields(kind: str, fields: Iterable[str]) -> tuple[str, ...]:
    """Recorded fields, including stamps, from which the given fields are derived."""
    text = find_type(kind).text
    names = (*fields, *_stamp_fields(kind))
    if text is None:
        return names
    others = [name for name in names if not name.startswith(f"{text.field}.")]
    return (*others, text.field, text.tag)


def with_texts(columns: TopicColumns) -> TopicColumns:
    """A topic with the numbers of its JSON texts as columns; messages without them are left out.

    Raises:
        StageError: ``field_not_a_text``.
    """
    text = find_type(columns.type_name).text
    column = None if text is None else columns.fields.get(text.field)
    if text is None or column is None:
        return columns
    if not isinstance(column, Strings):
        what = f"the field {text.field!r} is not text"
        raise StageError("field_not_a_text", what, where=columns.topic, hint="Name another topic.")
    # The last row belongs to messages without a text, whose code is -1.
    table = np.array([_read_numbers(value, text.keys) for value in (*column.values, "")])[column.codes]
    here = (numbers(columns, text.tag) == text.value) & np.isfinite(table).all(axis=1)
    return replace(
        columns,
        log_time=columns.log_time[here],
        publish_time=columns.publish_time[here],
        header_time=None if columns.header_time is None else columns.header_time[here],
        fields={f"{text.field}.{key}": table[here, index] for index, key in enumerate(text.keys)},
    )


def _read_numbers(text: str, keys: Iterable[str]) -> list[float]:
    """Numbers of a JSON object by key; NaN for other values."""
    try:
        numbers = json.loads(text)
        return [float(numbers[key]) for key in keys]
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return [np.nan for _ in keys]


def _stamp_fields(kind: str) -> tuple[str, ...]:
    stamp = find_type(kind).stamp
    if stamp is None:
        return ()
    return (stamp.field,) if stamp.tick_ns else (f"{stamp.field}.sec", f"{stamp.field}.nanosec")


def _list_wanted_transforms(
    sources: Iterable[DriveSource | PoseSource], types: dict[str, str]
) -> list[Wanted]:
    """All transforms if poses come from them; else the static ones, which may locate the pose's frame."""
    poses = [source for source in sources if isinstance(source, PoseSource)]
    if not poses:
        return []
    wanted = wanted_transforms(types)
    if any(source.from_transforms for source in poses):
        return wanted
    return [one for one in wanted if "static" in one.topic]


def with_stamps(columns: TopicColumns) -> TopicColumns:
    """A topic with the stamps of its type in place of a missing header.

    Numbers in texts become columns.
    """
    columns = with_texts(columns)
    stamp = find_type(columns.type_name).stamp
    if columns.header_time is not None or stamp is None:
        return columns
    if stamp.tick_ns:
        ticks = numbers(columns, stamp.field)
        known = np.isfinite(ticks)
        times = np.asarray(np.where(known, ticks, 0.0) * stamp.tick_ns, dtype=np.int64)
    else:
        times, known = join_times(*(numbers(columns, f"{stamp.field}.{part}") for part in ("sec", "nanosec")))
    return replace(columns, header_time=complete_stamps(times, known, columns.log_time))


@dataclass(frozen=True)
class PoseArrays:
    """Poses as recorded: position (n, 3) [m], quaternion (n, 4), and their frames.

    Those of a chain of transforms know where a localization corrected the odometry, shape (n,).
    """

    position: Floats
    quaternion: Floats
    parent: str
    child: str
    corrected: Flags | None = None

    def take(self, rows: Ints) -> PoseArrays:
        """Some of the poses, in the given order."""
        corrected = None if self.corrected is None else self.corrected[rows]
        return replace(
            self, position=self.position[rows], quaternion=self.quaternion[rows], corrected=corrected
        )


_UPRIGHT: Mapping[str, NDArray[np.float64]] = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
}
"""Rotation that takes each axis to z."""
_HALF_TURN = np.array([1.0, -1.0, -1.0])


def put_upright(arrays: PoseArrays, section: PoseSection) -> tuple[Floats, Floats, float]:
    """Positions and quaternions with z up and the vehicle's x axis ahead, as a configuration says.

    Args:
        arrays: poses as recorded.
        section: its ``axes``, ``up``, ``heading_deg`` and ``unit``.

    Returns:
        These, and the angle [rad] by which a frame leant that was turned upright, else zero.
    """
    up = section.up or ("-z" if section.axes == "ned" else "z")
    position, quaternion = LENGTH_UNITS[section.unit or "m"] * arrays.position, arrays.quaternion
    if up != "z":
        turn = _UPRIGHT[up.removeprefix("-")] * (_HALF_TURN[:, None] if up.startswith("-") else 1.0)
        position = position @ turn.T
        quaternion = np.column_stack([quaternion[:, :3] @ turn.T, quaternion[:, 3]])
    leant, lean = 0.0, find_lean(quaternion)
    if lean is not None:
        leant = float(np.arccos(np.clip(rigid.find_heights(lean), -1.0, 1.0)))
        quaternion = rigid.multiply_quaternions(quaternion, rigid.invert_quaternions(lean)[None])
    if section.heading_deg:
        half = 0.5 * np.radians(section.heading_deg)
        ahead = np.tile([0.0, 0.0, np.sin(half), np.cos(half)], (quaternion.shape[0], 1))
        quaternion = rigid.multiply_quaternions(quaternion, ahead)
    return position, quaternion, leant


_LEANS = 0.7
"""Height of a body's z axis below which its frame leans: no vehicle leans by 45 degrees most of the time."""
_CONSTANT = 0.9
"""Share of a mean orientation above which it is that of a mounting: turns about another axis have none."""


def find_lean(quaternion: Floats) -> Floats | None:
    """Orientation of a leaning frame on its vehicle, but for a heading, shape (4,); None where it is upright.

    A camera looks ahead along its z axis; a sensor may be mounted upside down.
    """
    size = np.linalg.norm(quaternion, axis=1)
    known = np.isfinite(size) & (size > 0.0)
    unit = quaternion[known] / size[known, None]
    if not unit.size or float(np.median(rigid.find_heights(unit))) > _LEANS:
        return None
    headings = rigid.quaternions_from_yaw(rigid.euler_from_quaternions(unit)[2])
    mounted = rigid.multiply_quaternions(rigid.invert_quaternions(headings), unit)
    shares, means = np.linalg.eigh(mounted.T @ mounted / len(mounted))
    return np.asarray(means[:, -1]) if shares[-1] > _CONSTANT else None


def turn_over(quaternion: Floats) -> Floats:
    """Poses (n, 4) of the body turned by half a turn about its x axis."""
    return rigid.multiply_quaternions(quaternion, np.broadcast_to(_FLU_IN_FRD, quaternion.shape))


@dataclass(frozen=True)
class Receiver:
    """A topic with its clock.

    Attributes:
        columns: as recorded.
        times: of all its messages [s], shape (n,).
        order: indices of the valid messages, in time order.
    """

    columns: TopicColumns
    times: Floats
    order: Ints


@dataclass(frozen=True)
class Located:
    """Poses of the vehicle.

    Attributes:
        rows: messages that give a pose, in time order, shape (m,).
        arrays: poses of base_link, shape (m,).
        findings: findings on the poses.
    """

    rows: Ints
    arrays: PoseArrays
    findings: tuple[Finding, ...]


_APART = 5
"""Poses between two positions of a displacement: half a second at 10 Hz."""
_ALONG = 0.5
"""Concentration of a body's course about its heading from which on it drives along it."""


def find_angle_unit(columns: TopicColumns, pose: PoseFields) -> Literal["rad", "deg"]:
    """Unit of headings that are one number: that of their type, unless the body drives along the others.

    Args:
        columns: the topic.
        pose: its fields, with an angle.
    """
    x, y = (numbers(columns, name) for name in axis_fields(pose.position, "xy")[:2])
    angle, position = numbers(columns, pose.angle), x + 1j * y
    moved, heading = position[2 * _APART :] - position[: -2 * _APART], angle[_APART:-_APART]
    known = np.isfinite(moved) & np.isfinite(heading)
    moved, heading = moved[known], heading[known]
    if pose.angle_unit == "deg" or moved.size < FEWEST_MESSAGES:
        return pose.angle_unit
    # Modulo half a turn, since it also drives backward; a jump of the pose counts as any other displacement.
    size = np.minimum(np.abs(moved), float(np.quantile(np.abs(moved), 0.9)))
    course = size * np.exp(2j * np.angle(moved))
    along = {
        unit: abs(np.sum(course * np.exp(-2j * factor * heading))) / max(float(np.sum(size)), 1e-12)
        for unit, factor in (("rad", 1.0), ("deg", np.pi / 180.0))
    }
    return "deg" if along["deg"] > _ALONG > 2.0 * along["rad"] else "rad"


def read_pose_topic(columns: TopicColumns, fields: PoseFields | None = None) -> PoseArrays:
    """Poses of a topic by the given fields, or by those of its type; axes ahead, left, up."""
    pose = fields or find_type(columns.type_name).pose
    if pose is None:
        raise _holds_no("pose", columns, "pose")
    position = np.zeros((columns.log_time.size, 3))
    for axis, name in enumerate(axis_fields(pose.position, "xyz")):
        # Poses in the plane have no height.
        if axis < 2 or name in columns.fields:  # noqa: PLR2004
            position[:, axis] = numbers(columns, name)
    turns = [numbers(columns, name) for name in _turn_fields(pose)]
    if not turns:
        still = np.zeros(columns.log_time.size)
        turns = [still, still, still, still + 1.0]
    if pose.angle:
        half = 0.5 * (np.radians(turns[0]) if pose.angle_unit == "deg" else turns[0])
        still = np.zeros(half.size)
        turns = [still, still, np.sin(half), np.cos(half)]
    arrays = PoseArrays(
        position,
        np.stack(turns, axis=-1),
        first_text(columns, pose.parent) if pose.parent else "",
        first_text(columns, pose.child) if pose.child else "",
    )
    return _turn_axes(arrays) if pose.convention == "ned_frd" else arrays


def read_fixes(columns: TopicColumns) -> tuple[Floats, Floats, Floats, Flags]:
    """Latitude and longitude [deg], altitude [m] and validity of fixes, each (n,)."""
    fix = find_type(columns.type_name).fix
    if fix is None:
        raise _holds_no("fix", columns, "pose")
    is_counted = np.issubdtype(getattr(columns.fields[fix.latitude], "dtype", float), np.integer)
    degree, metre = _COUNTED if is_counted else (1.0, 1.0)
    latitude, longitude = (degree * numbers(columns, name) for name in (fix.latitude, fix.longitude))
    altitude = metre * numbers(columns, fix.altitude)
    status = numbers(columns, fix.status) if fix.status else np.full(latitude.size, fix.least)
    # A receiver without a fix may report zero and zero, in the Gulf of Guinea.
    there = (np.abs(latitude) <= _POLE_DEG) & (np.abs(longitude) <= 4.0 * _POLE_DEG)
    there &= (latitude != 0.0) | (longitude != 0.0)
    return latitude, longitude, altitude, there & (status >= fix.least)


def read_ground_velocity(columns: TopicColumns) -> Floats:
    """Velocities over ground as published [m/s], shape (n, 2)."""
    velocity = find_type(columns.type_name).ground_velocity
    names = () if velocity is None else (velocity.east, velocity.north)
    return np.stack([numbers(columns, name) for name in names], axis=-1)


def read_own_speed(receiver: Receiver, source: PoseSource) -> tuple[Floats, Floats]:
    """Times [s], and how fast positions move by what is recorded with them [m/s], shape (n,) each.

    Args:
        receiver: the topic of the velocities: that of the positions, or of a satellite receiver beside them.
        source: the positions.
    """
    columns, rows = receiver.columns, receiver.order
    kind = find_type(columns.type_name)
    pose = source.fields or kind.pose
    names = [] if pose is None or source.content is not PoseContent.POSE else pose.velocity
    if kind.ground_velocity is not None and source.velocity:
        names = [kind.ground_velocity.east, kind.ground_velocity.north]
    names = [name for name in names if name in columns.fields]
    parts = [numbers(columns, name)[rows] for name in names]
    return receiver.times[rows], np.hypot(*parts) if len(parts) == 2 else np.full(rows.size, np.nan)  # noqa: PLR2004


def read_attitude(columns: TopicColumns) -> Floats | None:
    """Quaternions (n, 4) of an IMU; None if it has none, or they were not read."""
    imu = find_type(columns.type_name).imu
    names = axis_fields(imu.orientation, "xyzw") if imu is not None and imu.orientation else []
    if not names or any(name not in columns.fields for name in names):
        return None
    return np.stack([numbers(columns, name) for name in names], axis=-1)


def frame_of(columns: TopicColumns) -> str:
    """Frame in the headers of a topic; empty if there is none."""
    name = _frame_field(columns.type_name)
    return first_text(columns, name) if name else ""


def _frame_field(kind: str) -> str:
    """Field with the frame of a fix, a velocity or an IMU; empty of a type without one."""
    fix = find_type(kind).fix
    return _FRAME if fix is None else fix.frame


def _turn_axes(arrays: PoseArrays) -> PoseArrays:
    """Convert north-east-down poses of a body ahead-right-down to east-north-up and ahead-left-up."""
    position = arrays.position[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0])
    turned = rigid.multiply_quaternions(
        np.broadcast_to(_NED_IN_ENU, arrays.quaternion.shape),
        turn_over(arrays.quaternion),
    )
    return replace(arrays, position=position, quaternion=turned)


def read_imu(columns: TopicColumns) -> tuple[Floats, Floats]:
    """Angular velocity [rad/s] and specific force [m/s^2] of an IMU topic, each (n, 3)."""
    imu = find_type(columns.type_name).imu
    if imu is None:
        raise _holds_no("gyro", columns, "imu")
    signs = np.array([1.0, -1.0, -1.0]) if imu.convention == "ned_frd" else np.ones(3)
    rates, forces = (
        signs * np.stack([numbers(columns, name) for name in axis_fields(fields, "xyz")], axis=-1)
        for fields in (imu.rate, imu.force)
    )
    return rates, forces


def turn_to_radians(columns: TopicColumns) -> TopicColumns:
    """An IMU topic whose rates were recorded in degrees."""
    imu = find_type(columns.type_name).imu
    names = [] if imu is None else [name for name in axis_fields(imu.rate, "xyz") if name in columns.fields]
    return replace(
        columns, fields={**columns.fields, **{name: np.radians(numbers(columns, name)) for name in names}}
    )


def _holds_no(what: str, columns: TopicColumns, role: str) -> StageError:
    said, hint = f"{columns.type_name} holds no {what}", f"Name another {role}.topic."
    return StageError(f"no_{role}", said, where=columns.topic, hint=hint)


def numbers(columns: TopicColumns, name: str) -> Floats:
    """A column of plain numbers as float64; NaN where no message has the field.

    Raises:
        StageError: the field is a sequence or a text.
    """
    column = columns.fields.get(name)
    if column is None:
        return np.full(len(columns), np.nan)
    if isinstance(column, Ragged) and "[]." in name:
        # Of several bodies or receivers in one message the first.
        column = column.at(0)
    if not isinstance(column, np.ndarray) or column.ndim != 1:
        what = f"the field {name!r} is not one number a message"
        raise StageError("field_not_a_number", what, where=columns.topic, hint="Name one element: field[0].")
    return column.astype(np.float64)


def first_text(columns: TopicColumns, name: str) -> str:
    """First text of a column of strings, shortened for use in a message."""
    column = columns.fields.get(name)
    if isinstance(column, Strings) and len(column) and column.codes[0] >= 0:
        text: str = column.values[int(column.codes[0])]
        return shorten(text, LONGEST_NAME)
    return ""


def texts(columns: TopicColumns, name: str) -> list[str]:
    """A column of strings."""
    column = columns.fields[name]
    return column.to_list() if isinstance(column, Strings) else []
