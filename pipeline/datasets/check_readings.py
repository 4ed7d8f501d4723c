"""Estimates of one run with the model of a check, and the logarithms that are compared beside them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import polars as pl

from pipeline.core import (
    FEWEST_OF_SPREAD,
    NORMAL_95,
    STRETCH_S,
    Floats,
    Ints,
    group_rows,
    jackknife_deviation,
    student_quantile,
)
from pipeline.datasets.changes import RunNumbers, Side
from pipeline.estimation.commanded import measure_commanded_turn
from pipeline.estimation.estimation_data import EstimationData
from pipeline.estimation.fit import fit_path
from pipeline.estimation.intervals import estimate_path
from pipeline.estimation.model_fit import Fitted, fit_model
from pipeline.estimation.run_residuals import Input
from pipeline.models import Effect, Late, Model, Parameter, is_of_one_run
from pipeline.run import MotionRun

POSITION_ERROR = "error.position"


HEADING_ERROR = "error.heading"


ERRORS = (POSITION_ERROR, HEADING_ERROR)
"""Logarithms of the errors over 2 s [m, rad] divided by the speed of the run [m/s]: a change of these is not
explained by any parameter of the model."""


COMMANDED_TURN = "commanded.turn"


MULTIPLIER = "controller.multiplier"


COMMANDED = (COMMANDED_TURN, MULTIPLIER)
"""Logarithms of the share of the commanded yaw rate that the robot reaches, and of the multiplier of its
controller: unknown without a body command."""


LOGARITHMS = (*ERRORS, *COMMANDED)
"""Quantities beside the parameters, in their order; all are compared as logarithms."""


USUAL_LOG_RATIO = 0.4
"""Root mean square of the prior of such a logarithm's spread between runs on one terrain: the spread of the
Warthog recordings (`make bench NAME=check ARGS=real`)."""


USUAL_LOG_SHARE = 0.18
"""The same of the share of the commanded yaw rate: that of seven runs of a Warthog on three terrains."""


MULTIPLIER_ERROR = 0.02
"""Standard deviation of the logarithm of a side's multiplier that is measured by the wheels, however many
runs it has: simulated runs of one controller differ by 0.01, and load and wear of real wheels, which all runs
of a side share, do not average away."""


USUAL_LOGARITHMS = {
    POSITION_ERROR: USUAL_LOG_RATIO,
    HEADING_ERROR: USUAL_LOG_RATIO,
    COMMANDED_TURN: USUAL_LOG_SHARE,
    MULTIPLIER: 0.0,
}
"""Root mean square of the prior of each spread between runs; a setting has none."""


_LEAST_SQUARE = 1e-12
"""Lower bound of a mean square error [m^2, rad^2], to keep its logarithm finite."""


_LEAST_SLIP = 1e-6
"""Lower bound of a slip modulus [m/s], to keep its logarithm finite."""


_LEAST_RISE = 0.01
"""Smallest rise of chi-square between two values, to keep an error finite: less is the end of a fit."""


_RESAMPLES = 200
"""Bootstrap resamples: they give the standard deviation to a twentieth."""


@dataclass(frozen=True)
class Label:
    """A parameter that a check compares.

    Attributes:
        effect: effect of the parameter, with the values of the model.
        parameter: parameter of the effect.
    """

    effect: Effect
    parameter: Parameter

    @property
    def name(self) -> str:
        """``effect.parameter``."""
        return f"{self.effect.id}.{self.parameter.name}"


def list_labels(model: Model, per_run: Sequence[str] = ()) -> list[Label]:
    """Parameters of a model that can be compared between runs.

    Excluded are fixed parameters, parameters of single runs, effects that start within one recording, and
    clock effects of a recording.
    """
    return [
        Label(effect, parameter)
        for effect in model
        if effect.late is not Late.POSES and not is_of_one_run(effect.parameters)
        for parameter in effect.parameters
        if parameter.name not in effect.fixed
        and math.isfinite(effect.values[parameter.name])
        and not {effect.id, f"{effect.id}.{parameter.name}"} & set(per_run)
    ]


@dataclass(frozen=True)
class RunReading:
    """Estimates of a run with the model of a check.

    Attributes:
        numbers: estimates of the labels and of `LOGARITHMS`, in that order.
        sha256: hash of the recording.
        terrain: terrain of the run.
        pace: root mean square ideal speed [m/s]; a yaw rate of 1 rad/s counts as 1 m/s.
        slip: logarithm of the median slip modulus [m/s], and its standard deviation; NaN if unknown.
        fitted: the fit; None for a run from a baseline.
    """

    numbers: RunNumbers
    sha256: str
    terrain: str
    pace: float
    slip: tuple[float, float] = (math.nan, math.nan)
    fitted: Fitted | None = field(default=None, repr=False)


def read_run(run: MotionRun, model: Model, source: Input, labels: Sequence[Label], side: Side) -> RunReading:
    """Fit a model to one run, starting from the model's values, and return the estimates.

    The errors are those of the intervals of every fit (`estimate_intervals`). Correlations are shrunk
    according to the ratio of blocks to estimated parameters.

    Args:
        run: run of the model's vehicle.
        model: model, the same for all runs of a check.
        source: input of the model.
        labels: parameters to return, from `list_labels`.
        side: side of the check.

    Raises:
        MotionError: the run lacks the input, or is too short.
    """
    data = EstimationData([run], model.vehicle, source)
    fitted = fit_model(data, model)
    names = [label.name for label in labels]
    count = len(names) + len(LOGARITHMS)
    values, covariance = np.full(count, np.nan), np.full((count, count), np.nan)
    for fit in fitted.fits:
        if not fit.free:
            continue
        estimates = estimate_path(fit)
        common = [
            (index, item)
            for index, item in enumerate(estimates.items)
            if item.free.label in names
            and item.observable
            and math.isfinite(item.low)
            and item.deviation > 0.0
        ]
        places = [index for index, _ in common]
        rows = [names.index(item.free.label) for _, item in common]
        deviations = np.array([item.deviation for _, item in common])
        values[rows] = [item.value for _, item in common]
        believed = 1.0 / (1.0 + len(estimates.items) / max(estimates.blocks, 1))
        correlation = believed * np.nan_to_num(estimates.correlation[np.ix_(places, places)])
        np.fill_diagonal(correlation, 1.0)
        covariance[np.ix_(rows, rows)] = correlation * np.outer(deviations, deviations)
    errors, pace = _measure_errors(fitted)
    turn = measure_commanded_turn(run, model.vehicle)
    if turn is not None:
        errors += [(math.log(turn.share), turn.deviation), (math.log(turn.multiplier), MULTIPLIER_ERROR)]
    for index, (value, deviation) in enumerate(errors, start=len(names)):
        values[index], covariance[index, index] = value, deviation**2
    covariance[np.isnan(covariance) & ~np.eye(count, dtype=bool)] = 0.0
    numbers = RunNumbers(run.name, side, values, covariance)
    return RunReading(numbers, run.sha256, run.terrain, pace, fitted=fitted)


def widen(reading: RunReading, labels: Sequence[Label], others: Mapping[str, float]) -> RunReading:
    """The reading with the errors of some numbers by the likelihood at the values that another side has.

    The error of a fit is that of small changes. Another value far from it may fit the run as well once the
    other numbers follow: the error is then the one at which both values have their likelihoods.

    Args:
        reading: estimates of a run, returned unchanged without its fit.
        labels: parameters of the reading, in its order.
        others: value of another side, by name of the parameter.
    """
    fitted, numbers = reading.fitted, reading.numbers
    factors = np.ones(numbers.values.size)
    for index, label in enumerate(labels):
        if fitted is None or label.name not in others or not numbers.known[index]:
            continue
        error, away = math.sqrt(numbers.covariance[index, index]), others[label.name] - numbers.values[index]
        for fit in fitted.fits:
            effect = fit.state.find(label.effect.id)
            if effect is not None and label.name in {free.label for free in fit.free}:
                name = label.parameter.name
                moved = effect.change(**{name: others[label.name]}).fix(name)
                risen = fit_path(fit.path, fit.state.add(moved), noise=fit.noise).score - fit.score
                deviations = math.sqrt(max(risen / fit.overdispersion, _LEAST_RISE))
                factors[index] = max(abs(away) / deviations / error, 1.0)
    covariance = numbers.covariance * np.outer(factors, factors)
    return replace(reading, numbers=replace(numbers, covariance=covariance))


def _measure_errors(fitted: Fitted) -> tuple[list[tuple[float, float]], float]:
    """Logarithms of the errors divided by the speed, with their standard deviations, and the speed [m/s]."""
    data, state = fitted.data, fitted.state
    run_residuals = data.residuals_by_run[0]
    errors = run_residuals.find_horizon_errors(state.effects_of(0), state.timing[0])
    begin = run_residuals.run.start_s
    stretch = _number(run_residuals.horizons.times[:, 0] - begin)
    asked = (data.whole.find_ideal()[:, 0] ** 2).sum(axis=1)
    driven = _number(data.whole.times[:, 0] - begin)
    present, both = np.unique(np.concatenate((stretch, driven)), return_inverse=True)
    stretch, driven = np.split(both, [stretch.size])
    count = present.size
    ideal = _sum(driven, asked, count)
    pace = math.sqrt(max(float(ideal[0].sum() / ideal[1].sum()), _LEAST_SQUARE))
    squares = (errors.position**2, errors.yaw**2)
    return [_compare(_sum(stretch, one, count), ideal) for one in squares], pace


def _number(since: Floats) -> Ints:
    return np.maximum(since / STRETCH_S, 0.0).astype(np.int64)


def _sum(stretch: Ints, values: Floats, count: int) -> Floats:
    """Sums and numbers of values by stretch, shape (2, count)."""
    return np.array([np.bincount(stretch, values, count), np.bincount(stretch, minlength=count)])


def _compare(errors: Floats, ideal: Floats) -> tuple[float, float]:
    """Half the logarithm of the ratio of two mean squares, and its standard deviation (delete-one jackknife).

    The deviation is that of the normal distribution with the 95 % interval of Student's t; NaN if there are
    too few stretches.
    """
    rows = np.flatnonzero((errors[1] > 0) & (ideal[1] > 0))

    def look(means: Floats) -> Floats:
        mean = [means[..., index, 0] / means[..., index, 1] for index in (0, 1)]
        return 0.5 * np.log(np.maximum(mean[0], _LEAST_SQUARE) / np.maximum(mean[1], _LEAST_SQUARE))

    blocks = np.stack((errors[:, rows], ideal[:, rows])).transpose(2, 0, 1)
    if rows.size < FEWEST_OF_SPREAD:
        return math.nan, math.nan
    whole = blocks.sum(axis=0)
    without = look(whole - blocks)
    deviation = jackknife_deviation(without) * student_quantile(0.95, rows.size - 1.0) / NORMAL_95
    return float(look(whole)), deviation


def measure_slip(table: pl.DataFrame, source: Input) -> tuple[float, float]:
    """Logarithm of a run's median slip modulus [m/s], and its standard deviation by a bootstrap of stretches.

    Args:
        table: table `slip` of the run.
        source: input of the ideal model.
    """
    rows = table.filter(pl.col("input").cast(pl.String) == source.value, ~pl.col("suspect"))
    modulus = np.maximum(rows["modulus"].to_numpy(), _LEAST_SLIP)
    if modulus.size == 0:
        return math.nan, math.nan
    stretches = group_rows(_number(rows["t"].to_numpy() - float(rows["t"][0])))
    rng = np.random.default_rng(0)
    drawn = [
        np.median(modulus[np.concatenate([stretches[index] for index in picked])])
        for picked in rng.integers(len(stretches), size=(_RESAMPLES, len(stretches))).tolist()
    ]
    known = len(stretches) >= FEWEST_OF_SPREAD
    return math.log(float(np.median(modulus))), float(np.std(np.log(drawn))) if known else math.nan
