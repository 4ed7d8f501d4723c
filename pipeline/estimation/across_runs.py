"""Across runs and grounds: fits with a prior from other runs, and bands of predictions.

A joint fit of one model to many runs has noise of the same kind in all of them, and of each run's own size
(`noise.Noise`): a gentle run counts as much as a fast one, whose residuals are larger by a factor of ten.
Runs on other grounds than the requested one may count less (`path_residuals.weigh_runs`).

A ground parameter has one value per ground, shared by the runs on it; all other parameters belong to the
vehicle and have one value.

Bands of predictions over 2 s are conformal, by groups, and adapted during a run. An error is divided by the
distance predicted until then. The band of a model is the 95 % quantile of these ratios on grounds that it was
not fitted on: all grounds have the same weight, and so have all ten-second stretches of a ground. During a
run, the band adapts to the preceding errors (adaptive conformal inference; Gibbs and Candes, NeurIPS 2021),
so that its long-run coverage is 19 of 20 on any ground.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core import CONFIDENCE, Floats, Ints, format_share
from pipeline.estimation.estimation_data import EstimationData
from pipeline.estimation.held_out import HeldOut, number_predictions
from pipeline.estimation.model_state import ModelState, Prior
from pipeline.estimation.path_residuals import tie_prior
from pipeline.estimation.run_residuals import RunResiduals
from pipeline.models import LEAST_WAY_M, Bands


def tie_to_prior(data: EstimationData, numbers: Mapping[str, tuple[float, float]]) -> EstimationData:
    """The data with a prior on the parameters of a model.

    Args:
        data: the runs.
        numbers: mean and standard deviation by label ``effect.name``.

    Returns:
        The prepared runs, shared with `data`, with the prior in every path.
    """
    return data.with_paths(tuple(tie_prior(path, Prior(numbers)) for path in data.paths))


_ROUNDING = 1e-9
"""Tolerance of the sum of all weights for the rounding of doubles."""
_STEP = 0.5
"""Change of the logarithm of an adaptive band per unit of coverage error: a missed prediction widens it by
61 %, a covered one narrows it by 2.5 %; in the long run one in twenty is missed."""


@dataclass(frozen=True)
class Ratios:
    """Errors of predictions divided by the distance travelled until then, of one run.

    Attributes:
        group: group of the run, such as its ground.
        position, heading: [m/m] and [rad/m], NaN without a prediction, shape (n,) each.
        stretches: the ten-second stretch of each, shape (n,).
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
    """Shares of errors within bands.

    Attributes:
        as_it_is: coverage of the fixed bands.
        followed: coverage of bands that adapt during the run.
    """

    as_it_is: float
    followed: float


def list_ratios(data: EstimationData, state: ModelState, held_out: HeldOut) -> list[Ratios]:
    """Errors divided by the distance travelled, of each run.

    Args:
        data: the runs.
        state: the model that predicts the distances.
        held_out: its held-out errors.
    """
    stretches = number_predictions(data)
    return [
        _divide(run_residuals, state, run, held_out, stretches[run])
        for run, run_residuals in enumerate(data.residuals_by_run)
    ]


def _divide(
    run_residuals: RunResiduals, state: ModelState, run: int, held_out: HeldOut, stretches: Ints
) -> Ratios:
    effects = state.effects_of(run)
    travelled_m = run_residuals.find_horizon_shifts(effects, effects, state.timing[run])[2] + LEAST_WAY_M
    return Ratios(
        run_residuals.run.terrain,
        held_out.position[run] / travelled_m,
        held_out.yaw[run] / travelled_m,
        stretches,
        run_residuals.horizons.number,
    )


def make_bands(ratios: Sequence[Ratios], of: str) -> Bands | None:
    """Bands with a coverage of 95 %, with equal weights of groups and of ten-second stretches within them.

    The level includes the finite-sample correction for the number of stretches; None if there are too few.

    Args:
        ratios: ratios of runs, from fits without them.
        of: description of them.
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
    level = CONFIDENCE * (1.0 + 1.0 / stretches)
    index = int(np.searchsorted(np.cumsum(weight[order]), level - _ROUNDING))
    return float(every[order][index]) if index < every.size else math.inf


def measure_coverage(bands: Bands, ratios: Iterable[Ratios]) -> dict[str, Coverage]:
    """Coverage of bands on runs, for `position` and `heading`."""
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
    """Coverage of bands as a line of text; empty without bands."""
    if not coverages:
        return []
    held = [f"{format_share(one.as_it_is, 0)} of the {name} errors" for name, one in coverages.items()]
    followed = " and ".join(format_share(one.followed, 0) for one in coverages.values())
    return [f"the 95 % bands hold {' and '.join(held)}; following the run, {followed}"]


def _hold(ratios: Floats, band: float) -> Floats:
    return (ratios[np.isfinite(ratios)] <= band).astype(np.float64)


def _follow(ratios: Ratios, metric: str, band: float) -> Floats:
    """Which errors are within a band that adapts to the preceding predictions."""
    every, held = ratios.read(metric), list[Floats]()
    for number in np.unique(ratios.number).tolist():
        now = _hold(every[ratios.number == number], band)
        if now.size:
            held.append(now)
            band *= math.exp(_STEP * (CONFIDENCE - float(now.mean())))
    return np.concatenate(held) if held else np.zeros(0)
