"""Deadband: wheels stand still for commands that are too small.

step(x) is one from zero on, and zero below it. d [m/s] at the rim, 0.04 to 0.3. Drive slowly, and turn
slowly while driving.

Source: static friction of a geared drive; Siciliano and Khatib, Springer Handbook of Robotics, chapter 24.
"""

from pipeline.models.families import (
    WHEELED,
    Conditions,
    Effect,
    Excitation,
    Largest,
    Parameter,
    Place,
    Quantity,
    Search,
    declare,
)

# Share of the largest speed: a command passes a smaller deadband in one step.
_LEAST_SHARE = 0.02


def _is_small(effect: Effect, conditions: Conditions) -> bool:
    """Whether it is too small relative to the largest commanded speed."""
    return not effect.values["d"] > _LEAST_SHARE * conditions.largest.speed


def _list_usual(effect: Effect, largest: Largest) -> dict[str, float]:
    return {"d": effect.parameters[0].typical * min(largest.speed, 1.0)}


Deadband = declare(
    "deadband",
    __doc__,
    "Omega = step(r * abs(u) - d) * u",
    Parameter(
        "d",
        "m/s",
        (0.0, 2.0),
        0.0,
        "smallest rim speed that moves a wheel",
        0.15,
        search=Search.GRID,
        starts=(0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.45),
        step=0.02,
        quantities=(Quantity.DEADBAND,),
    ),
    rank=30,
    kinds=WHEELED,
    needs=(Excitation.SMALL,),
    place=Place.COMMAND,
    is_degenerate=_is_small,
    list_usual=_list_usual,
)
