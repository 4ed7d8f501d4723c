"""Whether measured wheels are on the scale of the motion: a wrong wheel radius, or a wrong unit.

Ground that slips makes wheels cover less way than they turn, and never so much more. A gain that is a unit's
is one: rpm for rad/s, degrees, millimetres.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from pipeline.stages.finding import Finding
from pipeline.vehicles import list_factors

if TYPE_CHECKING:
    from pipeline.stages.samples import Samples
    from pipeline.vehicles import Vehicle

Floats = NDArray[np.float64]

_UNIT_NEAR: Final = 0.2
"""A gain within so much of a unit's is taken for it; slip of ground and a radius differ less."""
_LEAST: Final = 0.55
_MOST: Final = 1.25
"""Way over wheel way that ground can make: on ice a third is lost, downhill a little is won."""
_LIVE: Final = 0.2
_FEWEST: Final = 100
_STEADY: Final = 0.25
"""Largest relative spread of the gain: a scale is the same throughout, slip is not."""


def check_scale(samples: Samples, vehicle: Vehicle) -> list[Finding]:
    """Steady gain of the motion ahead on that of the measured wheels."""
    if samples.measured is None:
        return []
    driven, moved = samples.measured[:, 0], samples.velocity[:, 0]
    known = np.isfinite(driven) & np.isfinite(moved) & samples.steady
    if known.sum() < _FEWEST:
        return []
    live = known & (np.abs(driven) > _LIVE * float(np.max(np.abs(driven[known]))))
    if live.sum() < _FEWEST:
        return []
    ratio = moved[live] / driven[live]
    gain = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - gain)))
    if gain <= 0.0 or spread > _STEADY * gain or _LEAST < gain < _MOST:
        return []
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
