"""The catalogue of effects that a scenario may ask for: parameters, units, neutral and usual values.

The formulas themselves stand where they act: ``drivetrain`` (command to wheels), ``body`` (wheels to body
velocity) and ``localization`` (what the pose reports). Signs follow REP-103: x forward, y left, z up.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.simulate.errors import SimulateError, unknown_name

if TYPE_CHECKING:
    from pipeline.simulate.vehicles import Kind

_INF = math.inf
_NAN = math.nan


@dataclass(frozen=True)
class ParameterSpec:
    """One number of an effect: its unit, the value that changes nothing, and a usual one.

    ``neutral`` is NaN for a parameter that only says where an effect acts and so cannot be neutral.
    """

    name: str
    unit: str
    neutral: float
    typical: float


@dataclass(frozen=True)
class EffectSpec:
    """One effect: its id, its formula in words of the body velocity, its parameters and its vehicles."""

    id: str
    formula: str
    parameters: tuple[ParameterSpec, ...]
    kinds: tuple[Kind, ...] = ("differential", "ackermann", "mecanum", "omni")


_SKID: tuple[Kind, ...] = ("differential", "mecanum", "omni")
_TWO_SIDED: tuple[Kind, ...] = ("differential", "mecanum")
_WHEELED: tuple[Kind, ...] = ("differential", "ackermann", "mecanum")
_SIDEWAYS: tuple[Kind, ...] = ("mecanum", "omni")
_CAR: tuple[Kind, ...] = ("ackermann",)


def _one(name: str, unit: str, neutral: float, typical: float) -> tuple[ParameterSpec, ...]:
    return (ParameterSpec(name, unit, neutral, typical),)


_SPECS: tuple[EffectSpec, ...] = (
    EffectSpec("body_speed_limit", "commanded v_x clipped to +-limit", _one("limit", "m/s", _INF, 0.7)),
    EffectSpec("body_turn_limit", "commanded yaw rate clipped to +-limit", _one("limit", "rad/s", _INF, 0.6)),
    EffectSpec("deadband", "Omega = 0 where |r u| < d, else u", _one("d", "m/s", 0.0, 0.15), _WHEELED),
    EffectSpec("transport_delay", "Omega(t) = u(t - d)", _one("d", "s", 0.0, 0.2)),
    EffectSpec("wheel_speed_limit", "Omega clipped to +-limit", _one("limit", "rad/s", _INF, 4.5), _WHEELED),
    EffectSpec("acceleration_limit", "|dOmega/dt| <= limit", _one("limit", "rad/s^2", _INF, 3.0), _WHEELED),
    EffectSpec(
        "reversal_pause", "Omega = 0 for d after the sign of u changes", _one("d", "s", 0.0, 0.4), _WHEELED
    ),
    EffectSpec("drive_lag", "tau dOmega/dt = u - Omega, each wheel", _one("tau", "s", 0.0, 0.5)),
    EffectSpec(
        "brake_lag",
        "tau_drive dOmega/dt = u - Omega, each wheel; tau_brake where it is slowed down",
        (ParameterSpec("tau_drive", "s", 0.0, 0.6), ParameterSpec("tau_brake", "s", 0.0, 0.2)),
        _WHEELED,
    ),
    EffectSpec(
        "turn_lag",
        "tau_mean on the mean and tau_diff on the difference of the wheels",
        (ParameterSpec("tau_mean", "s", 0.0, 0.3), ParameterSpec("tau_diff", "s", 0.0, 1.0)),
        _SKID,
    ),
    EffectSpec(
        "side_lag",
        "tau_left on the left wheels and tau_right on the right ones",
        (ParameterSpec("tau_left", "s", 0.0, 0.5), ParameterSpec("tau_right", "s", 0.0, 0.2)),
        ("differential",),
    ),
    EffectSpec(
        "turn_droop",
        "D = Omega_r - Omega_l; beyond +-threshold only gain times the excess is reached",
        (ParameterSpec("threshold", "rad/s", _NAN, 1.5), ParameterSpec("gain", "1", 1.0, 0.4)),
        _SKID,
    ),
    EffectSpec("steering_gain", "delta = g delta_u", _one("g", "1", 1.0, 0.85), _CAR),
    EffectSpec("steering_offset", "delta = delta_u + o", _one("o", "rad", 0.0, 0.04), _CAR),
    EffectSpec("steering_lag", "tau ddelta/dt = delta_u - delta", _one("tau", "s", 0.0, 0.4), _CAR),
    EffectSpec("steering_play", "delta stays within g of delta_u", _one("g", "rad", 0.0, 0.05), _CAR),
    EffectSpec(
        "steering_sensor_offset",
        "tyres steer delta + o, sensors read delta",
        _one("o", "rad", 0.0, 0.02),
        _CAR,
    ),
    EffectSpec("understeer", "v_w = v tan(delta) / (l + K v^2)", _one("K", "s^2/m", 0.0, 0.03), _CAR),
    EffectSpec("wheel_radius", "v0 = k * v0, w0 = k * w0", _one("k", "1", 1.0, 0.92)),
    EffectSpec(
        "wheel_asymmetry", "left r (1 - e/2), right r (1 + e/2)", _one("e", "1", 0.0, 0.04), _TWO_SIDED
    ),
    EffectSpec("effective_track", "w0 = w0 / k", _one("k", "1", 1.0, 1.8), _SKID),
    EffectSpec("lateral_scale", "s0 = k * s0", _one("k", "1", 1.0, 0.8), _SIDEWAYS),
    EffectSpec("time_drift", "v0, w0 scaled by 1 - k t/T", _one("k", "1", 0.0, 0.1)),
    EffectSpec(
        "terrain_change",
        "v0, w0 scaled by k_v, k_w after at_s, or beyond x = at_x when given; at_s defaults to half the run",
        (
            ParameterSpec("k_v", "1", 1.0, 0.85),
            ParameterSpec("k_w", "1", 1.0, 0.75),
            ParameterSpec("at_s", "s", _NAN, _NAN),
            ParameterSpec("at_x", "m", _NAN, _NAN),
        ),
    ),
    EffectSpec(
        "body_inertia",
        "dv_x/dt = (v0 - v_x)/tau + v_y w; dv_y/dt = -v_y/tau - v_x w; dw/dt = (w0 - w)/tau",
        _one("tau", "s", 0.0, 0.5),
    ),
    EffectSpec("lateral_skid", "v_y += -c v0 w0; sideways, v_x += c s0 w0", _one("c", "s", 0.0, 0.1)),
    EffectSpec("roller_slip", "v_y -= k s0 |s0|", _one("k", "s/m", 0.0, 0.3), _SIDEWAYS),
    EffectSpec("speed_slip", "v_x -= k v0 |v0|", _one("k", "s/m", 0.0, 0.08)),
    EffectSpec("turning_resistance", "v_x -= k v0 |w0|", _one("k", "s", 0.0, 0.24)),
    EffectSpec("speed_track", "v_w += k |v0| w0", _one("k", "s/m", 0.0, 0.05), _SKID),
    EffectSpec(
        "slope_drift",
        "v_x += k sin(pitch), v_y -= k cos(pitch) sin(roll), while the wheels turn",
        _one("k", "m/s", 0.0, 0.6),
    ),
    EffectSpec("lateral_drift", "v_y += c while the wheels turn", _one("c", "m/s", 0.0, 0.05)),
    EffectSpec("yaw_drift", "v_w += c while the wheels turn", _one("c", "rad/s", 0.0, 0.06)),
    EffectSpec("icr_offset", "v_y += -x_icr w", _one("x_icr", "m", 0.0, 0.12)),
    EffectSpec("icr_lateral", "v_x += y_icr w", _one("y_icr", "m", 0.0, 0.08)),
    EffectSpec("heading_skew", "reported yaw is that of d ago: v_y += d v0 w0", _one("d", "s", 0.0, 0.1)),
    EffectSpec(
        "yaw_misalignment",
        "reported yaw = yaw + psi: v_y = -psi v_x",
        _one("psi", "rad", 0.0, math.radians(3.0)),
    ),
    EffectSpec(
        "lever_arm",
        "position of a point (l_x, l_y): v_x -= l_y w, v_y += l_x w",
        (ParameterSpec("l_x", "m", 0.0, 0.2), ParameterSpec("l_y", "m", 0.0, 0.08)),
    ),
    EffectSpec("clock_offset", "pose stamped d late (d < 0: early)", _one("d", "s", 0.0, -0.15)),
)
CATALOGUE: dict[str, EffectSpec] = {spec.id: spec for spec in _SPECS}


class Effects:
    """The effects of one scenario with their values: complete, checked, and neutral where not asked for."""

    def __init__(self, values: Mapping[str, Mapping[str, float]]) -> None:
        self._values = {name: dict(numbers) for name, numbers in values.items()}

    def value(self, effect: str, parameter: str) -> float:
        """The value of a parameter; its neutral one when the effect was not asked for."""
        given = self._values.get(effect, {})
        if parameter in given:
            return given[parameter]
        return next(item.neutral for item in CATALOGUE[effect].parameters if item.name == parameter)

    def is_active(self, effect: str) -> bool:
        """Whether any parameter of the effect differs from its neutral value."""
        return any(
            not math.isnan(item.neutral) and self.value(effect, item.name) != item.neutral
            for item in CATALOGUE[effect].parameters
        )

    def as_mapping(self) -> dict[str, dict[str, float]]:
        """The values that were asked for, by effect and parameter."""
        return {name: dict(numbers) for name, numbers in self._values.items()}


def resolve_effects(asked: Mapping[str, Mapping[str, float] | float], kind: Kind) -> Effects:
    """Check what was asked for against the catalogue.

    Args:
        asked: effect id to its parameters, or to one number for an effect with one parameter.
        kind: the vehicle's kind.

    Raises:
        SimulateError: ``unknown_effect``, ``unknown_parameter``, ``parameter_needed``, ``bad_value`` or
            ``wrong_vehicle``.
    """
    values: dict[str, dict[str, float]] = {}
    for name, given in asked.items():
        spec = CATALOGUE.get(name)
        if spec is None:
            raise unknown_name("effect", name, sorted(CATALOGUE))
        if kind not in spec.kinds:
            raise SimulateError(
                "wrong_vehicle",
                f"{name} exists on {' or '.join(spec.kinds)} vehicles only, this one is {kind}",
                where=name,
                hint="Choose another vehicle or another effect",
            )
        values[name] = _check_parameters(spec, given)
    return Effects(values)


def _check_parameters(spec: EffectSpec, given: Mapping[str, float] | float) -> dict[str, float]:
    names = [item.name for item in spec.parameters]
    if not isinstance(given, Mapping):
        if len(names) > 1:
            raise SimulateError(
                "parameter_needed",
                "one number is not enough for an effect with several parameters",
                where=spec.id,
                hint=f"Name them: {', '.join(names)}",
            )
        given = {names[0]: given}
    for name, value in given.items():
        if name not in names:
            known = ", ".join(f"{item.name} [{item.unit}]" for item in spec.parameters)
            raise SimulateError(
                "unknown_parameter",
                f"{spec.id} has no parameter '{name}'",
                where=spec.id,
                hint=f"Its parameters are {known}",
            )
        _check_value(spec.id, name, float(value))
    return {name: float(value) for name, value in given.items()}


_NEVER_NEGATIVE = {"limit", "threshold"}
_SCALES = {"wheel_radius": 0.0, "effective_track": 0.05, "lateral_scale": 0.0}


def _check_value(effect: str, name: str, value: float) -> None:
    low = -_INF
    waits = effect in {"deadband", "transport_delay", "reversal_pause"} and name == "d"
    if name in _NEVER_NEGATIVE or name.startswith("tau") or effect == "steering_play" or waits:
        low = 0.0
    elif name == "k" and effect in _SCALES:
        low = _SCALES[effect]
    if math.isnan(value) or value < low or (math.isinf(value) and name != "limit"):
        raise SimulateError(
            "bad_value",
            f"{effect}.{name} = {value} is not possible",
            where=effect,
            hint=f"Give a finite number{'' if low == -_INF else f' of at least {low:g}'}",
        )
