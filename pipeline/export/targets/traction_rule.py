"""When wheels dig in, spin or slide: a function for the robot, and its thresholds for a behaviour tree."""

from __future__ import annotations

import inspect
import math
import textwrap

from pipeline.export.exporter import Current, Target
from pipeline.export.settings import Amount, Facts, start_sheet, write_yaml
from pipeline.models.model_file import ModelFile
from pipeline.models.parameter import Quantity
from pipeline.run.traction import find_limits, trace_traction

_NODE = "traction_monitor.ros__parameters"
_USUAL_TOP_MPS = 1.0
"""Largest speed that is assumed where neither the model nor the vehicle says one."""


def _list_thresholds(facts: Facts) -> dict[str, Amount]:
    """The thresholds of `trace_traction` for a vehicle, and the motion that its wheels usually bring."""
    known = [facts.find_speed_limit(), facts.measure("max_speed_mps")]
    top = next((one for one in known if one.is_known), Amount(_USUAL_TOP_MPS, ("assumed largest speed",)))
    gain = facts.take(Quantity.RADIUS)
    limits = vars(find_limits(top.value, gain.value))
    amounts = {name: Amount(value, ("the rule's threshold",)) for name, value in limits.items()}
    for name, of in (("live", top), ("margin", top), ("excess", gain)):
        if of.sources:
            amounts[name] = Amount(limits[name], of.sources, of.effects)
    return {"usual_gain": Amount(gain.value, gain.sources or ("ideal",), gain.effects), **amounts}


def write_traction(file: ModelFile, current: Current) -> str:
    """A Python function without dependencies: the rule of table `events`, with this vehicle's thresholds."""
    del current
    source = textwrap.dedent(inspect.getsource(trace_traction)).replace("Sequence[float]", "list[float]")
    values = {name: float(amount.value) for name, amount in _list_thresholds(Facts(file)).items()}
    lines = "".join(f"    {name!r}: {value:.6g},\n" for name, value in values.items() if name != "usual_gain")
    return (
        f'"""Traction of {file.model.vehicle.name.encode("ascii", "replace").decode()}: '
        'does it dig in, spin or slide."""\n\n'
        f"USUAL_GAIN = {values['usual_gain']:.6g}  # forward speed over that of the wheels\n"
        f"LIMITS = {{\n{lines}}}\n\n\n{source}\n\n"
        "def judge_traction(wheels, turning, body, step_s):\n"
        '    """What happens now, by the last seconds: drive, digging_in, spinning or sliding.\n\n'
        "    Args:\n"
        "        wheels: forward speed by the encoders over the last 10 s or more [m/s].\n"
        "        turning: half the track times the yaw rate by the encoders [m/s].\n"
        "        body: forward speed of the localization, smoothed over half a second [m/s].\n"
        "        step_s: time between two of them [s].\n"
        '    """\n'
        "    usual = [USUAL_GAIN * speed for speed in wheels]\n"
        "    code = trace_traction(usual, turning, body, step_s, **LIMITS)[-1]\n"
        '    return ("drive", "digging_in", "spinning", "sliding")[code]\n'
    )


def write_thresholds(file: ModelFile, current: Current) -> str:
    """The thresholds as ROS 2 parameters of a node whose condition a behaviour tree asks.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    del current
    facts, sheet = start_sheet(file, NAV2_TRACTION, "differential", "ackermann")
    for name, amount in _list_thresholds(facts).items():
        if math.isfinite(amount.value):
            sheet.add(f"{_NODE}.{name}", amount)
    return write_yaml(facts, sheet)


TRACTION = Target(
    "traction",
    "a Python function that tells whether the wheels dig in, spin or slide",
    "the function's docstring",
    write_traction,
)
NAV2_TRACTION = Target(
    "nav2_traction",
    "thresholds of the function of `--to traction`, for a condition node of a Nav2 behaviour tree",
    "the handbook, Watch a recording: Nav2 declares no such node, the function is yours to wrap",
    write_thresholds,
)
