"""A stretch of a run: what was driven first, and what after it."""

from dataclasses import replace

import numpy as np

from pipeline.runs.errors import MotionError
from pipeline.runs.recording import MotionRun
from pipeline.runs.signals import DriveSeries, find_fastest_wheel

# Between poses farther apart than that nobody knows whether the vehicle drove [s].
_LONGEST_STEP_S = 1.0
# Slower than this part of the fastest, wheels stand.
_STANDING = 0.02


def find_driven(run: MotionRun, driven_s: float) -> float:
    """Stamp [s] at which a run has been driven for so long [s]: wheels turn or are told to, poses are known.

    Raises:
        MotionError: ``too_short``: it was not.
    """
    times = run.track.times[run.track.active]
    steps = np.diff(times)
    counts = steps < _LONGEST_STEP_S
    series = run.commands or run.wheels
    if series is not None and times.size:
        speed = find_fastest_wheel(series)
        held = np.maximum(np.searchsorted(series.times, times[1:], side="right") - 1, 0)
        counts &= speed[held] > _STANDING * speed.max()
    done = np.cumsum(np.where(counts, steps, 0.0))
    place = int(np.searchsorted(done, driven_s))
    if place >= done.size:
        what = f"it was driven for {done[-1] if done.size else 0.0:.0f} s, not for {driven_s:g} s"
        raise MotionError("too_short", what, where=run.name, hint="Take less of it, or drive longer.")
    return float(times[place + 1])


def cut_run(run: MotionRun, begin_s: float = -np.inf, end_s: float = np.inf) -> MotionRun:
    """The run of which only poses from one stamp to another [s] count; what came before is still known.

    Recorded series end with the stretch: a fit to the first seconds of a run sees nothing of the rest but how
    its clocks were aligned.
    """
    track = run.track
    counts = track.active & (track.times >= begin_s) & (track.times <= end_s)
    streams = run.streams[run.streams <= end_s]
    commands, wheels = (
        None if series is None else _cut_series(series, end_s) for series in (run.commands, run.wheels)
    )
    track = replace(track, active=counts)
    return replace(run, track=track, streams=streams, commands=commands, wheels=wheels)


def _cut_series(series: DriveSeries, end_s: float) -> DriveSeries:
    rows = series.times <= end_s
    return series.change(series.times[rows], lambda signal: signal[rows])
