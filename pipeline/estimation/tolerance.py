"""Highest speed at which predictions stay within a tolerance, from held-out errors of a fitted model.

Errors of predictions grow with speed. Their mean square is described as

    E[e^2] = a^2 + (b v)^2 + (c v^2)^2

by non-negative least squares: noise of the localization and what does not depend on speed, an error in
proportion to speed, and one in proportion to its square. The band is that curve times the 95 % quantile of
the errors relative to it, a conformal band (Lei et al., JASA 113, 2018) whose width follows the speed. It
never falls with speed, so that it crosses a tolerance at most once, and it is not continued beyond the speeds
that were driven. Where errors grow otherwise, the share of the predictions up to a speed that are within the
tolerance decides as well.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import CONFIDENCE, JSON_DIGITS, STRETCH_S, Floats, Ints, finite_or_none, pick_finite
from pipeline.estimation.estimation_data import EstimationData
from pipeline.estimation.held_out import find_in_test, number_predictions, refit_fold
from pipeline.estimation.model_fit import fit_model
from pipeline.estimation.transfer import fit_as_it_is
from pipeline.run import HORIZON_S, NODE_S, SPAN_S, STILL_MPS, MotionError

if TYPE_CHECKING:
    from pipeline.estimation.model_fit import Fitted
    from pipeline.estimation.run_residuals import Input, RunResiduals
    from pipeline.models import ModelFile
    from pipeline.run import MotionRun

FEWEST_PREDICTIONS = math.ceil(1.0 / (1.0 - CONFIDENCE))
"""Fewest predictions of which a 95 % band can be made: of nineteen, the largest error is the quantile."""
_TOP = max(round(STRETCH_S / HORIZON_S), 1)
"""Predictions that must be at least as fast as the highest speed of an answer: ten seconds of driving."""
_ROUNDS = 5
"""Rounds of weighting by the fitted mean square: the weights change by less than a percent after three."""
_RESAMPLES = 200
"""Resamples of stretches: they give the ends of a 95 % interval to a tenth of its width."""
_STEPS = 400
"""Speeds at which the band is evaluated: finer than two digits of an answer."""


@dataclass(frozen=True)
class ErrorSamples:
    """Held-out errors of the predictions of runs at one time ahead.

    Attributes:
        speed: largest predicted speed until then, and in the half second before [m/s], shape (n,).
        error: error of position [m], shape (n,).
        stretch: ten-second stretch of each, shape (n,): errors within one are not independent.
    """

    speed: Floats
    error: Floats
    stretch: Ints


class Answer(enum.Enum):
    """How far a tolerance reaches among the speeds that were driven."""

    UP_TO = "up_to"
    EVERY = "every"
    NONE = "none"
    TOO_FEW = "too_few"


@dataclass(frozen=True)
class SpeedLimit:
    """Highest speed at which 95 % of the predictions are within a tolerance.

    Attributes:
        answer: whether a speed that was driven separates both sides.
        speed: highest speed within the tolerance [m/s]; the highest driven one for `EVERY`, NaN for `NONE`.
        low, high: its 95 % interval over stretches of the runs, within the driven speeds [m/s]; NaN except
            for `UP_TO`.
        slowest, fastest: range of the driven speeds [m/s].
        error_slowest, error_fastest: the 95 % band at its ends [m].
        predictions: number of predictions while driving.
        within: share of those up to `speed`, of all for `NONE`, whose error is within the tolerance.
    """

    answer: Answer
    speed: float
    low: float
    high: float
    slowest: float
    fastest: float
    error_slowest: float
    error_fastest: float
    predictions: int
    within: float


@dataclass(frozen=True)
class _Band:
    """Band of errors over speed.

    Attributes:
        squares: coefficients of 1, v^2 and v^4 in the mean square.
        quantile: of the errors over the root of the mean square.
    """

    squares: Floats
    quantile: float

    def at(self, speed: Floats) -> Floats:
        """Bound of 95 % of the errors [m]."""
        bound: Floats = self.quantile * np.sqrt(_list_powers(speed) @ self.squares)
        return bound


def _find_speed(
    band: _Band, speed: Floats, error: Floats, tolerance: float, ends: tuple[float, float]
) -> float:
    """Highest driven speed at which the band, and 95 % of the errors up to it, are within a tolerance."""
    speeds, order = np.linspace(*ends, _STEPS), np.argsort(speed)
    within = np.cumsum(error[order] <= tolerance) / np.arange(1, speed.size + 1)
    last = np.searchsorted(speed[order], speeds, side="right") - 1
    inside = speeds[(band.at(speeds) <= tolerance) & (last >= 0) & (within[last] >= CONFIDENCE)]
    return float(inside[-1]) if inside.size else math.nan


def _list_powers(speed: Floats) -> Floats:
    return np.column_stack((np.ones_like(speed), speed**2, speed**4))


def fit_mean_squares(columns: Floats, squares: Floats) -> Floats:
    """Coefficients, none negative, of a mean square as a sum of columns; by weighted least squares.

    The weights are those of normal errors, whose squares scatter as their mean.

    Args:
        columns: shape (n, p).
        squares: squared errors, shape (n,).
    """
    from scipy.optimize import nnls  # noqa: PLC0415 - heavy

    mean = max(float(squares.mean()), 1e-24)
    expected: Floats = np.full(squares.size, mean)
    size = np.maximum(columns.max(axis=0), 1e-12)
    fitted = np.zeros(columns.shape[1])
    for _ in range(_ROUNDS):
        # A mean square of zero has no scale: a thousandth of the typical error keeps the weights finite.
        weight = 1.0 / np.maximum(expected, 1e-6 * mean)
        fitted = nnls(columns / size * weight[:, None], squares * weight)[0] / size
        expected = columns @ fitted
    return fitted


def _fit_band(speed: Floats, error: Floats) -> _Band:
    powers, squares = _list_powers(speed), error**2
    fitted = fit_mean_squares(powers, squares)
    ratio = np.sort(error / np.sqrt(np.maximum(powers @ fitted, 1e-6 * max(float(squares.mean()), 1e-24))))
    index = math.ceil(CONFIDENCE * (ratio.size + 1)) - 1
    return _Band(fitted, float(ratio[min(index, ratio.size - 1)]))


def find_speed_limit(samples: ErrorSamples, tolerance: float, *, seed: int = 0) -> SpeedLimit:
    """Highest speed at which 95 % of the predictions are within a tolerance.

    Args:
        samples: held-out errors.
        tolerance: largest error of position [m].
        seed: seed of the resampling.
    """
    speed, error = samples.speed, samples.error
    count = speed.size
    if count < FEWEST_PREDICTIONS:
        nothing = (math.nan,) * 7
        return SpeedLimit(Answer.TOO_FEW, *nothing, predictions=count, within=math.nan)
    slowest, fastest = float(speed.min()), float(np.sort(speed)[-_TOP])
    band = _fit_band(speed, error)
    at_ends = band.at(np.array((slowest, fastest)))
    reached = _find_speed(band, speed, error, tolerance, (slowest, fastest))
    low, high = math.nan, math.nan
    if math.isnan(reached):
        answer = Answer.NONE
    elif reached >= fastest:
        answer = Answer.EVERY
    else:
        answer = Answer.UP_TO
        low, high = _resample(samples, tolerance, (slowest, fastest), np.random.default_rng(seed))
    below = speed <= (math.inf if answer in {Answer.NONE, Answer.EVERY} else reached)
    return SpeedLimit(
        answer, reached, low, high, slowest, fastest, float(at_ends[0]), float(at_ends[1]), count,
        float(np.mean(error[below] <= tolerance)),
    )  # fmt: skip


def _resample(
    samples: ErrorSamples, tolerance: float, ends: tuple[float, float], rng: np.random.Generator
) -> tuple[float, float]:
    """95 % interval of the speed over stretches drawn with replacement; no speed counts as the slowest."""
    order = np.argsort(samples.stretch, kind="stable")
    _, first, counts = np.unique(samples.stretch[order], return_index=True, return_counts=True)
    reached = []
    for _ in range(_RESAMPLES):
        drawn = rng.integers(first.size, size=first.size)
        rows = order[np.concatenate([np.arange(first[one], first[one] + counts[one]) for one in drawn])]
        speed, error = samples.speed[rows], samples.error[rows]
        one = _find_speed(_fit_band(speed, error), speed, error, tolerance, ends)
        reached.append(ends[0] if math.isnan(one) else one)
    tail = 0.5 * (1.0 - CONFIDENCE)
    low, high = np.quantile(reached, (tail, 1.0 - tail)).tolist()
    return low, high


def limit_speeds(
    file: ModelFile, runs: Sequence[MotionRun], source: Input, tolerance: float, ahead_s: float = HORIZON_S
) -> dict[str, SpeedLimit]:
    """Highest speeds within a tolerance, by terrain of the runs.

    Args:
        file: a model with fitted values.
        runs: runs of its vehicle.
        source: input of the model.
        tolerance: largest error of position [m].
        ahead_s: time ahead [s], at most `HORIZON_S`.

    Raises:
        MotionError: ``bad_tolerance``; others as `gather_samples`.
    """
    if not 0.0 < tolerance < math.inf:
        what = f"a tolerance is a length above zero, not {tolerance:g} m"
        raise MotionError("bad_tolerance", what, where="--within", hint="Write 10cm or 0.1m.")
    by_terrain: dict[str, list[MotionRun]] = {}
    for run in runs:
        by_terrain.setdefault(run.terrain, []).append(run)
    return {
        terrain: find_speed_limit(gather_samples(file, there, source, ahead_s), tolerance)
        for terrain, there in by_terrain.items()
    }


def limits_as_json(limits: Mapping[str, SpeedLimit]) -> list[dict[str, object]]:
    """Highest speeds by terrain as JSON objects; numbers that are not known are null."""
    speeds, errors = ("speed", "low", "high", "slowest", "fastest"), ("error_slowest", "error_fastest")
    return [
        {
            "terrain": terrain,
            "answer": limit.answer.value,
            **{f"{name}_mps": finite_or_none(getattr(limit, name), JSON_DIGITS) for name in speeds},
            **{f"{name}_m": finite_or_none(getattr(limit, name), JSON_DIGITS) for name in errors},
            **pick_finite(limit, "within", digits=JSON_DIGITS),
            "predictions": limit.predictions,
        }
        for terrain, limit in limits.items()
    ]


def gather_samples(
    file: ModelFile, runs: Sequence[MotionRun], source: Input, ahead_s: float = HORIZON_S
) -> ErrorSamples:
    """Errors of a model's predictions on runs, none from a fit that has seen the same ten seconds.

    On a run that the model was fitted to, its effects are fitted again without each tested stretch, and a
    learned term is left out; on others the model is used as it is, with only the delays of the recording and
    the numbers of single runs fitted.

    Args:
        file: a model with fitted values.
        runs: runs of its vehicle.
        source: input of the model.
        ahead_s: time ahead [s], at most `HORIZON_S`.

    Raises:
        MotionError: ``too_far_ahead``; a run lacks the input or is too short.
    """
    if not NODE_S <= ahead_s <= HORIZON_S:
        what = f"predictions are made {NODE_S:g} to {HORIZON_S:g} s ahead, not {ahead_s:g} s"
        hint = "A tolerance at another time ahead cannot be judged: choose one in this range."
        raise MotionError("too_far_ahead", what, where="--ahead", hint=hint)
    known = {row.get("run") for row in file.list_fitted("runs")}
    parts: list[ErrorSamples] = []
    seen = 0
    for run in runs:
        data = EstimationData([run], file.model.vehicle, source)
        if run.name in known:
            fitted = fit_model(data, file.model, per_run=file.per_run, exact=True)
        else:
            fitted = fit_as_it_is(data, file.model, file.per_run)
        part = _hold_out_at(data, fitted, ahead_s)
        parts.append(ErrorSamples(part.speed, part.error, part.stretch + seen))
        seen = int(parts[-1].stretch.max(initial=seen)) + 1
    return ErrorSamples(
        *(np.concatenate([getattr(one, name) for one in parts]) for name in ("speed", "error", "stretch"))
    )


def _hold_out_at(data: EstimationData, fitted: Fitted, ahead_s: float) -> ErrorSamples:
    """Held-out errors of one run's predictions at a time ahead."""
    (run_residuals,), whole = data.residuals_by_run, data.whole
    rows = _find_rows(run_residuals, ahead_s)
    horizons = run_residuals.horizons
    ends = run_residuals.nodes.times[np.column_stack((horizons.origin[rows], horizons.node[rows]))]
    edges = run_residuals.grid.locate_edges(ends.ravel()).reshape(ends.shape).astype(np.int64)
    since = ends[:, 1] - ends[:, 0]
    error, speed = (np.full(rows.size, np.nan) for _ in range(2))
    for number, fold in enumerate(data.folds):
        near = find_in_test(run_residuals, whole.times, fold.test)[rows]
        if near.any():
            state = refit_fold(data, fitted, number)
            effects, timing = state.effects_of(0), state.timing[0]
            error[near] = run_residuals.find_horizon_errors(effects, timing).position[rows][near]
            velocity = run_residuals.predict_velocity(effects, timing, restarted=True)
            moved = run_residuals.grid.sum_up(np.hypot(velocity.x, velocity.y))
            speed[near] = _find_fastest(moved, edges[near], run_residuals.grid.step_s)
    # Who stands still or turns on the spot has no speed that could be limited.
    known = np.isfinite(error) & (speed > STILL_MPS)
    # Poses are not exactly at the time ahead: over tenths of a second, errors grow in proportion to it.
    error *= ahead_s / since
    stretches = number_predictions(data)[0][rows]
    return ErrorSamples(speed[known], error[known], stretches[known])


