"""Parameters of Autoware, PX4 rovers and VESC nodes, and Gazebo's drive plugins."""

import csv
import io
import math
import operator
from xml.etree import ElementTree as ET

import yaml

from pipeline.export import Current, Target
from pipeline.export.settings import (
    Amount,
    Facts,
    Sheet,
    combine,
    list_comments,
    make_plain,
    start_sheet,
    write_yaml,
)
from pipeline.models.model_file import ModelFile
from pipeline.models.parameter import Quantity
from pipeline.run.recording import MotionError

_ALL = "/**.ros__parameters"
_INFO = "vehicle_info.param.yaml"
_MPC = "mpc_lateral_controller"
_PID = "pid_longitudinal_controller"
_SIMULATOR = "simple_planning_simulator with vehicle_model_type: DELAY_STEER_VEL"


def write_autoware(file: ModelFile, current: Current) -> str:
    """Write the parameters as YAML: one file for all nodes; each reads those that it declares.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, sheet = start_sheet(file, AUTOWARE, "ackermann")
    sheet.add(f"{_ALL}.wheel_radius", facts.find_radius(), _INFO)
    sheet.add(f"{_ALL}.wheel_base", facts.measure("wheelbase_m"), _INFO)
    sheet.add(f"{_ALL}.wheel_tread", facts.measure("track_width_m"), _INFO)
    sheet.add(f"{_ALL}.max_steer_angle", facts.measure("max_steering_rad"), _INFO)
    delay, lag = facts.take(Quantity.COMMAND_DELAY), facts.take(Quantity.STEERING_LAG)
    sheet.add(f"{_ALL}.input_delay", delay, _MPC)
    sheet.add(f"{_ALL}.vehicle_model_steer_tau", lag, f"{_MPC} with vehicle_model_type: kinematics")
    sheet.add(f"{_ALL}.delay_compensation_time", delay, _PID)
    sheet.add(f"{_ALL}.vel_time_delay", delay, _SIMULATOR)
    sheet.add(f"{_ALL}.vel_time_constant", facts.take(Quantity.SPEED_LAG), _SIMULATOR)
    sheet.add(f"{_ALL}.steer_time_delay", delay, _SIMULATOR)
    sheet.add(f"{_ALL}.steer_time_constant", lag, _SIMULATOR)
    sheet.add(f"{_ALL}.vel_lim", facts.find_speed_limit(), _SIMULATOR)
    sheet.add(f"{_ALL}.vel_rate_lim", facts.find_speed_acceleration(), _SIMULATOR)
    _add_offset(facts, sheet)
    return write_yaml(facts, sheet)


def _add_offset(facts: Facts, sheet: Sheet) -> None:
    offset = facts.take(Quantity.STEERING_OFFSET)
    sign = "measured less true angle: what is steered of itself to the left is a negative bias"
    sheet.add(f"{_ALL}.steer_bias", -offset, f"{_SIMULATOR}; {sign}")
    if offset.is_known:
        sheet.head.append(
            f"steer_offset = {offset.value:.5g} rad, true less measured angle as in steer_offset_estimator; "
            "the vehicle interface keeps it in a file of its vendor."
        )


AUTOWARE = Target(
    "autoware",
    "parameters of Autoware's vehicle_info, controllers and planning simulator",
    "autowarefoundation/autoware_universe, README of autoware_simple_planning_simulator and of "
    "autoware_steer_offset_estimator, lateral_controller_defaults.param.yaml; sample_vehicle_launch, "
    "vehicle_info.param.yaml",
    write_autoware,
)


_REAL32 = 9
"""MAV_PARAM_TYPE_REAL32: the type of all these parameters."""

_FULL_SPEED = "RO_MAX_THR_SPEED"


def write_px4(file: ModelFile, current: Current) -> str:
    """Write the parameters with comments, tabs between vehicle, component, name, value and type.

    Args:
        file: a fitted model.
        current: the speed at full throttle used for the log, which the wheel radius corrects.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, sheet = start_sheet(file, PX4, "differential", "ackermann")
    if facts.vehicle.kind == "differential":
        sheet.add("RD_WHEEL_TRACK", facts.measure("track_width_m"))
        sheet.add("RO_YAW_RATE_CORR", facts.take(Quantity.TRACK))
    else:
        sheet.add("RA_WHEEL_BASE", facts.measure("wheelbase_m"))
        sheet.add("RA_MAX_STR_ANG", facts.find_largest_steering())
    sheet.add(_FULL_SPEED, _find_full_speed(facts, current))
    _add_limits(facts, sheet)
    return _write_lines(facts, sheet)


