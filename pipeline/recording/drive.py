"""Wheel speeds, or speed and steering, from the various forms of drive topics."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
import polars as pl
from msgspec import structs

from pipeline.core import Flags, Floats, arrays
from pipeline.logs import Ragged, RaggedStrings, TopicColumns
from pipeline.recording import topic_values
from pipeline.recording.findings import Finding, StageError
from pipeline.recording.rates import differentiate_angle, report_jumps, settle_joints, unwrap_counter
from pipeline.sources import (
    DriveForm,
    DriveSection,
    DriveSource,
    OwnUnit,
    Vehicle,
    convert_unit,
    find_type,
    list_ranges,
)

SIDES = ("left", "right")
_LEFT = re.compile(r"left|(^|[_/])(l|lf|fl|rl|bl|ml|lb)([_/\d]|$)")
_RIGHT = re.compile(r"right|(^|[_/])(r|rf|fr|rr|br|mr|rb)([_/\d]|$)")
_FRONT = re.compile(r"front|(^|[_/])(f|fl|fr|lf|rf)([_/\d]|$)")
_REAR = re.compile(r"rear|back|(^|[_/])(rl|rr|bl|br|lr|lb|rb)([_/\d]|$)")
_STEERS = re.compile(r"steer|azimuth")
_DRIVES = re.compile(r"wheel|traction|drive|driving|propulsion|motor")
_USUAL_UNITS = {
    DriveForm.SIDES: ("rad/s", "rad/s"),
    DriveForm.BODY: ("m/s", "rad/s"),
    DriveForm.STEERING: ("m/s", "rad"),
}

SIGNALS = ("left", "right", "speed", "steering", "sideways", "body_x", "body_y", "body_w")
"""Signals of a drive, in the order of the tables' columns: speeds of the left and the right wheels [rad/s];
speed [m/s] and steering angle [rad] (Ackermann); wheel speed that moves the vehicle to the left [rad/s]
(mecanum, omni); and of a body command the speeds ahead and to the left [m/s] and the yaw rate [rad/s]."""
Drive = dict[str, Floats]
"""Those that the form of a message series has, by name, shape (n,) each."""


def read_joints(
    columns: TopicColumns, times: Floats, section: DriveSection, vehicle: Vehicle
) -> tuple[Drive, list[Finding]]:
    """Joint states: wheels by joint name, averaged per side.

    Args:
        columns: a topic whose type has wheels by name.
        times: time of each message [s].
        section: joint names, unit, sign.
        vehicle: its wheel radius converts a speed in m/s into rad/s.

    Raises:
        StageError: no joint name indicates a side, or there is neither velocity nor position.
    """
    if not vehicle.kinematics.known_joints:
        raise _no_wheels(columns.topic, ())
    velocity, position = _read_series(columns)
    joints = sorted(set(velocity) | set(position))
    chosen = choose_sides(joints, section, may_steer=vehicle.kinematics.has_inputs("steering"))
    left, right = (chosen[side] for side in (SIDES[::-1] if section.exchanged else SIDES))
    findings: list[Finding] = []
    missing = [joint for joint in (*left, *right) if not _is_known(joint, velocity, position)]
    if missing:
        findings.append(Finding("velocity_from_position", "info", columns.topic, {"joints": missing}))
    for joint in missing:
        if not _is_known(joint, position, velocity):
            raise _no_wheels(columns.topic, joints)
        velocity[joint] = differentiate_angle(times, position[joint])
    findings += report_jumps(columns.topic, times, {joint: position[joint] for joint in missing})
    recorded = [joint for joint in (*left, *right) if joint not in missing]
    section, settled = _settle(columns.topic, times, section, velocity, position, recorded)
    findings += settled
    velocity |= {
        joint: velocity[joint] * _find_factor(section, side, joint)
        for side, joints_of_it in chosen.items()
        for joint in joints_of_it
    }
    if vehicle.kinematics.has_inputs("steering"):
        steering = _mean_steering(position, section.steering_joint, columns.topic)
        wheels = [velocity[joint] for joint in (*left, *right)]
        if not wheels:
            raise _no_wheels(columns.topic, joints)
        speed = _to_radps(np.mean(wheels, axis=0), section, vehicle) * vehicle.wheel_radius_m
        name = (*left, *right)[0].lower()
        is_steered = len(wheels) == 1 and not any(one.search(name) for one in (_REAR, _LEFT, _RIGHT))
        # Behind a wheel that steers and drives, as a tricycle's, less of its speed is left.
        return {"speed": speed * np.cos(steering) if is_steered else speed, "steering": steering}, findings
    if not left or not right:
        raise _no_wheels(columns.topic, joints)
    sides = [
        _to_radps(np.mean([velocity[joint] for joint in side], axis=0), section, vehicle)
        for side in (left, right)
    ]
    speeds = {joint: _to_radps(velocity[joint], section, vehicle) for joint in (*left, *right)}
    drive = dict(zip(SIDES, sides, strict=True))
    if vehicle.kinematics.has_inputs("sideways"):
        drive["sideways"] = _mean_sideways(speeds, left, section, columns.topic)
    return drive, findings


def is_of_wheels(columns: TopicColumns, drive: Drive) -> Flags:
    """Messages that hold the joints of a drive, shape (n,): others of the topic may be of an arm."""
    joints = find_type(columns.type_name).joints
    names = None if joints is None else columns.fields[joints.names]
    if not isinstance(names, RaggedStrings) or not drive:
        return np.ones(columns.log_time.size, dtype=bool)
    sizes = np.diff(names.offsets)
    kinds = names.at(0).codes.astype(np.int64) * (1 + int(sizes.max(initial=0))) + sizes
    read = np.any([np.isfinite(one) for one in drive.values()], axis=0)
    return np.isin(kinds, kinds[read])


def list_joints(columns: TopicColumns) -> tuple[str, ...]:
    """Names of the joints that messages of a topic hold; none of a type without names."""
    joints = find_type(columns.type_name).joints
    names = None if joints is None else columns.fields.get(joints.names)
    return tuple(names.values) if isinstance(names, RaggedStrings) else ()


def _find_factor(section: DriveSection, side: str, joint: str = "") -> float:
    """Factor on the recorded speeds of a side, or of a joint of it, by its own scale and sign."""
    factors = section.factors or {}
    return factors.get(side, 1.0) * factors.get(joint, 1.0) * (-1.0 if section.reversed == side else 1.0)


def _settle(
    topic: str,
    times: Floats,
    section: DriveSection,
    velocity: dict[str, Floats],
    position: Mapping[str, Floats],
    joints: Sequence[str],
) -> tuple[DriveSection, list[Finding]]:
    """The section with the unit of the velocities, unless it gives one; rates of positions replace some.

    Velocities that are zero, or contradict what the positions of the same joints turn, are replaced.
    """
    both = [joint for joint in joints if _is_known(joint, position, velocity)]
    if section.unit is not None or not both:
        return section, []
    turned = {joint: differentiate_angle(times, position[joint]) for joint in both}
    settled = settle_joints(topic, {joint: velocity[joint] for joint in both}, turned)
    velocity |= {joint: turned[joint] for joint in settled.by_position}
    findings = list(settled.findings)
    if settled.by_position:
        findings += report_jumps(topic, times, {joint: position[joint] for joint in settled.by_position})
    if not settled.unit or len(both) < len(joints):
        return section, findings
    findings.append(Finding("unit_wrong", "warning", topic, {"kind": "of positions", "unit": settled.unit}))
    return structs.replace(section, unit=settled.unit), findings


def _mean_sideways(
    wheels: Mapping[str, Floats], left_joints: Sequence[str], section: DriveSection, topic: str
) -> Floats:
    """Speed [rad/s] of wheels with rollers that moves the vehicle to the left.

    The front right and rear left wheels push to the left when they turn forward, the others to the right.
    """
    parts = []
    for joint, speed in wheels.items():
        name = joint.lower()
        is_front = joint in section.front if section.front is not None else bool(_FRONT.search(name))
        if section.front is None and is_front == bool(_REAR.search(name)):
            what = f"{joint} of {topic} cannot be identified as a front or a rear wheel"
            hint = f"Set front to the names of the front wheels; it has: {', '.join(wheels)}."
            raise StageError("no_wheels", what, where=topic, hint=hint)
        parts.append(speed if is_front != (joint in left_joints) else -speed)
    mean: Floats = np.mean(parts, axis=0)
    return mean


def _mean_steering(position: Mapping[str, Floats], configured: str | None, topic: str) -> Floats:
    """Steering angle [rad] of the configured joint, else of the middle of those with steering names.

    Wheels of one axle that roll about one centre have that centre's distance in common, not the angle: the
    cotangent in the middle is the mean of theirs. Of other joints it is the mean of the angles.
    """
    names = [configured] if configured else [joint for joint in position if _is_steered(joint)]
    angles = [position[joint] for joint in names if joint in position]
    if not angles:
        hint = f"Set steering_joint to one of: {', '.join(sorted(position)) or 'none it has'}."
        raise StageError("no_steering", f"{topic} needs a steering joint", where=topic, hint=hint)
    if len(angles) != 2:  # noqa: PLR2004 - the wheels of one axle
        mean: Floats = np.mean(angles, axis=0)
        return mean
    first, second = np.tan(angles)
    middle, half = 0.5 * (first + second), 0.5 * (first - second)
    # Toe and offsets of sensors part wheels that hardly steer, too: no axle is longer than the wheelbase.
    apart = np.minimum(np.abs(half), 0.5 * middle**2)
    bent = np.divide(apart**2, middle, out=np.zeros_like(middle), where=middle != 0.0)
    between: Floats = np.arctan(middle - bent)
    return between


def _read_series(columns: TopicColumns) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Velocities and positions by joint name."""
    joints = find_type(columns.type_name).joints
    names = None if joints is None else columns.fields[joints.names]
    if joints is None or not isinstance(names, RaggedStrings):
        raise _no_wheels(columns.topic, ())
    if not joints.interfaces:
        velocity, position = (
            _joint_matrix(columns.fields.get(field), names) for field in (joints.velocity, joints.position)
        )
        return velocity, position
    interfaces, values = columns.fields[joints.interfaces], columns.fields[joints.values]
    if not isinstance(interfaces, RaggedStrings) or not isinstance(values, Ragged):
        raise _no_wheels(columns.topic, names.values)
    table = _read_interfaces(names, interfaces, values)
    if table is None:
        raise _no_wheels(columns.topic, names.values)
    velocity, position = (
        {joint: series for (joint, each), series in table.items() if each == quantity}
        for quantity in (joints.velocity, joints.position)
    )
    return velocity, position


