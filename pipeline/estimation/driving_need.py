"""How the evidence for effects and their intervals grow with driving, and whether the log is long enough."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from pipeline.core import Floats, Ints, round_digits
from pipeline.estimation.intervals import narrow_path
from pipeline.estimation.window_residuals import count_seconds
from pipeline.models import FEW_STRETCHES, FEWEST_STRETCHES, TOO_SHORT, Number, find_effect
from pipeline.results import INTERVAL_SHARE, DataNeed, GrownEvidence, Growth, Narrowing

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.estimation.estimation_data import EstimationData
    from pipeline.estimation.intervals import Estimates
    from pipeline.estimation.model_fit import Fitted
    from pipeline.results import Named

# A smaller relative reduction of an interval is no reduction.
_NO_NARROWER = 0.1
# Longest suggested driving, as a multiple of the time driven.
_TOO_LONG = 10.0
_POINTS = 60
"""Maximum number of points of a curve in a figure."""
_DIGITS = 4
"""Significant digits of a curve in JSON: a figure shows three."""


# Eight steps of six seconds, and fifteen: with fewer, a delay or a terrain change imitates the true effect.
_LEAST_DRIVING_S = {"measured": 48.0, "command": 90.0}


@dataclass(frozen=True)
class Curve:
    """Values by the seconds of driving, both of shape (k,)."""

    seconds: Floats
    values: Floats


def measure_driven(data: EstimationData) -> tuple[float, float]:
    """Seconds of driving, and how many are needed for a reliable identification."""
    return float(count_seconds(data.whole).sum()), _LEAST_DRIVING_S[data.source.value]


def list_numbers(data: EstimationData, fitted: Fitted, estimates: Estimates) -> dict[str, Number]:
    """Numbers of a fit by label ``effect.name``, with what the driving makes doubtful of them.

    All of them where it is too short; else those whose information comes from a few blocks, counted as
    the square of its sum over the sum of its squares: of blocks that inform equally, their number. Of those
    that runs have of their own only the doubt is known.
    """
    numbers, unknown = estimates.numbers, Number(math.nan)
    driven, least = measure_driven(data)
    if driven < least:
        labels = [number.label for number in fitted.free if number.effect]
        return numbers | {one: replace(numbers.get(one, unknown), doubt=TOO_SHORT) for one in labels}
    for label, curve in narrow_intervals(fitted).items():
        gained = np.diff(curve.values**-2.0, prepend=0.0).clip(0.0)
        count = max(round(float(gained.sum() ** 2 / np.sum(gained**2))), 1) if gained.any() else 0
        if 0 < count < FEWEST_STRETCHES:
            known = numbers.get(label, unknown)
            numbers[label] = replace(known, doubt=FEW_STRETCHES, stretches=count)
    return numbers


def thin_growth(evidence: Curve | None, widths: Mapping[str, Curve]) -> Growth:
    """Evidence and half-widths by parameter with at most sixty points each.

    Args:
        evidence: t of the effect; None where it was not searched for.
        widths: half-width of the 95 % interval by parameter.
    """
    return Growth(
        None if evidence is None else GrownEvidence(*_thin(evidence)),
        {name: Narrowing(*_thin(one)) for name, one in widths.items()},
    )


def _thin(curve: Curve) -> tuple[tuple[float, ...], tuple[float, ...]]:
    places = pick_points(curve.seconds.size)
    seconds, values = (column[places].tolist() for column in (curve.seconds, curve.values))
    return tuple(round(one, 1) for one in seconds), tuple(
        round_digits(one, _DIGITS) if math.isfinite(one) else math.nan for one in values
    )


def measure_need(effects: Sequence[Named], widths: Mapping[str, Curve]) -> DataNeed | None:
    """How well the driven time determines the parameters of effects, and how much more is needed.

    A value is known if no doubt is about it and the half-width of its interval is a twentieth of it, or of a
    typical value if larger; open if it is in doubt, or its interval is as wide as the number itself
    (`Number.is_open`). One that runs have of their own is known where it is in all of them. Of a number
    without a curve, as a threshold, more driving is not known to narrow the interval: it is known or open.

    Args:
        effects: identified effects.
        widths: half-width of the 95 % interval by label ``effect.name``.

    Returns:
        None where no identified effect has a number that was fitted.
    """
    known, vague, needed, driven, small, open_ones = [], [], 0.0, 0.0, False, 0
    for effect in effects:
        for name, value in effect.parameters.items():
            if effect.corrected or not math.isfinite(value.value):
                continue
            label = f"{effect.id}.{name}"
            curve, parameter = widths.get(label), find_effect(effect.id)().parameter(name)
            values = [one[name] for one in effect.by_run] if name in effect.own else [value]
            half = max(one.half for one in values) if curve is None else float(curve.values[-1])
            goal = find_goal(effect.id, name, value.value)
            is_open = any(one.doubt or one.is_open(parameter) for one in values)
            if is_open or not half < goal / INTERVAL_SHARE or (curve is None and half > goal):
                open_ones += 1
                continue
            since = math.nan
            if curve is not None:
                since = last_until(curve, goal)
                driven = max(driven, float(curve.seconds[-1]))
                needed = max(needed, last_until(curve, half * (1.0 + _NO_NARROWER)))
            if curve is not None and math.isinf(since):
                vague.append((half / goal, label, half, value.unit, curve, goal))
            else:
                known.append((since, label))
                small |= half > INTERVAL_SHARE * abs(value.value)
    if not (known or vague or open_ones):
        return None
    need = DataNeed(
        tuple(label for _, label in sorted(known, key=lambda one: (math.isnan(one[0]), one))),
        float(np.max([since for since, _ in known])) if known else math.nan,
        driven,
        is_typical=small,
        open=open_ones,
        idle_share=1.0 - needed / driven if driven else 0.0,
    )
    if not vague:
        return need
    _, label, half, unit, curve, goal = max(vague, key=lambda one: one[0])
    seconds = extrapolate(curve, goal)
    minutes = math.ceil((seconds - driven) / 60.0) if seconds < _TOO_LONG * driven else 0
    return replace(need, vague=label, half_width=half, unit=unit, others=len(vague) - 1, minutes=minutes)


def pick_points(count: int) -> Ints:
    """Indices of the points of a curve that are reported: at most sixty, including the first and the last."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, _POINTS)).round().astype(np.int64))


