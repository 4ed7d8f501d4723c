"""Whether map scale depends on direction: ratio of pose path to wheel path by heading."""

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

# A map that is scaled or sheared multiplies distances along heading h, to first order, by
# 1 + s + a cos 2h + b sin 2h. A log cannot distinguish the scale s from a wheel radius. No vehicle causes
# a and b, which follow the map's axes: an effect that turns with the vehicle is equal along all of them. The
# effect of a slope varies once per turn with the heading; it is fitted jointly, as are those of speed,
# turning and a late pose.

_CURVE_RAD = 0.5
"""Change of heading [rad] in a span above which it has no single heading."""
_LIVE = 0.2
"""Fraction of the usual largest speed above which wheels drive."""
_FEWEST = 120
"""Least number of spans of driving: one minute."""
_BLOCKS = 20
"""Number of stretches that are left out in turn, for the jackknife uncertainty of the shape."""
_SECTORS = 4
"""Pairs of opposite headings: four resolve an effect that repeats twice per turn."""
_FEWEST_SECTORS = 3
"""Least number of the four sectors with driving: two could be two roads with different ground."""
_SECTOR_SHARE = 0.08
"""Least fraction of the spans for a sector to count."""
_CHANCE = 1e-3
"""False-alarm probability on an even map if stretches are independent."""
_LEAST = 0.01
"""Least reported difference between longest and shortest direction: a tape measure is as accurate."""


def check_map_shape(samples: Samples, _vehicle: Vehicle) -> list[Finding]:
    """Report a map that is longer along one direction than across it."""
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
    """Regressors of each span's forward displacement, shape (m, 11), and the displacement [m], shape (m,)."""
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
    # Overall gain of the wheels' path: at one speed the columns do not determine it.
    gain = float(driven @ moved) / float(driven @ driven)
    return gain * np.column_stack(columns), moved
