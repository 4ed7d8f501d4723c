"""Where a fit starts: values for numbers with several valleys, and grids for those that are not smooth."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.identification.comparison import Input
from pipeline.identification.robust import estimate_scales, measure_loss, solve_step, weigh_system
from pipeline.models.effect import Search
from pipeline.runs.signals import name_inputs

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.identification.problem import Free, Problem, State
    from pipeline.identification.robust import Weights
    from pipeline.models.model import Model

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_DELAYS = (-0.2, 0.0, 0.2, 0.4)
_SHRINKS = 5


def find_starts(problem: Problem, model: Model, free: Sequence[Free], used: Flags) -> State:
    """Values to start a fit from.

    Every number that needs it is tried at several values, one after the other, all others being solved for
    in one or two linear steps each time. Effects that already have values keep them.

    Args:
        problem: the runs.
        model: effects at their neutral values are searched.
        free: the free numbers.
        used: windows to look at.
    """
    state = problem.start_state(model)
    fresh = [n for n in free if n.effect and model.effect(n.effect).is_neutral]
    for number in fresh:
        value = state.get(number)
        if math.isinf(value) or math.isnan(value):
            state = state.set(number, _neutral_start(problem, number))
    direct = [n for n in free if n.parameter is None or n.parameter.search is Search.DIRECT]
    searched = [n for n in fresh if n.parameter is not None and n.parameter.search is not Search.DIRECT]
    if not any(c.has_gyro for c in problem.comparisons):
        searched = [n for n in free if n.name == "pose_delay_s"] + searched
    known = list(direct)
    state, _ = _solve_linear(problem, state, known, used, steps=2)
    for number in searched:
        best, best_loss = state, math.inf
        others = [n for n in known if n is not number]
        for value in _list_values(problem, number):
            trial, loss = _solve_linear(problem, state.set(number, value), others, used, steps=1)
            if loss < best_loss:
                best, best_loss = trial, loss
        state = best
        if number.parameter is None or number.parameter.search is Search.STARTS:
            known.append(number)
            state, _ = _solve_linear(problem, state, known, used, steps=1)
    return state


def refine_grid(problem: Problem, state: State, free: Sequence[Free], weights: Weights, used: Flags) -> State:
    """Shrink a grid round every number that is not smooth, the others staying put."""
    for number in free:
        if number.parameter is None or number.parameter.search is not Search.GRID:
            continue
        centre = state.get(number)
        width = _first_width(problem, number)
        low, high = number.bounds
        best, best_loss = centre, measure_loss(problem, problem.find_residuals(state), weights, used)
        for _ in range(_SHRINKS):
            for value in np.clip(best + width * np.array([-1.0, -0.5, 0.5, 1.0]), low, high).tolist():
                loss = measure_loss(problem, problem.find_residuals(state.set(number, value)), weights, used)
                if loss < best_loss:
                    best, best_loss = value, loss
            width *= 0.5
        state = state.set(number, best)
    return state


def _first_width(problem: Problem, number: Free) -> float:
    values = sorted(_list_values(problem, number))
    return 0.5 * float(np.min(np.diff(values))) if len(values) > 1 else number.step


def _list_values(problem: Problem, number: Free) -> tuple[float, ...]:
    if number.parameter is None:
        return _DELAYS
    scale = _largest(problem, number)
    return tuple(scale * value for value in number.parameter.starts)


def _neutral_start(problem: Problem, number: Free) -> float:
    """A value that changes nothing yet, for numbers whose neutral one is infinite or unknown."""
    parameter = number.parameter
    if parameter is None or not parameter.starts:
        return 0.0
    if parameter.relative_to == "duration":
        return 0.5 * _largest(problem, number)
    factor = 1.2 if parameter.relative_to else 20.0
    return min(_largest(problem, number) * max(parameter.starts) * factor, parameter.bounds[1])


def _largest(problem: Problem, number: Free) -> float:
    """What relative starts are relative to."""
    kind = number.parameter.relative_to if number.parameter is not None else ""
    if not kind:
        return 1.0
    if kind == "duration":
        return problem.comparisons[number.run or 0].run.duration_s
    vehicle = problem.vehicle
    largest = 0.0
    for comparison in problem.comparisons:
        series = comparison.run.commands if problem.source is Input.COMMAND else comparison.run.wheels
        if series is None:
            continue
        speed, _, turn = vehicle.kinematics.asked(name_inputs(series, vehicle), vehicle)
        rim = np.maximum(np.abs(series.left), np.abs(series.right))
        values = {"wheel": rim, "speed": np.abs(speed), "turn": np.abs(turn)}[kind]
        largest = max(largest, float(np.quantile(values, 0.995)))
    return max(largest, 1e-3)


def _solve_linear(
    problem: Problem, state: State, free: Sequence[Free], used: Flags, *, steps: int
) -> tuple[State, float]:
    """Gauss-Newton steps over some numbers, and the loss reached under fixed plain scales."""
    residuals = problem.find_residuals(state)
    for _ in range(steps if free else 0):
        weights = estimate_scales(problem, residuals, used)
        jacobian = problem.differentiate(state, free, residuals)
        normal, gradient = weigh_system(problem, residuals, jacobian, weights, used)
        values = np.array([state.get(number) for number in free])
        bounds = np.array([number.bounds for number in free])
        step = solve_step(normal, gradient, values, bounds, 1e-4)
        before = measure_loss(problem, residuals, weights, used)
        for share in (1.0, 0.3, 0.1):
            moved = state
            for number, value in zip(free, (values + share * step).tolist(), strict=True):
                moved = moved.set(number, value)
            trial = problem.find_residuals(moved)
            if measure_loss(problem, trial, weights, used) < before:
                state, residuals = moved, trial
                break
        else:
            break
    # Comparable between candidates: no scale of their own enters.
    return state, float(
        np.mean(np.log(np.mean(np.minimum(residuals[used] ** 2, _clip(residuals[used])), axis=0) + 1e-12))
    )


def _clip(residuals: Floats) -> Floats:
    limit: Floats = (6.0 * 1.4826 * np.median(np.abs(residuals), axis=0) + 1e-6) ** 2
    return np.maximum(limit, np.mean(residuals**2, axis=0))
