"""Parameters of PX4 rovers, as QGroundControl loads them."""

import csv
import io
import math
import operator

from pipeline.export.settings import Amount, Facts, Sheet, combine, start_sheet
from pipeline.export.settings_text import list_comments, make_plain
from pipeline.export.target import Current, Target
from pipeline.models.model_file import ModelFile
from pipeline.models.quantity import Quantity
from pipeline.runs.errors import MotionError

_REAL32 = 9
"""MAV_PARAM_TYPE_REAL32: the type of all these parameters."""

_FULL_SPEED = "RO_MAX_THR_SPEED"


def write(file: ModelFile, current: Current) -> str:
    """The parameters with their comments, tabs between vehicle, component, name, value and type.

    Args:
        file: a fitted model.
        current: the speed at full throttle with which the log was driven, which the wheel radius corrects.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    facts, sheet = start_sheet(file, TARGET, "differential", "ackermann")
    if facts.vehicle.kind == "differential":
        sheet.add("RD_WHEEL_TRACK", facts.measure("track_width_m"))
        sheet.add("RO_YAW_RATE_CORR", facts.take(Quantity.TRACK))
    else:
        sheet.add("RA_WHEEL_BASE", facts.measure("wheelbase_m"))
        sheet.add("RA_MAX_STR_ANG", facts.find_largest_steering())
    sheet.add(_FULL_SPEED, _find_full_speed(facts, current))
    _add_limits(facts, sheet)
    return _write_lines(facts, sheet)


def read_current(text: str) -> Current:
    """Numbers of a parameter file of QGroundControl by name.

    Raises:
        MotionError: ``parameters_unreadable``.
    """
    found = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            _, _, name, value, _ = line.split()
            found[name] = float(value)
        except ValueError:
            what = "is not vehicle, component, name, value and type"
            hint = "Save the parameters in QGroundControl and give that file."
            raise MotionError("parameters_unreadable", what, where=f"--current:{number}", hint=hint) from None
    return found


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


TARGET = Target(
    "px4",
    "parameters of a PX4 rover, for QGroundControl",
    "PX4/PX4-Autopilot after 1.16, src/modules/rover_differential and rover_ackermann/module.yaml, "
    "src/lib/rover_control/rovercontrol_params.yaml",
    write,
    corrects=(_FULL_SPEED,),
    read_current=read_current,
)
