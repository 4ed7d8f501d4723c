"""Fitting problem: runs prepared for one input, to fit models and to score them on these or other runs."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.core import Flags, Floats, Newest, join_parts, require_compiler, turn_units
from pipeline.estimation.comparison import Comparison, Input, choose_rate
from pipeline.estimation.fit import PartFit
from pipeline.estimation.floor import estimate_floor
from pipeline.estimation.folds import Errors, Fold, HeldOut, find_near, hold_out, make_folds
from pipeline.estimation.model_fit import Fitted, fit_model
from pipeline.estimation.parts import BodyPart, Part, WheelPart
from pipeline.estimation.state import DelayName, State
from pipeline.estimation.window_residuals import WindowResiduals
from pipeline.models import EXCEEDED_SHARE, Effect, Largest, Model, Timing, drop_learned
from pipeline.run import (
    HORIZON_S,
    WINDOW_S,
    HeadingSource,
    MotionError,
    MotionRun,
    find_fastest_wheel,
    name_inputs,
    split_wheels,
)
from pipeline.sources import Vehicle
from pipeline.stages import SLOW_HZ


@dataclass(frozen=True)
class Prediction:
    """Predictions of a run by a model.

    Attributes:
        start_times: times at which predictions begin [s], shape (k,).
        poses: (x [m], y [m], yaw [rad]) in the map, by prediction and time since its start, shape (k, m, 3).
        horizon_times: times since a prediction's start [s], shape (m,).
    """

    start_times: Floats
    poses: Floats
    horizon_times: Floats


def predict_from(
    comparison: Comparison, effects: Sequence[Effect], timing: Timing, *, rate_hz: float = 20.0
) -> Prediction:
    """Predict a run over `HORIZON_S`, repeatedly from measured poses.

    Args:
        comparison: the run and its input.
        effects: effects of the model, with their values.
        timing: delays of the recording.
        rate_hz: rate of the result; the model itself runs at `choose_rate`.
    """
    velocity = comparison.predict_velocity(effects, timing)
    grid = comparison.grid
    start_times, start = comparison.list_starts()
    turned = grid.sum_up(velocity.w)
    own = turn_units(0.5 * (turned[1:] + turned[:-1]))
    travelled = grid.sum_up(join_parts(velocity.x, velocity.y) * own)
    since = np.arange(0.0, HORIZON_S + 0.5 / rate_hz, 1.0 / rate_hz)
    at = grid.locate_edges((start_times[:, None] + since).ravel())
    index = np.arange(turned.size, dtype=np.float64)
    yaw = np.interp(at, index, turned).reshape(start_times.size, since.size)
    path = np.interp(at, index, travelled.real) + 1j * np.interp(at, index, travelled.imag)
    path = path.reshape(yaw.shape)
    origin = comparison.run.origin
    turned = start[:, 2:] + yaw - yaw[:, :1] + origin.heading
    turn = np.exp(1j * (start[:, 2] - yaw[:, 0] + origin.heading))
    begin = origin.put_back(join_parts(start[:, 0], start[:, 1]))
    along = begin[:, None] + turn[:, None] * (path - path[:, :1])
    poses = np.stack((along.real, along.imag, turned), axis=-1)
    return Prediction(start_times + origin.time_s, poses, since)


def predict_at(model: Model, run: MotionRun, source: Input, at: Floats) -> Floats:
    """Body velocities of a model at given times; measured ones less these are slip relative to the model.

    Args:
        model: model with its values.
        run: run with the commands or wheels.
        source: input of the model.
        at: times of aligned poses [s], shape (n,).

    Returns:
        (v_x [m/s], v_y [m/s], v_w [rad/s]) as the localization would report them, NaN in gaps of the
        recording, shape (n, 3).

    Raises:
        MotionError: the run lacks the input.
    """
    comparison = Comparison(run, model.vehicle, source)
    return predict_at_from(comparison, model.effects, Timing(), at)


def predict_at_from(comparison: Comparison, effects: Sequence[Effect], timing: Timing, at: Floats) -> Floats:
    """As `predict_at`, for a prepared run.

    Args:
        comparison: the run and its input.
        effects: effects of the model, with their values.
        timing: delays of the recording.
        at: times of aligned poses [s], shape (n,).
    """
    velocity = comparison.predict_velocity(effects, timing)
    grid = comparison.grid
    at = at - comparison.run.origin.time_s
    columns = [np.interp(at, grid.times, values) for values in (velocity.x, velocity.y, velocity.w)]
    predicted = np.column_stack(columns)
    predicted[grid.find_span(at) < 0] = np.nan
    return predicted


FEWEST_WINDOWS = 20
"""Minimum number of windows of a fit: a model of several effects has about as many parameters."""
_MOSTLY = 0.99
"""Minimum share of live commands in a stretch for it to count: all but rounding."""
_MOST_FITS = 24
"""Number of cached fits of parts: more than the steps of a ladder of ten effects."""
_STILL = 1e-9
"""Offset of wheel speed and yaw rate [rad/s], so that their sum over a run is not zero."""


def _refuse_few(run: MotionRun, count: int) -> MotionError:
    """Error for a run with too few windows, with the reason."""
    periods = np.diff(run.track.times)
    rate = 1.0 / float(np.median(periods)) if periods.size else 0.0
    if 0.0 < rate < SLOW_HZ:
        return MotionError(
            "slow_poses",
            f"its poses come at {rate:.2g} Hz: at least {SLOW_HZ:g} Hz are needed",
            where=run.name,
            hint="Record a faster localization, or the transforms (/tf): the odometry in them fills the time "
            "between its poses.",
        )
    return MotionError(
        "too_short",
        f"the run has {count} stretches of half a second with live commands and good poses; "
        f"{FEWEST_WINDOWS} are needed",
        where=run.name,
        hint="Drive longer, or check the intervals and the pose topic with `slip inspect`.",
    )


class Problem:
    """Runs prepared for one input.

    Building one is expensive; fitting and scoring models with it is cheap.

    Args:
        runs: one or several recordings of one vehicle.
        vehicle: geometry.
        source: input of the models.
        heading: source of the heading.

    Attributes:
        comparisons: the runs with the input.
        parts: parts on which parameters are fitted: the whole path, or if wheels are measured as well as
            commanded, the path from the wheels to the body and that from the command to the wheels.
        largest: the largest commands.
        exceeded: speeds that measured wheels exceed, see `measure_exceeded`.
        fits: cached fits of a part by their starts: models with commands and with measured wheels as input
            share the part after the wheels.

    Raises:
        MotionError: a run lacks the input, or has too little comparable data.
    """

    def __init__(
        self,
        runs: Sequence[MotionRun],
        vehicle: Vehicle,
        source: Input,
        *,
        heading: HeadingSource = HeadingSource.AUTO,
    ) -> None:
        require_compiler()
        self.runs = tuple(run.anchored for run in runs)
        self.vehicle = runs[0].correct_vehicle(vehicle)
        self.source = source
        self.heading = heading
        self.comparisons = self._compare(source)
        counts = [comparison.windows.start.size for comparison in self.comparisons]
        if sum(counts) < FEWEST_WINDOWS or 0 in counts:
            fewest = counts.index(min(counts))
            raise _refuse_few(self.runs[fewest], counts[fewest])
        self.largest = measure_largest(self.runs, self.vehicle)
        self.exceeded = measure_exceeded(self.runs, self.vehicle)
        self.fits = Newest[PartFit](_MOST_FITS)
        # A gyro determines the delay of the poses, one in any run for all; the remaining delay between poses
        # and wheels is that of the encoders.
        gyro = any(comparison.has_gyro for comparison in self.comparisons)
        delays: tuple[DelayName, ...] = ("wheel_delay_s",) if gyro else ()
        self.parts: tuple[Part, ...]
        if source is Input.MEASURED:
            self.parts = (BodyPart(self.comparisons, delays, whole=False),)
        elif any(run.wheels is None for run in self.runs):
            self.parts = (BodyPart(self.comparisons),)
        else:
            self._measured = self._compare(Input.MEASURED)
            sideways = self.largest.sideways > 0.0
            self.parts = (
                BodyPart(self._measured, delays, whole=False),
                WheelPart(self.comparisons, self._measured, sideways=sideways, exceeded=self.exceeded),
            )

    def _compare(self, source: Input) -> tuple[Comparison, ...]:
        rate = choose_rate(self.runs)
        return tuple(
            Comparison(run, self.vehicle, source, heading=self.heading, rate_hz=rate) for run in self.runs
        )

    @cached_property
    def behind_wheels(self) -> Problem:
        """The same runs with their measured wheels as input; prepared data are shared."""
        if self.source is Input.MEASURED:
            return self
        if len(self.parts) == 1:
            raise MotionError(
                "no_measured",
                "the run has no measured wheels to feed a model with",
                where=", ".join(self.names),
                hint="Choose the other input.",
            )
        problem = self.with_parts(self.parts[:1])
        problem.source, problem.comparisons = Input.MEASURED, self._measured
        return problem

    def with_parts(self, parts: tuple[Part, ...]) -> Problem:
        """The same runs with other parts, without cached results of the former ones."""
        problem = copy(self)
        for name in ("behind_wheels", "whole", "folds", "training"):
            problem.__dict__.pop(name, None)
        problem.parts = parts
        return problem

    @cached_property
    def whole(self) -> WindowResiduals:
        """Residuals of the whole path, from the input to the body, in windows: errors are measured there."""
        return WindowResiduals(self.comparisons)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the runs."""
        return tuple(run.name for run in self.runs)

    @cached_property
    def floor(self) -> Errors:
        """The noise floor of these runs, independent of any fit (see `estimate_floor`)."""
        return estimate_floor(self, self.parts[0].find_residuals(self.start_state()))

    @cached_property
    def folds(self) -> tuple[Fold, ...]:
        """Windows of the whole path that are held out in turn."""
        return make_folds(self.whole)

    @cached_property
    def training(self) -> tuple[tuple[Flags, ...], ...]:
        """Masks of the training steps, by fold and part."""
        return tuple(
            tuple(~find_near(part, self.whole, fold.test) for part in self.parts) for fold in self.folds
        )

    def start_state(self, known: State | Sequence[Effect] = ()) -> State:
        """A state to start from: that of a fit, or one without delays."""
        if isinstance(known, State):
            return known
        return State(tuple(known), (Timing(),) * len(self.runs))

    def active_effects(self, model: Model) -> tuple[Effect, ...]:
        """Effects that can act on one of the runs, see `Comparison.list_active`."""
        active = {one.id for comparison in self.comparisons for one in comparison.list_active(model)}
        return tuple(effect for effect in model if effect.id in active)

    def find_residuals(self, state: State) -> Floats:
        """Residuals of the whole path, all windows of all runs, shape (n, 3): x, y [m/s], w [rad/s]."""
        return self.whole.find_residuals(state)

    def find_run_residuals(self, state: State, run: int) -> Floats:
        """Residuals of one run's windows."""
        return self.whole.find_run_residuals(state, run)


