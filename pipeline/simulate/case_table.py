"""The named scenarios: what ``cases.toml`` says, on the bases of ``bases.toml``."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass, replace
from typing import Any, TypeVar

from pipeline.simulate.facts import read_facts
from pipeline.simulate.mujoco_vehicle import MACHINES, SkidSteer
from pipeline.simulate.scenario import Scenario, State
from pipeline.simulate.vehicles import VEHICLES

Made = TypeVar("Made")


@dataclass(frozen=True)
class Case:
    """A named scenario and what it shows, in one line; a machine when it is built of rigid bodies."""

    name: str
    shows: str
    scenario: Scenario
    machine: SkidSteer | None = None


def _ride_oval_wheel(state: State) -> tuple[float, float, float]:
    # An out-of-round left wheel: 4 % of radius, once a turn.
    vehicle, uneven = VEHICLES["husky"], 0.04 * math.sin(state.left_angle)
    rim = vehicle.wheel_radius_m * state.left_speed
    return 0.5 * uneven * rim, 0.0, -uneven * rim / vehicle.track_width_m


_EXTRAS = {"oval_wheel": _ride_oval_wheel}


def _change(base: Made, changes: Mapping[str, Any]) -> Made:
    """A copy with other fields; a table changes fields of what stands there."""
    fields = {}
    for name, given in changes.items():
        before = getattr(base, name)
        inner = is_dataclass(before) and isinstance(given, dict)
        fields[name] = _change(before, given) if inner else given
    return replace(base, **fields)  # type: ignore[type-var]


def _change_scenario(base: Scenario, given: dict[str, Any]) -> Scenario:
    if isinstance(given.get("vehicle"), str):
        given["vehicle"] = VEHICLES[given["vehicle"]]
    if "extra" in given:
        given["extra"] = _EXTRAS[given["extra"]]
    return _change(base, given)


_BASES: dict[str, Scenario] = {}
for _name, _given in read_facts("bases.toml").items():
    _BASES[_name] = _change_scenario(_BASES.get(_given.pop("base", ""), Scenario()), _given)


def _make_case(name: str, given: dict[str, Any]) -> Case:
    shows, base, machine = given.pop("shows"), _BASES[given.pop("base")], given.pop("machine", None)
    if isinstance(machine, str):
        machine = {"base": machine}
    made = None if machine is None else _change(MACHINES[machine.pop("base")], machine)
    return Case(name, shows, _change_scenario(base, given), made)


CASES = tuple(_make_case(name, given) for name, given in read_facts("cases.toml").items())