def read_rates(columns: TopicColumns, times: Floats) -> dict[str, Floats]:
    """Rates of all joints by name, of velocities or else of positions.

    Args:
        columns: a topic whose type has wheels by name.
        times: time of each message [s].
    """
    velocity, position = _read_series(columns)
    rates = {
        name: rate
        for name, rate in velocity.items()
        if _is_known(name, velocity, position) and (np.any(rate[np.isfinite(rate)]) or name not in position)
    }
    return rates | {
        name: differentiate_angle(times, angle) for name, angle in position.items() if name not in rates
    }


def read_angles(columns: TopicColumns, times: Floats) -> dict[str, Floats]:
    """Angles of all joints by name, of positions or else of velocities.

    Args:
        columns: a topic whose type has wheels by name.
        times: time of each message [s].
    """
    velocity, position = _read_series(columns)
    turned = {
        name: arrays.integrate_rate(times, np.nan_to_num(rate))
        for name, rate in velocity.items()
        if not _is_known(name, position, velocity)
    }
    return position | turned


def _read_interfaces(
    names: RaggedStrings, interfaces: RaggedStrings, values: Ragged
) -> dict[tuple[str, str], Floats] | None:
    """Series by joint and quantity; None unless all messages have the same joints with the same quantities.

    The names of quantities are concatenated joint by joint. No joint has a name twice, so that names repeat
    once per joint only if all joints have the same ones.
    """
    joints, quantities, numbers = names.fixed(), interfaces.fixed(), values.fixed()
    if joints is None or quantities is None or numbers is None or not joints.size:
        return None
    alike = (joints == joints[0]).all() and (quantities == quantities[0]).all()
    each, rest = divmod(quantities.shape[1], joints.shape[1])
    if not alike or rest or quantities.shape != numbers.shape:
        return None
    blocks = quantities[0].reshape(joints.shape[1], each)
    if (blocks != blocks[0]).any() or np.unique(blocks[0]).size != each:
        return None
    keys = [(joint, quantity) for joint in names.row(0) for quantity in interfaces.row(0)[:each]]
    return {key: numbers[:, index].astype(np.float64) for index, key in enumerate(keys)}


