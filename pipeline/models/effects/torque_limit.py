"""Torque limit: wheels follow the commanded speed with a lag and a limited acceleration.

tau [s] and limit [rad/s^2]. After a small step the wheels follow like a drive lag; after a large one the
motors give their maximum, and the lag begins where limit tau remains. A commanded ramp is different: there
the lag follows the ramp. Command small and large steps of speed.

Source: saturation of a speed controller; Astrom and Murray, Feedback Systems, chapter 10.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import cast

from pipeline.models.effects.acceleration_limit import AccelerationLimit
from pipeline.models.effects.drive_lag import DriveLag
from pipeline.models.families import (
    LEAST_RAMP_S,
    TIME_CONSTANT,
    WARTHOG_LAGS,
    WHEELED,
    Conditions,
    Effect,
    Excitation,
    Floats,
    Largest,
    Least,
    Plausible,
    Quantity,
    Resets,
    Search,
    Spread,
    declare,
)
from pipeline.models.filters import lag_within


def _walk(
    values: Mapping[str, float], signal: Floats, step_s: float, resets: Resets, start: Floats
) -> Floats:
    return lag_within(signal, values["tau"], values["limit"], step_s, resets, start)


def _is_lag_or_ramp(effect: Effect, conditions: Conditions) -> bool:
    """Whether it is a lag, within the limit after the largest step, or a ramp without a lag."""
    tau, limit = effect.values.values()
    lags = tau > conditions.least_delay_s
    return not lags or limit * max(tau, LEAST_RAMP_S) >= conditions.largest.wheel


def _collapse(effect: Effect) -> Effect:
    """The lag, or the ramp."""
    tau, limit = effect.values.values()
    simpler = (
        DriveLag().change_within(tau=tau)
        if tau > LEAST_RAMP_S
        else AccelerationLimit().change_within(limit=limit)
    )
    return cast("Effect", simpler)


def _list_usual(effect: Effect, largest: Largest) -> dict[str, float]:
    return {"tau": effect.parameters[0].typical, "limit": largest.wheel}


TorqueLimit = declare(
    "torque_limit",
    __doc__,
    "dOmega/dt = (u - Omega) / tau within +-limit",
    replace(
        TIME_CONSTANT,
        typical=0.3,
        starts=(),
        search=Search.STARTS,
        least=Least(0.015, Least.STAMPS, sampled=1.0),
        plausible=Plausible(0.0, 3.0, "as of a drive lag"),
        between_runs=Spread(0.125, WARTHOG_LAGS),
        quantities=(Quantity.SPEED_LAG, Quantity.TURN_LAG),
    ),
    replace(AccelerationLimit.parameters[0], starts=(), search=Search.STARTS),
    rank=22,
    kinds=WHEELED,
    starts=(
        {"tau": 0.15, "limit": 4.0},
        {"tau": 0.5, "limit": 4.0},
        {"tau": 0.15, "limit": 12.0},
        {"tau": 0.5, "limit": 12.0},
    ),
    needs=(Excitation.CHANGES, Excitation.LARGE, Excitation.SMALL),
    walk=_walk,
    is_degenerate=_is_lag_or_ramp,
    collapse=_collapse,
    list_usual=_list_usual,
)
