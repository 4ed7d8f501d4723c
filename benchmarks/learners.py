"""Models learned from the data, which name no cause, beside the physics.

Regressions of residuals, with the same hold-out and restarts as the ladder. A learned term adds to the body
velocity. Its inputs are those of a model: the input up to four seconds back, the attitude, and at the start
of a prediction the velocity of the half second before and the wheel encoders. Position and time are excluded,
as they do not transfer to other runs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.kernel_approximation import Nystroem
from sklearn.linear_model import BayesianRidge
from sklearn.pipeline import make_pipeline, make_union
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from threadpoolctl import threadpool_limits

from pipeline.core import Flags, Floats, SlipError, robust_spreads
from pipeline.estimation import EstimationData, HeldOut, Input
from pipeline.estimation.estimation_data import FEWEST_WINDOWS
from pipeline.estimation.held_out import score
from pipeline.estimation.model_state import ModelState
from pipeline.estimation.run_residuals import RunResiduals
from pipeline.estimation.window_residuals import CLIP, locate_windows
from pipeline.models import AddedEffect, Effect, Place, Timing
from pipeline.run import SPAN_S, MeasuredDrive, Rolling, RunContext, Velocity, roll_ideally

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
    """All learners that compete with the physical model."""
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
            raise SlipError("too_short", what, where=", ".join(self.data.names), hint="Drive longer.")
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
