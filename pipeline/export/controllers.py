"""Parameters of controllers: Nav2, ros2_control's wheeled ones, Autoware, PX4 rovers and VESC nodes."""

import csv
import io
import math
import operator
import re
from collections.abc import Callable

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from pipeline.core import make_plain
from pipeline.export import (
    DRIVEN_SPEED,
    DRIVEN_TURN,
    LOWER_SPEED,
    Amount,
    Current,
    Facts,
    ParameterTable,
    Row,
    Setting,
    Target,
    combine,
    list_comments,
    name_entity,
    quote_name,
)
from pipeline.export.spread import describe_spread
from pipeline.models import Quantity
from pipeline.run import MotionError

_ROBOT, _CAR = ("differential",), ("ackermann",)
_BOTH, _SIDEWAYS = ("differential", "ackermann"), ("mecanum", "omni")
_FOLLOW = "controller_server.ros__parameters.FollowPath"
_SMOOTHER = "velocity_smoother.ros__parameters"
_PURSUIT = "regulated pure pursuit"


def _presuppose(facts: Facts, table: ParameterTable) -> None:
    """Say which corrections of the base's controller the limits presuppose: they are those of the body."""
    used = {line for setting in table.settings for line in setting.sources}
    gains = (Quantity.TRACK, Quantity.WHEELBASE, Quantity.RADIUS)
    given = [amount for amount in map(facts.take, gains) if used.intersection(amount.sources)]
    names = sorted({name for amount in given for name in amount.effects})
    if names:
        table.head.append(
            "Limits and deadbands are of the body: as commands they hold only once the controller of the "
            f"base is corrected for {' and '.join(names)}: slip model export MODEL --to ros2_control."
        )


NAV2 = Target(
    "nav2",
    "parameters of Nav2's MPPI, regulated pure pursuit and velocity smoother",
    "ros-navigation/navigation2 1.5 (Lyrical), parameters declared by nav2_mppi_controller, "
    "nav2_regulated_pure_pursuit_controller and nav2_velocity_smoother",
    (*_BOTH, *_SIDEWAYS),
    # Limits are the largest that were reached: smaller ones that are set on purpose remain valid. A vehicle
    # that moves sideways gets delays only: its limits depend on the direction, which these parameters do not.
    (
        Row(f"{_FOLLOW}.model_delay_vx", "speed_delay", "MPPI"),
        Row(f"{_FOLLOW}.model_delay_vy", "speed_delay", "MPPI", _SIDEWAYS),
        Row(f"{_FOLLOW}.model_delay_wz", "turn_delay", "MPPI"),
        Row(f"{_FOLLOW}.vx_max", "speed_limit", "MPPI", _BOTH),
        Row(f"{_FOLLOW}.vx_min", "-speed_limit", "MPPI", _BOTH),
        Row(f"{_FOLLOW}.wz_max", "turn_limit", "MPPI", _BOTH),
        Row(f"{_FOLLOW}.ax_max", "speed_acceleration", "MPPI", _BOTH),
        Row(f"{_FOLLOW}.ax_min", "-speed_acceleration", "MPPI", _BOTH),
        Row(f"{_FOLLOW}.az_max", "turn_acceleration", "MPPI", _BOTH),
        Row(
            f"{_FOLLOW}.VelocityDeadbandCritic.deadband_velocities",
            ("deadband_speed", 0.0, "deadband_turn"),
            "MPPI with VelocityDeadbandCritic among its critics",
            _BOTH,
        ),
        Row(
            f"{_FOLLOW}.max_linear_vel", "speed_limit", f"{_PURSUIT}; desired_linear_vel up to Kilted", _BOTH
        ),
        Row(f"{_FOLLOW}.min_linear_vel", "-speed_limit", _PURSUIT, _BOTH),
        Row(f"{_FOLLOW}.max_angular_vel", "turn_limit", _PURSUIT, _BOTH),
        Row(f"{_FOLLOW}.min_angular_vel", "-turn_limit", _PURSUIT, _BOTH),
        Row(f"{_FOLLOW}.max_linear_accel", "speed_acceleration", _PURSUIT, _BOTH),
        Row(f"{_FOLLOW}.max_linear_decel", "-speed_acceleration", _PURSUIT, _BOTH),
        Row(f"{_FOLLOW}.max_angular_accel", "turn_acceleration", _PURSUIT, _BOTH),
        Row(f"{_FOLLOW}.max_angular_decel", "-turn_acceleration", _PURSUIT, _BOTH),
        # The smoother needs a limit for every axis or for none.
        Row(f"{_SMOOTHER}.max_velocity", ("speed_limit", 0.0, "turn_limit"), "", _BOTH),
        Row(f"{_SMOOTHER}.min_velocity", ("-speed_limit", 0.0, "-turn_limit"), "", _BOTH),
        Row(f"{_SMOOTHER}.max_accel", ("speed_acceleration", 0.0, "turn_acceleration"), "", _BOTH),
        Row(f"{_SMOOTHER}.max_decel", ("-speed_acceleration", 0.0, "-turn_acceleration"), "", _BOTH),
        Row(
            f"{_FOLLOW}.ackermann.min_turning_r", "turning_radius", "MPPI with motion_model: ackermann", _CAR
        ),
    ),
    _presuppose,
)