def _joint_matrix(values: object, names: RaggedStrings) -> dict[str, Floats]:
    """Values by joint name, NaN if a message lacks the joint; the order of joints may change."""
    if not isinstance(values, Ragged):
        return {}
    series_by_joint: dict[str, Floats] = {}
    sizes, name_sizes = np.diff(values.offsets), np.diff(names.offsets)
    fits = sizes == name_sizes
    rows = np.repeat(np.arange(len(names)), name_sizes)
    inner = np.arange(names.codes.size) - np.repeat(names.offsets[:-1], name_sizes)
    for code, joint in enumerate(names.values):
        at = np.flatnonzero((names.codes == code) & fits[rows])
        if at.size:
            series = np.full(len(names), np.nan)
            series[rows[at]] = values.values[values.offsets[rows[at]] + inner[at]]
            series_by_joint[joint] = series
    return series_by_joint


def _is_known(joint: str, series: Mapping[str, Floats], other: Mapping[str, Floats]) -> bool:
    """Whether a joint's series has most of its readings; other messages may be of other joints."""
    read = [np.isfinite(one[joint]) for one in (series, other) if joint in one]
    return joint in series and bool(read[0].sum() > 0.5 * np.any(read, axis=0).sum())


def _is_steered(joint: str) -> bool:
    """Whether the name of a joint says that it steers."""
    return bool(_STEERS.search(joint.lower()))


