"""Export of a model as JSON or as dependency-free Python, and of its traction thresholds."""

import inspect
import json
import math
import textwrap
from datetime import date, time

from pipeline.core import finite_or_none, pick
from pipeline.export import Amount, Current, Facts, Target, require_plausible, start_table, write_yaml
from pipeline.models import FormulaEffect, ModelFile, Quantity
from pipeline.run import find_limits, trace_traction

_GEOMETRY = ("wheel_radius_m", "track_width_m", "wheelbase_m", "controller_track_multiplier")


def write_json_object(file: ModelFile, current: Current) -> str:
    """Write the model with values, intervals and units; numbers that are not finite become null."""
    vehicle = file.model.vehicle
    effects = []
    for effect in file.model:
        parameters = {}
        for parameter in effect.parameters:
            low, high = file.intervals.get(f"{effect.id}.{parameter.name}", (math.nan, math.nan))
            numbers = {"value": effect.values[parameter.name], "low": low, "high": high}
            parameters[parameter.name] = {
                **{key: finite_or_none(number) for key, number in numbers.items()},
                "unit": parameter.unit,
                **({"doubt": doubt} if (doubt := file.find_doubt(effect, parameter)) else {}),
            }
        item: dict[str, object] = {
            "id": effect.id,
            "place": effect.place.name.lower(),
            "parameters": parameters,
        }
        if isinstance(effect, FormulaEffect):
            item["formulas"] = effect.formulas
        effects.append(item)
    stand_ins = pick(vehicle, *vehicle.stand_ins)
    warnings = list(filter(None, [vehicle.format_unknown()]))
    content = {
        "vehicle": {
            **pick(vehicle, "id", "name", "kind", *_GEOMETRY),
            **dict.fromkeys(stand_ins),
            **({"stand_ins": stand_ins} if stand_ins else {}),
        },
        "effects": effects,
        "fit": _plain(file.fit),
        **({"warnings": warnings} if warnings else {}),
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _plain(value: object) -> object:
    """Value in a form that JSON can represent."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value.isoformat() if isinstance(value, date | time) else value


JSON_OBJECT = Target(
    "json", "the model with values, intervals and units", "the handbook, Models", write_json_object
)

_NODE = "traction_monitor.ros__parameters"
_USUAL_TOP_MPS = 1.0
"""Assumed largest speed if neither the model nor the vehicle gives one [m/s]."""


def _list_thresholds(facts: Facts) -> dict[str, Amount]:
    """Thresholds of `trace_traction` for a vehicle, and the usual ratio of body to wheel speed."""
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
    """Write a dependency-free Python function: the rule of table `events`, with this vehicle's thresholds."""
    del current
    source = textwrap.dedent(inspect.getsource(trace_traction)).replace("Sequence[float]", "list[float]")
    values = {name: float(amount.value) for name, amount in _list_thresholds(Facts(file)).items()}
    require_plausible("a threshold of traction", *values.values())
    lines = "".join(f"    {name!r}: {value:.6g},\n" for name, value in values.items() if name != "usual_gain")
    return (
        '"""Traction of a vehicle: does it dig in, spin or slide."""\n\n'
        f"VEHICLE = {file.model.vehicle.name!a}\n"
        f"USUAL_GAIN = {values['usual_gain']:.6g}  # forward speed over that of the wheels\n"
        f"LIMITS = {{\n{lines}}}\n\n\n{source}\n\n"
        "def judge_traction(wheels, turning, body, step_s):\n"
        '    """What happens now, by the last seconds: drive, digging_in, spinning or sliding.\n\n'
        "    Args:\n"
        "        wheels: forward speed by the encoders over the last 10 s or more [m/s].\n"
        "        turning: half the track times the yaw rate by the encoders [m/s].\n"
        "        body: forward speed of the localization, smoothed over half a second [m/s]. Sideways\n"
        "            motion counts up to the speed of the wheels: sliding through a turn is moving.\n"
        "        step_s: time between two of them [s].\n"
        '    """\n'
        "    usual = [USUAL_GAIN * speed for speed in wheels]\n"
        "    code = trace_traction(usual, turning, body, step_s, **LIMITS)[-1]\n"
        '    return ("drive", "digging_in", "spinning", "sliding")[code]\n'
    )


def write_thresholds(file: ModelFile, current: Current) -> str:
    """Write the thresholds as ROS 2 parameters of a node that a behaviour tree condition queries.

    Raises:
        MotionError: ``wrong_vehicle``.
    """
    del current
    facts, table = start_table(file, NAV2_TRACTION, "differential", "ackermann")
    for name, amount in _list_thresholds(facts).items():
        table.add(f"{_NODE}.{name}", amount)
    return write_yaml(facts, table)


TRACTION = Target(
    "traction",
    "a Python function that detects whether the wheels dig in, spin or slide",
    "the function's docstring",
    write_traction,
)
NAV2_TRACTION = Target(
    "nav2_traction",
    "thresholds of the function of `--to traction`, for a condition node of a Nav2 behaviour tree",
    "the handbook, Watch a recording: Nav2 declares no such node, the function is yours to wrap",
    write_thresholds,
)
