"""Comparison of models on runs, named and learned: held-out errors over 2 s, and significant differences.

A difference is taken between predictions from the same measured poses. Errors are autocorrelated: the
interval of a difference is a jackknife over stretches of ten seconds.

Learned terms are regressions of residuals, with the same hold-out and restarts as the ladder. A learned term
adds to the body velocity. Its inputs are those of a model: the input up to four seconds back, the attitude,
and at the start of a prediction the velocity of the half second before and the wheel encoders. Position and
time are excluded, as they do not transfer to other runs.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from threadpoolctl import threadpool_limits

from pipeline.core import (
    CONFIDENCE,
    JSON_DIGITS,
    Flags,
    Floats,
    Ints,
    SlipError,
    finite_or_none,
    jackknife_deviation,
    robust_spreads,
    student_quantile,
)
from pipeline.estimation.errors import errors_as_json
from pipeline.estimation.estimation_data import FEWEST_WINDOWS, EstimationData
from pipeline.estimation.held_out import HeldOut, hold_out, number_predictions, score
from pipeline.estimation.model_fit import Fitted, fit_model
from pipeline.estimation.run_residuals import Input, RunResiduals
from pipeline.estimation.window_residuals import CLIP, locate_windows
from pipeline.models import AddedEffect, Effect, Model, Place, Timing
from pipeline.results import ERRORS_OVER_2S, read_error
from pipeline.run import SPAN_S, MeasuredDrive, MotionError, Rolling, RunContext, Velocity, roll_ideally

if TYPE_CHECKING:
    from pipeline.estimation.held_out import HeldOut
    from pipeline.estimation.model_fit import Fitted
    from pipeline.estimation.model_state import ModelState


@dataclass(frozen=True)
class Rival:
    """A model with its held-out errors.

    Attributes:
        name: displayed name.
        numbers: number of fitted parameters; None for a learned model.
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
class Difference:
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

    def measure(self, rival: Rival, other: Rival, metric: str) -> Difference:
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
    return judge_fit(data, name, *time_fit(data, model, per_run))


def time_fit(data: EstimationData, model: Model, per_run: Sequence[str] = ()) -> tuple[Fitted, float]:
    """The fit of a model, and its processor time [s]."""
    start = time.process_time()
    active = model.keep(effect.id for effect in data.active_effects(model))
    fitted = fit_model(data, active, per_run=per_run, exact=True)
    return fitted, time.process_time() - start


def judge_fit(data: EstimationData, name: str, fitted: Fitted, fit_s: float) -> Rival:
    """Score a fit as the ladder scores its steps."""
    numbers = len({number.label for number in fitted.free if number.effect})
    return Rival(name, numbers, hold_out(data, fitted), fit_s)


def hold_contest(data: EstimationData, rivals: Sequence[Rival]) -> Contest:
    """Comparison of models that were scored on the same runs."""
    return Contest(tuple(rivals), np.concatenate(number_predictions(data)))


def compare_errors(one: Floats, other: Floats, stretches: Ints) -> Difference:
    """Difference of two root mean squares over the same predictions, by a jackknife over stretches.

    Args:
        one: errors, shape (n,); NaN without a prediction.
        other: errors of another model, shape (n,).
        stretches: number of the stretch of each, shape (n,).
    """
    known = np.isfinite(one) & np.isfinite(other)
    if not known.any():
        return Difference(math.nan, math.nan, math.nan)
    index = np.unique(stretches[known], return_inverse=True)[1]
    counts = np.bincount(index).astype(np.float64)
    sums = np.array([np.bincount(index, errors[known] ** 2) for errors in (one, other)])
    first, second = np.sqrt(sums.sum(axis=1) / counts.sum()).tolist()
    value = first - second
    if counts.size < 2:  # noqa: PLR2004 - one stretch has no spread
        return Difference(value, -math.inf, math.inf)
    without = np.sqrt((sums.sum(axis=1)[:, None] - sums) / (counts.sum() - counts))
    moved = without[0] - without[1]
    half = student_quantile(CONFIDENCE, counts.size - 1) * jackknife_deviation(moved)
    return Difference(value, value - half, value + half)


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
                "errors": errors_as_json(rival.held_out.pooled),
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


LAGS_S = (0.0, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)
"""Lags of the input [s]: dense in the range of drivetrain responses, at most four seconds."""
_FADES_S = (0.3, 1.0)
"""Decay time constants of the state at a prediction's start [s]: those of wheels and bodies."""
_INDUCING = 300
"""Inducing points of the sparse Gaussian process: time and memory of a fit grow with their number."""


