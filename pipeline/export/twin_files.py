"""Export of the base as a MuJoCo world that moves like the fitted model."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from xml.etree import ElementTree as ET

import numpy as np

from pipeline.core import make_plain
from pipeline.core.arrays import Floats
from pipeline.export import (
    DRIVEN_SPEED,
    Current,
    Facts,
    Target,
    name_entity,
    quote_name,
    require_plausible,
)
from pipeline.export.twin_body import (
    GRIP,
    TwinBody,
    TwinServo,
    TwinWheel,
    build_twin_body,
    weigh_chassis,
    weigh_wheel,
)
from pipeline.models.effect import Effect
from pipeline.models.model_file import ModelFile

STEP_S = 0.002
"""Time step of MuJoCo [s]: with 5 ms, wheels with so little creep leave the ground after a hard step."""
_REFERENCE_S = 2.0 * STEP_S
"""Time constant of constraints [s]: the shortest that MuJoCo allows at this step."""
_IMPEDANCE = 0.9
"""Impedance of the stiffest contact, MuJoCo's own default."""
_DAMPING_HZ = 2.0 / (_IMPEDANCE * _REFERENCE_S)
"""Damping rate of a contact along the ground, by MuJoCo's definition of solref [1/s]."""
_HALF_WIDTH = 0.02
"""Half the distance of a wheel's two contacts, relative to its radius."""
_CONTACTS = 2
"""Number of ground contacts of a capsule."""
_ARMATURE = 2.5
"""Motor inertia at its wheel, relative to the vehicle's mass times the wheel's radius squared. At this value
a servo can be stiff against creep, although MuJoCo's contacts ignore it within a step."""
_FREE = 0.01
"""The same for a wheel without its own motor."""
_SERVO_STEPS = 2.0
"""Time constant of a wheel's servo in time steps: the contact solver treats its torque as constant."""
_HOLD_HZ = 20.0
"""Natural frequency of the steering servo [Hz], far above that of any steering."""
_UNEVEN = 1.05
"""Ratio of friction coefficients above which the file says so: as well as a coefficient is known."""
_DRAWN_STEERING = 64
_BEND = 4
"""Degree of the steering polynomials of a car's tyres, MuJoCo's maximum."""


def write_mjcf(file: ModelFile, current: Current) -> str:
    """Write a MuJoCo world with the base on a plane.

    Raises:
        MotionError: ``wrong_vehicle``; ``no_geometry``.
    """
    return write_world(build_twin(file), list_head(file, MJCF))


def build_twin(file: ModelFile) -> TwinBody:
    """Build the body of a model file's vehicle, whose geometry must be its own.

    Raises:
        MotionError: ``wrong_vehicle``; ``no_geometry``; ``absurd_number``.
    """
    return build_twin_body(file.model, find_driven_speed(file))


def find_driven_speed(file: ModelFile) -> float:
    """Driven speed of the runs of a fit [m/s], otherwise half of the vehicle's maximum."""
    rows = file.list_fitted("runs")
    driven = [value for row in rows if isinstance(value := row.get(DRIVEN_SPEED), float)]
    return max(driven) if driven else 0.5 * (file.model.vehicle.max_speed_mps or 2.0)


