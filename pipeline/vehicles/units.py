"""Units of what drives are told and what they measure, made one: rad/s, m/s, rad."""

import math
from collections.abc import Mapping
from typing import Final

from pipeline.vehicles.errors import ConfigurationError
from pipeline.vehicles.presets import OwnUnit

_KNOWN: Final[Mapping[str, tuple[float, str]]] = {
    "rad/s": (1.0, "rad/s"),
    "rpm": (2.0 * math.pi / 60.0, "rad/s"),
    "deg/s": (math.pi / 180.0, "rad/s"),
    "m/s": (1.0, "m/s"),
    "mm/s": (1e-3, "m/s"),
    "rad": (1.0, "rad"),
    "deg": (math.pi / 180.0, "rad"),
}


def list_factors(*made: str) -> dict[str, float]:
    """Units that are no SI units, and what one of each is in SI.

    Args:
        made: SI units that they come to.
    """
    return {unit: factor for unit, (factor, si) in _KNOWN.items() if si in made and unit != si}


def convert_unit(unit: str, own: Mapping[str, OwnUnit], *, where: str) -> tuple[float, float, str]:
    """Scale, offset and unit that turn raw numbers into SI: value = scale * (raw - offset).

    Args:
        unit: of the raw numbers.
        own: units that the platform knows; they win.
        where: topic, for the error.

    Raises:
        ConfigurationError: ``unit_unknown``, a unit that depends on the platform, which is not known.
    """
    if unit in own:
        return 1.0 / own[unit].per, own[unit].offset, own[unit].unit
    if unit in _KNOWN:
        scale, made = _KNOWN[unit]
        return scale, 0.0, made
    say = "per_turn = N (ticks a turn of the wheel)" if unit == "ticks" else 'unit = "rad/s", or a --vehicle'
    raise ConfigurationError(
        "unit_unknown",
        f"{where} counts in {unit}, and what that is on this vehicle is not known",
        where=where,
        hint=f"Say it in run.toml: {say}.",
    )