def list_steered(columns: TopicColumns) -> list[str]:
    """Joints of a topic that steer by their names, and whose angles change."""
    _, position = _read_series(columns)
    steered = {joint: angle[np.isfinite(angle)] for joint, angle in position.items() if _is_steered(joint)}
    return sorted(joint for joint, angle in steered.items() if angle.size and np.ptp(angle) > 0.0)


def choose_sides(
    joints: Sequence[str], section: DriveSection, *, may_steer: bool = False
) -> dict[str, list[str]]:
    """The joints of each side by their names, ``left`` and ``right``, that drive and do not steer.

    Of a vehicle that steers, and whose joints name no side, the one that drives is on the left.
    """
    rolling = [joint for joint in joints if joint != section.steering_joint and not _is_steered(joint)]
    left = _choose_joints(rolling, section.left, _LEFT, _RIGHT)
    right = _choose_joints(rolling, section.right, _RIGHT, _LEFT)
    if may_steer and not (left or right):
        driven = [joint for joint in rolling if _DRIVES.search(joint.lower())]
        left = driven if len(driven) == 1 else []
    return {"left": left, "right": right}


def _choose_joints(
    joints: Sequence[str], configured: list[str] | None, side: re.Pattern[str], other: re.Pattern[str]
) -> list[str]:
    """Joints of a side: those configured, else by name, preferably names with `wheel`."""
    if configured is not None:
        return [joint for joint in joints if joint in configured]
    matching = [joint for joint in joints if side.search(joint.lower()) and not other.search(joint.lower())]
    wheels = [joint for joint in matching if "wheel" in joint.lower()]
    return wheels or matching