def write_world(body: TwinBody, head: Sequence[str] = ()) -> str:
    """MJCF of a twin's body.

    Args:
        body: the body.
        head: lines of the comment above it.
    """
    root = ET.Element("mujoco", {"model": name_entity(body.vehicle)})
    for line in [*head, *list_notes(body, body.controller), *_note_friction(body)]:
        root.append(ET.Comment(write_comment(line)))
    ET.SubElement(root, "compiler", {"angle": "radian", "autolimits": "true"})
    ease = _ease_contacts(body)
    ET.SubElement(
        root,
        "option",
        {
            "timestep": f"{STEP_S}",
            "cone": "elliptic",
            "integrator": "implicitfast",
            "impratio": format_numbers(ease),
        },
    )
    _add_bodies(root, body)
    _add_contacts(root, body, ease)
    _add_servos(root, body)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _add_bodies(root: ET.Element, body: TwinBody) -> None:
    world = ET.SubElement(root, "worldbody")
    ET.SubElement(world, "light", {"pos": "0 0 10"})
    ET.SubElement(world, "geom", {"name": "ground", "type": "plane", "size": "0 0 1", **_ALONE})
    height = max(wheel.radius_m for wheel in body.wheels)
    base = ET.SubElement(world, "body", {"name": "base_link", "pos": f"0 0 {format_numbers(height)}"})
    ET.SubElement(base, "freejoint", {"name": "base"})
    ET.SubElement(base, "site", {"name": "base_link"})
    mass, inertia, low = weigh_chassis(body)
    (x, y), flat = body.centre_m, format_numbers(inertia[0])
    ET.SubElement(
        base,
        "inertial",
        {
            "pos": format_numbers(x, y, low),
            "mass": format_numbers(mass),
            "diaginertia": f"{flat} {flat} {format_numbers(inertia[1])}",
        },
    )
    long = 0.5 * (body.wheelbase_m or body.track_m)
    size = format_numbers(long, 0.4 * body.track_m, 0.4 * height)
    ET.SubElement(
        base, "geom", {"type": "box", "size": size, "pos": format_numbers(x, y, 0.2 * height), **_SHOWN}
    )
    for wheel in body.wheels:
        _add_wheel(base, wheel, body)
    for number, castor in enumerate(body.castors_m):
        small = 0.2 * height
        position, radius = format_numbers(*castor, small - height), format_numbers(small)
        ET.SubElement(
            base,
            "geom",
            {
                "name": f"castor_{number}",
                "size": radius,
                "pos": position,
                "mass": "0",
                **_ALONE,
            },
        )
    if body.steering is not None:
        column = ET.SubElement(base, "body", {"name": "steering_column", "pos": format_numbers(x, y, height)})
        weight = format_numbers(1e-3 * body.mass_kg)
        ET.SubElement(
            column,
            "joint",
            {"name": "steering", "axis": "0 0 1", "armature": format_numbers(_steer_kgm2(body))},
        )
        ET.SubElement(column, "geom", {"type": "sphere", "size": "0.02", "mass": weight, **_ALONE})
        shaft = ET.SubElement(base, "body", {"name": "drive_shaft", "pos": format_numbers(x, y, height)})
        armature = format_numbers(_weigh_shaft(body))
        ET.SubElement(shaft, "joint", {"name": "drive", "axis": "0 1 0", "armature": armature})
        ET.SubElement(shaft, "geom", {"type": "sphere", "size": "0.02", "mass": weight, **_ALONE})


_ALONE = {"contype": "0", "conaffinity": "0"}
_SHOWN = {"mass": "0", "rgba": "0.4 0.5 0.6 0.5", **_ALONE}


def _add_wheel(base: ET.Element, wheel: TwinWheel, body: TwinBody) -> None:
    lift = wheel.radius_m - max(other.radius_m for other in body.wheels)
    position = format_numbers(wheel.x_m, wheel.y_m, lift)
    made = ET.SubElement(base, "body", {"name": wheel.name, "pos": position})
    mass, spin, across = weigh_wheel(wheel, body)
    inertia = f"{format_numbers(across)} {format_numbers(spin)} {format_numbers(across)}"
    ET.SubElement(made, "inertial", {"pos": "0 0 0", "mass": format_numbers(mass), "diaginertia": inertia})
    if wheel.is_steered:
        armature = format_numbers(_steer_kgm2(body))
        ET.SubElement(made, "joint", {"name": f"{wheel.name}_steer", "axis": "0 0 1", "armature": armature})
    joint = {"name": wheel.name, "axis": "0 1 0", "armature": format_numbers(_find_armature(wheel, body))}
    ET.SubElement(made, "joint", joint)
    size = format_numbers(wheel.radius_m, _HALF_WIDTH * wheel.radius_m)
    upright = {"type": "capsule", "euler": format_numbers(0.5 * math.pi, 0.0, 0.0)}
    ET.SubElement(made, "geom", {"name": wheel.name, "size": size, **upright, **_ALONE})