class Regressor(Protocol):
    """Interface of an estimator of scikit-learn."""

    def fit(self, x: Floats, y: Floats) -> object:
        """Fit features, shape (n, p), to values, shape (n,)."""

    def predict(self, x: Floats) -> Floats:
        """Values at features."""


@dataclass(frozen=True)
class Learner:
    """A kind of regression.

    Attributes:
        name: displayed name.
        title: description in one line.
        make: constructor of an unfitted regressor for a number of windows.
    """

    name: str
    title: str
    make: Callable[[int], Regressor]


def list_learners() -> tuple[Learner, ...]:
    """All learners that compete with the physical model.

    Raises:
        SlipError: ``learn_needed``, the extra is not installed.
    """
    try:
        from sklearn.ensemble import HistGradientBoostingRegressor  # noqa: PLC0415 - heavy, and an extra
        from sklearn.kernel_approximation import Nystroem  # noqa: PLC0415
        from sklearn.linear_model import BayesianRidge  # noqa: PLC0415
        from sklearn.pipeline import make_pipeline, make_union  # noqa: PLC0415
        from sklearn.preprocessing import FunctionTransformer, StandardScaler  # noqa: PLC0415
    except ImportError as error:
        hint = "Install the extra: pip install 'slip-pipeline[learn]'"
        raise SlipError("learn_needed", "scikit-learn is not installed", hint=hint) from error
    return (
        Learner(
            "learned_linear",
            "Bayesian linear regression",
            lambda _: make_pipeline(StandardScaler(), BayesianRidge()),
        ),
        Learner(
            "learned_process",
            f"sparse Gaussian process of a linear and a Gaussian kernel, {_INDUCING} inducing points",
            lambda count: make_pipeline(
                StandardScaler(),
                make_union(
                    FunctionTransformer(), Nystroem(n_components=min(_INDUCING, count), random_state=0)
                ),
                BayesianRidge(),
            ),
        ),
        Learner(
            "learned_trees",
            "boosted trees",
            lambda _: HistGradientBoostingRegressor(
                max_iter=100, learning_rate=0.1, max_leaf_nodes=16, max_bins=64, random_state=0
            ),
        ),
    )


class LearnedTerm(AddedEffect):
    """Adds learned velocities of one run.

    Args:
        added: x, y [m/s] and w [rad/s] on the cells, shape (n, 3).
    """

    id = "learned_term"
    place = Place.LOCALIZATION
    parameters = ()

    def __init__(self, added: Floats) -> None:
        super().__init__()
        self._added = added

    def add_to(
        self,
        total: Velocity,
        rolling: Rolling,  # noqa: ARG002 - what was learned is known already
        velocity: Velocity,  # noqa: ARG002
        context: RunContext,  # noqa: ARG002
    ) -> Velocity:
        """Add the learned velocities."""
        return total.add(*self._added.T)


@dataclass(frozen=True)
class Learned:
    """Fitted regressions of the three channels.

    Attributes:
        regressors: regressors of x, y and w.
    """

    regressors: tuple[Regressor, ...]

    def add_to(self, run_residuals: RunResiduals, features: Floats | None = None) -> tuple[Effect, ...]:
        """The learned term of a run."""
        known = make_features(run_residuals) if features is None else features
        with threadpool_limits(1):
            added = np.column_stack([one.predict(known) for one in self.regressors])
        return (LearnedTerm(added),)


@dataclass(frozen=True)
class Lesson:
    """Training runs with the features of their cells and windows.

    Attributes:
        data: the runs.
        learner: the kind of regression.
    """

    data: EstimationData
    learner: Learner
    _features: dict[int, Floats] = field(default_factory=dict, repr=False)

    def read_features(self, run: int) -> Floats:
        """Features of the cells of a run, shape (n, p)."""
        if run not in self._features:
            self._features[run] = make_features(self.data.residuals_by_run[run])
        return self._features[run]

    @cached_property
    def windows(self) -> tuple[Floats, Flags]:
        """Mean features of all windows, shape (n, p), and whether a window lies within one prediction."""
        averages = [
            average_features(c, self.read_features(run)) for run, c in enumerate(self.data.residuals_by_run)
        ]
        return np.concatenate([one[0] for one in averages]), np.concatenate([one[1] for one in averages])

    def learn(self, state: ModelState, rows: Flags) -> Learned:
        """Learn the residuals of a model on some windows.

        Args:
            state: the model with its values.
            rows: mask of the training windows, shape (n,).
        """
        features, whole = self.windows
        rows = rows & whole
        if rows.sum() < FEWEST_WINDOWS:
            what = f"{int(rows.sum())} half seconds can be learned from; {FEWEST_WINDOWS} are needed"
            raise MotionError("too_short", what, where=", ".join(self.data.names), hint="Drive longer.")
        residuals_of = [
            # Restarted: errors that a reset to measured states removes are not learned a second time.
            run_residuals.find_residuals(state.effects_of(run), state.timing[run], restarted=True)
            for run, run_residuals in enumerate(self.data.residuals_by_run)
        ]
        residuals = np.concatenate(residuals_of)[rows]
        most = CLIP * np.maximum(robust_spreads(residuals), 1e-9)
        targets = np.clip(residuals, -most, most)
        made = tuple(self.learner.make(len(targets)) for _ in range(targets.shape[1]))
        with threadpool_limits(1):
            for one, target in zip(made, targets.T, strict=True):
                one.fit(features[rows], target)
        return Learned(made)

    def learn_fold(self, state: ModelState, rows: Flags) -> Callable[[int], Sequence[Effect]]:
        """Learned terms from some windows by run, as `hold_out` requires."""
        learned = self.learn(state, rows)
        return lambda run: learned.add_to(self.data.residuals_by_run[run], self.read_features(run))