def _no_wheels(topic: str, joints: Sequence[str]) -> StageError:
    return StageError(
        "no_wheels",
        f"no wheel speeds of both sides can be found in {topic}",
        where=topic,
        hint=f"Set left and right to joint names; it has: {', '.join(joints) or 'no joints'}.",
    )


def _to_radps(values: Floats, section: DriveSection, vehicle: Vehicle) -> Floats:
    scale, offset, unit = convert_unit(section.unit or "rad/s", vehicle.units, where="wheels")
    return (values - offset) * scale * section.direction / (vehicle.wheel_radius_m if unit == "m/s" else 1.0)


def read_signal(
    columns: TopicColumns, source: DriveSource, number: int, section: DriveSection, vehicle: Vehicle
) -> Floats:
    """One signal of a pair as recorded, in rad/s or m/s; a wheel angle in rad, unwrapped.

    Args:
        columns: the signal's topic.
        source: the pair.
        number: 0 for the left wheels or the speed, 1 for the other.
        section: unit and ticks per turn, if configured.
        vehicle: platform with possible units of its own.

    Raises:
        ConfigurationError: ``unit_unknown``.
    """
    signal = source.signals[number]
    paths = [topic_values.numbers(columns, path) for path in signal.fields()]
    # A controller of one wheel has no second: a list element that no message has is left out of the average.
    there = [values for values in paths if np.isfinite(values).any()] or paths
    raw = np.mean(there, axis=0) * signal.sign
    own = dict(vehicle.units)
    per_turn = section.per_turn
    if per_turn is None and signal.per_turn:
        per_turn = float(np.nanmedian(topic_values.numbers(columns, signal.per_turn)))
        least, largest = list_ranges(DriveSection)["per_turn"]
        per_turn = per_turn if least <= per_turn <= largest else None
    if per_turn is not None:
        own["ticks"] = OwnUnit(per_turn / (2.0 * np.pi), "rad")
    second = section.steering_unit if source.form is DriveForm.STEERING else section.yaw_unit
    asked = section.unit if number == 0 or source.form is DriveForm.SIDES else second
    unit = asked or signal.unit or _USUAL_UNITS[source.form][number]
    if unit == "ticks":
        raw = unwrap_counter(raw)
    scale, offset, made = convert_unit(unit, own, where=signal.topic)
    values: Floats = (raw - offset) * scale
    if number == 0 or source.form is DriveForm.SIDES:
        if source.form is DriveForm.SIDES and made == "m/s":
            return values / vehicle.wheel_radius_m
        if source.form is DriveForm.STEERING and made == "rad/s":
            return values * vehicle.wheel_radius_m
    return values


def is_angle(source: DriveSource, section: DriveSection) -> bool:
    """Whether the signals of a pair are wheel angles, to be differentiated."""
    unit = section.unit or source.signals[0].unit
    return source.form is DriveForm.SIDES and unit in {"rad", "deg", "ticks"}


def read_pair(
    form: DriveForm,
    first: Floats,
    second: Floats,
    section: DriveSection,
    vehicle: Vehicle,
    *,
    nominal: bool,
    sideways: Floats | None = None,
) -> Drive:
    """Convert two signals at common times into the drive's inputs.

    Args:
        form: form of the signals.
        first: speeds of the left wheels [rad/s], or speed [m/s].
        second: speeds of the right wheels [rad/s], yaw rate [rad/s] or steering angle [rad].
        section: sign.
        vehicle: its kind and geometry.
        nominal: whether a body motion refers to the nominal track width, regardless of the controller's
            multiplier.
        sideways: speed to the left of a body motion [m/s]; None if not recorded.

    Raises:
        StageError: the drive of this kind of vehicle has other inputs.
    """
    if form is DriveForm.SIDES:
        left, right = (section.direction * _find_factor(section, side) for side in SIDES)
        first, second = first * left, second * right
        return read_sides(*((second, first) if section.exchanged else (first, second)), vehicle)
    if form is DriveForm.STEERING:
        return read_steering(first * section.direction, second, vehicle)
    if nominal:
        vehicle = structs.replace(vehicle, controller_track_multiplier=1.0)
    return read_body(first * section.direction, second, vehicle, sideways)


