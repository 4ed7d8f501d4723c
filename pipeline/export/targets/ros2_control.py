"""Parameters of ros2_control's wheeled controllers: diff_drive_controller, ackermann_steering_controller."""

from pipeline.export.settings import Facts, Sheet, combine, start_sheet
from pipeline.export.settings_text import write_yaml
from pipeline.export.target import Current, Target
from pipeline.models.model_file import ModelFile
from pipeline.models.quantity import Quantity


def write(file: ModelFile, current: Current) -> str:
    """The parameters as YAML; they stand for the controller's own, not beside them.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, sheet = start_sheet(file, TARGET, "differential", "ackermann")
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


TARGET = Target(
    "ros2_control",
    "parameters of ros2_control's wheeled controllers",
    "ros-controls/ros2_controllers 4.42 (Jazzy) to 6.9 (Rolling), diff_drive_controller_parameter.yaml and "
    "ackermann_steering_controller.yaml",
    write,
)
