"""Regions with excess error of a model: commands, slopes, times and places with more than their share."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pipeline.core import Flags, Floats
from pipeline.estimation.window_residuals import WindowResiduals
from pipeline.results import Region
from pipeline.run import NODE_S

CHANNELS = ("x", "y", "w")
_LEAST_SHARE = 0.2
"""Smallest share of a channel's squared error for reporting a region: a fifth of the total."""
_EXCESS = 1.3
"""Factor over the expected error above which a region has excess error: 30 % more is not specific to it."""
_SHOWN = 3
"""Half of the number of regions that are picked: six, for three channels."""
_STANDING = 0.03
"""Largest ideal speed or yaw rate of a run [m/s, rad/s] up to which it counts as not driven or not turned:
shares are then taken of this value."""
_CHANGE = 0.05
"""Smallest change of a command, as a share of its largest value: the jitter of joysticks is smaller."""
_LARGE_SHARE = 0.5
"""Share of a channel's squared error in the main region: as much as in all other windows."""
_NARROW_SHARE, _NARROW_TIME = 0.75, 1.0 / 3.0
"""Share of the error, and at most of the time, from which on it is an event of its own."""
_CONCENTRATED = 1.5
"""Factor over its share of the time: a region that covers most of the run has most of any error."""
_BEYOND = 1.5
"""Factor over the error expected from the commands, for a time or a place: without an effect of either it
was at most 1.47 on nine simulated runs of 150 s, with a patch of other ground 1.6 to 2.8."""
_RIDGE = 1e-3
"""Ridge penalty as a share of each command's largest square, for poorly determined coefficients."""
_SLOPES_RAD = (math.radians(3.0), math.radians(6.0), math.radians(10.0))
"""Angles above which a region is on a slope: floors are level within a degree."""
_SHAPE_LAGS = (0, 2, 4)
"""Lags, in quarters of a second, at which products of two commands are formed."""


class _Cut(NamedTuple):
    """Rows of windows in a region, with what `Region` says of it."""

    kind: str
    id: str
    limits: tuple[float, ...]
    rows: Flags


def is_excessive(region: Region) -> bool:
    """Whether a region's share of the error exceeds the expected share."""
    least = _BEYOND if region.kind in _CIRCUMSTANCES else _EXCESS
    return region.share > max(least * region.expected, _EXCESS * region.time_share)


def is_narrow(region: Region) -> bool:
    """Whether a region has nearly all of the error in little of the time."""
    return region.share >= _NARROW_SHARE and region.time_share <= _NARROW_TIME


def map_errors(windows: WindowResiduals, residual: Floats, places: Floats) -> list[Region]:
    """Every region of every kind with its share of each channel's error.

    Args:
        windows: the windows.
        residual: of a model, shape (n, 3).
        places: x, y [m] in the map at every window, shape (n, 2).
    """
    regions = []
    candidates = [cut for cut in _list_regions(windows, places) if cut.rows.any()]
    for channel, name in enumerate(CHANNELS):
        limit = math.sqrt(36.0 * float(np.median(residual[:, channel] ** 2)) + 1.0)
        error = np.clip(residual[:, channel], -limit, limit)
        square = error**2
        total = float(square.sum())
        if total <= 0.0:
            continue
        response = _list_responses(windows.find_ideal(), channel)
        for kind, which, limits, rows in candidates:
            share, time_share = float(square[rows].sum()) / total, float(rows.mean())
            expected = time_share
            if kind in _CIRCUMSTANCES and share > _EXCESS * time_share and not rows.all():
                inside = _expect_square(response, error, rows)
                outside = float(square[~rows].sum())
                # Without any error outside, nothing there tells what to expect.
                expected = inside / (inside + outside) if outside > 0.0 else time_share
            rms = float(np.sqrt(square[rows].mean()))
            regions.append(Region(name, kind, which, limits, share, time_share, rms, expected))
    return regions


_CIRCUMSTANCES = ("time", "place")
"""Kinds of regions whose commands differ from those elsewhere, which could explain an error there, too."""


def _list_responses(lags: Floats, channel: int) -> Floats:
    """Regressors of a channel's error: commands of the last 2 s, and physically motivated products.

    Args:
        lags: see `WindowResiduals.find_ideal`.
        channel: 0, 1, 2 for x, y, w: products as in the physics of speed, skid and yaw rate.

    Returns:
        Columns, the first of ones, none larger than one; shape (n, columns).
    """
    scaled = lags / np.maximum(np.abs(lags).max(axis=(0, 1)), _STANDING)
    speed, turn = scaled[:, _SHAPE_LAGS, 0], scaled[:, _SHAPE_LAGS, 1]
    own, other = (speed, turn) if channel == 0 else (turn, speed)
    shapes = [speed * turn] if channel == 1 else [own * np.abs(own), own * np.abs(other), own * other**2]
    return np.column_stack([np.ones(lags.shape[0]), scaled.reshape(lags.shape[0], -1), *shapes])


def _expect_square(response: Floats, error: Floats, rows: Flags) -> float:
    """Expected squared error in some windows, predicted from their commands by a fit to all other windows."""
    known, count = response[~rows], response.shape[1]
    penalty = _RIDGE * error.size * np.diag(np.arange(count) > 0).astype(np.float64)
    weights = np.linalg.solve(known.T @ known + penalty, known.T @ error[~rows])
    spread = float(((error[~rows] - known @ weights) ** 2).mean())
    return float(((response[rows] @ weights) ** 2 + spread).sum())