def read_sides(left: Floats, right: Floats, vehicle: Vehicle) -> Drive:
    """One signal per side, already at common times."""
    if vehicle.kinematics.has_inputs("steering"):
        what = "a pair of wheel speeds has no steering angle"
        hint = "Configure speed_topic and steering_topic, or an AckermannDrive topic."
        raise StageError("no_steering", what, where="configuration", hint=hint)
    if vehicle.kinematics.has_inputs("sideways"):
        what = f"a pair of wheel speeds does not say how {vehicle.name} ({vehicle.kind}) moves sideways"
        hint = "Configure a topic of body motion with linear.y, or a JointState of all wheels."
        raise StageError("no_sideways", what, where="configuration", hint=hint)
    return {"left": left, "right": right}


def read_body(forward: Floats, yaw_rate: Floats, vehicle: Vehicle, sideways: Floats | None = None) -> Drive:
    """A body command, converted into the drive's inputs by the vehicle's ideal inverse."""
    aside = np.zeros_like(forward) if sideways is None else sideways
    inputs = vehicle.kinematics.inverse((forward, aside, yaw_rate), vehicle)
    body = {"body_x": forward, "body_w": yaw_rate} | ({} if sideways is None else {"body_y": sideways})
    return {**inputs, **body}


def read_steering(speed: Floats, steering: Floats, vehicle: Vehicle) -> Drive:
    """Speed and steering angle, as recorded."""
    if not vehicle.kinematics.has_inputs("speed", "steering"):
        what = f"speed and steering cannot drive {vehicle.name}, which is {vehicle.kind}"
        hint = 'Set vehicle.kind = "ackermann" and vehicle.wheelbase_m.'
        raise StageError("wrong_kind", what, where="configuration", hint=hint)
    return {"speed": speed, "steering": steering}


def read_speed(table: pl.DataFrame, vehicle: Vehicle) -> tuple[Floats, Floats] | None:
    """Times [s] and forward speed [m/s] of a table of wheels or commands; None with too few rows.

    Args:
        table: `wheels` or `commands`.
        vehicle: its wheel radius converts wheel speeds.
    """
    if table.height < topic_values.FEWEST_MESSAGES:
        return None
    if table["speed"].null_count() < table.height:
        speed = table["speed"].to_numpy()
    else:
        speed = 0.5 * vehicle.wheel_radius_m * (table["left"] + table["right"]).to_numpy()
    known = np.isfinite(speed)
    return (
        (table["t"].to_numpy()[known], speed[known]) if known.sum() >= topic_values.FEWEST_MESSAGES else None
    )


_FEW_REPEATS = 0.05
"""Share of readings between two others above which their repeats are reported, as of poses."""


def interpolate_readings(wheels: pl.DataFrame) -> tuple[pl.DataFrame, list[Finding]]:
    """Table `wheels` with readings that are repeated interpolated, each side between its own readings."""
    if wheels.is_empty():
        return wheels, []
    times = wheels["t"].to_numpy()
    columns, periods, moved = {}, [0.0], np.zeros(times.size, dtype=bool)
    for name in (name for name in SIGNALS if name in wheels.columns):
        values = wheels[name].cast(pl.Float64).fill_null(np.nan).to_numpy()
        filled, period = interpolate_repeats(times, values)
        columns[f"{name}_aligned"] = pl.Series(filled).fill_nan(None)
        periods.append(period)
        moved |= ~np.isclose(filled, values, equal_nan=True)
    repeated = wheels.with_columns(**columns)
    share = float(moved.mean())
    if share <= _FEW_REPEATS:
        return repeated, []
    return repeated, [Finding("held_wheels", "info", "wheels", {"value": max(periods)})]


