"""Numbers of an effect as they are said: those of the one fit, with its intervals."""

import math
from collections.abc import Iterable, Mapping

import numpy as np

from pipeline.core.numbers import NORMAL_95
from pipeline.diagnosis.diagnosis import Value
from pipeline.identification import Estimates, State
from pipeline.models import Effect, find_effect
from pipeline.models.bounds import cut_interval, stands_at_bound
from pipeline.models.parameter import Parameter, is_of_one_run
from pipeline.runs import MotionRun


def list_values(effect: Effect, estimates: Estimates | None) -> dict[str, Value]:
    """Numbers of an effect with the intervals of a fit; none where the fit could not tell."""
    known = {} if estimates is None else {item.free.label: item for item in estimates.items}
    values = {}
    for parameter in effect.parameters:
        value = effect.values[parameter.name]
        if not math.isfinite(value):
            continue
        item = known.get(f"{effect.id}.{parameter.name}")
        low, high = (math.nan, math.nan) if item is None else item.interval
        at_bound = stands_at_bound(value, parameter.bounds)
        own = at_bound or is_of_one_run(effect.parameters)
        another = (math.nan, math.nan) if own else expect_another_run(parameter, value, low, high)
        values[parameter.name] = Value(value, low, high, parameter.unit, at_bound, another)
    return values


def holds_nothing(name: str, tellings: Iterable[Mapping[str, Value]]) -> bool:
    """Whether no interval of an effect leaves out where it does nothing; a limit does nothing at infinity."""
    known = [
        (value, parameter)
        for values in tellings
        for key, value in values.items()
        if not math.isnan((parameter := find_effect(name)().parameter(key)).neutral)
        and math.isfinite(value.high - value.low)
        and value.high > value.low
    ]
    return bool(known) and all(
        value.low <= parameter.neutral <= value.high
        if math.isfinite(parameter.neutral)
        else value.low <= parameter.bounds[0]
        for value, parameter in known
    )


def list_first_run(state: State, estimates: Estimates) -> dict[str, dict[str, Value]]:
    """Numbers of every effect of a fitted state as they act in the first run, by id."""
    first = estimates.choose_run(0)
    return {effect.id: list_values(effect, first) for effect in state.effects_of(0)}


def expect_another_run(parameter: Parameter, value: float, low: float, high: float) -> tuple[float, float]:
    """95 % interval of a number in another run on the same ground, NaN where this run has none.

    The interval of this run, and the spread between runs that recordings have shown or that is usual
    (`Parameter.spread`), independent of each other, of this run and of the other: two runs differ by the root
    of two more than either does from the ground's mean. Within the bounds of the search.
    """
    if not math.isfinite(high - low):
        return math.nan, math.nan
    change = NORMAL_95 * math.sqrt(2.0) * parameter.spread.size
    below, above = math.hypot(value - low, change), math.hypot(high - value, change)
    return cut_interval(value - below, value + above, parameter.bounds)


def read_clock(effect: Effect, run: MotionRun) -> dict[str, Value]:
    """How late poses were by a run's gyro: no fit of the motion moves it, its error is the gyro's.

    It is known no better than it varies in a run, nor than to half a sample of the gyro, whose stamp may be
    that of its begin or its end; and where poses are repeated until the next one is computed, that one may be
    as old as the time between two of them when it is first published.
    """
    (parameter,) = effect.parameters
    value = effect.values[parameter.name]
    half = math.nan
    if run.gyro_fit is not None and run.gyro is not None:
        sampling = 0.5 * float(np.median(np.diff(run.gyro[0]))) / NORMAL_95
        spread = run.alignment.latency_spread_s
        half = NORMAL_95 * math.sqrt(run.gyro_fit.delay_error_s**2 + spread**2 + sampling**2)
    low, high = value - half - run.repeats_s, value + half
    another = expect_another_run(parameter, value, low, high)
    return {parameter.name: Value(value, low, high, parameter.unit, another_run=another)}
