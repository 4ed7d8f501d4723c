"""Estimates of one run with the model of a check, and what is compared beside them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.core import (
    FEWEST_OF_SPREAD,
    NORMAL_95,
    Floats,
    Ints,
    jackknife_deviation,
    number_stretches,
    resample_median,
    student_quantile,
)
from pipeline.estimation.commanded import measure_commanded_turn
from pipeline.estimation.estimation_data import EstimationData
from pipeline.estimation.intervals import estimate_path
from pipeline.estimation.model_fit import Fitted, fit_model
from pipeline.estimation.run_residuals import Input
from pipeline.models import Effect, Late, Model, Parameter, is_of_one_run
from pipeline.run import MotionRun
from schemas.run_tables import COUNTED

POSITION_ERROR, HEADING_ERROR = "error.position", "error.heading"
ERRORS = {POSITION_ERROR: "m", HEADING_ERROR: "rad"}
"""Errors over 2 s divided by the speed of the run, which no parameter of the model explains, and their
units."""
COMMANDED_TURN, MULTIPLIER = "commanded.turn", "controller.multiplier"
"""Share of the commanded yaw rate that the robot reaches, and its controller's multiplier: without a body
command unknown."""
LOGARITHMS = (*ERRORS, COMMANDED_TURN, MULTIPLIER)
"""Quantities beside the parameters; they are compared as logarithms."""
_MULTIPLIER_ERROR = 0.02
"""Standard deviation of the logarithm of a multiplier that is measured by the wheels: simulated runs of one
controller differ by 0.01, and load and wear of real wheels, which all runs of a side share, do not average
away."""
_LEAST_SQUARE = 1e-12
"""Lower bound of a mean square error [m^2, rad^2], to keep its logarithm finite."""
_LEAST_SLIP = 1e-6
"""Lower bound of a slip modulus [m/s], to keep its logarithm finite."""
Estimate = tuple[float, float]
"""A value and its standard deviation."""


@dataclass(frozen=True)
class Label:
    """A parameter that a check compares, of an effect with the values of the model."""

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
        run: name of the run.
        terrain: terrain of the run.
        pace: root mean square ideal speed [m/s]; a yaw rate of 1 rad/s counts as 1 m/s.
        estimates: of the parameters by label, and of `LOGARITHMS`; of what the run determines.
        slip: logarithm of the median slip modulus [m/s]; NaN if unknown.
    """

    run: str
    terrain: str
    pace: float
    estimates: dict[str, Estimate]
    slip: Estimate = (math.nan, math.nan)


def read_run(run: MotionRun, model: Model, source: Input, labels: Sequence[Label]) -> RunReading:
    """Fit a model to one run, starting from the model's values, and return the estimates.

    Args:
        run: run of the model's vehicle.
        model: model, the same for all runs of a check.
        source: input of the model.
        labels: parameters to return, from `list_labels`.

    Raises:
        MotionError: the run lacks the input, or is too short.
    """
    fitted = fit_model(EstimationData([run], model.vehicle, source), model)
    names = {label.name for label in labels}
    estimates = {
        item.free.label: (item.value, item.deviation)
        for fit in fitted.fits
        if fit.free
        for item in estimate_path(fit).items
        if item.free.label in names and item.observable and math.isfinite(item.low) and item.deviation > 0.0
    }
    errors, pace = _measure_errors(fitted)
    estimates |= {name: error for name, error in zip(ERRORS, errors, strict=True) if math.isfinite(error[1])}
    turn = measure_commanded_turn(run, model.vehicle)
    if turn is not None:
        estimates[COMMANDED_TURN] = (math.log(turn.share), turn.deviation)
        estimates[MULTIPLIER] = (math.log(turn.controller_multiplier), _MULTIPLIER_ERROR)
    return RunReading(run.name, run.terrain, pace, estimates)


def _measure_errors(fitted: Fitted) -> tuple[list[Estimate], float]:
    """Logarithms of the errors divided by the speed, with their standard deviations, and the speed [m/s]."""
    data, state = fitted.data, fitted.state
    run_residuals = data.residuals_by_run[0]
    errors = run_residuals.find_horizon_errors(state.effects_of(0), state.timing[0])
    begin = run_residuals.run.start_s
    stretch = number_stretches(run_residuals.horizons.times[:, 0] - begin)
    asked = (data.whole.find_ideal()[:, 0] ** 2).sum(axis=1)
    driven = number_stretches(data.whole.times[:, 0] - begin)
    count = int(max(stretch.max(), driven.max())) + 1
    ideal = _sum(driven, asked, count)
    pace = math.sqrt(max(float(ideal[0].sum() / ideal[1].sum()), _LEAST_SQUARE))
    squares = (errors.position**2, errors.yaw**2)
    return [_compare(_sum(stretch, one, count), ideal) for one in squares], pace


def _sum(stretch: Ints, values: Floats, count: int) -> Floats:
    """Sums and numbers of values by stretch, shape (2, count)."""
    return np.array([np.bincount(stretch, values, count), np.bincount(stretch, minlength=count)])


def _compare(errors: Floats, ideal: Floats) -> Estimate:
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


def measure_slip(table: pl.DataFrame, source: Input) -> Estimate:
    """Logarithm of a run's median slip modulus [m/s], and its standard deviation by a bootstrap of stretches.

    Args:
        table: table `slip` of the run.
        source: input of the ideal model.
    """
    rows = table.filter(pl.col("input").cast(pl.String) == source.value, COUNTED)
    modulus = np.maximum(rows["modulus"].to_numpy(), _LEAST_SLIP)
    if modulus.size == 0:
        return math.nan, math.nan
    drawn = np.log(resample_median(modulus, rows["t"].to_numpy()))
    return math.log(float(np.median(modulus))), float(np.std(drawn)) if drawn.size else math.nan
