"""Parameters of controllers: Nav2, ros2_control's wheeled ones, Autoware, PX4 rovers and VESC nodes."""

import csv
import io
import math
import operator
import re

import yaml

from pipeline.core import make_plain
from pipeline.export import (
    DRIVEN_SPEED,
    DRIVEN_TURN,
    LOWER_SPEED,
    Amount,
    Current,
    Facts,
    ParameterTable,
    Setting,
    Target,
    combine,
    list_comments,
    name_entity,
    quote_name,
    start_table,
    write_yaml,
)
from pipeline.export.simulator import describe_spread
from pipeline.models import ModelFile, Quantity
from pipeline.run import MotionError

_CONTROLLER = "controller_server.ros__parameters.FollowPath"
_SMOOTHER = "velocity_smoother.ros__parameters"
_DELAY = "MPPI: the sum of dead times and time constants, the delay behind a smooth command"


def write_nav2(file: ModelFile, current: Current) -> str:
    """Write the parameters as YAML; rename the group if the plugin is not called FollowPath.

    Limits are the largest that were reached: smaller ones that are set on purpose remain valid. A vehicle
    that moves sideways gets delays only: its limits depend on the direction, which these parameters do not.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, table = start_table(file, NAV2, "differential", "ackermann", "mecanum", "omni")
    moves_sideways = facts.vehicle.kinematics.has_inputs("sideways")
    table.add(f"{_CONTROLLER}.model_delay_vx", facts.find_speed_delay(), _DELAY)
    if moves_sideways:
        table.add(f"{_CONTROLLER}.model_delay_vy", facts.find_speed_delay(), _DELAY)
    table.add(f"{_CONTROLLER}.model_delay_wz", facts.find_turn_delay(), _DELAY)
    if not moves_sideways:
        _add_limits_of_nav2(facts, table)
    if facts.vehicle.kind == "ackermann":
        key = f"{_CONTROLLER}.ackermann.min_turning_r"
        table.add(key, facts.find_turning_radius(), "MPPI with motion_model: ackermann")
    return write_yaml(facts, table)


def _add_limits_of_nav2(facts: Facts, table: ParameterTable) -> None:
    speed, turn = facts.find_speed_limit(), facts.find_turn_limit()
    acceleration, turning = facts.find_speed_acceleration(), facts.find_turn_acceleration()
    table.add(f"{_CONTROLLER}.vx_max", speed, "MPPI")
    table.add(f"{_CONTROLLER}.vx_min", -speed, "MPPI")
    table.add(f"{_CONTROLLER}.wz_max", turn, "MPPI")
    table.add(f"{_CONTROLLER}.ax_max", acceleration, "MPPI")
    table.add(f"{_CONTROLLER}.ax_min", -acceleration, "MPPI")
    table.add(f"{_CONTROLLER}.az_max", turning, "MPPI")
    table.add_row(
        f"{_CONTROLLER}.VelocityDeadbandCritic.deadband_velocities",
        (facts.find_deadband()[0], 0.0, facts.find_deadband()[1]),
        "MPPI with VelocityDeadbandCritic among its critics",
    )
    pursuit = "regulated pure pursuit"
    table.add(f"{_CONTROLLER}.max_linear_vel", speed, f"{pursuit}; desired_linear_vel up to Kilted")
    table.add(f"{_CONTROLLER}.min_linear_vel", -speed, pursuit)
    table.add(f"{_CONTROLLER}.max_angular_vel", turn, pursuit)
    table.add(f"{_CONTROLLER}.min_angular_vel", -turn, pursuit)
    table.add(f"{_CONTROLLER}.max_linear_accel", acceleration, pursuit)
    table.add(f"{_CONTROLLER}.max_linear_decel", -acceleration, pursuit)
    table.add(f"{_CONTROLLER}.max_angular_accel", turning, pursuit)
    table.add(f"{_CONTROLLER}.max_angular_decel", -turning, pursuit)
    # The smoother needs a limit for every axis or for none.
    table.add_row(f"{_SMOOTHER}.max_velocity", (speed, 0.0, turn))
    table.add_row(f"{_SMOOTHER}.min_velocity", (-speed, 0.0, -turn))
    table.add_row(f"{_SMOOTHER}.max_accel", (acceleration, 0.0, turning))
    table.add_row(f"{_SMOOTHER}.max_decel", (-acceleration, 0.0, -turning))


NAV2 = Target(
    "nav2",
    "parameters of Nav2's MPPI, regulated pure pursuit and velocity smoother",
    "ros-navigation/navigation2 1.5 (Lyrical), parameters declared by nav2_mppi_controller, "
    "nav2_regulated_pure_pursuit_controller and nav2_velocity_smoother",
    write_nav2,
)


def write_ros2_control(file: ModelFile, current: Current) -> str:
    """Write the parameters as YAML; they replace those of the controller.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, table = start_table(file, ROS2_CONTROL, "differential", "ackermann")
    if facts.vehicle.kind == "differential":
        _add_differential(facts, table)
    else:
        _add_ackermann(facts, table)
    return write_yaml(facts, table)