def judge_learned(data: EstimationData, fitted: Fitted, learner: Learner) -> Rival:
    """Score a fit with a regression added, as the ladder scores its steps."""
    lesson = Lesson(data, learner)
    start = time.process_time()
    lesson.learn(fitted.state, np.ones(data.whole.run.size, dtype=bool))
    fit_s = time.process_time() - start
    return Rival(learner.name, None, hold_out(data, fitted, lesson.learn_fold), fit_s)


def score_learned(data: EstimationData, state: ModelState, learned: Learned) -> HeldOut:
    """Score a term learned on other runs, with an unchanged model."""
    return score(data, state, lambda run: learned.add_to(data.residuals_by_run[run]))


def make_features(run_residuals: RunResiduals) -> Floats:
    """Features of a learned term at every cell of a run, shape (n, p)."""
    context = run_residuals.restarts
    ideal = run_residuals.predict_velocity((), Timing())
    signals = [ideal.x, ideal.w]
    if context.vehicle.kinematics.has_inputs("sideways"):
        signals.append(ideal.y)
    first = context.spans.first[context.spans.number]
    index = np.arange(context.times.size)
    columns = []
    for late in LAGS_S:
        back = np.maximum(index - round(late / context.step_s), first)
        columns += [signal[back] for signal in signals]
    forward, turning = ideal.x, ideal.w
    columns += [
        forward * turning,
        forward * np.abs(forward),
        forward * np.abs(turning),
        np.abs(forward) * turning,
        turning * np.abs(turning),
        np.abs(forward),
        np.abs(turning),
        np.sign(forward),
        np.sign(turning),
        *context.attitude[:, :2].T,
    ]
    columns += _look_back(run_residuals, np.column_stack((ideal.x, ideal.y, ideal.w)))
    return np.column_stack(columns)


def _look_back(run_residuals: RunResiduals, ideal: Floats) -> list[Floats]:
    """Measurements at the start of each prediction less the input, and their decayed values."""
    context = run_residuals.restarts
    reset = context.body.number
    began = context.body.at[reset]
    surplus = [np.nan_to_num(context.body.start[reset] - ideal[began])]
    if run_residuals.source is Input.COMMAND and run_residuals.run.wheels is not None:
        seen = MeasuredDrive(run_residuals.run.wheels).interpolate(context.times[context.body.at], 0.0)
        rolled = roll_ideally(seen, context)
        wheels = np.column_stack((rolled.v0, rolled.w0))
        surplus.append((wheels - ideal[context.body.at][:, [0, 2]])[reset])
    known = np.column_stack(surplus)
    age = context.times - context.times[began]
    fading = [np.exp(-age / tau)[:, None] * known for tau in _FADES_S]
    return [age, *known.T, *np.column_stack(fading).T]


def average_features(run_residuals: RunResiduals, features: Floats) -> tuple[Floats, Flags]:
    """Means of features over the windows of a run, and whether a window lies within one prediction."""
    spans, context = locate_windows(run_residuals), run_residuals.restarts
    total = np.concatenate((np.zeros((1, features.shape[1])), np.cumsum(features, axis=0)))
    first, last = spans.first, spans.last
    means = (total[last + 1] - total[first]) / (last + 1 - first)[:, None]
    reset = context.body.number
    # The velocity at the start is measured over the window before, and refers to the middle of it.
    since = context.times[first] - context.times[context.body.at[reset[first]]]
    return means, (reset[first] == reset[last]) & (since > 0.5 * SPAN_S - 1.5 * context.step_s)
