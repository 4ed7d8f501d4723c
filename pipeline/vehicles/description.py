"""Geometry out of a robot description (URDF): wheels, their radii, track width, wheelbase and steering.

A wheel is a continuous joint that turns about the body's lateral axis; a steering joint turns about its
vertical one and carries a wheel, or says so. Casters are none. Wheels are mecanum wheels where the text
speaks of such or of rollers. The radius is that of the wheel's cylinder, else the height of its axis over
base_footprint.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from xml.etree import ElementTree as ET

import numpy as np

from pipeline.core import rigid
from pipeline.core.arrays import Floats

_LONGEST = 8_000_000
_LATERAL = 0.9
_CASTER = re.compile(r"caster|castor|swivel|rocker|suspension")
_ROLLERS = re.compile(r"mecanum|roller")
_ROLLS = ("continuous", "revolute")
_APART_M = 0.02


@dataclass(frozen=True)
class Description:
    """What a description says of the drive; None where it says nothing.

    Attributes:
        name: of the robot.
        kind: ``differential``, ``ackermann`` or ``mecanum``.
        wheel_radius_m, track_width_m, wheelbase_m: geometry.
        base_to_rear_axle_m: how far base_link lies ahead of the rear axle (Ackermann).
        wheels: names of the wheel joints.
    """

    name: str
    kind: str
    wheel_radius_m: float | None
    track_width_m: float | None
    wheelbase_m: float | None
    base_to_rear_axle_m: float
    wheels: tuple[str, ...]


@dataclass(frozen=True)
class _Joint:
    name: str
    kind: str
    parent: str
    child: str
    place: Floats
    turn: Floats
    axis: Floats


def read_description(text: str) -> Description | None:
    """What a robot description says; None where it is no description or has no wheels."""
    # Entities could make a short text endless; no exporter of descriptions writes them.
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
        placed = _place_in(base, joint, joints)
        if placed is None or _CASTER.search(joint.name.lower()) or joint.kind not in _ROLLS:
            continue
        place, axis = placed
        if abs(axis[1]) > _LATERAL and abs(place[1]) > _APART_M:
            wheels.append((joint, place))
        elif abs(axis[2]) > _LATERAL and "steer" in joint.name.lower():
            steering.append((joint, place))
    if not any(place[1] > 0.0 for _, place in wheels) or not any(place[1] < 0.0 for _, place in wheels):
        return None
    described = _describe(robot, wheels, steering, joints)
    has_rollers = described.kind == "differential" and bool(_ROLLERS.search(text.lower()))
    return replace(described, kind="mecanum") if has_rollers else described


def _describe(
    robot: ET.Element,
    wheels: list[tuple[_Joint, Floats]],
    steering: list[tuple[_Joint, Floats]],
    joints: Mapping[str, _Joint],
) -> Description:
    links = {link.get("name", ""): link for link in robot.iter("link")}
    radii = [radius for joint, _ in wheels if (radius := _read_radius(links.get(joint.child)))]
    if not radii:
        footprint = [_place_in("base_footprint", joint, joints) for joint, _ in wheels]
        radii = [float(placed[0][2]) for placed in footprint if placed is not None and placed[0][2] > 0.0]
    steered = {joint.child for joint, _ in steering}
    driven = [place for joint, place in wheels if joint.parent not in steered] or [p for _, p in wheels]
    left = [place[1] for place in driven if place[1] > 0.0]
    right = [place[1] for place in driven if place[1] < 0.0]
    ahead = [place[0] for _, place in steering]
    rear = min(place[0] for place in driven)
    front = float(np.mean(ahead)) if ahead else max(place[0] for place in driven)
    return Description(
        name=robot.get("name", ""),
        kind="ackermann" if steering else "differential",
        wheel_radius_m=float(np.median(radii)) if radii else None,
        track_width_m=float(np.mean(left) - np.mean(right)) if left and right else None,
        wheelbase_m=float(front - rear) if front - rear > _APART_M else None,
        base_to_rear_axle_m=-float(rear) if steering else 0.0,
        wheels=tuple(joint.name for joint, _ in wheels),
    )


def _read_joint(element: ET.Element) -> _Joint | None:
    parent, child, origin = element.find("parent"), element.find("child"), element.find("origin")
    axis = element.find("axis")
    if parent is None or child is None:
        return None
    try:
        place = _numbers(origin, "xyz", (0.0, 0.0, 0.0))
        turn = rigid.quaternions_from_euler(*_numbers(origin, "rpy", (0.0, 0.0, 0.0)))
        along = _numbers(axis, "xyz", (1.0, 0.0, 0.0))
    except ValueError:
        return None
    kind = element.get("type", "")
    return _Joint(
        element.get("name", ""), kind, parent.get("link", ""), child.get("link", ""), place, turn, along
    )


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


def _place_in(base: str, joint: _Joint, joints: Mapping[str, _Joint]) -> tuple[Floats, Floats] | None:
    """Place of a joint and its axis in a frame above it, all joints at zero; None where it is not below."""
    place, turn = joint.place, joint.turn
    frame, seen = joint.parent, {joint.child}
    while frame != base:
        above = joints.get(frame)
        if above is None or frame in seen:
            return None
        seen.add(frame)
        place = above.place + rigid.rotate(above.turn, place)
        turn = rigid.multiply_quaternions(above.turn, turn)
        frame = above.parent
    length = float(np.linalg.norm(joint.axis))
    return place, rigid.rotate(turn, joint.axis) / (length or 1.0)


def _read_radius(link: ET.Element | None) -> float | None:
    """Radius [m] of a wheel's cylinder or sphere, of its collision shape before its looks."""
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