def _find_armature(wheel: TwinWheel, body: TwinBody) -> float:
    """Inertia of the motor at a wheel; a car has one motor at its shaft."""
    return (_ARMATURE if body.steering is None else _FREE) * body.mass_kg * wheel.radius_m**2


def _weigh_shaft(body: TwinBody) -> float:
    """Inertia of a car's motor, referred to its wheels [kg m^2]."""
    driven = [wheel for wheel in body.wheels if wheel.is_driven]
    return _ARMATURE * body.mass_kg * sum(wheel.radius_m**2 for wheel in driven)


def _stiffen(wheel: TwinWheel, body: TwinBody) -> float:
    """Gain of a wheel's servo: torque over speed error [N m s]."""
    if body.steering is not None:
        return _weigh_shaft(body) / (2.0 * _SERVO_STEPS * STEP_S)
    _, spin, _ = weigh_wheel(wheel, body)
    return (spin + _find_armature(wheel, body)) / (_SERVO_STEPS * STEP_S)


def _steer_kgm2(body: TwinBody) -> float:
    return 1e-3 * body.turning_inertia_kgm2


def _ease_contacts(body: TwinBody) -> float:
    """MuJoCo's impratio for the stiffest contact: ratio of stiffness along the ground and normal to it."""
    return min(
        (1.0 - _IMPEDANCE) / _IMPEDANCE * weight * _soften(wheel.aside_nspm, body) / _CONTACTS / _DAMPING_HZ
        for wheel, weight in zip(body.wheels, _find_mobilities(body), strict=True)
    )


def _soften(coefficient: float, body: TwinBody) -> float:
    """Contact coefficient that includes the time constant of MuJoCo's own constraint [N s/m]."""
    total = body.mass_kg
    share = coefficient / total
    return total * share / (1.0 - min(share * len(body.wheels) / _DAMPING_HZ, 0.5))


def _add_contacts(root: ET.Element, body: TwinBody, ease: float) -> None:
    contact = ET.SubElement(root, "contact")
    for wheel, weight in zip(body.wheels, _find_mobilities(body), strict=True):
        aside, along = _soften(wheel.aside_nspm, body), wheel.along_nspm
        if wheel.is_driven:
            # The compliance of the servo is part of the creep.
            along = _soften(1.0 / (1.0 / along - wheel.radius_m**2 / _stiffen(wheel, body)), body)
        # The regularizer of MuJoCo along the axle is (1 - d) / d times mobility over impratio.
        give = _DAMPING_HZ * ease * _CONTACTS / (aside * weight)
        impedance = 1.0 / (1.0 + give)
        anisotropy = math.sqrt(along / aside)
        ET.SubElement(
            contact,
            "pair",
            {
                "geom1": "ground",
                "geom2": wheel.name,
                "condim": "3",
                "friction": f"{format_numbers(body.grip, body.grip * anisotropy)} 0.005 0.0001 0.0001",
                "solref": f"{_REFERENCE_S} 1",
                "solreffriction": f"{format_numbers(2.0 / (impedance * _DAMPING_HZ))} 1",
                "solimp": f"{format_numbers(impedance)} {format_numbers(impedance)} 0.001",
            },
        )
    for number in range(len(body.castors_m)):
        ET.SubElement(contact, "pair", {"geom1": "ground", "geom2": f"castor_{number}", "condim": "1"})


