"""Gazebo's drive plugins, as an element for the model's SDF."""

import operator
from xml.etree import ElementTree as ET

from pipeline.export.settings import Facts, Sheet, start_sheet
from pipeline.export.settings_text import list_comments, make_plain
from pipeline.export.target import Current, Target
from pipeline.models.model_file import ModelFile
from pipeline.models.quantity import Quantity

_SYSTEMS = {
    "differential": ("gz-sim-diff-drive-system", "gz::sim::systems::DiffDrive"),
    "ackermann": ("gz-sim-ackermann-steering-system", "gz::sim::systems::AckermannSteering"),
}


def write(file: ModelFile, current: Current) -> str:
    """A plugin element without its joints and topics, which only the model's SDF knows.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, sheet = start_sheet(file, TARGET, *_SYSTEMS)
    sheet.add("plugin.wheel_radius", facts.find_radius())
    if facts.vehicle.kind == "differential":
        note = "for a simulated ground on which the wheels skid as on the real one"
        sheet.add("plugin.wheel_separation", facts.find_track(), note)
    else:
        sheet.add("plugin.wheel_separation", facts.measure("track_width_m"))
        sheet.add("plugin.wheel_base", facts.measure("wheelbase_m"))
        angle = facts.measure("max_steering_rad").change(operator.mul, facts.take(Quantity.STEERING_GAIN))
        sheet.add("plugin.steering_limit", angle)
    _add_limits(facts, sheet)
    return _write_element(facts, sheet)


def _add_limits(facts: Facts, sheet: Sheet) -> None:
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
    filename, name = _SYSTEMS[facts.vehicle.kind]
    plugin = ET.Element("plugin", {"filename": filename, "name": name})
    for line in list_comments(facts, sheet):
        plugin.append(ET.Comment(_make_comment(line)))
    for setting in sheet.settings:
        for line in setting.sources:
            plugin.append(ET.Comment(_make_comment(line)))
        ET.SubElement(plugin, setting.path.rpartition(".")[2]).text = repr(setting.value)
    ET.indent(plugin)
    return ET.tostring(plugin, encoding="unicode") + "\n"


def _make_comment(text: str) -> str:
    """The text of a comment, in which XML allows no two dashes beside each other."""
    return f" {'- -'.join(make_plain(text).split('--'))} "


TARGET = Target(
    "gazebo",
    "the drive plugin of a model in Gazebo, without joints and topics",
    "gazebosim/gz-sim 11, src/systems: diff_drive/DiffDrive.hh, ackermann_steering/AckermannSteering.hh",
    write,
)