def _add_differential(facts: Facts, table: ParameterTable) -> None:
    node = "diff_drive_controller.ros__parameters"
    radius, difference = facts.take(Quantity.RADIUS), facts.take(Quantity.RADIUS_DIFFERENCE)
    table.add(f"{node}.wheel_separation", facts.measure("track_width_m"))
    table.add(f"{node}.wheel_radius", facts.measure("wheel_radius_m"))
    track = facts.take(Quantity.TRACK)
    table.add(f"{node}.wheel_separation_multiplier", track, "replaces the present multiplier")
    left = combine(lambda k, e: k * (1.0 - e / 2.0), radius, difference)
    right = combine(lambda k, e: k * (1.0 + e / 2.0), radius, difference)
    table.add(f"{node}.left_wheel_radius_multiplier", left)
    table.add(f"{node}.right_wheel_radius_multiplier", right)
    for axis, limit, acceleration in (
        ("linear.x", facts.find_speed_limit(), facts.find_speed_acceleration()),
        ("angular.z", facts.find_turn_limit(), facts.find_turn_acceleration()),
    ):
        table.add(f"{node}.{axis}.max_velocity", limit)
        table.add(f"{node}.{axis}.min_velocity", -limit)
        table.add(f"{node}.{axis}.max_acceleration", acceleration)
        table.add(f"{node}.{axis}.max_deceleration", -acceleration)
    table.head += describe_spread(facts)
    table.head.append("On Humble limits also need has_velocity_limits and has_acceleration_limits.")


def _add_ackermann(facts: Facts, table: ParameterTable) -> None:
    node = "ackermann_steering_controller.ros__parameters"
    table.add(f"{node}.wheelbase", facts.find_wheelbase())
    table.add(f"{node}.traction_track_width", facts.measure("track_width_m"))
    table.add(f"{node}.traction_wheels_radius", facts.find_radius())
    table.head.append(
        "On Humble traction_track_width is rear_wheel_track, traction_wheels_radius rear_wheels_radius."
    )


ROS2_CONTROL = Target(
    "ros2_control",
    "parameters of ros2_control's wheeled controllers",
    "ros-controls/ros2_controllers 4.42 (Jazzy) to 6.9 (Rolling), diff_drive_controller_parameter.yaml and "
    "ackermann_steering_controller.yaml",
    write_ros2_control,
)

_ALL = "/**.ros__parameters"
_INFO = "vehicle_info.param.yaml"
_MPC = "mpc_lateral_controller"
_ESTIMATOR = "steer_offset_estimator"
_PID = "pid_longitudinal_controller"
_SIMULATOR = "simple_planning_simulator with vehicle_model_type: DELAY_STEER_VEL"


