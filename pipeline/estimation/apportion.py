"""Error budget of a run: the share of its slip, and of its 2 s error, by effects of a model, and by times.

An effect's share of the mean square is its Shapley value: the fall of the held-out error when it is added,
averaged over the orders in which the effects of the model can be added (Shapley, Contributions to the Theory
of Games II, 1953). It does not depend on the order; shares, disturbance and noise floor add up to the
whole. For up to five effects all orders are used; for more, the cyclic orders in both directions. Each effect
then takes each position equally often, which is exact if effects interact only in pairs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations

import numpy as np

from pipeline.core import (
    FEWEST_OF_SPREAD,
    Floats,
    Ints,
    jackknife_deviation,
    nearest_indices,
    student_quantile,
)
from pipeline.estimation.estimation_data import EstimationData
from pipeline.estimation.held_out import HeldOut, score
from pipeline.estimation.ladder import ModelAssessment
from pipeline.results import ABOVE_FLOOR, Moments, Share, SlipBudget, Stretch
from pipeline.run import HORIZON_S

Subset = frozenset[str]

QUANTITIES = {"slip": "m^2/s^2", "position": "m^2", "heading": "rad^2"}
"""Mean squares that are apportioned, with their units: slip modulus over half a second, 2 s errors."""

_ALL_ORDERS = 5
"""Largest number of effects for which all orders are used: 120 orders of 32 sets."""


def apportion(assessment: ModelAssessment, *, length_scale_m: float = 1.0) -> tuple[SlipBudget, ...]:
    """The budgets of a judged model: of the slip, and of the 2 s errors of position and heading.

    The ideal and the whole model are the first and last steps of the ladder, so that totals and remainders
    equal those of the ladder. The models in between are the whole model without some effects.

    Args:
        assessment: the model on its runs.
        length_scale_m: of the slip modulus [m].
    """
    data, fitted = assessment.data, assessment.fitted
    players = fitted.model.ids
    known = {frozenset(players): assessment.whole.held_out}
    known[frozenset()] = assessment.ideal.held_out
    # Models with the same first effects are adjacent, so that their common prediction is computed once.
    asked = sorted(list_subsets(players) - known.keys(), key=lambda one: [p in one for p in players])
    for one in asked:
        known[one] = score(data, fitted.state.drop([name for name in players if name not in one]))
    stretches = _find_stretches(data)
    losses = {one: _sum_stretches(data, stretches, held, length_scale_m) for one, held in known.items()}
    split = share_out(players, losses)
    floor = assessment.floor
    x, y, w = floor.velocity_rms
    floors = (x**2 + y**2 + (length_scale_m * w) ** 2, floor.t_mrmse_m**2, floor.r_mrmse_rad**2)
    return tuple(
        _make_budget(data.source.value, quantity, split, floors[column], column)
        for column, quantity in enumerate(QUANTITIES)
    )


@dataclass(frozen=True)
class Split:
    """Apportioned losses by stretch: each array has shape (stretches, ...); sums over stretches give totals.

    Attributes:
        whole: loss without any player.
        rest: loss with all players.
        parts: Shapley value of each player.
        alone: loss that a player removes by itself.
        last: loss that it removes after all others.
    """

    whole: Floats
    rest: Floats
    parts: Mapping[str, Floats]
    alone: Mapping[str, Floats]
    last: Mapping[str, Floats]


def list_subsets(players: Sequence[str]) -> set[Subset]:
    """Sets of players whose loss `share_out` needs."""
    orders = (order[:size] for order in _list_orders(players) for size in range(len(players) + 1))
    others = (set(players) - {name} for name in players)
    return {frozenset(one) for one in (*orders, *others, *((name,) for name in players))}


def share_out(players: Sequence[str], losses: Mapping[Subset, Floats]) -> Split:
    """Shapley values of players that reduce a loss.

    Args:
        players: names.
        losses: loss, of any shape, by the players present, for all sets in `list_subsets`.
    """
    nobody, everybody = frozenset[str](), frozenset(players)
    parts = {name: np.zeros_like(losses[nobody]) for name in players}
    count = 0
    for order in _list_orders(players):
        count += 1
        steps = [frozenset(order[:size]) for size in range(len(order) + 1)]
        for name, (before, after) in zip(order, pairwise(steps), strict=True):
            parts[name] += losses[before] - losses[after]
    return Split(
        whole=losses[nobody],
        rest=losses[everybody],
        parts={name: part / count for name, part in parts.items()},
        alone={name: losses[nobody] - losses[frozenset({name})] for name in players},
        last={name: losses[everybody - {name}] - losses[everybody] for name in players},
    )


def _list_orders(players: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """All orders of few players; for many the cyclic orders and their reversals."""
    if len(players) <= _ALL_ORDERS:
        yield from permutations(players)
        return
    for first in range(len(players)):
        order = (*players[first:], *players[:first])
        yield order
        yield order[::-1]


def _find_stretches(data: EstimationData) -> Ints:
    """Ten-second stretch of each 2 s prediction, run by run, shape (m,)."""
    whole = data.whole
    middle = whole.times.mean(axis=1)
    units = []
    for number, run_residuals in enumerate(data.residuals_by_run):
        rows = whole.run == number
        nearest = nearest_indices(run_residuals.horizons.times.mean(axis=1), middle[rows])
        units.append(whole.unit[rows][nearest])
    return np.concatenate(units)


def _sum_stretches(data: EstimationData, stretches: Ints, held: HeldOut, length_scale_m: float) -> Floats:
    """Contribution of each ten-second stretch to each mean square, shape (stretches, quantities).

    Args:
        data: the runs.
        stretches: of the 2 s predictions, shape (m,).
        held: errors.
        length_scale_m: of the slip modulus [m].
    """
    unit = data.whole.unit
    squares = np.sum((held.residuals * [1.0, 1.0, length_scale_m]) ** 2, axis=1)
    columns = [_add_up(unit, squares, unit)]
    columns += [_add_up(stretches, np.concatenate(errors) ** 2, unit) for errors in (held.position, held.yaw)]
    return np.column_stack(columns)


def _add_up(stretch: Ints, squares: Floats, unit: Ints) -> Floats:
    known = np.isfinite(squares)
    sums = np.bincount(stretch[known], squares[known], minlength=int(unit.max()) + 1)
    return sums / max(int(known.sum()), 1)


def _make_budget(source: str, quantity: str, split: Split, floor: float, column: int) -> SlipBudget:
    whole, rest = split.whole[:, column], split.rest[:, column]
    there = whole > 0.0

    def bound(part: Floats, factor: float = 1.0) -> tuple[float, float, float]:
        share, half = jackknife_ratio(part[there], whole[there])
        return factor * share, factor * (share - half), factor * (share + half)

    def ratio(part: Floats) -> float:
        return float(part.sum()) / max(float(whole.sum()), 1e-300)

    shares = [
        Share(name, *bound(part[:, column]), ratio(split.alone[name][:, column]),
              ratio(split.last[name][:, column]))
        for name, part in split.parts.items()
    ]  # fmt: skip
    shares.sort(key=lambda one: -one.share)
    # The noise floor is one value for all stretches: its share of the residual is assumed equal in each.
    noise = min(floor / max(float(rest.sum()), 1e-300), 1.0)
    return SlipBudget(
        source, quantity, float(whole.sum()), QUANTITIES[quantity], int(there.sum()), tuple(shares),
        Share("disturbance", *bound(rest, 1.0 - noise)), Share("localization_noise", *bound(rest, noise)),
    )  # fmt: skip


def jackknife_ratio(part: Floats, whole: Floats) -> tuple[float, float]:
    """Ratio of two sums over stretches and the half-width of its 95 % interval.

    Jackknife over stretches, with Student's t for their number. Source: Tukey, Annals of Mathematical
    Statistics 29 (1958); for ratios Cochran, Sampling Techniques (1977), chapter 6.

    Args:
        part: shape (n,).
        whole: shape (n,), positive.

    Returns:
        The ratio, and NaN for the half-width with fewer than three stretches.
    """
    total = float(whole.sum())
    if total <= 0.0:
        return 0.0, math.nan
    ratio, count = float(part.sum()) / total, part.size
    if count < FEWEST_OF_SPREAD:
        return ratio, math.nan
    without = (part.sum() - part) / np.maximum(total - whole, 1e-300)
    error = jackknife_deviation(without)
    return ratio, student_quantile(0.95, count - 1) * error


def find_moments(assessment: ModelAssessment) -> tuple[Moments, ...]:
    """When half of the squared held-out error of each run arises, where it is above the noise floor."""
    moments, floor, reached = list[Moments](), assessment.floor, assessment.whole.held_out
    sides = (
        ("heading", reached.yaw, floor.r_mrmse_rad),
        ("position", reached.position, floor.t_mrmse_m),
    )
    for number, run_residuals in enumerate(assessment.data.residuals_by_run):
        stretch = np.floor(run_residuals.horizons.times.mean(axis=1) / HORIZON_S).astype(np.int64)
        for quantity, errors, least in sides:
            square = errors[number] ** 2
            known = np.isfinite(square)
            if known.any() and float(square[known].mean()) > (ABOVE_FLOOR * least) ** 2:
                share, spans = find_half(stretch[known], square[known])
                moments.append(Moments(quantity, share, tuple(Stretch(*span) for span in spans), number))
    return tuple(moments)


def find_half(stretch: Ints, square: Floats) -> tuple[float, tuple[tuple[float, float, float], ...]]:
    """The fewest stretches of 2 s with half of a sum of squares.

    Args:
        stretch: number of the stretch of each square, shape (n,).
        square: shape (n,).

    Returns:
        Their share of the time, and spans of adjacent ones: start, end [s] and share, the largest first.
    """
    numbers, position = np.unique(stretch, return_inverse=True)
    sums, counts = np.bincount(position, square) / square.sum(), np.bincount(position)
    order = np.argsort(-sums)
    half = order[: int(np.searchsorted(np.cumsum(sums[order]), 0.5)) + 1]
    chosen = np.sort(half)
    spans = [
        (
            HORIZON_S * float(numbers[some[0]]),
            HORIZON_S * float(numbers[some[-1]] + 1),
            float(sums[some].sum()),
        )
        for some in np.split(chosen, np.flatnonzero(np.diff(numbers[chosen]) > 1) + 1)
    ]
    spans.sort(key=lambda span: -span[2])
    return float(counts[half].sum() / counts.sum()), tuple(spans)