def narrow_intervals(fitted: Fitted) -> dict[str, Curve]:
    """Half-widths of the 95 % intervals of all smooth parameters of effects, by label ``effect.name``.

    See `narrow_path`; parameters of single runs are excluded.
    """
    curves: dict[str, Curve] = {}
    for fit in fitted.fits:
        if not fit.free:
            continue
        seconds, halves = narrow_path(fit)
        curves |= {
            number.label: Curve(seconds, halves[:, index])
            for index, number in enumerate(fit.free)
            if number.effect and not number.runs and number.is_smooth
        }
    return curves


def find_goal(effect: str, name: str, value: float) -> float:
    """Target half-width for a parameter: a share of its size, or of its typical size if that is larger."""
    parameter = find_effect(effect)().parameter(name)
    neutral = parameter.neutral if math.isfinite(parameter.neutral) else 0.0
    return INTERVAL_SHARE * max(abs(value), abs(parameter.typical - neutral))


def last_until(curve: Curve, goal: float) -> float:
    """Seconds after which a curve stays at or below a goal; infinite if it ends above it."""
    above = np.flatnonzero(~(curve.values <= goal))
    if above.size == 0:
        return float(curve.seconds[0])
    if above[-1] == curve.seconds.size - 1:
        return math.inf
    return float(curve.seconds[above[-1] + 1])


def extrapolate(curve: Curve, goal: float) -> float:
    """Seconds of such driving after which a width would reach a goal; infinite if it never would.

    The square of a width is the sum of a part that falls with the driving time, and of a constant: more
    driving does not reduce the clock errors. Both are fitted to the later half of the curve.
    """
    seconds, squares = curve.seconds, curve.values**2
    later = np.isfinite(squares) & (seconds >= 0.5 * seconds[-1])
    if later.sum() < 2:  # noqa: PLR2004 - two numbers are read from it
        return float(seconds[-1] * squares[-1] / goal**2)
    slope, stays = np.polyfit(1.0 / seconds[later], squares[later], 1)
    # The extrapolation begins at the last width, even if the fit deviates from it.
    falls = float(np.clip(slope / seconds[-1], 0.0, squares[-1]))
    stays = float(squares[-1]) - falls
    return math.inf if stays >= goal**2 else float(seconds[-1]) * falls / (goal**2 - stays)