_STANDS = 0.1
"""Share of the largest commanded wheel speed up to which a wheel counts as standing."""
_MOMENTS = 0.1
"""Share of the commands at either end that may be ramps."""
_ONE_SPEED = 0.8
"""Ratio of commanded speeds above which they are one: a limit and a gain that agree at one of them differ by
less than a fifth at the other, which lags of the drive hide."""


def measure_largest(runs: Sequence[MotionRun], vehicle: Vehicle) -> Largest:
    """The largest inputs of runs: of commands if there are any, else of wheels."""
    speed = aside = turn = wheel = difference = 0.0
    fastest = list[Floats]()
    for run in runs:
        series = run.commands or run.wheels
        if series is None:
            continue
        forward, sideways, yaw_rate = vehicle.kinematics.asked(name_inputs(series, vehicle), vehicle)
        speed, turn = max(speed, float(np.abs(forward).max())), max(turn, float(np.abs(yaw_rate).max()))
        if series.sideways is not None:
            aside = max(aside, float(np.abs(sideways).max()))
        wheels = find_fastest_wheel(series)
        wheel = max(wheel, float(wheels.max()))
        difference = max(difference, float(np.abs(series.right - series.left).max()))
        if series.sideways is None:
            fastest.append(wheels)
        else:
            # Rollers turn faster on a diagonal, at the same speed.
            half = 0.5 * np.abs(series.right - series.left)
            fastest.append(np.hypot(forward, sideways) / vehicle.wheel_radius_m + half)
    moments, turns = _find_tenths(runs, vehicle)
    rim = vehicle.wheel_radius_m * wheel
    return Largest(
        speed, turn, wheel, max(difference, 1e-6), moments, sideways=aside, turns=turns, rim=rim,
        is_one_speed=_is_one_speed(np.concatenate(fastest or [np.zeros(0)])),
    )  # fmt: skip