_LONGEST_REPEAT_S = 1.0
"""Longest period of readings [s]: encoders of the recordings are read every 0.1, 0.15 or 0.25 s."""
_ALMOST = 0.9
"""Share of the period before a new reading at which the one before was still right: stamps vary."""


def interpolate_repeats(times: Floats, values: Floats) -> tuple[Floats, float]:
    """Readings that are published repeatedly until the next one, linear between one and the next.

    A reading that repeats its value at a later period, as at rest, is left until one period before a change.

    Args:
        times: increasing [s], shape (n,).
        values: NaN where unknown, shape (n,).

    Returns:
        The values, and the median period of the readings [s]; zero if none is periodic.
    """
    known = np.flatnonzero(np.isfinite(values))
    stamps, read = times[known], values[known]
    fresh = np.flatnonzero(np.diff(read)) + 1
    waits = np.diff(stamps[fresh])
    waits = waits[waits <= _LONGEST_REPEAT_S]
    if not waits.size:
        return values, 0.0
    period = float(np.median(waits))
    last = np.searchsorted(stamps, stamps[fresh] - _ALMOST * period, side="right") - 1
    before = np.append(0, fresh[:-1])
    knots = np.unique(np.concatenate((before, np.maximum(last, before), fresh, [read.size - 1])))
    filled = values.copy()
    filled[known] = np.interp(stamps, stamps[knots], read[knots])
    return filled, period


_DIFFERENCE = 0.98
"""Share of what a pose moves from message to message that speeds times these steps explain from which on the
speeds are its differences."""
_SCATTERED = 0.9
"""The same of speeds between which one interpolates, below which they scatter: stamps jitter, or an encoder
is read less often than it is sent."""
_REST_S = 0.3
"""Time [s] without any change after which a base is at rest, and not between two readings of its encoders."""


def smooth_differences(
    times: Floats, position: Floats, yaw: Floats, speeds: tuple[Floats, Floats]
) -> tuple[Floats, Floats] | None:
    """Speeds of an odometry by how far its own positions go, where those that it states scatter about them.

    Args:
        times: of its messages [s], shape (n,).
        position: [m], shape (n, 2).
        yaw: [rad], shape (n,).
        speeds: ahead [m/s] and turning [rad/s], shape (n,) each.

    Returns:
        Both speeds over about two of its readings; None where those that are stated serve.
    """
    elapsed = np.diff(times)
    yaw = np.unwrap(yaw)
    if elapsed.size == 0 or not (np.isfinite(position).all() and (elapsed > 0.0).all()):
        return None
    along = np.exp(-0.5j * (yaw[1:] + yaw[:-1]))
    moved = (np.diff(position[:, 0] + 1j * position[:, 1]) * along).real, np.diff(yaw)
    shares = []
    for change, speed in zip(moved, speeds, strict=True):
        size = float(change @ change)
        if size == 0.0:
            continue
        rests = change - speed[1:] * elapsed, change - 0.5 * (speed[1:] + speed[:-1]) * elapsed
        shares.append([1.0 - float(rest @ rest) / size for rest in rests])
    if (
        not shares
        or min(one for one, _ in shares) < _DIFFERENCE
        or min(one for _, one in shares) > _SCATTERED
    ):
        return None
    changed = np.append(True, (moved[0] != 0.0) | (moved[1] != 0.0))
    last = np.maximum.accumulate(np.where(changed, times, -np.inf))
    knots = np.flatnonzero(changed | (times - last > _REST_S))
    half = float(np.median(np.diff(times[knots])))
    paths = (np.append(0.0, np.cumsum(one))[knots] for one in moved)
    ahead, turning = (
        (np.interp(times + half, times[knots], path) - np.interp(times - half, times[knots], path))
        / (2.0 * half)
        for path in paths
    )
    return ahead, turning