def read_px4(text: str) -> Current:
    """Read the numbers of a QGroundControl parameter file by name.

    Raises:
        MotionError: ``parameters_unreadable``.
    """
    numbers = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            _, _, name, value, _ = line.split()
            numbers[name] = float(value)
        except ValueError:
            what = "is not vehicle, component, name, value and type"
            hint = "Save the parameters in QGroundControl and give that file."
            raise MotionError("parameters_unreadable", what, where=f"--current:{number}", hint=hint) from None
    return numbers


def _find_full_speed(facts: Facts, current: Current) -> Amount:
    wheels = facts.take(Quantity.WHEEL_SPEED_LIMIT).change(operator.mul, facts.find_radius())
    if wheels.is_known or _FULL_SPEED not in current:
        return wheels
    used = Amount(current[_FULL_SPEED], (f"{_FULL_SPEED} = {current[_FULL_SPEED]:g} in use",))
    return combine(operator.mul, facts.take(Quantity.RADIUS), used)


def _add_limits(facts: Facts, sheet: Sheet) -> None:
    acceleration = facts.find_speed_acceleration()
    turn, turning = (
        amount.change(math.degrees) for amount in (facts.find_turn_limit(), facts.find_turn_acceleration())
    )
    sheet.add("RO_SPEED_LIM", facts.find_speed_limit())
    sheet.add("RO_YAW_RATE_LIM", turn, "in deg/s")
    sheet.add("RO_ACCEL_LIM", acceleration)
    sheet.add("RO_DECEL_LIM", acceleration)
    sheet.add("RO_YAW_ACCEL_LIM", turning, "in deg/s^2")
    sheet.add("RO_YAW_DECEL_LIM", turning, "in deg/s^2")


def _write_lines(facts: Facts, sheet: Sheet) -> str:
    text = io.StringIO()
    writer = csv.writer(text, delimiter="\t", lineterminator="\n")
    text.writelines(f"# {line}\n" for line in list_comments(facts, sheet))
    text.write("#\n# Vehicle-Id Component-Id Name Value Type\n")
    for setting in sheet.settings:
        text.writelines(f"# {make_plain(line)}\n" for line in setting.sources)
        writer.writerow([1, 1, setting.path, setting.value, _REAL32])
    return text.getvalue()


PX4 = Target(
    "px4",
    "parameters of a PX4 rover, for QGroundControl",
    "PX4/PX4-Autopilot after 1.16, src/modules/rover_differential and rover_ackermann/module.yaml, "
    "src/lib/rover_control/rovercontrol_params.yaml",
    write_px4,
    corrects=(_FULL_SPEED,),
    read_current=read_px4,
)


_SPEED_GAIN = "speed_to_erpm_gain"
_STEERING_GAIN = "steering_angle_to_servo_gain"
_STEERING_OFFSET = "steering_angle_to_servo_offset"


def write_vesc(file: ModelFile, current: Current) -> str:
    """Write the parameters as YAML: current gains and offset, corrected so that the car follows its commands.

    A car that steers by g u + o and drives k times its speed needs u = (wanted - o) / g and wanted / k.

    Args:
        file: a fitted model.
        current: gains and offset that converted the speeds and angles of the log to ERPM and servo values;
            if missing, those of the vehicle's preset, which were used for reading commands in ERPM.

    Raises:
        MotionError: ``wrong_vehicle``; ``gains_unknown``, neither is there.
    """
    facts, sheet = start_sheet(file, VESC, "ackermann")
    speed, servo, centre = (_find_current(facts, current, name) for name in VESC.corrects)
    radius = facts.take(Quantity.RADIUS)
    gain, offset = facts.take(Quantity.STEERING_GAIN), facts.take(Quantity.STEERING_OFFSET)
    sheet.add(f"{_ALL}.{_SPEED_GAIN}", combine(operator.truediv, speed, radius))
    sheet.add(f"{_ALL}.{_STEERING_GAIN}", combine(operator.truediv, servo, gain))
    straight = combine(lambda c, s, g, o: c - s * o / g, centre, servo, gain, offset)
    sheet.add(f"{_ALL}.{_STEERING_OFFSET}", straight)
    sheet.add("vesc_to_odom_node.ros__parameters.wheelbase", facts.measure("wheelbase_m"))
    limit = facts.find_speed_acceleration()
    sheet.add("throttle_interpolator.ros__parameters.max_acceleration", limit)
    return write_yaml(facts, sheet)