def _is_one_speed(fastest: Floats) -> bool:
    """Whether speeds that are commanded while not standing are one, but for some moments."""
    moving = fastest[fastest > _STANDS * fastest.max(initial=0.0)]
    if not moving.size:
        return False
    low, high = np.quantile(moving, (_MOMENTS, 1.0 - _MOMENTS))
    return bool(low > _ONE_SPEED * high)


def measure_exceeded(runs: Sequence[MotionRun], vehicle: Vehicle) -> dict[str, float]:
    """Half-second means that measured wheels exceed in `EXCEEDED_SHARE` of a run: `speed`, `turn`, `wheel`.

    For several runs the largest value, as a limit applies to all of them. Means over half a second, the
    length of the fitted windows, average out the encoder noise of single readings (6 % on a Husky).
    """
    most: dict[str, float] = {}
    for run in runs:
        if run.wheels is None:
            continue
        wheels = run.wheels
        forward, _, yaw_rate = vehicle.kinematics.asked(name_inputs(wheels, vehicle), vehicle)
        driven = np.interp(wheels.times, run.track.times, run.track.active.astype(np.float64))
        active = average_sustained(wheels.times, driven) > _MOSTLY
        series = {"speed": [forward], "turn": [yaw_rate], "wheel": split_wheels(wheels)}
        for name, signals in series.items():
            means = np.array([average_sustained(wheels.times, signal) for signal in signals])[:, active]
            fastest = _find_fastest_mean(means)
            if fastest.size:
                most[name] = max(most.get(name, 0.0), float(np.quantile(fastest, 1.0 - EXCEEDED_SHARE)))
    return most