_DIFF = "diff_drive_controller.ros__parameters"
_ACKERMANN = "ackermann_steering_controller.ros__parameters"


def _scale_side(sign: float) -> Callable[[Facts, Current], Amount]:
    """The multiplier of the radius of a side: -1 is the left one."""

    def find(facts: Facts, _: Current) -> Amount:
        radius, difference = facts.take(Quantity.RADIUS), facts.take(Quantity.RADIUS_DIFFERENCE)
        return combine(lambda k, e: k * (1.0 + sign * e / 2.0), radius, difference)

    return find


def _remark(facts: Facts, table: ParameterTable) -> None:
    """Say what other versions call it, and which multipliers depend on the speed."""
    if facts.vehicle.kind == "differential":
        table.head += describe_spread(facts)
        table.head.append("On Humble limits also need has_velocity_limits and has_acceleration_limits.")
    else:
        table.head.append(
            "On Humble traction_track_width is rear_wheel_track, traction_wheels_radius rear_wheels_radius."
        )


ROS2_CONTROL = Target(
    "ros2_control",
    "parameters of ros2_control's wheeled controllers",
    "ros-controls/ros2_controllers 4.42 (Jazzy) to 6.9 (Rolling), diff_drive_controller_parameter.yaml and "
    "ackermann_steering_controller.yaml",
    _BOTH,
    (
        Row(f"{_DIFF}.wheel_separation", "track_width_m", "", _ROBOT),
        Row(f"{_DIFF}.wheel_radius", "wheel_radius_m", "", _ROBOT),
        Row(
            f"{_DIFF}.wheel_separation_multiplier", Quantity.TRACK, "replaces the present multiplier", _ROBOT
        ),
        Row(f"{_DIFF}.left_wheel_radius_multiplier", _scale_side(-1.0), "", _ROBOT),
        Row(f"{_DIFF}.right_wheel_radius_multiplier", _scale_side(1.0), "", _ROBOT),
        *(
            Row(f"{_DIFF}.{axis}.{bound}", f"{sign}{motion}_{limit}", "", _ROBOT)
            for axis, motion in (("linear.x", "speed"), ("angular.z", "turn"))
            for bound, sign, limit in (
                ("max_velocity", "", "limit"),
                ("min_velocity", "-", "limit"),
                ("max_acceleration", "", "acceleration"),
                ("max_deceleration", "-", "acceleration"),
            )
        ),
        Row(f"{_ACKERMANN}.wheelbase", "wheelbase", "", _CAR),
        Row(f"{_ACKERMANN}.traction_track_width", "track_width_m", "", _CAR),
        Row(f"{_ACKERMANN}.traction_wheels_radius", "radius", "", _CAR),
    ),
    _remark,
)

_ALL = "/**.ros__parameters"
_INFO = "vehicle_info.param.yaml"
_MPC = "mpc_lateral_controller"
_ESTIMATOR = "steer_offset_estimator"
_PID = "pid_longitudinal_controller"
_SIMULATOR = "simple_planning_simulator with vehicle_model_type: DELAY_STEER_VEL"


def _add_offset(facts: Facts, table: ParameterTable, gate: str) -> None:
    offset = facts.take(Quantity.STEERING_OFFSET)
    sign = "measured minus true angle: an offset to the left is a negative bias"
    table.add(f"{_ALL}.steer_bias", -offset, f"{_SIMULATOR}; {sign}")
    if offset.is_doubtful or not offset.is_known:
        return
    condition, lower, turn = _find_condition(facts)
    table.head.append(
        f"steer_offset = {offset.value:.5g} rad with gate {gate}: true less measured angle as in "
        f"steer_offset_estimator{condition}; other load, wheels or ground may change it."
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
    slow, fast, turn = map(facts.list_driven, (LOWER_SPEED, DRIVEN_SPEED, DRIVEN_TURN))
    if not (slow and fast and turn):
        return "", Amount(math.nan), Amount(math.nan)
    grounds = dict.fromkeys(str(row.get("terrain")) for row in facts.file.list_fitted("runs"))
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
    _CAR,
    (
        Row(f"{_ALL}.wheel_radius", "radius", _INFO),
        Row(f"{_ALL}.wheel_base", "wheelbase", _INFO),
        Row(f"{_ALL}.wheel_tread", "track_width_m", _INFO),
        Row(f"{_ALL}.max_steer_angle", "max_steering_rad", _INFO),
        Row(f"{_ALL}.input_delay", Quantity.COMMAND_DELAY, _MPC),
        Row(
            f"{_ALL}.vehicle_model_steer_tau",
            Quantity.STEERING_LAG,
            f"{_MPC} with vehicle_model_type: kinematics",
        ),
        Row(f"{_ALL}.delay_compensation_time", Quantity.COMMAND_DELAY, _PID),
        Row(f"{_ALL}.vel_time_delay", Quantity.COMMAND_DELAY, _SIMULATOR),
        Row(f"{_ALL}.vel_time_constant", Quantity.SPEED_LAG, _SIMULATOR),
        Row(f"{_ALL}.steer_time_delay", Quantity.COMMAND_DELAY, _SIMULATOR),
        Row(f"{_ALL}.steer_time_constant", Quantity.STEERING_LAG, _SIMULATOR),
        Row(f"{_ALL}.vel_lim", "speed_limit", _SIMULATOR),
        Row(f"{_ALL}.vel_rate_lim", "speed_acceleration", _SIMULATOR),
    ),
    _add_offset,
    gates=("auto", "off", "on"),
)

