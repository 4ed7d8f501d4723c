"""Numbers of an effect on its own way: command to wheels for the drivetrain, wheels to body for the ground.

What one way leaves unexplained is pressed into the numbers of the other where both are fitted at once.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from pipeline.diagnosis.diagnosis import Value
from pipeline.models.effect import Search

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.diagnosis.naming import Search as Found
    from pipeline.diagnosis.timing import YawDelay
    from pipeline.identification import Estimates
    from pipeline.models import Effect

_SURE = 1.96


def list_values(effect: Effect, estimates: Estimates | None) -> dict[str, Value]:
    """Numbers of an effect with the intervals of a fit; none where the fit could not tell."""
    known = {} if estimates is None else {item.free.label: item for item in estimates.items}
    values = {}
    for parameter in effect.parameters:
        value = effect.values[parameter.name]
        if not math.isfinite(value):
            continue
        item = known.get(f"{effect.id}.{parameter.name}")
        low, high = (math.nan, math.nan) if item is None else (item.low, item.high)
        least, most = parameter.bounds
        if high - low > most - least:
            low = high = math.nan
        values[parameter.name] = Value(value, low, high, parameter.unit)
    return values


def measure_values(effect: Effect, found: Found) -> dict[str, Value]:
    """Numbers of an effect as the search fitted them, with intervals from stretches of ten seconds.

    Each stretch's pull on the fit counts as one observation, whatever repeats itself inside it.
    """
    arena, fitted = found.arena, found.final.fitted
    factor = arena.metric.weights(fitted.residual)
    smooth = [place for place, slot in enumerate(fitted.slots) if slot.search is not Search.GRID]
    errors: dict[str, float] = {}
    if smooth:
        rows = fitted.jacobian[:, :, smooth] * factor[:, :, None]
        flat = rows.reshape(-1, len(smooth))
        bread = np.linalg.pinv(flat.T @ flat)
        unit = arena.problem.unit
        pulls = np.zeros((int(unit.max()) + 1, len(smooth)))
        np.add.at(pulls, unit, np.einsum("nip,ni->np", rows, fitted.residual * factor))
        count = int(np.unique(unit).size)
        covariance = bread @ (pulls.T @ pulls) @ bread * count / max(count - len(smooth), 1)
        spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        for place, error in zip(smooth, spread.tolist(), strict=True):
            if fitted.slots[place].effect == effect.id:
                errors[fitted.slots[place].name] = error
    values = {}
    for name, value in list_values(effect, None).items():
        half = _SURE * errors.get(name, math.nan)
        low, high = effect.parameter(name).bounds
        half = half if 2.0 * half <= high - low else math.nan
        values[name] = Value(value.value, value.value - half, value.value + half, value.unit)
    return values


def read_gyro_clock(effect: Effect, delays: Sequence[YawDelay]) -> dict[str, Value]:
    """How late poses are by the gyro's clock: no fit of the motion moves it, its error is the gyro's."""
    (parameter,) = effect.parameters
    value = effect.values[parameter.name]
    half = _SURE * float(np.sqrt(np.mean([delay.error**2 for delay in delays]) / len(delays)))
    half = half if np.isfinite(half) else math.nan
    return {parameter.name: Value(value, value - half, value + half, parameter.unit)}


def rescale_values(values: Mapping[str, Value], scale: float) -> dict[str, Value]:
    """Numbers of an effect multiplied, with their intervals."""
    return {
        name: Value(scale * value.value, scale * value.low, scale * value.high, value.unit)
        for name, value in values.items()
    }