def _find_fastest_mean(means: Floats) -> Floats:
    """Least speed of the fastest wheel, or of a signal, for means of shape (1, 2 or 4 signals, n)."""
    if means.shape[0] < 4:  # noqa: PLR2004 - wheels
        return np.asarray(np.abs(means).max(axis=0))
    # Sides do not show how fast four wheels turn against each other: one of them is at least so fast.
    opposed = means * np.array([[1.0], [1.0], [-1.0], [-1.0]])
    return np.asarray(0.5 * np.ptp(opposed, axis=0))


def average_sustained(times: Floats, signal: Floats) -> Floats:
    """Means of a signal over the complete stretches of `WINDOW_S` that begin at each sample."""
    count = max(round(WINDOW_S / float(np.median(np.diff(times)))), 1) if times.size > 1 else 1
    whole = times[count - 1 :] - times[: times.size - count + 1] <= WINDOW_S
    return np.convolve(signal, np.full(count, 1.0 / count), "valid")[whole]


def _find_tenths(runs: Sequence[MotionRun], vehicle: Vehicle) -> Floats:
    """Times of the tenths of the fastest wheel's travel, and of the total turning [s], shape (2, 11)."""
    times, moved = list[Floats](), list[Floats]()
    for run in runs:
        series, at = run.wheels or run.commands, run.track.times[run.track.active]
        if series is not None and at.size:
            yaw_rate = vehicle.kinematics.asked(name_inputs(series, vehicle), vehicle)[2]
            both = np.array([find_fastest_wheel(series), np.abs(yaw_rate)])
            times.append(at)
            # Without any motion, the share grows evenly with time.
            moved.append(np.array([np.interp(at, series.times, one) + _STILL for one in both]))
    if not times:
        return np.zeros((2, 11))
    order = np.argsort(np.concatenate(times), kind="stable")
    done = np.cumsum(np.concatenate(moved, axis=1)[:, order], axis=1)
    when, share = np.concatenate(times)[order], np.linspace(0.0, 1.0, 11)
    return np.array([np.interp(share * one[-1], one, when) for one in done])


