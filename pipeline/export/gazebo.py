"""Export to Gazebo: its drive plugins with the parameters of the fitted model."""

from xml.etree import ElementTree as ET

from pipeline.core import make_plain
from pipeline.export import Facts, ParameterTable, Row, Target, list_comments

_DRIVE_PLUGINS = {
    "differential": ("gz-sim-diff-drive-system", "gz::sim::systems::DiffDrive"),
    "ackermann": ("gz-sim-ackermann-steering-system", "gz::sim::systems::AckermannSteering"),
}


def _write_element(facts: Facts, table: ParameterTable) -> str:
    filename, name = _DRIVE_PLUGINS[facts.vehicle.kind]
    plugin = ET.Element("plugin", {"filename": filename, "name": name})
    for line in list_comments(facts, table):
        plugin.append(ET.Comment(_write_comment(line)))
    for setting in table.settings:
        for line in setting.sources:
            plugin.append(ET.Comment(_write_comment(line)))
        element = ET.Element(setting.path.rpartition(".")[2])
        element.text = repr(setting.value)
        commented = ET.Comment(f" {ET.tostring(element, encoding='unicode')} ")
        plugin.append(commented if setting.is_doubtful else element)
    ET.indent(plugin)
    return ET.tostring(plugin, encoding="unicode") + "\n"


_DASHES = r"-\x2d"


def _write_comment(text: str) -> str:
    """Format a comment; XML allows no two adjacent dashes in it, so the second is written as in a literal."""
    return f" {make_plain(text).replace('--', _DASHES)} "


_ROBOT, _CAR = ("differential",), ("ackermann",)
GAZEBO = Target(
    "gazebo",
    "the drive plugin of a model in Gazebo, without joints and topics",
    "gazebosim/gz-sim 11, src/systems: diff_drive/DiffDrive.hh, ackermann_steering/AckermannSteering.hh",
    tuple(_DRIVE_PLUGINS),
    (
        Row("plugin.wheel_radius", "radius"),
        Row(
            "plugin.wheel_separation",
            "track",
            "for a simulated ground on which the wheels skid as on the real one",
            _ROBOT,
        ),
        Row("plugin.wheel_separation", "track_width_m", "", _CAR),
        Row("plugin.wheel_base", "wheelbase", "", _CAR),
        Row("plugin.steering_limit", "largest_steering", "", _CAR),
        *(
            Row(f"plugin.{bound}_{name}", f"{sign}{value}", "", kinds)
            for name, value, kinds in (
                ("linear_velocity", "speed_limit", _ROBOT),
                ("velocity", "speed_limit", _CAR),
                ("linear_acceleration", "speed_acceleration", _ROBOT),
                ("acceleration", "speed_acceleration", _CAR),
                ("angular_velocity", "turn_limit", _ROBOT),
                ("angular_acceleration", "turn_acceleration", _ROBOT),
            )
            for bound, sign in (("min", "-"), ("max", ""))
        ),
    ),
    write=_write_element,
)
