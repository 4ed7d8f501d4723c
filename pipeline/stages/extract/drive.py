"""Wheel speeds, or speed and steering, out of whatever form the drive's topics have."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.logs import Ragged, RaggedStrings, TopicColumns
from pipeline.stages.errors import StageError
from pipeline.stages.finding import Finding
from pipeline.vehicles import DriveForm, DriveSection, Vehicle

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

Floats = NDArray[np.float64]

_LEFT = re.compile(r"left|(^|[_/])(l|lf|fl|rl|bl|ml|lb)([_/\d]|$)")
_RIGHT = re.compile(r"right|(^|[_/])(r|rf|fr|rr|br|mr|rb)([_/\d]|$)")
_STEERS = re.compile(r"steer")
_RPM = 2.0 * np.pi / 60.0

BODY_FIELDS = {"geometry_msgs/Twist": "", "geometry_msgs/TwistStamped": "twist."}
ACKERMANN_FIELDS = {"ackermann_msgs/AckermannDrive": "", "ackermann_msgs/AckermannDriveStamped": "drive."}


@dataclass(frozen=True)
class Drive:
    """Drive signals of one message series; a quantity that the form does not have is None.

    Attributes:
        left: speed of the left wheels [rad/s], shape (n,).
        right: speed of the right wheels [rad/s].
        speed: speed [m/s] (Ackermann).
        steering: steering angle [rad] (Ackermann).
        body_x: forward speed of the body command [m/s].
        body_w: yaw rate of the body command [rad/s].
    """

    left: Floats | None = None
    right: Floats | None = None
    speed: Floats | None = None
    steering: Floats | None = None
    body_x: Floats | None = None
    body_w: Floats | None = None
    findings: tuple[Finding, ...] = field(default=())


def read_joints(columns: TopicColumns, times: Floats, section: DriveSection, vehicle: Vehicle) -> Drive:
    """Joint states: wheels by joint name, averaged a side.

    Args:
        columns: a JointState topic with `name`, `velocity`, `position`.
        times: time of each message [s].
        section: joint names, unit, sign.
        vehicle: whose wheel radius turns a speed in m/s into rad/s.

    Raises:
        StageError: no joint can be told to be on a side, or there is neither velocity nor position.
    """
    names = columns.fields["name"]
    if not isinstance(names, RaggedStrings):
        raise _no_wheels(columns.topic, ())
    velocity = _joint_matrix(columns.fields["velocity"], names)
    position = _joint_matrix(columns.fields["position"], names)
    joints = sorted(set(velocity) | set(position))
    rolling = [
        joint for joint in joints if joint != section.steering_joint and not _STEERS.search(joint.lower())
    ]
    left = _choose_joints(rolling, section.left, _LEFT, _RIGHT)
    right = _choose_joints(rolling, section.right, _RIGHT, _LEFT)
    found: list[Finding] = []
    missing = [joint for joint in (*left, *right) if not _is_known(velocity, joint)]
    if missing:
        found.append(
            Finding(
                "velocity_from_position",
                "info",
                f"{columns.topic} has no velocity of {', '.join(missing)}: positions were differentiated",
                where=columns.topic,
            )
        )
    for joint in missing:
        if not _is_known(position, joint):
            raise _no_wheels(columns.topic, joints)
        velocity[joint] = differentiate_angle(times, position[joint])
    if vehicle.kinematics.has_inputs("steering"):
        steering = _mean_steering(position, section.steering_joint, columns.topic)
        wheels = [velocity[joint] for joint in (*left, *right)]
        if not wheels:
            raise _no_wheels(columns.topic, joints)
        speed = _to_radps(np.mean(wheels, axis=0), section, vehicle) * vehicle.wheel_radius_m
        return Drive(speed=speed, steering=steering, findings=tuple(found))
    if not left or not right:
        raise _no_wheels(columns.topic, joints)
    sides = [
        _to_radps(np.mean([velocity[joint] for joint in side], axis=0), section, vehicle)
        for side in (left, right)
    ]
    return Drive(left=sides[0], right=sides[1], findings=tuple(found))


def _mean_steering(position: Mapping[str, Floats], configured: str | None, topic: str) -> Floats:
    """Steering angle [rad]: of the configured joint, else the mean of those whose names say they steer."""
    names = [configured] if configured else [joint for joint in position if _STEERS.search(joint.lower())]
    found = [position[joint] for joint in names if joint in position]
    if not found:
        raise StageError(
            "no_steering",
            f"{topic} needs a steering joint",
            where=topic,
            hint=f"Set steering_joint to one of: {', '.join(sorted(position)) or 'none it has'}.",
        )
    mean: Floats = np.mean(found, axis=0)
    return mean


def _joint_matrix(values: object, names: RaggedStrings) -> dict[str, Floats]:
    """Values by joint name, NaN where a message lacks the joint; the order of joints may change."""
    if not isinstance(values, Ragged):
        return {}
    found: dict[str, Floats] = {}
    sizes, name_sizes = np.diff(values.offsets), np.diff(names.offsets)
    fits = sizes == name_sizes
    rows = np.repeat(np.arange(len(names)), name_sizes)
    inner = np.arange(names.codes.size) - np.repeat(names.offsets[:-1], name_sizes)
    for code, joint in enumerate(names.values):
        at = np.flatnonzero((names.codes == code) & fits[rows])
        if at.size:
            series = np.full(len(names), np.nan)
            series[rows[at]] = values.values[values.offsets[rows[at]] + inner[at]]
            found[joint] = series
    return found


def _is_known(series: Mapping[str, Floats], joint: str) -> bool:
    return joint in series and bool(np.isfinite(series[joint]).mean() > 0.5)  # noqa: PLR2004 - most of the time


def _choose_joints(
    joints: Sequence[str], configured: list[str] | None, side: re.Pattern[str], other: re.Pattern[str]
) -> list[str]:
    """Joints of a side: those configured, else by name, and among these the ones that say `wheel`."""
    if configured is not None:
        return [joint for joint in joints if joint in configured]
    found = [joint for joint in joints if side.search(joint.lower()) and not other.search(joint.lower())]
    wheels = [joint for joint in found if "wheel" in joint.lower()]
    return wheels or found


def _no_wheels(topic: str, joints: Sequence[str]) -> StageError:
    return StageError(
        "no_wheels",
        f"no wheel speeds of both sides can be found in {topic}",
        where=topic,
        hint=f"Set left and right to joint names; it has: {', '.join(joints) or 'no joints'}.",
    )


def differentiate_angle(times: Floats, angle: Floats) -> Floats:
    """Rate [rad/s] of a wheel angle [rad] by central differences; an angle kept in one turn is unwrapped."""
    kept_in_a_turn = bool(np.nanmax(np.abs(np.diff(angle))) > np.pi and np.ptp(angle) <= 2.0 * np.pi + 1e-6)
    series = np.unwrap(angle) if kept_in_a_turn else angle
    if times.size < 3:  # noqa: PLR2004 - a central difference needs neighbours
        return np.zeros_like(angle)
    spaced = np.maximum.accumulate(times) + np.arange(times.size) * 1e-12
    return np.asarray(np.gradient(series, spaced), dtype=np.float64)


def _to_radps(values: Floats, section: DriveSection, vehicle: Vehicle) -> Floats:
    scale = {"rad/s": 1.0, "rpm": _RPM, "m/s": 1.0 / vehicle.wheel_radius_m}[section.unit]
    return values * (scale * section.sign)


def read_sides(left: Floats, right: Floats, section: DriveSection, vehicle: Vehicle) -> Drive:
    """A signal a side, already at common times."""
    if vehicle.kinematics.has_inputs("steering"):
        raise StageError(
            "no_steering",
            "a pair of wheel speeds has no steering angle",
            where="configuration",
            hint="Configure speed_topic and steering_topic, or an AckermannDrive topic.",
        )
    return Drive(left=_to_radps(left, section, vehicle), right=_to_radps(right, section, vehicle))


def read_body(forward: Floats, yaw_rate: Floats, section: DriveSection, vehicle: Vehicle) -> Drive:
    """A body command, turned into the drive's by the vehicle's ideal inverse."""
    forward = forward * section.sign
    inputs = vehicle.kinematics.inverse((forward, np.zeros_like(forward), yaw_rate), vehicle)
    return Drive(**inputs, body_x=forward, body_w=yaw_rate, findings=())


def read_steering(speed: Floats, steering: Floats, section: DriveSection, vehicle: Vehicle) -> Drive:
    """Speed and steering angle, as recorded."""
    if not vehicle.kinematics.has_inputs("speed", "steering"):
        raise StageError(
            "wrong_kind",
            f"speed and steering cannot drive {vehicle.name}, which is {vehicle.kind}",
            where="configuration",
            hint='Set vehicle.kind = "ackermann" and vehicle.wheelbase_m.',
        )
    return Drive(speed=speed * section.sign, steering=steering)


def is_single_topic(form: DriveForm) -> bool:
    """Whether a form reads everything from one topic."""
    return form in {DriveForm.JOINTS, DriveForm.BODY, DriveForm.ACKERMANN}
