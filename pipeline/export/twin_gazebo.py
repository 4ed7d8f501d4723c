"""Export to Gazebo: its drive plugins, and the base as a world that moves like the fitted model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from xml.etree import ElementTree as ET

import msgspec

from pipeline.export import Current, Facts, Sheet, Target, list_comments, name_entity, start_sheet
from pipeline.export.twin_body import GRIP, TwinBody, TwinWheel, weigh_chassis, weigh_wheel
from pipeline.export.twin_files import build_twin, format_numbers, list_head, list_notes, write_comment
from pipeline.models import Model
from pipeline.models.effect import Effect
from pipeline.models.model_file import ModelFile
from pipeline.models.parameter import Quantity, TwinRole

_DRIVE_PLUGINS = {
    "differential": ("gz-sim-diff-drive-system", "gz::sim::systems::DiffDrive"),
    "ackermann": ("gz-sim-ackermann-steering-system", "gz::sim::systems::AckermannSteering"),
}


def write_gazebo(file: ModelFile, current: Current) -> str:
    """Write a plugin element without its joints and topics, which only the model's SDF contains.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, sheet = start_sheet(file, GAZEBO, *_DRIVE_PLUGINS)
    sheet.add("plugin.wheel_radius", facts.find_radius())
    if facts.vehicle.kind == "differential":
        note = "for a simulated ground on which the wheels skid as on the real one"
        sheet.add("plugin.wheel_separation", facts.find_track(), note)
    else:
        sheet.add("plugin.wheel_separation", facts.measure("track_width_m"))
        sheet.add("plugin.wheel_base", facts.find_wheelbase())
        sheet.add("plugin.steering_limit", facts.find_largest_steering())
    _add_limits_of_gazebo(facts, sheet)
    return _write_element(facts, sheet)


def _add_limits_of_gazebo(facts: Facts, sheet: Sheet) -> None:
    linear = "linear_" if facts.vehicle.kind == "differential" else ""
    limits = [
        (f"{linear}velocity", facts.find_speed_limit()),
        (f"{linear}acceleration", facts.find_speed_acceleration()),
    ]
    if facts.vehicle.kind == "differential":
        limits += [
            ("angular_velocity", facts.find_turn_limit()),
            ("angular_acceleration", facts.find_turn_acceleration()),
        ]
    for name, limit in limits:
        sheet.add(f"plugin.min_{name}", -limit)
        sheet.add(f"plugin.max_{name}", limit)


def _write_element(facts: Facts, sheet: Sheet) -> str:
    filename, name = _DRIVE_PLUGINS[facts.vehicle.kind]
    plugin = ET.Element("plugin", {"filename": filename, "name": name})
    for line in list_comments(facts, sheet):
        plugin.append(ET.Comment(write_comment(line)))
    for setting in sheet.settings:
        for line in setting.sources:
            plugin.append(ET.Comment(write_comment(line)))
        ET.SubElement(plugin, setting.path.rpartition(".")[2]).text = repr(setting.value)
    ET.indent(plugin)
    return ET.tostring(plugin, encoding="unicode") + "\n"


GAZEBO = Target(
    "gazebo",
    "the drive plugin of a model in Gazebo, without joints and topics",
    "gazebosim/gz-sim 11, src/systems: diff_drive/DiffDrive.hh, ackermann_steering/AckermannSteering.hh",
    write_gazebo,
)

_STEP_S = 0.001
"""Gazebo's default time step [s]."""
_LIMITS = {
    Quantity.SPEED_LIMIT,
    Quantity.TURN_LIMIT,
    Quantity.WHEEL_SPEED_LIMIT,
    Quantity.WHEEL_ACCELERATION_LIMIT,
    Quantity.ACCELERATION_LIMIT,
    Quantity.TURN_ACCELERATION_LIMIT,
}
_OF_GROUND = {Quantity.RADIUS, Quantity.TRACK, Quantity.WHEELBASE}
_BESIDE_PLUGINS = {
    TwinRole.DELAY,
    TwinRole.SPEED_LAG,
    TwinRole.SIDE_LAGS,
    TwinRole.SIDE_GAIN,
    TwinRole.STEERING_LAG,
    TwinRole.STEERING_GAIN,
    TwinRole.STEERING_OFFSET,
}
"""Roles that servos of the body cover and plugins of Gazebo do not: these have only one gain."""
_SYSTEMS = (
    ("gz-sim-physics-system", "gz::sim::systems::Physics"),
    ("gz-sim-user-commands-system", "gz::sim::systems::UserCommands"),
    ("gz-sim-scene-broadcaster-system", "gz::sim::systems::SceneBroadcaster"),
)
_STEER_LIMIT = 1.2
"""Largest steering angle of a car's tyre [rad], above what its plugin commands."""


