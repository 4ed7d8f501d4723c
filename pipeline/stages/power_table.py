"""Electric power of the drive over time, and energy per distance."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
import polars as pl

from pipeline.core.arrays import Floats, Ints, nearest_indices
from pipeline.logs import TopicColumns
from pipeline.run.signals import MOVING_MPS
from pipeline.sources.candidates import PowerSource, Signal
from pipeline.stages import Finding, reading
from pipeline.stages.clocks import TopicClock

_HALF_S: Final = 0.5
"""Half the span over which speed is measured [s]: a longer one would cut corners in turns."""

_SILENT_S: Final = 0.5
"""Largest distance in time between a sample and a pose used for it [s]."""

Ordered = Callable[[str], tuple[TopicColumns, TopicClock, Ints] | None]


def tabulate_power(
    source: PowerSource | None, ordered: Ordered, seconds: Callable[[Ints], Floats], poses: pl.DataFrame
) -> tuple[pl.DataFrame, list[Finding]]:
    """The table of power, and findings; empty without a source.

    Args:
        source: currents and voltages.
        ordered: columns, clock and order of a topic's messages.
        seconds: stamps as times of the run [s].
        poses: the run's, with ``t``, ``x``, ``y``.
    """
    first = None if source is None else ordered(source.currents[0].topic)
    if source is None or first is None or not first[2].size:
        return pl.DataFrame(), []
    columns, clock, order = first
    stamp, log_time = clock.stamp[order], columns.log_time[order]
    times = seconds(stamp)

    def read(signals: tuple[Signal, ...]) -> list[Floats]:
        columns = []
        for signal in signals:
            series = ordered(signal.topic)
            if series is not None and series[2].size:
                values = reading.numbers(series[0], signal.fields()[0])[series[2]]
                columns.append(np.interp(times, seconds(series[1].stamp[series[2]]), values))
        return columns

    current = source.sign * np.sum(read(source.currents), axis=0)
    voltages = read(source.voltages)
    voltage = np.mean(voltages, axis=0) if voltages else np.full(times.size, np.nan)
    power = current * voltage
    speed = _measure_speed(times, poses)
    with np.errstate(invalid="ignore"):
        per_metre = np.where(speed > MOVING_MPS, power / np.maximum(speed, MOVING_MPS), np.nan)
    table = pl.DataFrame(
        {
            "t": times,
            "stamp": stamp,
            "log_time": log_time,
            "current": current,
            "voltage": voltage,
            "power": power,
            "energy_per_m": per_metre,
        }
    ).with_columns(pl.col("voltage", "power", "energy_per_m").fill_nan(None))
    return table.filter(pl.col("current").is_finite()), [_describe(source, current, per_metre)]


def _measure_speed(times: Floats, poses: pl.DataFrame) -> Floats:
    """Speed over ground about some times [m/s], NaN without poses about them."""
    if poses.height < 2:  # noqa: PLR2004 - a way has two ends
        return np.full(times.size, np.nan)
    clock, position = poses["t"].to_numpy(), poses["x", "y"].to_numpy()
    ends = [np.clip(times + by, clock[0], clock[-1]) for by in (-_HALF_S, _HALF_S)]
    span, moved = ends[1] - ends[0], np.zeros((times.size, 2))
    known = span >= _HALF_S
    for moment, sign in zip(ends, (-1.0, 1.0), strict=True):
        known &= np.abs(clock[nearest_indices(moment, clock)] - moment) < _SILENT_S
        moved += sign * np.stack([np.interp(moment, clock, position[:, axis]) for axis in range(2)], axis=-1)
    speed: Floats = np.where(known, np.linalg.norm(moved, axis=1) / np.maximum(span, _HALF_S), np.nan)
    return speed


def _describe(source: PowerSource, current: Floats, per_metre: Floats) -> Finding:
    driven = per_metre[np.isfinite(per_metre)]
    median = float(np.median(driven)) if driven.size else None
    text = f"the drive draws {np.nanmean(current):.1f} A in the mean"
    if median is not None:
        text += f" and {median:.0f} J a metre in the median"
    elif not source.voltages:
        text += "; no voltage is recorded, so that its power is not known"
    return Finding("power_drawn", "info", f"{text} ({source.reason})", where=str(source), value=median)
