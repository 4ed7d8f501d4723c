"""What is too small to be named, and what no vehicle does."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.diagnosis.screen import Largest
    from pipeline.motion.effect import Effect, Parameter

# Below these an effect cannot be told from stamps, mounting and rounding, however small its interval.
_LEAST: Mapping[tuple[str, str], float] = {
    ("transport_delay", "d"): 0.012,
    ("clock_offset", "d"): 0.012,
    ("heading_skew", "d"): 0.012,
    ("yaw_misalignment", "psi"): 0.003,
    ("icr_offset", "x_icr"): 0.004,
    ("icr_lateral", "y_icr"): 0.004,
    ("drive_lag", "tau"): 0.015,
    ("body_inertia", "tau"): 0.02,
    ("steering_lag", "tau"): 0.015,
    ("lateral_skid", "c"): 0.012,
}
_LATE = frozenset({"transport_delay", "clock_offset", "drive_lag", "steering_lag"})
# How far from its neutral value a gain must be: less is a vehicle's data sheet, not an effect.
_LEAST_GAIN: Mapping[str, tuple[tuple[str, ...], float]] = {
    "wheel_radius": (("k",), 0.004),
    "wheel_asymmetry": (("e",), 0.003),
    "effective_track": (("k",), 0.01),
    "steering_gain": (("g",), 0.01),
    "steering_offset": (("o",), 0.002),
    "time_drift": (("k",), 0.015),
    "terrain_change": (("k_v", "k_w"), 0.03),
    "turn_droop": (("gain",), 0.03),
}
# Sizes that vehicles show (a wider range than was ever seen): outside, a name stands for something else.
_PLAUSIBLE: Mapping[tuple[str, str], tuple[float, float]] = {
    ("wheel_radius", "k"): (0.7, 1.3),
    ("wheel_asymmetry", "e"): (-0.2, 0.2),
    ("effective_track", "k"): (0.7, 4.0),
    ("icr_offset", "x_icr"): (-0.6, 0.6),
    ("icr_lateral", "y_icr"): (-0.5, 0.5),
    ("lateral_skid", "c"): (-0.02, 0.4),
    ("speed_slip", "k"): (-0.02, 0.4),
    ("turning_resistance", "k"): (-0.05, 0.6),
    ("slope_drift", "k"): (-0.1, 2.5),
    ("time_drift", "k"): (-0.4, 0.4),
    ("terrain_change", "k_v"): (0.4, 1.7),
    ("terrain_change", "k_w"): (0.4, 1.7),
    ("drive_lag", "tau"): (0.0, 3.0),
    ("turn_lag", "tau_mean"): (0.0, 3.0),
    ("turn_lag", "tau_diff"): (0.0, 3.0),
    ("transport_delay", "d"): (0.0, 0.8),
    ("body_inertia", "tau"): (0.0, 3.0),
    ("turn_droop", "gain"): (0.0, 0.97),
    ("steering_gain", "g"): (0.5, 1.5),
    ("understeer", "K"): (-0.02, 0.5),
    ("yaw_misalignment", "psi"): (-0.35, 0.35),
    ("heading_skew", "d"): (-0.3, 0.4),
    ("clock_offset", "d"): (-0.8, 0.8),
}
# What only ever takes motion away: the other sign is no physics, but a clock or chance.
_ONE_SIGN: Mapping[str, str] = {
    "lateral_skid": "c",
    "speed_slip": "k",
    "turning_resistance": "k",
    "slope_drift": "k",
    # A heading newer than its position is lateral skid to the first order, and skid is what vehicles do.
    "heading_skew": "d",
}
_SHARE_OF_TURNING = 0.1
_LEAST_RISE = 0.08
_LEAST_RAMP_S = 0.08
_APART = 0.08
_LEAST_APART_S = 0.02
_LEAST_DEADBAND = 0.02
_REACHED = 0.99
_EDGE = 0.15
_AT_BOUND = 1e-3


def is_nameable(effect: Effect, largest: Largest, least_delay: float = 0.0) -> bool:
    """Whether an effect is large enough to be named, of a vehicle's size, and not another one in disguise.

    Args:
        effect: with its values.
        largest: what the run asked for.
        least_delay: delays and lags below it are a matter of sampling [s].
    """
    sized = is_large_enough(effect, least_delay) and _is_itself(effect, largest, least_delay)
    return sized and find_implausible(effect) is None


def is_large_enough(effect: Effect, least_delay: float = 0.0) -> bool:
    """Whether an effect is more than stamps, mounting and rounding make of nothing."""
    for (name, parameter), least in _LEAST.items():
        size = abs(effect.values[parameter]) if effect.id == name else math.inf
        if size < least or (effect.id in _LATE and size < least_delay):
            return False
    if effect.id in _LEAST_GAIN:
        names, least = _LEAST_GAIN[effect.id]
        return max(abs(effect.values[name] - effect.parameter(name).neutral) for name in names) >= least
    return True


def _is_itself(effect: Effect, largest: Largest, least_delay: float) -> bool:
    """Whether an effect is no degenerate form of another one, and of the sign that physics has."""
    if effect.id in _ONE_SIGN:
        return effect.values[_ONE_SIGN[effect.id]] > 0.0
    if effect.id == "turn_lag":
        fast, slow = effect.values["tau_mean"], effect.values["tau_diff"]
        # With equal time constants it is a drive lag.
        apart = abs(fast - slow) > max(_APART * max(fast, slow), least_delay, _LEAST_APART_S)
        return apart and max(fast, slow) > max(_LEAST_APART_S, least_delay)
    if effect.id == "terrain_change":
        return _lies_within(effect.values["at_s"], effect.values["at_x"], largest)
    checks = {
        "deadband": lambda v: v["d"] > _LEAST_DEADBAND * largest.speed,
        "acceleration_limit": lambda v: v["limit"] * _LEAST_RAMP_S < largest.wheel,
        # With its threshold at zero a droop is a wider track, with no gain beyond it a limit.
        "turn_droop": lambda v: (
            _SHARE_OF_TURNING < v["threshold"] / largest.difference < _REACHED and v["gain"] > _LEAST_RISE
        ),
        "body_speed_limit": lambda v: v["limit"] <= _REACHED * largest.speed,
        "body_turn_limit": lambda v: v["limit"] <= _REACHED * largest.turn,
        "wheel_speed_limit": lambda v: v["limit"] <= _REACHED * largest.wheel,
    }
    return effect.id not in checks or bool(checks[effect.id](effect.values))


def _lies_within(at_s: float, at_x: float, largest: Largest) -> bool:
    """Whether a change lies in the run: near its ends it is a wheel radius and a track under another name."""
    if math.isfinite(at_s):
        return _EDGE <= at_s / largest.duration <= 1.0 - _EDGE
    tenths = largest.places
    low, high = 0.5 * (tenths[1] + tenths[2]), 0.5 * (tenths[-3] + tenths[-2])
    return not math.isfinite(at_x) or bool(low <= at_x <= high)


def _is_at_bound(value: float, parameter: Parameter) -> bool:
    """Whether a number only stopped because it may go no further; at no effect it may well stand."""
    if value == parameter.neutral:
        return False
    low, high = parameter.bounds
    margin = _AT_BOUND * (high - low) if math.isfinite(high - low) else 0.0
    return value <= low + margin < parameter.neutral or value >= high - margin > parameter.neutral


def find_implausible(effect: Effect) -> str | None:
    """In words what no vehicle does, None where the numbers are those of a vehicle."""
    for parameter in effect.parameters:
        value = effect.values[parameter.name]
        if not math.isfinite(value):
            continue
        low, high = _PLAUSIBLE.get((effect.id, parameter.name), parameter.bounds)
        if not low <= value <= high or _is_at_bound(value, parameter):
            unit = "" if parameter.unit == "1" else f" {parameter.unit}"
            return (
                f"{effect.id}: {parameter.name} = {value:.3g}{unit} is outside of what vehicles show "
                f"({low:g} to {high:g}{unit}); it may stand for another cause"
            )
    return None
