"""Export to Gazebo: its drive plugins with the parameters of the fitted model."""

from xml.etree import ElementTree as ET

from pipeline.core import make_plain
from pipeline.export import Current, Facts, ParameterTable, Target, list_comments, start_table
from pipeline.models import ModelFile

_DRIVE_PLUGINS = {
    "differential": ("gz-sim-diff-drive-system", "gz::sim::systems::DiffDrive"),
    "ackermann": ("gz-sim-ackermann-steering-system", "gz::sim::systems::AckermannSteering"),
}


def write_gazebo(file: ModelFile, current: Current) -> str:
    """Write a plugin element without its joints and topics, which only the model's SDF contains.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, table = start_table(file, GAZEBO, *_DRIVE_PLUGINS)
    table.add("plugin.wheel_radius", facts.find_radius())
    if facts.vehicle.kind == "differential":
        note = "for a simulated ground on which the wheels skid as on the real one"
        table.add("plugin.wheel_separation", facts.find_track(), note)
    else:
        table.add("plugin.wheel_separation", facts.measure("track_width_m"))
        table.add("plugin.wheel_base", facts.find_wheelbase())
        table.add("plugin.steering_limit", facts.find_largest_steering())
    _add_limits_of_gazebo(facts, table)
    return _write_element(facts, table)


def _add_limits_of_gazebo(facts: Facts, table: ParameterTable) -> None:
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
        table.add(f"plugin.min_{name}", -limit)
        table.add(f"plugin.max_{name}", limit)


def _write_element(facts: Facts, table: ParameterTable) -> str:
    filename, name = _DRIVE_PLUGINS[facts.vehicle.kind]
    plugin = ET.Element("plugin", {"filename": filename, "name": name})
    for line in list_comments(facts, table):
        plugin.append(ET.Comment(_write_comment(line)))
    for setting in table.settings:
        for line in setting.sources:
            plugin.append(ET.Comment(_write_comment(line)))
        ET.SubElement(plugin, setting.path.rpartition(".")[2]).text = repr(setting.value)
    ET.indent(plugin)
    return ET.tostring(plugin, encoding="unicode") + "\n"


_DASHES = r"-\x2d"


def _write_comment(text: str) -> str:
    """Format a comment; XML allows no two adjacent dashes in it, so the second is written as in a literal."""
    return f" {make_plain(text).replace('--', _DASHES)} "


GAZEBO = Target(
    "gazebo",
    "the drive plugin of a model in Gazebo, without joints and topics",
    "gazebosim/gz-sim 11, src/systems: diff_drive/DiffDrive.hh, ackermann_steering/AckermannSteering.hh",
    write_gazebo,
)
