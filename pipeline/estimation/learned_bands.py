"""Bands of predictions over 2 s: conformal, by groups, and followed while a run goes on.

An error is set against the way that is predicted until then. What holds 95 % of these ratios on grounds that
a model was not fitted on is its band: every ground counts the same, and in it every ten seconds. On a run
that goes on, the band follows the errors that were seen before (adaptive conformal inference; Gibbs and
Candes, NeurIPS 2021), so that 19 of 20 hold in the long run wherever it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Floats, Ints
from pipeline.core.program import format_share
from pipeline.estimation.comparison import Comparison
from pipeline.estimation.folds import HeldOut, number_predictions
from pipeline.estimation.problem import Problem
from pipeline.estimation.state import State
from pipeline.models.learned_term import LEAST_WAY_M, Bands

LEVEL = 0.95
"""Share of the errors that a band is to hold."""
_ROUNDING = 1e-9
"""Share by which the sum of all weights may miss 1 for the rounding of doubles."""
_STEP = 0.5
"""By how much the logarithm of a followed band moves for a share that it misses: a prediction that it
misses widens it by 61 %, one that it holds narrows it by 2.5 %: in the long run one in twenty is missed."""


@dataclass(frozen=True)
class Ratios:
    """Errors of predictions over the way until then, of one run.

    Attributes:
        group: of what it is one: its ground, say.
        position, heading: [m/m] and [rad/m], NaN where nothing was predicted, shape (n,) each.
        stretches: the ten seconds of each, shape (n,).
        number: the prediction of each, in order of time, shape (n,).
    """

    group: str
    position: Floats
    heading: Floats
    stretches: Ints
    number: Ints

    def read(self, metric: str) -> Floats:
        """Ratios of `position` or `heading`."""
        return self.position if metric == "position" else self.heading


@dataclass(frozen=True)
class Coverage:
    """Shares of errors that bands hold.

    Attributes:
        as_it_is: under the bands as they stand.
        followed: under bands that follow the run.
    """

    as_it_is: float
    followed: float


def list_ratios(problem: Problem, state: State, held_out: HeldOut) -> list[Ratios]:
    """Errors over the way, of each run.

    Args:
        problem: the runs.
        state: the model that predicts the ways.
        held_out: errors of it that its fit has not seen.
    """
    stretches = number_predictions(problem)
    return [
        _divide(comparison, state, run, held_out, stretches[run])
        for run, comparison in enumerate(problem.comparisons)
    ]


def _divide(comparison: Comparison, state: State, run: int, held_out: HeldOut, stretches: Ints) -> Ratios:
    effects = state.effects_of(run)
    travelled_m = comparison.find_horizon_shifts(effects, effects, state.timing[run])[2] + LEAST_WAY_M
    return Ratios(
        comparison.run.terrain,
        held_out.position[run] / travelled_m,
        held_out.yaw[run] / travelled_m,
        stretches,
        comparison.horizons.number,
    )


def make_bands(ratios: Sequence[Ratios], of: str) -> Bands | None:
    """Bands that hold 95 % of the errors: every group counts the same, and in it every ten seconds.

    The level is raised by what a quantile of so many stretches lacks; None where there are too few.

    Args:
        ratios: of runs, from fits that have not seen them.
        of: what they are, in words.
    """
    position, heading = (_find_quantile(ratios, metric) for metric in ("position", "heading"))
    return Bands(position, heading, of) if math.isfinite(position + heading) else None


def _find_quantile(ratios: Sequence[Ratios], metric: str) -> float:
    values, shares, stretches = list[Floats](), list[Floats](), 0
    groups = sorted({one.group for one in ratios})
    for group in groups:
        mine = [one for one in ratios if one.group == group]
        known = [np.isfinite(one.read(metric)) for one in mine]
        value = np.concatenate([one.read(metric)[rows] for one, rows in zip(mine, known, strict=True)])
        # Stretches of two runs may have the same number.
        label = np.concatenate(
            [
                2**32 * run + one.stretches[rows]
                for run, (one, rows) in enumerate(zip(mine, known, strict=True))
            ]
        )
        _, rows_of, counts = np.unique(label, return_inverse=True, return_counts=True)
        if counts.size == 0:
            continue
        values.append(value)
        shares.append(1.0 / (counts.size * counts[rows_of]))
        stretches += counts.size
    if not values:
        return math.nan
    every, weight = np.concatenate(values), np.concatenate(shares) / len(values)
    order = np.argsort(every)
    level = LEVEL * (1.0 + 1.0 / stretches)
    index = int(np.searchsorted(np.cumsum(weight[order]), level - _ROUNDING))
    return float(every[order][index]) if index < every.size else math.inf


def measure_coverage(bands: Bands, ratios: Iterable[Ratios]) -> dict[str, Coverage]:
    """Shares of the errors of runs that bands hold, of `position` and `heading`."""
    known = list(ratios)
    return {
        metric: Coverage(
            float(
                np.mean(np.concatenate([_hold(one.read(metric), getattr(bands, metric)) for one in known]))
            ),
            float(np.mean(np.concatenate([_follow(one, metric, getattr(bands, metric)) for one in known]))),
        )
        for metric in ("position", "heading")
    }


def describe_coverage(coverages: Mapping[str, Coverage]) -> list[str]:
    """How many errors bands hold, as a line for people; none without bands."""
    if not coverages:
        return []
    held = [f"{format_share(one.as_it_is, 0)} of the {name} errors" for name, one in coverages.items()]
    followed = " and ".join(format_share(one.followed, 0) for one in coverages.values())
    return [f"the 95 % bands hold {' and '.join(held)}; following the run, {followed}"]


def _hold(ratios: Floats, band: float) -> Floats:
    return (ratios[np.isfinite(ratios)] <= band).astype(np.float64)


def _follow(ratios: Ratios, metric: str, band: float) -> Floats:
    """Which errors a band holds that follows the predictions before."""
    every, held = ratios.read(metric), list[Floats]()
    for number in np.unique(ratios.number).tolist():
        now = _hold(every[ratios.number == number], band)
        if now.size:
            held.append(now)
            band *= math.exp(_STEP * (LEVEL - float(now.mean())))
    return np.concatenate(held) if held else np.zeros(0)
