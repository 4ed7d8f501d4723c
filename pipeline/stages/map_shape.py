"""Whether the map is as long along one direction as along another: way over wheel way by the heading."""

from __future__ import annotations

import math

import numpy as np

from pipeline.core import arrays
from pipeline.core.arrays import Flags, Floats, Ints, fit_robustly
from pipeline.core.numerics import student_quantile
from pipeline.core.program import format_share
from pipeline.sources import Vehicle
from pipeline.stages import Finding
from pipeline.stages.trust import Samples, list_spans

# A map that is scaled or sheared has, to first order, distances that are 1 + s + a cos 2h + b sin 2h times as
# long as they are along heading h. The scale s is also what a wheel radius is, and no log tells them apart; a
# and b no vehicle makes, as they follow the map's axes: what turns with the vehicle is the same along all.
# What a slope adds follows the heading once in a turn; it is fitted beside them, and so is what speed,
# turning and a late pose take.

_CURVE_RAD = 0.5
"""Turned in a span: in a sharper curve it has no one heading."""
_LIVE = 0.2
"""Of the usual largest speed, from which on wheels drive."""
_FEWEST = 120
"""Spans of driving, a minute, below which nothing is looked for."""
_BLOCKS = 20
"""Stretches of the run that are left out in turn, which tells how uncertain the shape is."""
_SECTORS = 4
"""Of pairs of opposite headings: what repeats itself twice a turn is seen from four of them."""
_FEWEST_SECTORS = 3
"""Of four pairs of opposite headings, those with driving: two would be two roads, of two kinds of ground."""
_SECTOR_SHARE = 0.08
"""Of the spans, that a sector must have to count."""
_CHANCE = 1e-3
"""Chance of the finding where the map is even, were stretches independent."""
_LEAST = 0.01
"""Difference between the longest and the shortest direction that matters: a tape measure is as good."""


def check_map_shape(samples: Samples, _vehicle: Vehicle) -> list[Finding]:
    """A map that is longer along one direction than across it."""
    if samples.measured is None:
        return []
    first, last = _list_straight_spans(samples, samples.measured)
    if first.size < _FEWEST or not _turns_about(samples.yaw[(first + last) // 2]):
        return []
    design, moved = _arrange(samples, samples.measured, first, last)
    stretch = np.minimum(np.arange(first.size) * _BLOCKS // first.size, _BLOCKS - 1)
    whole = fit_robustly(design, moved)[0]
    others = [stretch != one for one in range(_BLOCKS)]
    without = np.array([fit_robustly(design[rows], moved[rows])[0] for rows in others])
    pair, pairs = whole[1:3], without[:, 1:3]
    freedom = _BLOCKS - 1.0
    centred = pairs - pairs.mean(axis=0)
    covariance = freedom / _BLOCKS * centred.T @ centred
    size = float(np.hypot(*pair))
    along = pair / max(size, 1e-12)
    half = student_quantile(0.95, freedom) * 2.0 * math.sqrt(float(along @ covariance @ along))
    # Hotelling's T of two numbers: its F has a quantile in closed form.
    reached = float(pair @ np.linalg.pinv(covariance) @ pair) * (freedom - 1.0) / (2.0 * freedom)
    needed = 0.5 * (freedom - 1.0) * (_CHANCE ** (-2.0 / (freedom - 1.0)) - 1.0)
    stretched = 2.0 * size
    if reached < needed or stretched < _LEAST:
        return []
    angle = math.degrees(0.5 * math.atan2(pair[1], pair[0])) % 180.0
    low, high = (format_share(max(end, 0.0), 2) for end in (stretched - half, stretched + half))
    text = (
        f"by the wheels, distances in the map are {format_share(stretched, 2)} ({low} to {high}) longer "
        f"along its heading of {angle:.0f} degrees than across: it is sheared or its axes have unequal "
        "scales, or there is a slope that the poses do not show (a scale of the whole map is not told from "
        "the wheels' radius)"
    )
    return [Finding("map_uneven", "warning", text, where="pose", value=stretched, count=int(first.size))]


def _list_straight_spans(samples: Samples, measured: Floats) -> tuple[Ints, Ints]:
    """First and last samples of half seconds of driving along one heading, each of shape (m,)."""
    known: Flags = np.isfinite(measured).all(axis=1) & np.isfinite(samples.velocity[:, 0])
    driven = np.abs(np.nan_to_num(measured[:, 0]))
    first, last = list_spans(samples, known & (driven > _LIVE * float(np.quantile(driven, 0.95))))
    straight = np.abs(samples.yaw[last] - samples.yaw[first]) < _CURVE_RAD
    return first[straight], last[straight]


def _turns_about(heading: Floats) -> bool:
    """Whether there is driving along enough directions of the map."""
    sector = np.floor(heading / np.pi * _SECTORS).astype(np.int64) % _SECTORS
    share = np.bincount(sector, minlength=_SECTORS) / heading.size
    return int((share > _SECTOR_SHARE).sum()) >= _FEWEST_SECTORS


def _arrange(samples: Samples, measured: Floats, first: Ints, last: Ints) -> tuple[Floats, Floats]:
    """What the way ahead of each span may be made of, shape (m, 11), and that way [m], shape (m,)."""
    rates = (samples.velocity[:, 0], measured[:, 0])
    paths = (arrays.integrate_rate(samples.times, np.nan_to_num(rate)) for rate in rates)
    moved, driven = (path[last] - path[first] for path in paths)
    heading = 0.5 * (samples.yaw[first] + samples.yaw[last])
    once, twice = np.exp(1j * heading), np.exp(2j * heading)
    turned = samples.yaw[last] - samples.yaw[first]
    size, lasted = np.abs(driven), samples.times[last] - samples.times[first]
    columns = (
        driven, driven * twice.real, driven * twice.imag,
        size * once.real, size * once.imag, lasted * once.real, lasted * once.imag,
        driven * size, driven * turned, driven * np.abs(turned), measured[last, 0] - measured[first, 0],
    )  # fmt: skip
    # The share of the wheels' way that is made altogether: at one speed the columns do not tell it.
    gain = float(driven @ moved) / float(driven @ driven)
    return gain * np.column_stack(columns), moved
