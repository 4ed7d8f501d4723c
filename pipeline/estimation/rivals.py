"""Comparison of models on runs: held-out errors over 2 s, and significant differences.

A difference is taken between predictions from the same measured poses. Errors are autocorrelated: the
interval of a difference is a jackknife over stretches of ten seconds.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import (
    CONFIDENCE,
    JSON_DIGITS,
    Floats,
    Ints,
    finite_or_none,
    jackknife_deviation,
    student_quantile,
)
from pipeline.estimation.estimation_data import EstimationData
from pipeline.estimation.held_out import HeldOut, hold_out, number_predictions
from pipeline.estimation.model_fit import Fitted, fit_model
from pipeline.models import Model
from pipeline.results import ERRORS_OVER_2S, read_error, to_json

if TYPE_CHECKING:
    from pipeline.estimation.held_out import HeldOut
    from pipeline.estimation.model_fit import Fitted


@dataclass(frozen=True)
class Rival:
    """A model with its held-out errors.

    Attributes:
        name: displayed name.
        numbers: number of fitted parameters; None where they are not counted.
        held_out: its held-out errors.
        fit_s: processor time of its fit [s].
    """

    name: str
    numbers: int | None
    held_out: HeldOut
    fit_s: float

    def list_errors(self, metric: str) -> Floats:
        """Errors of all predictions of all runs: position [m] or wrapped yaw [rad]."""
        held = self.held_out
        return np.concatenate(held.position if metric == "t_mrmse_m" else held.yaw)

    def read(self, metric: str) -> float:
        """An error over 2 s by its name in `ERRORS_OVER_2S`."""
        return read_error(self.held_out.pooled, metric)


@dataclass(frozen=True)
class LossDifference:
    """Difference of two errors, with its 95 % interval."""

    value: float
    low: float
    high: float

    @property
    def is_chance(self) -> bool:
        """Whether the interval contains zero, or nothing could be estimated."""
        return not (self.low > 0.0 or self.high < 0.0)


@dataclass(frozen=True)
class Contest:
    """Models scored on the same predictions.

    Attributes:
        rivals: the models, at least one.
        stretches: the stretch of ten seconds of each prediction, shape (n,).
    """

    rivals: tuple[Rival, ...]
    stretches: Ints

    def find_best(self, metric: str) -> Rival:
        """The model with the smallest error."""
        return min(self.rivals, key=lambda rival: (math.isnan(rival.read(metric)), rival.read(metric)))

    def measure(self, rival: Rival, other: Rival, metric: str) -> LossDifference:
        """Difference of the errors of a model and of another one."""
        return compare_errors(rival.list_errors(metric), other.list_errors(metric), self.stretches)

    def list_ties(self, metric: str) -> list[Rival]:
        """Models whose error is not significantly larger than the smallest one."""
        best = self.find_best(metric)
        others = (rival for rival in self.rivals if rival is not best)
        return [rival for rival in others if self.measure(rival, best, metric).is_chance]

    def is_best(self, rival: Rival, metric: str) -> bool:
        """Whether the error of a model is the smallest, or not significantly larger."""
        return rival is self.find_best(metric) or rival.name in self.ties[metric]

    @cached_property
    def ties(self) -> dict[str, list[str]]:
        """Names of the models that are not significantly worse than the best, by metric."""
        return {metric: [rival.name for rival in self.list_ties(metric)] for metric in ERRORS_OVER_2S}


def judge_rival(data: EstimationData, name: str, model: Model, per_run: Sequence[str] = ()) -> Rival:
    """Fit a model to runs and score it as the ladder scores its steps."""
    fitted, fit_s = time_fit(data, model, per_run)
    numbers = len({number.label for number in fitted.free if number.effect})
    return Rival(name, numbers, hold_out(data, fitted), fit_s)


def time_fit(data: EstimationData, model: Model, per_run: Sequence[str] = ()) -> tuple[Fitted, float]:
    """The fit of a model, and its processor time [s]."""
    start = time.process_time()
    active = model.keep(effect.id for effect in data.active_effects(model))
    fitted = fit_model(data, active, per_run=per_run, exact=True)
    return fitted, time.process_time() - start


def hold_contest(data: EstimationData, rivals: Sequence[Rival]) -> Contest:
    """Comparison of models that were scored on the same runs."""
    return Contest(tuple(rivals), np.concatenate(number_predictions(data)))


def compare_errors(one: Floats, other: Floats, stretches: Ints) -> LossDifference:
    """Difference of two root mean squares over the same predictions, by a jackknife over stretches.

    Args:
        one: errors, shape (n,); NaN without a prediction.
        other: errors of another model, shape (n,).
        stretches: number of the stretch of each, shape (n,).
    """
    known = np.isfinite(one) & np.isfinite(other)
    if not known.any():
        return LossDifference(math.nan, math.nan, math.nan)
    index = np.unique(stretches[known], return_inverse=True)[1]
    counts = np.bincount(index).astype(np.float64)
    sums = np.array([np.bincount(index, errors[known] ** 2) for errors in (one, other)])
    first, second = np.sqrt(sums.sum(axis=1) / counts.sum()).tolist()
    value = first - second
    if counts.size < 2:  # noqa: PLR2004 - one stretch has no spread
        return LossDifference(value, -math.inf, math.inf)
    without = np.sqrt((sums.sum(axis=1)[:, None] - sums) / (counts.sum() - counts))
    moved = without[0] - without[1]
    half = student_quantile(CONFIDENCE, counts.size - 1) * jackknife_deviation(moved)
    return LossDifference(value, value - half, value + half)


def contest_as_json(contest: Contest) -> dict[str, object]:
    """The models, their held-out errors, and the difference of each to the best."""
    best = {metric: contest.find_best(metric) for metric in ERRORS_OVER_2S}

    def behind(rival: Rival) -> dict[str, object]:
        margins = {metric: contest.measure(rival, best[metric], metric) for metric in ERRORS_OVER_2S}
        return {
            metric: {
                name: finite_or_none(getattr(one, name), JSON_DIGITS) for name in ("value", "low", "high")
            }
            for metric, one in margins.items()
        }

    return {
        "models": [
            {
                "model": rival.name,
                "numbers": rival.numbers,
                "fit_s": round(rival.fit_s, 3),
                "errors": to_json(rival.held_out.pooled),
                "behind_best": behind(rival),
            }
            for rival in contest.rivals
        ],
        "best": {
            metric: {
                "model": best[metric].name,
                "is_significant": not contest.ties[metric],
                "not_told_apart_from": contest.ties[metric],
            }
            for metric in ERRORS_OVER_2S
        },
    }