def write_autoware(file: ModelFile, current: Current, gate: str = "auto") -> str:
    """Write the parameters as YAML: one file for all nodes; each reads those that it declares.

    Args:
        file: a fitted model.
        current: not used.
        gate: `off`, the steering offset is not applied; `on`, it is applied as measured; `auto`, applied
            and learned on by Autoware, where it drives as when the offset was measured.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, table = start_table(file, AUTOWARE, "ackermann")
    table.add(f"{_ALL}.wheel_radius", facts.find_radius(), _INFO)
    table.add(f"{_ALL}.wheel_base", facts.find_wheelbase(), _INFO)
    table.add(f"{_ALL}.wheel_tread", facts.measure("track_width_m"), _INFO)
    table.add(f"{_ALL}.max_steer_angle", facts.measure("max_steering_rad"), _INFO)
    delay, lag = facts.take(Quantity.COMMAND_DELAY), facts.take(Quantity.STEERING_LAG)
    table.add(f"{_ALL}.input_delay", delay, _MPC)
    table.add(f"{_ALL}.vehicle_model_steer_tau", lag, f"{_MPC} with vehicle_model_type: kinematics")
    table.add(f"{_ALL}.delay_compensation_time", delay, _PID)
    table.add(f"{_ALL}.vel_time_delay", delay, _SIMULATOR)
    table.add(f"{_ALL}.vel_time_constant", facts.take(Quantity.SPEED_LAG), _SIMULATOR)
    table.add(f"{_ALL}.steer_time_delay", delay, _SIMULATOR)
    table.add(f"{_ALL}.steer_time_constant", lag, _SIMULATOR)
    table.add(f"{_ALL}.vel_lim", facts.find_speed_limit(), _SIMULATOR)
    table.add(f"{_ALL}.vel_rate_lim", facts.find_speed_acceleration(), _SIMULATOR)
    _add_offset(facts, table, gate)
    return write_yaml(facts, table)


def _add_offset(facts: Facts, table: ParameterTable, gate: str) -> None:
    offset = facts.take(Quantity.STEERING_OFFSET)
    sign = "measured minus true angle: an offset to the left is a negative bias"
    table.add(f"{_ALL}.steer_bias", -offset, f"{_SIMULATOR}; {sign}")
    if not offset.is_known:
        return
    condition, lower, turn = _find_condition(facts)
    table.head.append(
        f"steer_offset = {offset.value:.5g} rad with gate {gate}: true less measured angle as in "
        f"steer_offset_estimator{condition}; another load, tyre or ground may change it."
    )
    is_applied = gate != "off"
    sources = (*offset.sources, f"{_MPC}; gate {gate}: the offset is {'' if is_applied else 'not '}applied")
    switch = f"{_ALL}.steering_offset.enable_auto_steering_offset_removal"
    table.settings.append(Setting(switch, is_applied, sources, offset.effects))
    if is_applied:
        table.add(f"{_ALL}.steer_offset", offset, "steer_offset.param.yaml, where the controller begins")
    learned = gate == "auto"
    note = f"{_ESTIMATOR}; {'goes on learning' if learned else 'learns nothing'}"
    table.settings.append(Setting(f"{_ALL}.calibration.mode", "auto" if learned else "off", (note,)))
    if not learned:
        return
    table.add(f"{_ALL}.initial_offset", offset, _ESTIMATOR)
    table.add(f"{_ALL}.initial_covariance", facts.find_variance(Quantity.STEERING_OFFSET), _ESTIMATOR)
    as_here = f"{_ESTIMATOR}; where the offset was measured"
    table.add(f"{_ALL}.min_velocity", lower, as_here)
    table.add(f"{_ALL}.max_ang_velocity", turn, as_here)


def _find_condition(facts: Facts) -> tuple[str, Amount, Amount]:
    """How the runs of the fit were driven: in words, lower speed [m/s] and largest yaw rate [rad/s]."""
    rows = facts.file.list_fitted("runs")
    slow, fast, turn = (
        [value for row in rows if isinstance(value := row.get(key), float)]
        for key in (LOWER_SPEED, DRIVEN_SPEED, DRIVEN_TURN)
    )
    if not (slow and fast and turn):
        return "", Amount(math.nan), Amount(math.nan)
    grounds = dict.fromkeys(str(row.get("terrain")) for row in rows)
    where = " and ".join(quote_name(name) for name in grounds if name not in {"unknown", "None"})
    words = f", learned mostly at {min(slow):.3g} to {max(fast):.3g} m/s, up to {max(turn):.3g} rad/s"
    least, most = (Amount(value, ("driven in the runs of the fit",)) for value in (min(slow), max(turn)))
    return f"{words}{f', on {where}' if where else ''}", least, most


AUTOWARE = Target(
    "autoware",
    "parameters of Autoware's vehicle_info, controllers and planning simulator",
    "autowarefoundation/autoware_universe, README of autoware_simple_planning_simulator and of "
    "autoware_steer_offset_estimator and its node.cpp, lateral_controller_defaults.param.yaml; "
    "sample_vehicle_launch, vehicle_info.param.yaml",
    write_autoware,
    gates=("off", "on", "auto"),
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
    facts, table = start_table(file, PX4, "differential", "ackermann")
    if facts.vehicle.kind == "differential":
        table.add("RD_WHEEL_TRACK", facts.measure("track_width_m"))
        table.add("RO_YAW_RATE_CORR", facts.take(Quantity.TRACK))
    else:
        table.add("RA_WHEEL_BASE", facts.find_wheelbase())
        table.add("RA_MAX_STR_ANG", facts.find_largest_steering())
    table.add(_FULL_SPEED, _find_full_speed(facts, current))
    _add_limits(facts, table)
    return _write_lines(facts, table)


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
    wheels = combine(operator.mul, facts.take(Quantity.WHEEL_SPEED_LIMIT), facts.find_radius())
    if wheels.is_known or _FULL_SPEED not in current:
        return wheels
    used = Amount(current[_FULL_SPEED], (f"{_FULL_SPEED} = {current[_FULL_SPEED]:g} in use",))
    return combine(operator.mul, facts.take(Quantity.RADIUS), used)


def _add_limits(facts: Facts, table: ParameterTable) -> None:
    acceleration = facts.find_speed_acceleration()
    turn, turning = (
        amount.change(math.degrees) for amount in (facts.find_turn_limit(), facts.find_turn_acceleration())
    )
    table.add("RO_SPEED_LIM", facts.find_speed_limit())
    table.add("RO_YAW_RATE_LIM", turn, "in deg/s")
    table.add("RO_ACCEL_LIM", acceleration)
    table.add("RO_DECEL_LIM", acceleration)
    table.add("RO_YAW_ACCEL_LIM", turning, "in deg/s^2")
    table.add("RO_YAW_DECEL_LIM", turning, "in deg/s^2")


def _write_lines(facts: Facts, table: ParameterTable) -> str:
    text = io.StringIO()
    writer = csv.writer(text, delimiter="\t", lineterminator="\n")
    text.writelines(f"# {line}\n" for line in list_comments(facts, table))
    text.write("#\n# Vehicle-Id Component-Id Name Value Type\n")
    for setting in table.settings:
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
    facts, table = start_table(file, VESC, "ackermann")
    speed, servo, centre = (_find_current(facts, current, name) for name in VESC.corrects)
    radius = facts.take(Quantity.RADIUS)
    gain, offset = facts.take(Quantity.STEERING_GAIN), facts.take(Quantity.STEERING_OFFSET)
    table.add(f"{_ALL}.{_SPEED_GAIN}", combine(operator.truediv, speed, radius))
    table.add(f"{_ALL}.{_STEERING_GAIN}", combine(operator.truediv, servo, gain))
    straight = combine(lambda c, s, g, o: c - s * o / g, centre, servo, gain, offset)
    table.add(f"{_ALL}.{_STEERING_OFFSET}", straight)
    table.add("vesc_to_odom_node.ros__parameters.wheelbase", facts.find_wheelbase())
    limit = facts.find_speed_acceleration()
    table.add("throttle_interpolator.ros__parameters.max_acceleration", limit)
    return write_yaml(facts, table)


def read_vesc(text: str) -> Current:
    """Read the numbers of a vesc.yaml by name, under any node.

    Raises:
        MotionError: ``parameters_unreadable``.
    """
    try:
        # Scalars as texts: the constructors of other types fail in ways of their own.
        tree = yaml.load(text, Loader=yaml.BaseLoader)  # noqa: S506 - the loader that makes texts only
    except (yaml.YAMLError, RecursionError) as error:
        what = f"is not YAML: {' '.join(str(error).split())}"
        hint = "Give the vesc.yaml that the car was driven with."
        raise MotionError("parameters_unreadable", what, where="--current", hint=hint) from None
    numbers: dict[str, float] = {}
    groups, seen = [tree], set[int]()
    while groups:
        group = groups.pop()
        if not isinstance(group, dict) or id(group) in seen:
            continue
        # Aliases may repeat a group without end.
        seen.add(id(group))
        for name, value in group.items():
            if isinstance(value, str) and _NUMBER.fullmatch(value):
                numbers[str(name)] = float(value.replace(".inf", "inf").replace(".nan", "nan"))
            groups.append(value)
    return numbers


_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?\.inf|\.nan", re.ASCII)


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
    source = f"{name} = {value:g} of the preset {name_entity(facts.vehicle)}; others in use: --current"
    return Amount(value, (source,))


VESC = Target(
    "vesc",
    "gains and offsets of vesc.yaml",
    "f1tenth/vesc, vesc_ackermann/src/ackermann_to_vesc.cpp (erpm = gain * speed + offset, servo likewise); "
    "f1tenth/f1tenth_system, f1tenth_stack/config/vesc.yaml",
    write_vesc,
    corrects=(_SPEED_GAIN, _STEERING_GAIN, _STEERING_OFFSET),
    read_current=read_vesc,
)