CARRIES_OVER = 1.1
"""Largest ratio of a model's error on another run to that of a fit to that run for it to transfer."""


@dataclass(frozen=True)
class Transfer:
    """A model on a run that it was not fitted on.

    Attributes:
        run: name of the run; `terrain` its terrain.
        carried: errors with the model's values; only the delays of the recording and parameters of single
            runs are fitted.
        own: held-out errors of the same effects fitted to this run.
        ideal: errors of the ideal model.
        ratio: ratio of carried to own, geometric mean over the channels x, y, w.
        warning: reason not to trust the model here; empty if it transfers.
    """

    run: str
    terrain: str
    carried: HeldOut
    own: HeldOut
    ideal: HeldOut
    ratio: float
    warning: str


def carry_over(
    model: Model,
    runs: Sequence[MotionRun],
    source: Input,
    *,
    fitted_on: Sequence[str] = (),
    per_run: Sequence[str] = (),
) -> list[Transfer]:
    """Predict runs with a model that was fitted on others.

    Args:
        model: model with fitted values.
        runs: runs to predict.
        source: input of the model.
        fitted_on: terrains it was fitted on, for the warning.
        per_run: labels of parameters with one value per run, which are fitted to each run.
    """
    transfers = []
    for run in runs:
        problem = Problem([run], model.vehicle, source)
        carried = hold_out(problem, fit_as_it_is(problem, model, per_run))
        own = hold_out(problem, fit_model(problem, drop_learned(model), exact=True))
        ideal = hold_out(problem, fit_model(problem, model.ideal, exact=True))
        ratios = np.array(carried.pooled.ratios(own.pooled)[:3])
        ratio = float(np.exp(np.mean(np.log(ratios))))
        transfers.append(
            Transfer(run.name, run.terrain, carried, own, ideal, ratio, _warn(run, ratio, fitted_on))
        )
    return transfers


def fit_as_it_is(problem: Problem, model: Model, per_run: Sequence[str] = ()) -> Fitted:
    """A model with its values: only delays of the recording and parameters of single runs are fitted."""
    return fit_model(
        problem,
        model.swap(
            *(
                effect.fix(*(n for n in effect.values if f"{effect.id}.{n}" not in per_run))
                for effect in model
            )
        ),
    )


def _warn(run: MotionRun, ratio: float, fitted_on: Sequence[str]) -> str:
    if ratio <= CARRIES_OVER:
        return ""
    where = f" on {run.terrain}" if run.terrain != "unknown" else ""
    came = f" (fitted on {', '.join(sorted(set(fitted_on)))})" if fitted_on else ""
    return (
        f"the model{came} does not transfer to {run.name}{where}: its errors are {ratio:.2f} times "
        "those of a fit to that run"
    )