def _find_mobilities(body: TwinBody) -> list[float]:
    """Mean inverse mass at the centre of each wheel [1/kg], as MuJoCo computes it when loading the file."""
    mass, (flat, turning), low = weigh_chassis(body)
    height = max(wheel.radius_m for wheel in body.wheels)
    x, y = body.centre_m
    parts = [(mass, np.array([x, y, low]), np.array([flat, flat, turning]), np.zeros(3))]
    for wheel in body.wheels:
        weight, spin, across = weigh_wheel(wheel, body)
        free = np.array([0.0, spin**2 / (spin + _find_armature(wheel, body)), 0.0])
        if wheel.is_steered:
            free[2] = across**2 / (across + _steer_kgm2(body))
        position = np.array([wheel.x_m, wheel.y_m, wheel.radius_m - height])
        parts.append((weight, position, np.array([across, spin, across]), free))
    if body.steering is not None:
        parts += [(1e-3 * body.mass_kg, np.array([x, y, height]), np.zeros(3), np.zeros(3))] * 2
    total = sum(weight for weight, *_ in parts)
    centre = sum((weight * position for weight, position, *_ in parts), np.zeros(3)) / total
    inertia = np.zeros((3, 3))
    for weight, position, own, free in parts:
        arm = _cross(position - centre)
        inertia += np.diag(own - free) - weight * arm @ arm
    inverse = np.linalg.inv(inertia)
    mobilities = []
    for wheel in body.wheels:
        arm = _cross(np.array([wheel.x_m, wheel.y_m, wheel.radius_m - height]) - centre)
        mobilities.append(1.0 / total - float(np.trace(arm @ inverse @ arm)) / 3.0)
    return mobilities


def _cross(vector: Floats) -> Floats:
    """Matrix of the cross product with a vector."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _add_servos(root: ET.Element, body: TwinBody) -> None:
    if body.steering is not None:
        tendons = ET.SubElement(root, "tendon")
        driven = {wheel.name for wheel in body.wheels if wheel.is_driven}
        for name, joints in {"differential": driven, "shaft": {"drive"}}.items():
            tendon = ET.SubElement(tendons, "fixed", {"name": name})
            for joint in sorted(joints):
                ET.SubElement(tendon, "joint", {"joint": joint, "coef": format_numbers(1.0 / len(joints))})
        equality = ET.SubElement(root, "equality")
        hold = {"solref": f"{_REFERENCE_S} 1", "solimp": "0.99 0.99 0.001"}
        ET.SubElement(equality, "tendon", {"tendon1": "differential", "tendon2": "shaft", **hold})
        for wheel in body.wheels:
            if wheel.is_steered:
                bend = format_numbers(*_fit_steering(body, wheel))
                names = {"joint1": f"{wheel.name}_steer", "joint2": "steering"}
                ET.SubElement(equality, "joint", {**names, "polycoef": bend, **hold})
    actuators = ET.SubElement(root, "actuator")
    if body.steering is None:
        for wheel in body.wheels:
            stiff = _stiffen(wheel, body)
            servo = body.servos[wheel.side]
            ET.SubElement(actuators, "general", _write_servo({"joint": wheel.name}, servo, stiff, body))
        return
    stiff = _weigh_shaft(body) / (_SERVO_STEPS * STEP_S)
    drive = _write_servo({"joint": "drive"}, body.servos["left"], stiff, body)
    ET.SubElement(actuators, "general", drive)
    inertia = 3.0 * _steer_kgm2(body)
    rate = 2.0 * math.pi * _HOLD_HZ
    stiff, damp = inertia * rate**2, 2.0 * inertia * rate
    ET.SubElement(
        actuators,
        "general",
        {
            "name": "steering",
            "joint": "steering",
            **_write_delay(body.delay_s),
            **_write_lag(body.steering.lag_s),
            "gainprm": format_numbers(stiff * body.steering.gain),
            "biastype": "affine",
            "biasprm": format_numbers(stiff * body.steering.offset, -stiff, -damp),
        },
    )


def _fit_steering(body: TwinBody, wheel: TwinWheel) -> list[float]:
    """Polynomial from the column angle to that of a tyre, so that all tyres roll about one point."""
    most = body.vehicle.max_steering_rad or 0.6
    column = np.linspace(-most, most, _DRAWN_STEERING)
    aside = wheel.y_m - body.centre_m[1]
    across = body.wheelbase_m - aside * np.tan(column)
    tyre = np.arctan(body.wheelbase_m * np.tan(column) / across)
    powers = np.stack([column**power for power in range(1, _BEND + 1)], axis=1)
    coefficients = np.linalg.lstsq(powers, tyre, rcond=None)[0]
    return [0.0, *coefficients.tolist()]


def _write_servo(of: dict[str, str], servo: TwinServo, stiff: float, body: TwinBody) -> dict[str, str]:
    limit = body.wheel_limit_radps
    limits = {"ctrlrange": format_numbers(-limit, limit)} if math.isfinite(limit) else {}
    return {
        "name": next(iter(of.values())),
        **of,
        **limits,
        **_write_delay(body.delay_s),
        **_write_lag(servo.lag_s),
        "gainprm": format_numbers(stiff * servo.gain),
        "biastype": "affine",
        "biasprm": format_numbers(0.0, 0.0, -stiff),
    }


def _write_delay(delay_s: float) -> dict[str, str]:
    steps = round(delay_s / STEP_S)
    return {"delay": format_numbers(steps * STEP_S), "nsample": f"{steps + 1}"} if steps else {}


def _write_lag(lag_s: float) -> dict[str, str]:
    return {"dyntype": "filterexact", "dynprm": format_numbers(lag_s)} if lag_s > 0.0 else {}


def list_head(file: ModelFile, target: Target) -> list[str]:
    """Head of a twin's file: vehicle, source of its names, and data of the fit."""
    fitted = Facts(file).format_fit()
    head = [f"{quote_name(file.model.vehicle.name)}: {target.about}.", f"Names: {target.source}."]
    return [*head, fitted] if fitted else head


