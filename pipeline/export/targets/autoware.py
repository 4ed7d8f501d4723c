"""Parameters of Autoware: vehicle_info, the MPC and PID controllers, and the planning simulator."""

from pipeline.export.settings import Facts, Sheet, start_sheet
from pipeline.export.settings_text import write_yaml
from pipeline.export.target import Current, Target
from pipeline.models.model_file import ModelFile
from pipeline.models.quantity import Quantity

_ALL = "/**.ros__parameters"
_INFO = "vehicle_info.param.yaml"
_MPC = "mpc_lateral_controller"
_PID = "pid_longitudinal_controller"
_SIMULATOR = "simple_planning_simulator with vehicle_model_type: DELAY_STEER_VEL"


def write(file: ModelFile, current: Current) -> str:
    """The parameters as YAML: one file for all nodes, each takes what it declares.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, sheet = start_sheet(file, TARGET, "ackermann")
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


TARGET = Target(
    "autoware",
    "parameters of Autoware's vehicle_info, controllers and planning simulator",
    "autowarefoundation/autoware_universe, README of autoware_simple_planning_simulator and of "
    "autoware_steer_offset_estimator, lateral_controller_defaults.param.yaml; sample_vehicle_launch, "
    "vehicle_info.param.yaml",
    write,
)
