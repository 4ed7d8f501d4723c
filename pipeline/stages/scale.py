"""Whether measured wheels are on the scale of the motion: a wrong wheel radius, or a wrong unit.

Ground that slips makes wheels cover less way than they turn, and never so much more. A gain that is a unit's
is one: rpm for rad/s, degrees, millimetres. A smaller one is a radius only where the vehicle goes as
fast as its body command asks: a controller that knows the radius makes up for nothing that the ground takes.
"""

from typing import Final

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.stages.finding import Finding
from pipeline.stages.samples import Samples
from pipeline.vehicles import Vehicle, list_factors

_UNIT_NEAR: Final = 0.2
"""A gain within so much of a unit's is taken for it; slip of ground and a radius differ less."""
_LEAST: Final = 0.55
_MOST: Final = 1.25
"""Way over wheel way that ground can make: on ice a third is lost, downhill a little is won."""
_LIVE: Final = 0.2
_FEWEST: Final = 100
_TELLS: Final = 0.1
"""Differences of radius that a body command tells; tyres and their pressure make smaller ones."""
_AS_ASKED: Final = 0.05
"""A controller reaches the speed that it is asked for to within so much."""
_STEADY: Final = 0.25
"""Largest relative spread of the gain: a scale is the same throughout, slip is not."""


def check_scale(samples: Samples, vehicle: Vehicle) -> list[Finding]:
    """Steady gain of the motion ahead on that of the measured wheels."""
    gain = None if samples.measured is None else _find_gain(samples, samples.measured[:, 0])
    if gain is None or samples.measured is None:
        return []
    if _LEAST < gain < _MOST:
        asked = None
        if samples.body_commanded and samples.command is not None:
            asked = _find_gain(samples, samples.command[:, 0])
        if asked is None or abs(asked - 1.0) > _AS_ASKED or abs(gain - 1.0) < _TELLS:
            return []
    driven = samples.measured[:, 0]
    known = np.isfinite(driven) & samples.steady
    for unit, factor in list_factors("rad/s", "m/s").items():
        if abs(gain / factor - 1.0) < _UNIT_NEAR:
            fastest = float(np.max(np.abs(driven[known])))
            text = (
                f"the measured wheels say up to {fastest:.3g} m/s, and the vehicle covers {gain:.3g} times "
                f'that way: are they in {unit}? Then [wheels] unit = "{unit}" in run.toml'
            )
            return [Finding("unit_wrong", "error", text, where="wheels", value=gain)]
    radius = vehicle.wheel_radius_m
    text = (
        f"the vehicle covers {gain:.3g} times the way that wheels of radius {radius:g} m give: is it "
        f"{radius * gain:.3g} m? Then --wheel-radius {radius * gain:.3g}, or another --vehicle"
    )
    return [Finding("wheel_radius_wrong", "error", text, where="wheels", value=radius * gain)]


def _find_gain(samples: Samples, driven: Floats) -> float | None:
    """Median of the motion ahead over an ideal one [m/s], shape (n,); None where it is not steady."""
    moved = samples.velocity[:, 0]
    known = np.isfinite(driven) & np.isfinite(moved) & samples.steady
    if known.sum() < _FEWEST:
        return None
    live = known & (np.abs(driven) > _LIVE * float(np.max(np.abs(driven[known]))))
    if live.sum() < _FEWEST:
        return None
    ratio = moved[live] / driven[live]
    gain = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - gain)))
    return gain if gain > 0.0 and spread <= _STEADY * gain else None
