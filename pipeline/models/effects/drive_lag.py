"""Drive lag: wheels follow the commanded speed like a first-order system.

tau [s]: 0.55 to 0.64 on a Husky on tile, 1.0 in snow, 1.05 to 1.2 on a Warthog. Change commands often.

Source: the powertrain model of Samson et al. 2024 and of DRIVE, Baril et al. 2024.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import cast

from pipeline.models.families import (
    TIME_CONSTANT,
    WARTHOG_LAGS,
    Conditions,
    Effect,
    Excitation,
    Least,
    Parameter,
    Plausible,
    Quantity,
    Spread,
    declare,
    is_one_motion,
)

DriveLag = declare(
    "drive_lag",
    __doc__,
    "tau * dOmega/dt = u - Omega",
    replace(
        TIME_CONSTANT,
        least=Least(0.015, Least.STAMPS, sampled=1.0),
        plausible=Plausible(0.0, 3.0, "wider than the 0.55 to 1.2 s of Husky and Warthog"),
        between_runs=Spread(0.125, WARTHOG_LAGS),
        quantities=(Quantity.SPEED_LAG, Quantity.TURN_LAG),
    ),
    rank=20,
    needs=(Excitation.CHANGES,),
    is_equivalent=is_one_motion,
)


def time_constant(name: str, about: str, typical: float, starts: tuple[float, ...]) -> Parameter:
    """One of two time constants."""
    return replace(TIME_CONSTANT, name=name, about=about, typical=typical, starts=starts)


def are_equal(apart: float, least_s: float) -> Callable[[Effect, Conditions], bool]:
    """`Effect.is_degenerate` of two time constants that are one.

    Args:
        apart: their smallest difference, as a share of the slower one.
        least_s: their smallest difference [s].
    """

    def is_one_lag(effect: Effect, conditions: Conditions) -> bool:
        one, other = effect.values.values()
        least = max(conditions.least_delay_s, least_s)
        return abs(one - other) <= max(apart * max(one, other), least)

    return is_one_lag


def to_one_lag(effect: Effect) -> Effect:
    """`Effect.collapse` of two time constants: a drive lag with their mean."""
    return cast("Effect", DriveLag().change_within(tau=0.5 * sum(effect.values.values())))
