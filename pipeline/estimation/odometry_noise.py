"""Noise of wheel odometry as AMCL's differential motion model describes it.

Between two updates odometry turns by r1, drives t and turns by r2; a particle gets noise of the variances

    r1: alpha1 r1^2 + alpha2 t^2      t: alpha3 t^2 + alpha4 (r1^2 + r2^2)      r2: alpha1 r2^2 + alpha2 t^2

Over several updates the variances of heading and way add up. They are matched to the held-out errors over up
to two seconds, since errors of odometry are correlated over about a second: variances of single updates would
be too small for what they add up to. The model has no noise across the way; noise of the localization is part
of the errors.

Source: Thrun, Burgard and Fox, Probabilistic Robotics (2005), table 5.6.
"""

from __future__ import annotations

import cmath
import math
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import Complex, Floats
from pipeline.estimation.estimation_data import FEWEST_WINDOWS
from pipeline.estimation.held_out import find_in_test, refit_fold
from pipeline.estimation.tolerance import fit_mean_squares
from pipeline.export.odometry import UPDATE_M, UPDATE_RAD

if TYPE_CHECKING:
    from pipeline.estimation.estimation_data import EstimationData
    from pipeline.estimation.model_fit import Fitted

Alphas = tuple[float, float, float, float]

Walk = tuple[float, float, float, float]
"""Sums over updates of squared turns [rad^2] and ways [m^2]; errors of heading [rad] and of the way [m]."""

_STILL_M = 0.01
"""Way [m] below which the direction of a step is that of its noise: a turn on the spot, as in AMCL."""


def measure_alphas(data: EstimationData, fitted: Fitted) -> Alphas | None:
    """AMCL's alphas of a fitted model of wheel odometry; None if the runs have too few predictions.

    Args:
        data: runs with their measured wheels as input.
        fitted: the model.
    """
    walks: list[Walk] = []
    whole = data.whole
    for number, fold in enumerate(data.folds):
        state = refit_fold(data, fitted, number)
        for run, run_residuals in enumerate(data.residuals_by_run):
            mine = whole.run == run
            near = find_in_test(run_residuals, whole.times[mine], fold.test[mine])
            if not near.any():
                continue
            traced = run_residuals.trace_horizons(state.effects_of(run), state.timing[run])
            of = run_residuals.horizons.number
            for one in np.unique(of[near]).tolist():
                rows = of == one
                made = walk(*(series[rows] for series in traced))
                walks += [made] if made else []
    return fit_alphas(np.array(walks)) if len(walks) >= FEWEST_WINDOWS else None


def walk(moved: Complex, turned: Floats, seen: Complex, seen_turned: Floats) -> Walk | None:
    """Updates in a stretch of odometry, and its errors at the last of them; None without any.

    Args:
        moved: displacement of the odometry since the start, in the frame of the start [m], shape (n,).
        turned: its turn since then [rad], shape (n,).
        seen: displacement as measured [m], shape (n,).
        seen_turned: turn as measured [rad], shape (n,).
    """
    turns = ways = at_turn = 0.0
    at, end = 0j, -1
    for index, (position, heading) in enumerate(zip(moved.tolist(), turned.tolist(), strict=True)):
        step = (position - at) * cmath.exp(-1j * at_turn)
        turn = heading - at_turn
        if abs(step) < UPDATE_M and abs(turn) < UPDATE_RAD:
            continue
        first = cmath.phase(step) if abs(step) > _STILL_M else 0.0
        second = math.remainder(turn - first, 2.0 * math.pi)
        # Driving backward is no turn by half a circle.
        turns += sum(min(abs(one), math.pi - abs(one)) ** 2 for one in (first, second))
        ways += abs(step) ** 2
        at, at_turn, end = position, heading, index
    if end < 0:
        return None
    direction = at / abs(at) if abs(at) > _STILL_M else 1.0
    along = ((complex(seen[end]) - at) * direction.conjugate()).real
    return turns, ways, math.remainder(float(seen_turned[end]) - at_turn, 2.0 * math.pi), along


def fit_alphas(walks: Floats) -> Alphas:
    """Alphas of stretches of odometry.

    Args:
        walks: rows as from `walk`, shape (n, 4).
    """
    turns, ways, heading, along = walks.T
    first, second = fit_mean_squares(np.column_stack((turns, 2.0 * ways)), heading**2).tolist()
    third, fourth = fit_mean_squares(np.column_stack((ways, turns)), along**2).tolist()
    return first, second, third, fourth
