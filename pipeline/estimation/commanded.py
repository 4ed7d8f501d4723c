"""How much of the commanded yaw rate a robot reaches, whatever turns body commands into wheel commands.

    w + tau dw/dt = g f(t - d),    share = g m

w is the measured yaw rate, f that of the commanded wheels at the nominal track, and m the factor from the yaw
rate of the body command to f (`Alignment.body_multiplier`). No model of the robot is involved: a multiplier
that was changed in the controller changes the share, also where the robot answers its wheels as before.
"""

from __future__ import annotations

import contextlib
import math

import numpy as np

from pipeline.core import (
    FEWEST_OF_SPREAD,
    NORMAL_95,
    Floats,
    Ints,
    SlipError,
    group_rows,
    jackknife_deviation,
    number_stretches,
    student_quantile,
)
from pipeline.estimation.run_residuals import Input, RunResiduals
from pipeline.estimation.window_residuals import locate_windows
from pipeline.models import Timing
from pipeline.results import CommandedTurn
from pipeline.run import MotionRun
from pipeline.sources import Vehicle

_DELAYS_S = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
"""Dead times that are tried [s]: those of recorded drives are up to half a second."""
_ASIDE = 2
"""Windows to either side whose difference is the derivative: windows are a quarter of a second apart."""
_LONGEST_S = 1.3
"""Longest time between these windows; across a gap there is no derivative."""
_LEAST_EXPLAINED = 0.5
"""Share of the yaw rate's power that has to follow the command: else it has no gain."""
_LEAST_SHARE, _MOST_SHARE = 0.02, 50.0
"""Range of a share that means anything."""


def measure_commanded_turn(run: MotionRun, vehicle: Vehicle) -> CommandedTurn | None:
    """Measure the share of the commanded yaw rate that a run reaches.

    Returns:
        None without a body command or a pose, with too few stretches of driving, or where the yaw rate does
        not follow.
    """
    multiplier = run.alignment.body_multiplier
    if multiplier is None or run.commands is None or run.is_drive_alone:
        return None
    with contextlib.suppress(SlipError):
        gained = _measure_gain(RunResiduals(run, vehicle, Input.COMMAND))
        if gained is not None and _LEAST_SHARE < multiplier * gained[0] < _MOST_SHARE:
            share, factor = multiplier * gained[0], math.exp(NORMAL_95 * gained[1])
            return CommandedTurn(share, share / factor, share * factor, multiplier)
    return None


def _measure_gain(run_residuals: RunResiduals) -> tuple[float, float] | None:
    """Yaw rate over that of the commanded wheels, and the standard deviation of its logarithm."""
    times, asked = run_residuals.windows.times, run_residuals.predict_velocity((), Timing()).w
    driven = [locate_windows(run_residuals, late).average(run_residuals, asked) for late in _DELAYS_S]
    windows = run_residuals.find_residuals((), Timing())[:, 2] + driven[0]
    inner = np.arange(_ASIDE, max(windows.size - _ASIDE, _ASIDE))
    apart = times[inner + _ASIDE, 0] - times[inner - _ASIDE, 0]
    near = (apart > 0.0) & (apart < _LONGEST_S)
    rows = inner[near]
    change = (windows[rows + _ASIDE] - windows[rows - _ASIDE]) / apart[near]
    moved = _smooth(windows, rows)
    stretches = group_rows(number_stretches(times[rows, 0] - times[:1, 0]))
    power = float(np.sum(moved**2))
    if len(stretches) < FEWEST_OF_SPREAD or power <= 0.0:
        return None
    best = power * (1.0 - _LEAST_EXPLAINED), np.zeros(0), 0.0
    for one in driven:
        design = np.column_stack((_smooth(one, rows), -change))
        normal = np.array([design[own].T @ design[own] for own in stretches])
        pull = np.array([design[own].T @ moved[own] for own in stretches])
        solved = _solve(normal.sum(axis=0), pull.sum(axis=0))
        rest = power - float(solved @ pull.sum(axis=0))
        if solved[1] >= 0.0 and rest < best[0]:
            without = zip(normal.sum(axis=0) - normal, pull.sum(axis=0) - pull, strict=True)
            best = rest, np.array([_solve(*one)[0] for one in without]), float(solved[0])
    _, gains, gain = best
    if gain <= 0.0 or not (gains > 0.0).all():
        return None
    deviation = jackknife_deviation(np.log(gains)) * student_quantile(0.95, gains.size - 1.0) / NORMAL_95
    return gain, deviation


def _smooth(windows: Floats, rows: Ints) -> Floats:
    """Mean over the time whose ends give the derivative, so that the equation holds for a lag exactly."""
    inside = sum(windows[rows + shift] for shift in range(1 - _ASIDE, _ASIDE))
    ends = 0.5 * (windows[rows - _ASIDE] + windows[rows + _ASIDE])
    return np.asarray((inside + ends) / (2 * _ASIDE), dtype=np.float64)


def _solve(normal: Floats, pull: Floats) -> Floats:
    return np.asarray(np.linalg.lstsq(normal, pull, rcond=None)[0], dtype=np.float64)
