"""Parameters of Nav2: MPPI, regulated pure pursuit and the velocity smoother."""

from pipeline.export.settings import Facts, Sheet, start_sheet
from pipeline.export.settings_text import write_yaml
from pipeline.export.target import Current, Target
from pipeline.models.model_file import ModelFile

_CONTROLLER = "controller_server.ros__parameters.FollowPath"
_SMOOTHER = "velocity_smoother.ros__parameters"
_DELAY = "MPPI: dead times and time constants added up, as a smooth command is followed that late"


def write(file: ModelFile, current: Current) -> str:
    """The parameters as YAML; a plugin of another name than FollowPath reads them under its own.

    Limits are the largest that were reached: smaller ones that are set on purpose stay right.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, sheet = start_sheet(file, TARGET, "differential", "ackermann")
    sheet.add(f"{_CONTROLLER}.model_delay_vx", facts.find_speed_delay(), _DELAY)
    sheet.add(f"{_CONTROLLER}.model_delay_wz", facts.find_turn_delay(), _DELAY)
    _add_limits(facts, sheet)
    if facts.vehicle.kind == "ackermann":
        place = f"{_CONTROLLER}.ackermann.min_turning_r"
        sheet.add(place, facts.find_turning_radius(), "MPPI with motion_model: ackermann")
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
    # The smoother takes a limit for every axis or none.
    sheet.add_row(f"{_SMOOTHER}.max_velocity", (speed, 0.0, turn))
    sheet.add_row(f"{_SMOOTHER}.min_velocity", (-speed, 0.0, -turn))
    sheet.add_row(f"{_SMOOTHER}.max_accel", (acceleration, 0.0, turning))
    sheet.add_row(f"{_SMOOTHER}.max_decel", (-acceleration, 0.0, -turning))


TARGET = Target(
    "nav2",
    "parameters of Nav2's MPPI, regulated pure pursuit and velocity smoother",
    "ros-navigation/navigation2 1.5 (Lyrical), parameters declared by nav2_mppi_controller, "
    "nav2_regulated_pure_pursuit_controller and nav2_velocity_smoother",
    write,
)