def _find_fastest(moved: Floats, edges: Ints, step_s: float) -> Floats:
    """Largest predicted speed, a mean over `SPAN_S`, from that time before each prediction to its end.

    What happens after braking is the error of the speed before it: a limit of the speed avoids both.

    Args:
        moved: way predicted until each cell edge [m], shape (m,).
        edges: cell edges of the starts and ends of predictions, shape (n, 2).
        step_s: width of a cell [s].
    """
    count = max(round(SPAN_S / step_s), 1)
    sustained = (moved[count:] - moved[:-count]) / (count * step_s)
    starts, ends = np.maximum(edges[:, 0] - count, 0), np.maximum(edges[:, 1] - count, 0)
    return np.array([sustained[a : b + 1].max(initial=0.0) for a, b in zip(starts, ends, strict=True)])


def _find_rows(run_residuals: RunResiduals, ahead_s: float) -> Ints:
    """Row of each prediction's pose nearest to a time ahead; none where poses are rarer than that time."""
    horizons, times = run_residuals.horizons, run_residuals.nodes.times
    gap = np.abs(times[horizons.node] - times[horizons.origin] - ahead_s)
    order = np.lexsort((gap, horizons.number))
    first = np.flatnonzero(np.diff(horizons.number[order], prepend=-1))
    nearest = order[first]
    return nearest[gap[nearest] <= 0.5 * ahead_s]