def read_vesc(text: str) -> Current:
    """Read the numbers of a vesc.yaml by name, under any node.

    Raises:
        MotionError: ``parameters_unreadable``.
    """
    try:
        tree = yaml.safe_load(text)
    except yaml.YAMLError as error:
        what = f"is not YAML: {' '.join(str(error).split())}"
        hint = "Give the vesc.yaml that the car was driven with."
        raise MotionError("parameters_unreadable", what, where="--current", hint=hint) from None
    numbers: dict[str, float] = {}
    groups = [tree]
    while groups:
        group = groups.pop()
        for name, value in group.items() if isinstance(group, dict) else ():
            if isinstance(value, int | float) and not isinstance(value, bool):
                numbers[str(name)] = float(value)
            groups.append(value)
    return numbers


def _find_current(facts: Facts, current: Current, name: str) -> Amount:
    if name in current:
        return Amount(current[name], (f"{name} = {current[name]:g} in use",))
    unit = "erpm" if name == _SPEED_GAIN else "servo"
    part = "offset" if name == _STEERING_OFFSET else "per"
    if unit not in facts.vehicle.units:
        what = f"{name} with which the log was driven is not known"
        hint = "Give the car's file: --current vesc.yaml."
        raise MotionError("gains_unknown", what, where=facts.vehicle.id, hint=hint)
    value = float(getattr(facts.vehicle.units[unit], part))
    return Amount(value, (f"{name} = {value:g} of the preset {facts.vehicle.id}; others in use: --current",))


VESC = Target(
    "vesc",
    "gains and offsets of vesc.yaml",
    "f1tenth/vesc, vesc_ackermann/src/ackermann_to_vesc.cpp (erpm = gain * speed + offset, servo likewise); "
    "f1tenth/f1tenth_system, f1tenth_stack/config/vesc.yaml",
    write_vesc,
    corrects=(_SPEED_GAIN, _STEERING_GAIN, _STEERING_OFFSET),
    read_current=read_vesc,
)


_SYSTEMS = {
    "differential": ("gz-sim-diff-drive-system", "gz::sim::systems::DiffDrive"),
    "ackermann": ("gz-sim-ackermann-steering-system", "gz::sim::systems::AckermannSteering"),
}


def write_gazebo(file: ModelFile, current: Current) -> str:
    """Write a plugin element without its joints and topics, which only the model's SDF contains.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, sheet = start_sheet(file, GAZEBO, *_SYSTEMS)
    sheet.add("plugin.wheel_radius", facts.find_radius())
    if facts.vehicle.kind == "differential":
        note = "for a simulated ground on which the wheels skid as on the real one"
        sheet.add("plugin.wheel_separation", facts.find_track(), note)
    else:
        sheet.add("plugin.wheel_separation", facts.measure("track_width_m"))
        sheet.add("plugin.wheel_base", facts.measure("wheelbase_m"))
        angle = facts.measure("max_steering_rad").change(operator.mul, facts.take(Quantity.STEERING_GAIN))
        sheet.add("plugin.steering_limit", angle)
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
    """Format a comment; XML does not allow two adjacent dashes in it."""
    return f" {'- -'.join(make_plain(text).split('--'))} "


GAZEBO = Target(
    "gazebo",
    "the drive plugin of a model in Gazebo, without joints and topics",
    "gazebosim/gz-sim 11, src/systems: diff_drive/DiffDrive.hh, ackermann_steering/AckermannSteering.hh",
    write_gazebo,
)