def pick_regions(regions: list[Region], residual: Floats, noise: Floats) -> list[Region]:
    """The few regions with most of the excess error.

    Args:
        regions: all regions.
        residual: of the model, shape (n, 3).
        noise: spread that no model can explain, by channel, shape (3,); at this level nothing is in excess.
    """
    excess = np.sqrt((residual**2).mean(axis=0)) > 1.2 * noise
    picked = []
    for channel, name in enumerate(CHANNELS):
        if not excess[channel]:
            continue
        distinct = [
            region
            for region in regions
            if region.channel == name and region.share >= _LEAST_SHARE and is_excessive(region)
        ]
        distinct.sort(key=lambda region: region.time_share - region.share)
        kinds: set[str] = set()
        for region in distinct:
            if region.kind not in kinds:
                kinds.add(region.kind)
                picked.append(region)
    picked.sort(key=lambda region: region.time_share - region.share)
    return picked[: 2 * _SHOWN]


def find_main_region(windows: WindowResiduals, residual: Floats, places: Floats) -> Region | None:
    """The region with half of a channel's squared error in much less of the time; None without one.

    Args:
        windows: the windows.
        residual: of a model, shape (n, 3).
        places: x, y [m] in the map at every window, shape (n, 2).
    """
    picked = pick_regions(map_errors(windows, residual, places), residual, windows.noise)
    return next(
        (region for region in picked if region.share >= max(_LARGE_SHARE, _CONCENTRATED * region.time_share)),
        None,
    )


def _list_regions(windows: WindowResiduals, places: Floats) -> list[_Cut]:
    lags = windows.find_ideal()
    speed, turn = lags[:, 0, 0], lags[:, 0, 1]
    regions = _cut_commands(speed, turn)
    for aside in lags[:, 0, 2:].T:
        regions += _cut_sideways(aside)
    changed = np.abs(lags - lags[:, :1, :]).max(axis=1) > _CHANGE * np.abs(lags).max(axis=(0, 1))
    transitory = changed.any(axis=1)
    regions.append(_Cut("phase", "change", (NODE_S * (lags.shape[1] - 1),), transitory))
    regions.append(_Cut("phase", "steady", (), ~transitory & windows.live))
    middle = windows.times.mean(axis=1)
    edges = np.linspace(float(middle.min()), float(middle.max()) + 1e-6, 6)
    for low, high in pairwise(edges.tolist()):
        regions.append(_Cut("time", "between", (low, high), (middle >= low) & (middle < high)))
    regions += _cut_slopes(windows)
    for axis, name in ((0, "x"), (1, "y")):
        cut = float(np.median(places[:, axis]))
        regions.append(_Cut("place", f"{name}_above", (cut,), places[:, axis] > cut))
        regions.append(_Cut("place", f"{name}_below", (cut,), places[:, axis] <= cut))
    return regions


def _cut_slopes(windows: WindowResiduals) -> list[_Cut]:
    """Regions by the slope that the vehicle stands on."""
    roll, pitch = windows.find_attitude().T
    slopes = (("uphill", -pitch), ("downhill", pitch), ("slope_left", -roll), ("slope_right", roll))
    return [
        _Cut("slope", name, (math.degrees(least),), angle > least)
        for name, angle in slopes
        for least in _SLOPES_RAD
    ]


def _cut_commands(speed: Floats, turn: Floats) -> list[_Cut]:
    """Regions of the command space by sign and magnitude of yaw rate, of speed, and of both together."""
    fast, sharp = float(np.abs(speed).max()), float(np.abs(turn).max())
    regions: list[_Cut] = []
    signs = ((1.0, "left", "forward"), (-1.0, "right", "backward"))
    for sign, side, direction in signs:
        for share in (0.25, 0.5):
            if sharp > _STANDING:
                regions.append(_Cut("command", side, (share * sharp,), sign * turn > share * sharp))
            if fast > _STANDING:
                regions.append(_Cut("command", direction, (share * fast,), sign * speed > share * fast))
    for share in (0.25, 0.5):
        turning = np.abs(turn) > share * max(sharp, _STANDING)
        driving = np.abs(speed) > share * max(fast, _STANDING)
        regions.append(_Cut("command", "turning", (share * sharp,), turning))
        regions.append(_Cut("command", "driving", (share * fast,), driving))
        regions.append(_Cut("command", "curve", (share * sharp, share * fast), turning & driving))
    slow = (np.abs(speed) < 0.15 * max(fast, _STANDING)) & (np.abs(turn) > 0.25 * max(sharp, _STANDING))
    regions.append(_Cut("command", "on_the_spot", (), slow))
    straight = (np.abs(turn) < 0.1 * max(sharp, _STANDING)) & (np.abs(speed) > 0.25 * max(fast, _STANDING))
    regions.append(_Cut("command", "straight", (), straight))
    return regions


def _cut_sideways(aside: Floats) -> list[_Cut]:
    """Regions of the command space by sign and magnitude of sideways motion."""
    fast = float(np.abs(aside).max())
    if fast <= _STANDING:
        return []
    regions: list[_Cut] = []
    for share in (0.25, 0.5):
        least = share * fast
        regions.append(_Cut("command", "to_the_left", (least,), aside > least))
        regions.append(_Cut("command", "to_the_right", (least,), -aside > least))
        regions.append(_Cut("command", "sideways", (least,), np.abs(aside) > least))
    return regions