def write_sdf(file: ModelFile, current: Current) -> str:
    """Write a Gazebo world with the base on a plane, driven by a body command.

    Raises:
        MotionError: ``wrong_vehicle``; ``no_geometry``.
    """
    body = build_twin(file)
    root = ET.Element("sdf", {"version": "1.9"})
    outside = [
        *body.controller,
        *(e for e in file.model.effects if e.twin in _BESIDE_PLUGINS and e not in body.controller),
    ]
    for line in [*list_head(file, SDF), *list_notes(body, filter(None, map(_take_off_limits, outside)))]:
        root.append(ET.Comment(write_comment(line)))
    world = ET.SubElement(root, "world", {"name": "twin"})
    physics = ET.SubElement(world, "physics", {"name": "1ms", "type": "ignored"})
    _add_texts(physics, {"max_step_size": str(_STEP_S), "real_time_factor": "1"})
    for filename, name in _SYSTEMS:
        ET.SubElement(world, "plugin", {"filename": filename, "name": name})
    _add_ground(world)
    _add_model(world, body, file)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _take_off_limits(effect: Effect) -> Effect | None:
    """The effect without the limits that the plugin has; None where nothing else is left."""
    limits = {p.name: p.neutral for p in effect.parameters if _LIMITS.intersection(p.quantities)}
    return effect.change(**limits) if len(limits) < len(effect.parameters) else None


def _add_ground(world: ET.Element) -> None:
    model = ET.SubElement(world, "model", {"name": "ground"})
    _add_texts(model, {"static": "true"})
    link = ET.SubElement(model, "link", {"name": "ground"})
    for kind in ("collision", "visual"):
        part = ET.SubElement(link, kind, {"name": kind})
        plane = ET.SubElement(ET.SubElement(part, "geometry"), "plane")
        _add_texts(plane, {"normal": "0 0 1", "size": "1000 1000"})
        if kind == "collision":
            _add_friction(part, {"mu": str(GRIP), "mu2": str(GRIP)})


def _add_friction(collision: ET.Element, values: Mapping[str, str]) -> None:
    friction = ET.SubElement(ET.SubElement(collision, "surface"), "friction")
    _add_texts(ET.SubElement(friction, "ode"), values)


def _add_texts(element: ET.Element, values: Mapping[str, str]) -> None:
    for name, text in values.items():
        ET.SubElement(element, name).text = text


def _add_model(world: ET.Element, body: TwinBody, file: ModelFile) -> None:
    height = max(wheel.radius_m for wheel in body.wheels)
    model = ET.SubElement(world, "model", {"name": name_entity(body.vehicle)})
    _add_texts(model, {"pose": format_numbers(0.0, 0.0, height, 0.0, 0.0, 0.0)})
    base = ET.SubElement(model, "link", {"name": "base_link"})
    mass, (flat, turning), low = weigh_chassis(body)
    x, y = body.centre_m
    _add_inertial(base, mass, (x, y, low), (flat, flat, turning))
    visual = ET.SubElement(base, "visual", {"name": "base"})
    _add_texts(visual, {"pose": format_numbers(x, y, 0.2 * height, 0.0, 0.0, 0.0)})
    box = ET.SubElement(ET.SubElement(visual, "geometry"), "box")
    size = format_numbers(body.wheelbase_m or body.track_m, 0.8 * body.track_m, 0.8 * height)
    _add_texts(box, {"size": size})
    for number, (ahead, aside) in enumerate(body.castors_m):
        small = 0.2 * height
        castor = ET.SubElement(base, "collision", {"name": f"castor_{number}"})
        _add_texts(castor, {"pose": format_numbers(ahead, aside, small - height, 0.0, 0.0, 0.0)})
        ball = ET.SubElement(ET.SubElement(castor, "geometry"), "sphere")
        _add_texts(ball, {"radius": format_numbers(small)})
        _add_friction(castor, {"mu": "0", "mu2": "0"})
    for wheel in body.wheels:
        _add_wheel(model, wheel, body)
    model.append(_make_plugin(body, file))


def _add_inertial(
    link: ET.Element, mass: float, position: Sequence[float], moments: tuple[float, float, float]
) -> None:
    inertial = ET.SubElement(link, "inertial")
    _add_texts(inertial, {"pose": format_numbers(*position, 0.0, 0.0, 0.0), "mass": format_numbers(mass)})
    inertia = dict(zip(("ixx", "iyy", "izz"), map(format_numbers, moments), strict=True))
    _add_texts(ET.SubElement(inertial, "inertia"), {**inertia, "ixy": "0", "ixz": "0", "iyz": "0"})