_REAL32 = 9
"""MAV_PARAM_TYPE_REAL32: the type of all these parameters."""

_FULL_SPEED = "RO_MAX_THR_SPEED"


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


def _write_lines(facts: Facts, table: ParameterTable) -> str:
    text = io.StringIO()
    writer = csv.writer(text, delimiter="\t", lineterminator="\n")
    text.writelines(f"# {line}\n" for line in list_comments(facts, table))
    text.write("#\n# Vehicle-Id Component-Id Name Value Type\n")
    for setting in table.settings:
        text.writelines(f"# {make_plain(line)}\n" for line in setting.sources)
        text.write("# " * setting.is_doubtful)
        writer.writerow([1, 1, setting.path, setting.value, _REAL32])
    return text.getvalue()


PX4 = Target(
    "px4",
    "parameters of a PX4 rover, for QGroundControl",
    "PX4/PX4-Autopilot after 1.16, src/modules/rover_differential and rover_ackermann/module.yaml, "
    "src/lib/rover_control/rovercontrol_params.yaml",
    _BOTH,
    (
        Row("RD_WHEEL_TRACK", "track_width_m", "", _ROBOT),
        Row("RO_YAW_RATE_CORR", Quantity.TRACK, "", _ROBOT),
        Row("RA_WHEEL_BASE", "wheelbase", "", _CAR),
        Row("RA_MAX_STR_ANG", "largest_steering", "", _CAR),
        Row(_FULL_SPEED, _find_full_speed),
        Row("RO_SPEED_LIM", "speed_limit"),
        Row("RO_YAW_RATE_LIM", "turn_limit", "in deg/s", change=math.degrees),
        Row("RO_ACCEL_LIM", "speed_acceleration"),
        Row("RO_DECEL_LIM", "speed_acceleration"),
        Row("RO_YAW_ACCEL_LIM", "turn_acceleration", "in deg/s^2", change=math.degrees),
        Row("RO_YAW_DECEL_LIM", "turn_acceleration", "in deg/s^2", change=math.degrees),
    ),
    write=_write_lines,
    corrects=(_FULL_SPEED,),
    read_current=read_px4,
)

_SPEED_GAIN = "speed_to_erpm_gain"
_STEERING_GAIN = "steering_angle_to_servo_gain"
_STEERING_OFFSET = "steering_angle_to_servo_offset"


def read_vesc(text: str) -> Current:
    """Read the numbers of a vesc.yaml by name, under any node.

    Raises:
        MotionError: ``parameters_unreadable``.
    """
    try:
        # Scalars as texts: the constructors of other types fail in ways of their own.
        tree = YAML(typ="base", pure=True).load(text)
    except (YAMLError, RecursionError) as error:
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


# A car that steers by g u + o and drives k times its speed needs u = (wanted - o) / g and wanted / k.


def _correct_speed(facts: Facts, current: Current) -> Amount:
    return combine(operator.truediv, _find_current(facts, current, _SPEED_GAIN), facts.take(Quantity.RADIUS))


def _correct_steering(facts: Facts, current: Current) -> Amount:
    gain = facts.take(Quantity.STEERING_GAIN)
    return combine(operator.truediv, _find_current(facts, current, _STEERING_GAIN), gain)


def _correct_centre(facts: Facts, current: Current) -> Amount:
    servo, centre = (_find_current(facts, current, name) for name in (_STEERING_GAIN, _STEERING_OFFSET))
    gain, offset = facts.take(Quantity.STEERING_GAIN), facts.take(Quantity.STEERING_OFFSET)
    return combine(lambda c, s, g, o: c - s * o / g, centre, servo, gain, offset)


VESC = Target(
    "vesc",
    "gains and offsets of vesc.yaml",
    "f1tenth/vesc, vesc_ackermann/src/ackermann_to_vesc.cpp (erpm = gain * speed + offset, servo likewise); "
    "f1tenth/f1tenth_system, f1tenth_stack/config/vesc.yaml",
    _CAR,
    (
        Row(f"{_ALL}.{_SPEED_GAIN}", _correct_speed),
        Row(f"{_ALL}.{_STEERING_GAIN}", _correct_steering),
        Row(f"{_ALL}.{_STEERING_OFFSET}", _correct_centre),
        Row("vesc_to_odom_node.ros__parameters.wheelbase", "wheelbase"),
        Row("throttle_interpolator.ros__parameters.max_acceleration", "speed_acceleration"),
    ),
    corrects=(_SPEED_GAIN, _STEERING_GAIN, _STEERING_OFFSET),
    read_current=read_vesc,
)
