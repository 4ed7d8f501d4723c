"""Curves of what is known against the seconds that were driven for it."""

import math
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Floats, Ints
from pipeline.identification.fit import Fitted
from pipeline.identification.intervals import narrow_part
from pipeline.models.catalogue import find_effect

INTERVAL_SHARE = 0.05
"""Of a number's size: half of a 95 % interval that is narrow enough."""
_POINTS = 60


@dataclass(frozen=True)
class Curve:
    """Values by the seconds of driving behind them, both of shape (k,)."""

    seconds: Floats
    values: Floats


def pick_points(count: int) -> Ints:
    """Which of so many points of a curve are told, the first and the last among them: at most sixty."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, _POINTS)).round().astype(np.int64))


def narrow_intervals(fitted: Fitted) -> dict[str, Curve]:
    """Half-widths of the 95 % intervals of all smooth numbers of effects, by label ``effect.name``.

    See `narrow_part`; numbers of one run alone are left out.
    """
    found: dict[str, Curve] = {}
    for part, fit in zip(fitted.problem.parts, fitted.fits, strict=True):
        if not fit.free:
            continue
        seconds, halves = narrow_part(part, fit)
        found |= {
            number.label: Curve(seconds, halves[:, place])
            for place, number in enumerate(fit.free)
            if number.effect and number.run is None and number.is_smooth
        }
    return found


def find_goal(effect: str, name: str, value: float) -> float:
    """Half-width that is narrow enough for a number: a share of it, or of a usual one where it is smaller."""
    parameter = find_effect(effect)().parameter(name)
    neutral = parameter.neutral if math.isfinite(parameter.neutral) else 0.0
    return INTERVAL_SHARE * max(abs(value), abs(parameter.typical - neutral))


def last_until(curve: Curve, goal: float) -> float:
    """Seconds after which a curve stays at or below a goal; infinite where it ends above it."""
    above = np.flatnonzero(~(curve.values <= goal))
    if above.size == 0:
        return float(curve.seconds[0])
    if above[-1] == curve.seconds.size - 1:
        return math.inf
    return float(curve.seconds[above[-1] + 1])


def extrapolate(curve: Curve, goal: float) -> float:
    """Seconds of such driving after which a width would reach a goal; infinite where it never would.

    The square of a width is a part that falls with the time driven, and one that stays: what is not known of
    the clocks does not go away by driving on. Both are read from the later half of the curve.
    """
    seconds, squares = curve.seconds, curve.values**2
    later = np.isfinite(squares) & (seconds >= 0.5 * seconds[-1])
    if later.sum() < 2:  # noqa: PLR2004 - two numbers are read from it
        return float(seconds[-1] * squares[-1] / goal**2)
    slope, stays = np.polyfit(1.0 / seconds[later], squares[later], 1)
    # From the last width on, whatever the fit says of it.
    falls = float(np.clip(slope / seconds[-1], 0.0, squares[-1]))
    stays = float(squares[-1]) - falls
    return math.inf if stays >= goal**2 else float(seconds[-1]) * falls / (goal**2 - stays)
