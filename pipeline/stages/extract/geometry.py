"""Geometry of a vehicle that nothing names: as its poses show it, and as its controller drives with."""

from collections.abc import Mapping
from typing import Final

import numpy as np
import polars as pl

from pipeline.core import timegrid
from pipeline.core.arrays import Floats
from pipeline.stages.extract.choice import split_chords, yaw_of

_SPAN_S: Final = 0.5
_ASKED_SPAN_S: Final = 2.0
"""Over so long wheels have done what they were asked, but for a drive's lag at its ends."""
_STEADY: Final = 0.2
_LIVE: Final = 0.1
"""Share of the largest way of a span below which a ratio says nothing."""
_LIKELY: Final = {"wheel_radius_m": (0.7, 1.4), "track_width_m": (0.8, 4.0)}
"""Geometry by the poses over that of the controller: ice takes a third of the way, a skid-steer may turn by a
third of what its track asks."""
_FEWEST: Final = 20


def fit_geometry(wheels: pl.DataFrame, poses: pl.DataFrame, kind: str) -> dict[str, float] | None:
    """Geometry of an unknown vehicle, as its poses show it.

    Args:
        wheels: measured with a stand-in of unit radius, track width and wheelbase.
        poses: of the localization.
        kind: of vehicle.

    Returns:
        Wheel radius and effective track width [m], or the wheelbase of a car; None where it does not drive
        enough to tell.
    """
    fresh = poses.filter(~pl.col("held") & pl.col("x").is_finite() & pl.col("q_w").is_finite())
    if fresh.height < _FEWEST or wheels.height < _FEWEST:
        return None
    time = fresh["t"].to_numpy()
    ends = np.arange(0, time.size, timegrid.count_steps(time, _SPAN_S))
    position = np.stack([fresh[axis].to_numpy() for axis in "xy"], axis=1)[ends]
    yaw = np.unwrap(yaw_of(np.stack([fresh[f"q_{axis}"].to_numpy() for axis in "xyzw"], axis=1)))[ends]
    way, _ = split_chords(position, yaw)
    clock = wheels["t"].to_numpy()

    def integral(rate: Floats) -> Floats:
        return np.diff(np.interp(time[ends], clock, timegrid.integrate_rate(clock, np.nan_to_num(rate))))

    if kind == "ackermann":
        speed, steering = wheels["speed"].to_numpy(), wheels["steering"].to_numpy()
        scale = _median_gain(way, integral(speed))
        bent = _median_gain(np.diff(yaw), integral(speed * np.tan(steering)))
        return None if not scale or not bent else {"wheelbase_m": 1.0 / bent}
    left, right = wheels["left"].to_numpy(), wheels["right"].to_numpy()
    radius = _median_gain(way, integral(0.5 * (left + right)))
    over = _median_gain(np.diff(yaw), integral(right - left))
    if not radius or not over or radius <= 0.0 or over <= 0.0:
        return None
    return {"wheel_radius_m": radius, "track_width_m": radius / over}


def fit_controller(
    commands: pl.DataFrame, wheels: pl.DataFrame, by_pose: Mapping[str, float]
) -> dict[str, float] | None:
    """Geometry by which a controller turns body commands into wheel speeds.

    Args:
        commands: body commands.
        wheels: measured with a stand-in of unit radius and track width.
        by_pose: as `fit_geometry` gives it.

    Returns:
        Wheel radius and track width [m]; None where there are no body commands, or where wheels and commands
        do not agree, or agree on a vehicle that could not move as the poses do.
    """
    if commands.height < _FEWEST or wheels.height < _FEWEST or "wheel_radius_m" not in by_pose:
        return None
    if commands["body_x"].null_count() == commands.height or wheels["left"].null_count() == wheels.height:
        return None
    asked, clock = commands["t"].to_numpy(), wheels["t"].to_numpy()
    starts = np.arange(max(asked[0], clock[0]), min(asked[-1], clock[-1]) - _ASKED_SPAN_S, _SPAN_S)
    spans = np.stack((starts, starts + _ASKED_SPAN_S))
    held = np.minimum(np.diff(asked), timegrid.usual_hold(asked))

    def sum_up(times: Floats, total: Floats) -> Floats:
        moved: Floats = np.diff(np.interp(spans, times, total), axis=0)[0]
        return moved

    left, right = wheels["left"].to_numpy(), wheels["right"].to_numpy()
    rolled, turned = (
        sum_up(clock, timegrid.integrate_rate(clock, np.nan_to_num(rate)))
        for rate in (0.5 * (left + right), right - left)
    )
    way, turn = (
        sum_up(asked, np.append(0.0, np.cumsum(np.nan_to_num(commands[name].to_numpy())[:-1] * held)))
        for name in ("body_x", "body_w")
    )
    radius, over = _steady_gain(way, rolled), _steady_gain(turn, turned)
    if not radius or not over or radius <= 0.0 or over <= 0.0:
        return None
    found = {"wheel_radius_m": radius, "track_width_m": radius / over}
    ratios = {key: by_pose[key] / value for key, value in found.items()}
    fits = all(low < ratios[key] < high for key, (low, high) in _LIKELY.items())
    return found if fits else None


def _steady_gain(moved: Floats, driven: Floats) -> float | None:
    """Weighted median of moved over driven; None where it is not the same throughout."""
    gain = _median_gain(moved, driven)
    if gain is None:
        return None
    live = np.abs(driven) > _LIVE * float(np.max(np.abs(driven)))
    rest = np.abs(moved[live] / (gain * driven[live]) - 1.0) if gain else np.ones(1)
    return gain if float(np.median(rest)) < _STEADY else None


def _median_gain(moved: Floats, driven: Floats) -> float | None:
    """Weighted median of moved over driven; None where hardly anything was driven."""
    live = np.abs(driven) > _LIVE * float(np.max(np.abs(driven), initial=0.0))
    if live.sum() < _FEWEST:
        return None
    ratio, weight = moved[live] / driven[live], np.abs(driven[live])
    order = np.argsort(ratio)
    total = np.cumsum(weight[order])
    return float(ratio[order][np.searchsorted(total, 0.5 * total[-1])])