def _note_friction(body: TwinBody) -> list[str]:
    """A line where wheels slide later lengthwise than sideways: MuJoCo has one ratio for creep and grip."""
    ratio = max(math.sqrt(wheel.along_nspm / wheel.aside_nspm) for wheel in body.wheels)
    if body.grip >= GRIP or ratio < _UNEVEN:
        return []
    return [f"Lengthwise they slide above {ratio * body.grip:.2g}: in MuJoCo friction is as uneven as creep."]


def list_notes(body: TwinBody, outside: Iterable[Effect]) -> list[str]:
    """Lines on the contents of a twin's file, and on what it does not contain.

    Args:
        body: the twin's body.
        outside: effects between command and wheels that the file has no element for.
    """
    lines = []
    if body.creep_s > 0.0:
        late = f"the body follows them with a time constant of {body.creep_s:.2g} s"
        lines.append(f"Its wheels creep: {late}, by which lags of the drive must be less.")
    if body.grip < GRIP:
        lines.append(f"Its wheels slide above a friction coefficient of {body.grip:.2g}.")
    lines += [f"Assumed: {note}." for note in body.notes]
    lines += _list_effects("Not in the file, left to your controller:", outside)
    lines += _list_effects("Of the localization, which no body has:", body.reported)
    return lines + _list_effects("Not reproduced by the contact of wheels:", body.missing)


def _list_effects(title: str, effects: Iterable[Effect]) -> list[str]:
    texts = [repr(effect) for effect in effects]
    return [f"{title} {', '.join(texts)}."] if texts else []


def format_numbers(*numbers: float) -> str:
    """Format numbers as an XML attribute.

    Raises:
        MotionError: ``absurd_number``.
    """
    require_plausible("a dimension or a coefficient of the twin", *numbers)
    return " ".join(f"{number:.6g}" for number in numbers)


_DASHES = r"-\x2d"


def write_comment(text: str) -> str:
    """Format a comment; XML allows no two adjacent dashes in it, so the second is written as in a literal."""
    return f" {make_plain(text).replace('--', _DASHES)} "


MJCF = Target(
    "mjcf",
    "the base as a world of MuJoCo, to be driven by wheel speeds",
    "google-deepmind/mujoco 4.0, XML reference: option, pair, tendon, equality, actuator general",
    write_mjcf,
)