def _add_wheel(model: ET.Element, wheel: TwinWheel, body: TwinBody) -> None:
    lift = wheel.radius_m - max(other.radius_m for other in body.wheels)
    position = format_numbers(wheel.x_m, wheel.y_m, lift, 0.0, 0.0, 0.0)
    mass, spin, across = weigh_wheel(wheel, body)
    parent = "base_link"
    if wheel.is_steered:
        # A steered tyre rotates about two axes, each of which needs a link.
        parent = f"{wheel.name}_knuckle"
        knuckle = ET.SubElement(model, "link", {"name": parent})
        _add_texts(knuckle, {"pose": position})
        _add_inertial(knuckle, 0.1 * mass, (0.0, 0.0, 0.0), (across, across, across))
        steer = _add_joint(model, f"{wheel.name}_steer", "base_link", parent, "0 0 1")
        limit = ET.SubElement(steer, "limit")
        _add_texts(limit, {"lower": str(-_STEER_LIMIT), "upper": str(_STEER_LIMIT)})
    link = ET.SubElement(model, "link", {"name": wheel.name})
    _add_texts(link, {"pose": position})
    _add_inertial(link, mass, (0.0, 0.0, 0.0), (across, spin, across))
    upright = format_numbers(0.0, 0.0, 0.0, -0.5 * math.pi, 0.0, 0.0)
    visual = ET.SubElement(link, "visual", {"name": wheel.name})
    _add_texts(visual, {"pose": upright})
    drawn = ET.SubElement(ET.SubElement(visual, "geometry"), "cylinder")
    _add_texts(
        drawn, {"radius": format_numbers(wheel.radius_m), "length": format_numbers(0.5 * wheel.radius_m)}
    )
    # A ball has one contact point, so that the slip of the point is that of the wheel.
    collision = ET.SubElement(link, "collision", {"name": wheel.name})
    _add_texts(collision, {"pose": upright})
    ball = ET.SubElement(ET.SubElement(collision, "geometry"), "sphere")
    _add_texts(ball, {"radius": format_numbers(wheel.radius_m)})
    slip = {
        "slip1": format_numbers(1.0 / wheel.aside_nspm),
        "slip2": format_numbers(1.0 / wheel.along_nspm),
    }
    grip = format_numbers(body.grip)
    _add_friction(collision, {"mu": grip, "mu2": grip, "fdir1": "0 0 1", **slip})
    _add_joint(model, f"{wheel.name}_joint", parent, wheel.name, "0 1 0")


def _add_joint(model: ET.Element, name: str, parent: str, child: str, axis: str) -> ET.Element:
    joint = ET.SubElement(model, "joint", {"name": name, "type": "revolute"})
    _add_texts(joint, {"parent": parent, "child": child})
    element = ET.SubElement(joint, "axis")
    _add_texts(element, {"xyz": axis})
    return element


def _make_plugin(body: TwinBody, file: ModelFile) -> ET.Element:
    """Drive plugin with the geometry of the robot's controller; the contacts represent the rest."""
    vehicle = body.vehicle
    is_car = body.steering is not None
    width = (vehicle.track_width_m or body.track_m) * (1.0 if is_car else vehicle.controller_track_multiplier)
    # A servo with a gain below one is equivalent to a controller with a larger wheel radius.
    gain = sum(servo.gain for servo in body.servos.values()) / len(body.servos)
    controller = msgspec.structs.replace(
        vehicle, wheel_radius_m=vehicle.wheel_radius_m / gain, track_width_m=width
    )
    # Limits are those of the controller: the ground of the world takes its share of the motion itself.
    effects = [
        effect
        for effect in file.model
        if not any(_OF_GROUND & {*parameter.quantities} for parameter in effect.parameters)
    ]
    fit = {key: value for key, value in file.fit.items() if key != "runs"}
    own = replace(file, model=Model(controller, tuple(effects)), fit=fit)
    made = ET.fromstring(write_gazebo(own, {}))  # noqa: S314 - written just now
    plugin = ET.Element("plugin", dict(made.attrib))
    for wheel in body.wheels:
        if not wheel.is_steered or is_car:
            _add_texts(plugin, {f"{wheel.side}_joint": f"{wheel.name}_joint"})
    for wheel in body.wheels:
        if wheel.is_steered:
            _add_texts(plugin, {f"{wheel.side}_steering_joint": f"{wheel.name}_steer"})
    values = {child.tag: str(child.text) for child in made}
    values["wheel_separation"] = format_numbers(width)
    values["wheel_radius"] = format_numbers(controller.wheel_radius_m)
    if is_car:
        values["kingpin_width"] = format_numbers(body.track_m)
    _add_texts(plugin, {**values, "topic": "cmd_vel", "odom_topic": "odom"})
    return plugin


SDF = Target(
    "sdf",
    "the base as a world of Gazebo, to be driven by a body command on the topic cmd_vel",
    "gazebosim/sdformat, sdf/1.9: surface, joint, inertial; gazebosim/gz-sim 11, src/systems: "
    "diff_drive/DiffDrive.hh, ackermann_steering/AckermannSteering.hh",
    write_sdf,
)
