"""Parameters of Nav2, of ros2_control's wheeled controllers, and of robot_localization."""

from collections.abc import Collection

import msgspec

from pipeline.export import Current, Target
from pipeline.export.settings import Amount, Facts, Setting, Sheet, combine, start_sheet, write_yaml
from pipeline.models.effect import Effect, Place
from pipeline.models.model_file import ModelFile
from pipeline.models.parameter import Quantity
from pipeline.run.recording import MotionError

_CONTROLLER = "controller_server.ros__parameters.FollowPath"
_SMOOTHER = "velocity_smoother.ros__parameters"
_DELAY = "MPPI: the sum of dead times and time constants, the delay behind a smooth command"


def write_nav2(file: ModelFile, current: Current) -> str:
    """Write the parameters as YAML; rename the group if the plugin is not called FollowPath.

    Limits are the largest that were reached: smaller ones that are set on purpose remain valid.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, sheet = start_sheet(file, NAV2, "differential", "ackermann")
    sheet.add(f"{_CONTROLLER}.model_delay_vx", facts.find_speed_delay(), _DELAY)
    sheet.add(f"{_CONTROLLER}.model_delay_wz", facts.find_turn_delay(), _DELAY)
    _add_limits(facts, sheet)
    if facts.vehicle.kind == "ackermann":
        key = f"{_CONTROLLER}.ackermann.min_turning_r"
        sheet.add(key, facts.find_turning_radius(), "MPPI with motion_model: ackermann")
    return write_yaml(facts, sheet)


def _add_limits(facts: Facts, sheet: Sheet) -> None:
    speed, turn = facts.find_speed_limit(), facts.find_turn_limit()
    acceleration, turning = facts.find_speed_acceleration(), facts.find_turn_acceleration()
    sheet.add(f"{_CONTROLLER}.vx_max", speed, "MPPI")
    sheet.add(f"{_CONTROLLER}.vx_min", -speed, "MPPI")
    sheet.add(f"{_CONTROLLER}.wz_max", turn, "MPPI")
    sheet.add(f"{_CONTROLLER}.ax_max", acceleration, "MPPI")
    sheet.add(f"{_CONTROLLER}.ax_min", -acceleration, "MPPI")
    sheet.add(f"{_CONTROLLER}.az_max", turning, "MPPI")
    sheet.add_row(
        f"{_CONTROLLER}.VelocityDeadbandCritic.deadband_velocities",
        (facts.find_deadband()[0], 0.0, facts.find_deadband()[1]),
        "MPPI with VelocityDeadbandCritic among its critics",
    )
    pursuit = "regulated pure pursuit"
    sheet.add(f"{_CONTROLLER}.max_linear_vel", speed, f"{pursuit}; desired_linear_vel up to Kilted")
    sheet.add(f"{_CONTROLLER}.min_linear_vel", -speed, pursuit)
    sheet.add(f"{_CONTROLLER}.max_angular_vel", turn, pursuit)
    sheet.add(f"{_CONTROLLER}.min_angular_vel", -turn, pursuit)
    sheet.add(f"{_CONTROLLER}.max_linear_accel", acceleration, pursuit)
    sheet.add(f"{_CONTROLLER}.max_linear_decel", -acceleration, pursuit)
    sheet.add(f"{_CONTROLLER}.max_angular_accel", turning, pursuit)
    sheet.add(f"{_CONTROLLER}.max_angular_decel", -turning, pursuit)
    # The smoother needs a limit for every axis or for none.
    sheet.add_row(f"{_SMOOTHER}.max_velocity", (speed, 0.0, turn))
    sheet.add_row(f"{_SMOOTHER}.min_velocity", (-speed, 0.0, -turn))
    sheet.add_row(f"{_SMOOTHER}.max_accel", (acceleration, 0.0, turning))
    sheet.add_row(f"{_SMOOTHER}.max_decel", (-acceleration, 0.0, -turning))


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
    facts, sheet = start_sheet(file, ROS2_CONTROL, "differential", "ackermann")
    if facts.vehicle.kind == "differential":
        _add_differential(facts, sheet)
    else:
        _add_ackermann(facts, sheet)
    return write_yaml(facts, sheet)


def _add_differential(facts: Facts, sheet: Sheet) -> None:
    node = "diff_drive_controller.ros__parameters"
    radius, difference = facts.take(Quantity.RADIUS), facts.take(Quantity.RADIUS_DIFFERENCE)
    sheet.add(f"{node}.wheel_separation", facts.measure("track_width_m"))
    sheet.add(f"{node}.wheel_radius", facts.measure("wheel_radius_m"))
    track = facts.take(Quantity.TRACK)
    sheet.add(f"{node}.wheel_separation_multiplier", track, "in place of the one in use")
    left = combine(lambda k, e: k * (1.0 - e / 2.0), radius, difference)
    right = combine(lambda k, e: k * (1.0 + e / 2.0), radius, difference)
    sheet.add(f"{node}.left_wheel_radius_multiplier", left)
    sheet.add(f"{node}.right_wheel_radius_multiplier", right)
    for axis, limit, acceleration in (
        ("linear.x", facts.find_speed_limit(), facts.find_speed_acceleration()),
        ("angular.z", facts.find_turn_limit(), facts.find_turn_acceleration()),
    ):
        sheet.add(f"{node}.{axis}.max_velocity", limit)
        sheet.add(f"{node}.{axis}.min_velocity", -limit)
        sheet.add(f"{node}.{axis}.max_acceleration", acceleration)
        sheet.add(f"{node}.{axis}.max_deceleration", -acceleration)
    sheet.head.append("On Humble limits also need has_velocity_limits and has_acceleration_limits.")


def _add_ackermann(facts: Facts, sheet: Sheet) -> None:
    node = "ackermann_steering_controller.ros__parameters"
    sheet.add(f"{node}.wheelbase", facts.measure("wheelbase_m"))
    sheet.add(f"{node}.traction_track_width", facts.measure("track_width_m"))
    sheet.add(f"{node}.traction_wheels_radius", facts.find_radius())
    sheet.head.append(
        "On Humble traction_track_width is rear_wheel_track, traction_wheels_radius rear_wheels_radius."
    )


ROS2_CONTROL = Target(
    "ros2_control",
    "parameters of ros2_control's wheeled controllers",
    "ros-controls/ros2_controllers 4.42 (Jazzy) to 6.9 (Rolling), diff_drive_controller_parameter.yaml and "
    "ackermann_steering_controller.yaml",
    write_ros2_control,
)


_FILTER = "ekf_filter_node.ros__parameters"
_CONTROLLERS = {
    "differential": ("diff_drive_controller", {Quantity.RADIUS, Quantity.RADIUS_DIFFERENCE, Quantity.TRACK}),
    "ackermann": ("ackermann_steering_controller", {Quantity.RADIUS}),
}
_UNSEEN = {Quantity.STEERING_GAIN, Quantity.STEERING_OFFSET}
"""Quantities that encoders on the steering do not measure: their own offset and scale."""

_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
_STATE = (*_POSE, *(f"v{name}" for name in _POSE), "ax", "ay", "az")
_FUSED = tuple(name in {"vx", "vy", "vyaw"} for name in _STATE)
_INDEPENDENT = (
    "z, roll and pitch are neither measured nor fused; errors are correlated over about half a second, so "
    "multiply the covariance by 0.5 s * f for a filter that takes f messages a second as independent"
)


def write_robot_localization(file: ModelFile, current: Current) -> str:
    """Write the parameters as YAML.

    The filter has no parameter for the covariance of a measurement: it comes with the odometry messages,
    whose controller gets it here. Variances are the squares of the held-out errors over half a second, from
    the last step of the ladder whose effects are all known to wheel odometry. They include the localization's
    own noise, so they are too large rather than too small.

    Raises:
        MotionError: ``wrong_vehicle``; ``not_fitted``, the file has no ladder.
    """
    facts, sheet = start_sheet(file, ROBOT_LOCALIZATION, *_CONTROLLERS)
    controller, known = _CONTROLLERS[facts.vehicle.kind]
    step = _find_step(file, known)
    sources = (
        f"squares of the held-out errors over half a second with {', '.join(step.effects) or 'no effect'}",
        "for odometry that is corrected first: --to ros2_control",
        *_warn(file, step, known),
    )
    # The error is known to some per cent; more digits would only reflect the starting values of the fit.
    x, y, w = (Amount(float(f"{error * error:.3g}"), sources) for error in step.velocity_rms)
    sheet.settings.append(Setting(f"{_FILTER}.odom0_config", _FUSED, ("vx, vy and the yaw rate of odom0",)))
    acceleration, turning = facts.find_speed_acceleration(), facts.find_turn_acceleration()
    for name in ("acceleration_limits", "deceleration_limits"):
        limits = (acceleration, 0.0, 0.0, 0.0, 0.0, turning)
        sheet.add_row(f"{_FILTER}.{name}", limits, "with use_control: true")
    key = f"{controller}.ros__parameters.twist_covariance_diagonal"
    sheet.add_row(key, (x, y, 0.0, 0.0, 0.0, w), _INDEPENDENT)
    return write_yaml(facts, sheet)


class _Step(msgspec.Struct):
    """Errors of a step of the ladder in a model file, x and y in m/s, w in rad/s."""

    effects: list[str]
    velocity_rms: tuple[float, float, float]


def _find_step(file: ModelFile, known: Collection[Quantity]) -> _Step:
    """The last step of the ladder whose effects wheel odometry can follow."""
    try:
        steps = msgspec.convert(file.fit.get("ladder", []), list[_Step])
    except msgspec.ValidationError:
        steps = []
    for step in reversed(steps):
        if all(name in file.model and _is_seen(file.model.effect(name), known) for name in step.effects):
            return step
    what = "the model was never fitted: it has no held-out errors to make a covariance of"
    hint = "Name a log: --on LOG, or fit it first: slip model fit MODEL --on LOG --input measured."
    raise MotionError("not_fitted", what, where="fit.ladder", hint=hint)


def _is_seen(effect: Effect, known: Collection[Quantity]) -> bool:
    """Whether wheel odometry includes an effect: encoders measure it, or the controller models it."""
    quantities = {quantity for parameter in effect.parameters for quantity in parameter.quantities}
    if effect.place <= Place.DRIVE:
        return not quantities & _UNSEEN
    return bool(quantities) and quantities <= set(known)


def _warn(file: ModelFile, step: _Step, known: Collection[Quantity]) -> list[str]:
    """Reasons why the variances are larger than necessary."""
    lines = []
    if file.fit.get("input") != "measured":
        lines.append(
            "fitted on commands; for odometry of encoders: --on LOG, whose measured wheels then count"
        )
    unseen = " ".join(effect.id for effect in file.model if not _is_seen(effect, known))
    if unseen and len(step.effects) < len(file.model.effects):
        lines.append(f"odometry does not follow {unseen}; sharper: slip model drop MODEL {unseen} --on LOG")
    return lines


ROBOT_LOCALIZATION = Target(
    "robot_localization",
    "the covariance of wheel odometry for robot_localization",
    "cra-ros-pkg/robot_localization 3.6, params/ekf.yaml and preparing_sensor_data.rst; the filter takes "
    "covariances from the messages, which ros-controls/ros2_controllers fills from twist_covariance_diagonal",
    write_robot_localization,
    has_errors=True,
)
