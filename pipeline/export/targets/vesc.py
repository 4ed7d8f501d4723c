"""Parameters of the VESC nodes of F1TENTH cars: vesc.yaml."""

import operator

import yaml

from pipeline.export.settings import Amount, Facts, combine, start_sheet
from pipeline.export.settings_text import write_yaml
from pipeline.export.target import Current, Target
from pipeline.models.model_file import ModelFile
from pipeline.models.quantity import Quantity
from pipeline.runs.errors import MotionError

_ALL = "/**.ros__parameters"
_SPEED_GAIN = "speed_to_erpm_gain"
_STEERING_GAIN = "steering_angle_to_servo_gain"
_STEERING_OFFSET = "steering_angle_to_servo_offset"


def write(file: ModelFile, current: Current) -> str:
    """The parameters as YAML: gains and offset in use, corrected so that the car does what it is told.

    A car that steers by g u + o and drives k times its speed is told u = (wanted - o) / g and wanted / k.

    Args:
        file: a fitted model.
        current: gains and offset with which the speeds and angles of the log were turned into ERPM and servo
            values; those of the vehicle's preset without, which commands in ERPM were read with.

    Raises:
        MotionError: ``wrong_vehicle``; ``gains_unknown``, neither is there.
    """
    facts, sheet = start_sheet(file, TARGET, "ackermann")
    speed, servo, centre = (_find_current(facts, current, name) for name in TARGET.corrects)
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


def read_current(text: str) -> Current:
    """Numbers of a vesc.yaml by name, whatever node they stand under.

    Raises:
        MotionError: ``parameters_unreadable``.
    """
    try:
        tree = yaml.safe_load(text)
    except yaml.YAMLError as error:
        what = f"is no YAML: {' '.join(str(error).split())}"
        hint = "Give the vesc.yaml that the car was driven with."
        raise MotionError("parameters_unreadable", what, where="--current", hint=hint) from None
    found: dict[str, float] = {}
    groups = [tree]
    while groups:
        group = groups.pop()
        for name, value in group.items() if isinstance(group, dict) else ():
            if isinstance(value, int | float) and not isinstance(value, bool):
                found[str(name)] = float(value)
            groups.append(value)
    return found


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


TARGET = Target(
    "vesc",
    "gains and offsets of vesc.yaml",
    "f1tenth/vesc, vesc_ackermann/src/ackermann_to_vesc.cpp (erpm = gain * speed + offset, servo likewise); "
    "f1tenth/f1tenth_system, f1tenth_stack/config/vesc.yaml",
    write,
    corrects=(_SPEED_GAIN, _STEERING_GAIN, _STEERING_OFFSET),
    read_current=read_current,
)
