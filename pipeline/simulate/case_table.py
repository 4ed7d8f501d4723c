"""The named scenarios: what ``cases.toml`` says, on the bases here."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass, replace
from importlib import resources
from typing import Any, TypeVar

from pipeline.simulate.mujoco_vehicle import MACHINES, SkidSteer
from pipeline.simulate.scenario import Disturbance, PoseSensor, Program, Scenario, State
from pipeline.simulate.vehicles import VEHICLES

Made = TypeVar("Made")


@dataclass(frozen=True)
class Case:
    """A named scenario and what it shows, in one line; a machine when it is built of rigid bodies."""

    name: str
    shows: str
    scenario: Scenario
    machine: SkidSteer | None = None


_ICP = PoseSensor(
    noise_m=0.004,
    noise_rad=0.002,
    noise_z_m=0.004,
    noise_tilt_rad=0.001,
    drift_m=0.01,
    drift_rad=0.002,
    latency_s=0.06,
    latency_jitter_s=0.008,
)
_HUSKY = Scenario(pose=_ICP, disturbance=Disturbance(0.01, 0.015), duration_s=180.0)
_WARTHOG = replace(
    _HUSKY,
    vehicle=VEHICLES["warthog"],
    program=Program(speed_scale=0.6, turn_scale=0.7),
    disturbance=Disturbance(0.03, 0.04),
)
_CAR = replace(
    _HUSKY,
    vehicle=VEHICLES["car"],
    program=Program(speed_scale=0.5),
    disturbance=Disturbance(0.02, 0.02),
)
_BASES = {"husky": _HUSKY, "warthog": _WARTHOG, "car": _CAR}


def _ride_oval_wheel(state: State) -> tuple[float, float, float]:
    # An out-of-round left wheel: 4 % of radius, once a turn.
    uneven = 0.04 * math.sin(state.left_angle)
    rim = _HUSKY.vehicle.wheel_radius_m * state.left_speed
    return 0.5 * uneven * rim, 0.0, -uneven * rim / _HUSKY.vehicle.track_width_m


_EXTRAS = {"oval_wheel": _ride_oval_wheel}


def _change(base: Made, changes: Mapping[str, Any]) -> Made:
    """A copy with other fields; a table changes fields of what stands there."""
    fields = {}
    for name, given in changes.items():
        before = getattr(base, name)
        inner = is_dataclass(before) and isinstance(given, dict)
        fields[name] = _change(before, given) if inner else given
    return replace(base, **fields)  # type: ignore[type-var]


def _make_case(name: str, given: dict[str, Any]) -> Case:
    shows, base, machine = given.pop("shows"), _BASES[given.pop("base")], given.pop("machine", None)
    if isinstance(machine, str):
        machine = {"base": machine}
    if isinstance(given.get("vehicle"), str):
        given["vehicle"] = VEHICLES[given["vehicle"]]
    if "extra" in given:
        given["extra"] = _EXTRAS[given["extra"]]
    made = None if machine is None else _change(MACHINES[machine.pop("base")], machine)
    return Case(name, shows, _change(base, given), made)


CASES: tuple[Case, ...] = tuple(
    _make_case(name, given)
    for name, given in tomllib.loads(
        resources.files("pipeline.simulate").joinpath("cases.toml").read_text("utf-8")
    ).items()
)
