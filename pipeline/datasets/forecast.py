"""Parameters of a fleet by level, and the forecast of a vehicle's parameters on a terrain."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import polars as pl

from pipeline.core import FEWEST_OF_SPREAD, NORMAL_95, Floats, format_count, format_interval
from pipeline.datasets.levels import (
    LevelFit,
    draw_run,
    find_outliers,
    split_levels,
)
from pipeline.datasets.pooling import UNKNOWN, ComparisonError
from pipeline.models import (
    USUAL_SPREAD,
    Effect,
    Late,
    Level,
    Parameter,
    Place,
    find_effect,
    is_of_one_run,
    stands_at_bound,
)

# Parameters of a fleet by level: vehicle, terrain or run.
#
# A parameter of an effect in a run is the sum of the vehicle's value, the terrain's contribution on that
# vehicle, the run's own contribution, and the error of the estimate (`pipeline.datasets.levels`). Several
# runs identify the level where one run cannot: wheels that are too small are so on every terrain, slipping
# wheels are not.

SURE = 0.01
"""Significance level for differences: of fleets with ten parameters per vehicle, nine in ten show no false
difference."""


@dataclass(frozen=True)
class FleetNumber:
    """A parameter of an effect on one vehicle, over all its runs.

    Attributes:
        vehicle: name of the vehicle.
        effect, parameter, unit: identify the parameter.
        level: level of the parameter; None if these runs do not determine it.
        name: name at that level; all possible names if the level is open.
        because: reason for the level, or what is needed to determine it.
        fit: common value, terrains, spreads.
        named: number of runs whose diagnosis reports the effect.
        runs: runs that determine the parameter.
        odd: outlying runs, excluded from the fit.
        is_dated: whether it is a pose clock offset determined by the gyros of these runs, not a delay.
    """

    vehicle: str
    effect: str
    parameter: str
    unit: str
    level: Level | None
    name: str
    because: str
    fit: LevelFit
    named: int
    runs: tuple[str, ...]
    odd: tuple[str, ...]
    is_dated: bool = False

    @property
    def label(self) -> str:
        """``effect.parameter``."""
        return f"{self.effect}.{self.parameter}"

    @property
    def candidates(self) -> tuple[str, ...]:
        """Possible names; one if every level has the same."""
        return list_names(self.effect, is_dated=self.is_dated)


@dataclass(frozen=True)
class FleetModel:
    """All parameters of a fleet.

    Attributes:
        numbers: parameters by vehicle and effect.
        runs: names of the runs used, by vehicle.
        notes: what was excluded, and why.
    """

    numbers: tuple[FleetNumber, ...]
    runs: Mapping[str, tuple[str, ...]]
    notes: tuple[str, ...] = ()


def list_names(effect: str, *, is_dated: bool = False) -> tuple[str, ...]:
    """Possible names of an effect before its level is known; one name if all levels share it.

    Args:
        effect: id of the effect.
        is_dated: whether it is a clock offset determined by gyros, which has no other name.
    """
    readings = () if is_dated else find_effect(effect).readings
    return tuple(dict.fromkeys(reading.name for reading in readings)) or (effect,)


def fit_fleet(estimates: pl.DataFrame) -> FleetModel:
    """Fit the parameters of every vehicle.

    A parameter is included if at least one run reports its effect, and of the runs whose model contains it:
    what a model does without is not determined beside it. Of a run with both inputs the parameters from the
    command are used. Runs on unknown terrain, parameters at a search bound and estimates outside physics are
    excluded, with a note.

    Args:
        estimates: rows of the table `estimates` of all runs.
    """
    notes = []
    known = estimates.filter(pl.col("terrain") != UNKNOWN)
    lost = sorted(set(estimates["run"]) - set(known["run"]))
    if lost:
        notes.append(f"left out, terrain unknown: {', '.join(lost)}")
    bound = known.filter(pl.col("at_bound")).select("effect").to_series().unique().sort().to_list()
    if bound:
        notes.append(f"numbers at a bound of the search are left out: of {', '.join(bound)} in some runs")
    notes += _note_unphysical(known)
    numbers = []
    for vehicle, effect, parameter, rows in list_numbers(known.filter(_find_physical(known))):
        # A corrected clock is named, and no part of the model.
        own = rows.filter(pl.col("in_model") | pl.col("named"))
        numbers.append(_fit_number(vehicle, effect, parameter, own, rows.height - own.height))
    numbers.sort(key=lambda one: (one.vehicle, -one.named, one.effect, one.parameter))
    runs = {
        str(vehicle): tuple(rows["run"].unique().sort().to_list())
        for (vehicle,), rows in known.partition_by("vehicle", as_dict=True, maintain_order=True).items()
    }
    return FleetModel(tuple(numbers), dict(sorted(runs.items())), tuple(notes))


def list_numbers(estimates: pl.DataFrame) -> list[tuple[str, str, str, pl.DataFrame]]:
    """Vehicle, effect, parameter and rows of every parameter whose effect at least one run reports.

    Effects that start at one moment of a recording are excluded: they do not apply to other recordings.
    """
    parts = take_numbers(estimates).partition_by(
        "vehicle", "effect", "parameter", as_dict=True, maintain_order=True
    )
    return [
        (str(vehicle), str(effect), str(parameter), rows)
        for (vehicle, effect, parameter), rows in parts.items()
        if rows["named"].any() and not is_of_one_run(find_effect(str(effect)).parameters)
    ]


def _find_physical(estimates: pl.DataFrame) -> pl.Series:
    """Whether each row of `estimates` can be one of physics."""
    rows = estimates.select("effect", "parameter", "value", "standard_error").iter_rows()
    return pl.Series(
        [
            find_effect(effect)().parameter(name).is_physical(value, error)
            for effect, name, value, error in rows
        ],
        dtype=pl.Boolean,
    )


def _note_unphysical(estimates: pl.DataFrame) -> list[str]:
    """Notes on numbers of models that are left out because they are outside physics, by parameter."""
    own = estimates.filter(pl.col("in_model") | pl.col("named"), ~pl.col("at_bound"))
    out = own.filter(~_find_physical(own)).with_columns(
        pl.format("{}.{}", "effect", "parameter").alias("label")
    )
    return [
        f"{label} left out, outside the physical range: "
        + ", ".join(
            f"{value:.3g} in {run}" for run, value in rows.unique("run", maintain_order=True).iter_rows()
        )
        for (label,), rows in out.sort("label", "run")
        .partition_by("label", as_dict=True, maintain_order=True, include_key=False)
        .items()
        for rows in [rows.select("run", "value")]
    ]


def take_numbers(estimates: pl.DataFrame, source: str = "command") -> pl.DataFrame:
    """Valid rows of `estimates`: not at a bound, with an error, one of two inputs."""
    return (
        estimates.filter(~pl.col("at_bound"), pl.col("standard_error") > 0.0)
        .with_columns(pl.col("input").cast(pl.String))
        .sort("run", "effect", "parameter", pl.col("input") != source)
        .unique(["run", "effect", "parameter"], keep="first", maintain_order=True)
    )


def _fit_number(vehicle: str, effect: str, parameter: str, rows: pl.DataFrame, without: int) -> FleetNumber:
    """Fit one parameter to its rows; ``without`` is the number of runs whose model lacks its effect."""
    used, odd = leave_out_odd(rows)
    fit = split_levels(used["value"], used["standard_error"], used["terrain"].to_list())
    declared = find_effect(effect)().parameter(parameter)
    level, because = _take_declared(declared) or decide_level(fit, declared.neutral)
    if odd:
        because += f"; {', '.join(odd)} stand{'s' * (len(odd) == 1)} apart from it"
    if without:
        because += f"; not in the models of {format_count(without, 'other run')}"
    # A clock offset determined by a gyro was corrected before the fit: no written model contains it.
    is_dated = find_effect(effect).late is Late.POSES and not used["in_model"].any()
    readings = {} if is_dated else {reading.level: reading.name for reading in find_effect(effect).readings}
    names = list_names(effect, is_dated=is_dated)
    name = " or ".join(names) if level is None else readings.get(level, effect)
    return FleetNumber(
        vehicle=vehicle,
        effect=effect,
        parameter=parameter,
        unit=str(rows["unit"][0]),
        level=level,
        name=name,
        because=because,
        fit=fit,
        named=int(rows["named"].sum()),
        runs=tuple(used["run"].to_list()),
        odd=odd,
        is_dated=is_dated,
    )


def leave_out_odd(rows: pl.DataFrame) -> tuple[pl.DataFrame, tuple[str, ...]]:
    """Rows of one parameter without outlying runs, and the names of these runs."""
    values, errors = (rows[name].to_numpy() for name in ("value", "standard_error"))
    odd = [str(rows["run"][index]) for index in find_outliers(values, errors, rows["terrain"].to_list())]
    return rows.filter(~pl.col("run").is_in(odd)), tuple(odd)


def _take_declared(parameter: Parameter) -> tuple[Level, str] | None:
    """Level declared in the catalogue, as for a controller's gain; None if runs must determine it."""
    if parameter.level is None:
        return None
    whose = {Level.VEHICLE: "the vehicle's", Level.TERRAIN: "the ground's", Level.RUN: "the run's"}
    return parameter.level, f"by its nature {whose[parameter.level]}"


def decide_level(fit: LevelFit, neutral: float) -> tuple[Level | None, str]:
    """Decide the level of a parameter, with the reason.

    It is the terrain's if terrains differ significantly by more than runs do, and open if they may differ.
    Otherwise it is the vehicle's if the common value differs significantly from neutral, and the run's if it
    does not but runs scatter by more than their errors explain.

    Args:
        fit: fit of the runs of one vehicle.
        neutral: value without effect; not finite for a limit, which always has an effect.
    """
    if (reason := _find_open(fit)) is not None:
        return None, reason
    if fit.p_groups < SURE:
        ends = sorted(fit.groups.items(), key=lambda one: one[1].value)
        means = ", ".join(
            f"{name} {mean.value:.3g} ({format_count(mean.runs, 'run')})" for name, mean in ends
        )
        return Level.TERRAIN, f"terrains differ by more than runs do (p = {fit.p_groups:.1g}): {means}"
    alike = f"{len(fit.groups)} terrains not shown to differ by more than runs do (p = {fit.p_groups:.2g})"
    inside = fit.interval
    if inside is not None and not (math.isfinite(neutral) and inside.low <= neutral <= inside.high):
        return Level.VEHICLE, f"{alike}: {format_interval(fit.value, inside.low, inside.high)}"
    if fit.p_runs < SURE:
        spread = f"scatter by {fit.spread_run:.2g} about {fit.value:.3g}"
        return Level.RUN, f"{alike}, and runs {spread} (p = {fit.p_runs:.1g})"
    return None, f"{alike}, and the mean is not significantly different from neutral: more runs are needed"


def _find_open(fit: LevelFit) -> str | None:
    """Why terrain and run cannot be separated, and which runs would separate them; None if they can."""
    if len(fit.groups) == 1:
        terrain = next(iter(fit.groups))
        return f"only runs on {terrain} determine it: runs on another terrain separate vehicle and terrain"
    if not fit.freedom:
        return "no terrain has two runs: a second run on one of them separates terrain and run"
    if fit.p_groups >= SURE and fit.spread_group > fit.scatter:
        return (
            f"terrains may differ (by {fit.spread_group:.2g}, runs by {fit.scatter:.2g}, "
            f"p = {fit.p_groups:.2g}): more runs on each are needed"
        )
    return None


DRAWS = 400
"""Draws per parameter: bounds of 95 % intervals then have a standard error of 3 % of their width."""
RUNS_SHARE = USUAL_SPREAD / 0.67449
"""Prior scale of the spread between runs of one terrain, as a share of that between terrains (the usual size
of the parameter). The half-normal prior then has the usual spread between runs as its median, and intervals
of a terrain with two to four runs contain 93 to 97 % of drawn runs (`make bench NAME=fleets`,
`ARGS="--drawn 200"`)."""
_ENDS = (0.025, 0.975)
"""Quantiles of draws that bound a 95 % interval."""
_EVERYWHERE = "*"
_MOST = 0.5
"""Share of the runs whose model must contain an effect for a forecast to include it: half of them."""


@dataclass(frozen=True)
class ForecastNumber:
    """Prediction of a parameter for another run on the terrain.

    Attributes:
        effect, parameter, unit: identify the parameter.
        draws: draws of the parameter, within the search bounds, shape (n,).
        runs: number of runs that determine it.
        joint: expected value of the joint fit to all runs; NaN without one.
    """

    effect: str
    parameter: str
    unit: str
    draws: Floats
    runs: int
    joint: float = math.nan

    @property
    def label(self) -> str:
        """``effect.parameter``."""
        return f"{self.effect}.{self.parameter}"

    @property
    def value(self) -> float:
        """Expected value of the joint fit, otherwise the median of the draws."""
        return self.joint if math.isfinite(self.joint) else float(np.median(self.draws))

    @property
    def ends(self) -> tuple[float, float]:
        """95 % interval: quantiles of the draws."""
        low, high = np.quantile(self.draws, _ENDS).tolist()
        return low, high

    @property
    def bounds(self) -> tuple[float, float]:
        """Bounds of the parameter's search."""
        return find_effect(self.effect)().parameter(self.parameter).bounds

    @property
    def at_bound(self) -> bool:
        """Whether a search bound cuts the interval, so that its coverage is below 95 %."""
        return any(stands_at_bound(end, self.bounds) for end in self.ends)

    @property
    def has_default_spread(self) -> bool:
        """Whether the usual spread between runs is used, because too few runs determine the parameter."""
        return self.runs < FEWEST_OF_SPREAD

    @property
    def has_interval(self) -> bool:
        """Whether a model file states its interval: three runs determine it, and no bound cuts it."""
        return not (self.has_default_spread or self.at_bound)

    @property
    def deviation(self) -> float:
        """Standard deviation of the normal distribution with that interval."""
        low, high = self.ends
        return (high - low) / (2.0 * NORMAL_95)


@dataclass(frozen=True)
class Forecast:
    """Expected model of a vehicle on a terrain.

    Attributes:
        vehicle, terrain: names.
        input: input of the model.
        numbers: parameters of its effects.
        here: runs of the vehicle on this terrain.
        elsewhere: its runs on other terrains.
    """

    vehicle: str
    terrain: str
    input: Literal["command", "measured"]
    numbers: tuple[ForecastNumber, ...]
    here: tuple[str, ...]
    elsewhere: tuple[str, ...]

    @property
    def runs(self) -> tuple[str, ...]:
        """All runs of the vehicle, those on this terrain first."""
        return (*self.here, *self.elsewhere)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects at their expected values, in the order of the signal path from the command."""
        return self._make([number.value for number in self.numbers])

    @property
    def prior(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation of every parameter by label, for a fit."""
        return {number.label: (number.value, number.deviation) for number in self.numbers}

    def draw(self, which: int) -> tuple[Effect, ...]:
        """The effects at one draw of all parameters."""
        return self._make([float(number.draws[which]) for number in self.numbers])

    def _make(self, values: Sequence[float]) -> tuple[Effect, ...]:
        own: dict[str, dict[str, float]] = {}
        for number, value in zip(self.numbers, values, strict=True):
            own.setdefault(number.effect, {})[number.parameter] = value
        return make_effects(own)


def make_effects(values: dict[str, dict[str, float]]) -> tuple[Effect, ...]:
    """Effects of the catalogue with these values, in the order of the signal path from the command."""
    effects = [find_effect(name)().change(**own) for name, own in values.items()]
    return tuple(sorted(effects, key=lambda effect: (effect.place, effect.rank, effect.id)))


def forecast_vehicle(
    estimates: pl.DataFrame,
    vehicle: str,
    terrain: str,
    source: Literal["command", "measured"] = "command",
    *,
    also: Sequence[str] = (),
    seed: int = 0,
) -> Forecast:
    """Forecast the parameters of a vehicle on a terrain.

    A drivetrain effect is included if the written models of half of all runs of the vehicle contain it. A
    ground effect is included if half of those on the terrain do, or half of all for a new terrain. Each
    parameter is drawn as for another run (`draw_run`), without outlying runs. Draws of different parameters
    vary together as the estimates of the runs do (`_correlate`): the covariance of a run's fit is not stored.

    Args:
        estimates: rows of the table `estimates` of the fleet's runs.
        vehicle: name of the vehicle.
        terrain: name of the terrain; may have no runs.
        source: input of the model.
        also: ids of additional effects.
        seed: seed of the draws.

    Raises:
        ComparisonError: ``no_such_vehicle``: no run of the vehicle on a known terrain has estimates.
    """
    known = estimates.filter(pl.col("terrain") != UNKNOWN)
    rows = take_numbers(known.filter(_find_physical(known)), source).filter(pl.col("vehicle") == vehicle)
    if rows.is_empty():
        what = f"no run of {vehicle} on a known terrain has estimates"
        hint = f"There are runs of: {', '.join(sorted(set(known['vehicle']))) or 'no vehicle'}."
        raise ComparisonError("no_such_vehicle", what, hint=hint)
    here = rows.filter(pl.col("terrain") == terrain)
    numbers: list[ForecastNumber] = []
    estimated: list[pl.DataFrame] = []
    for effect in (*_choose_effects(rows, terrain, source), *(find_effect(name)() for name in also)):
        for parameter in effect.parameters:
            own = rows.filter(pl.col("effect") == effect.id, pl.col("parameter") == parameter.name)
            if own.is_empty():
                continue
            ground = terrain
            if parameter.level is Level.VEHICLE:
                # Runs on other terrains carry as much information on it as those on this one.
                own, ground = own.with_columns(pl.lit(_EVERYWHERE).alias("terrain")), _EVERYWHERE
            own, _ = leave_out_odd(own)
            drawn = draw_run(
                own["value"],
                own["standard_error"],
                own["terrain"].to_list(),
                ground,
                usual=(parameter.usual_size, RUNS_SHARE * parameter.usual_size),
                count=DRAWS,
                rng=np.random.default_rng([seed, *f"{effect.id}.{parameter.name}".encode()]),
            )
            draws = np.clip(drawn, *parameter.bounds)
            numbers.append(ForecastNumber(effect.id, parameter.name, parameter.unit, draws, own.height))
            estimated.append(own)
    numbers = _correlate(numbers, estimated, np.random.default_rng([seed, len(numbers)]))
    names = set(rows["run"])
    there = set(here["run"])
    return Forecast(
        vehicle, terrain, source, tuple(numbers), tuple(sorted(there)), tuple(sorted(names - there))
    )


def _correlate(
    numbers: Sequence[ForecastNumber], estimated: Sequence[pl.DataFrame], rng: np.random.Generator
) -> list[ForecastNumber]:
    """The same draws of every number, put into an order in which they vary together as runs do.

    The correlation is that of the runs about the means of their terrains, with an inverse Wishart prior
    about independence: two runs say little of it, twenty most. Source: Iman and Conover, Communications in
    Statistics 11 (1982).

    Args:
        numbers: drawn on their own.
        estimated: rows of `estimates` that each was drawn from.
        rng: random generator.
    """
    if not numbers:
        return []
    count = len(numbers)
    runs = sorted(set().union(*(rows["run"] for rows in estimated)))
    away = np.zeros((len(runs), count))
    for index, rows in enumerate(estimated):
        own = (rows["value"] - rows.select(pl.col("value").mean().over("terrain"))["value"]).to_numpy()
        freedom = own.size - rows["terrain"].n_unique()
        if freedom and own.any():
            away[[runs.index(run) for run in rows["run"]], index] = own / math.sqrt(own @ own / freedom)
    covariance = (count + 1) * np.eye(count) + away.T @ away
    ranks = rng.multivariate_normal(np.zeros(count), covariance, DRAWS).argsort(axis=0).argsort(axis=0)
    return [
        replace(number, draws=np.sort(number.draws)[ranks[:, index]]) for index, number in enumerate(numbers)
    ]


def expect_values(start: Forecast, values: Mapping[str, float]) -> Forecast:
    """The forecast with the values of a fit to all runs as what is expected.

    Every second draw is moved by what that fit and the single runs differ by: what they disagree about is
    not known, and widens the interval.

    Args:
        start: forecast from single runs.
        values: values of that fit on this terrain, by label; other parameters are expected at their median.
    """
    numbers = []
    for number in start.numbers:
        if number.label not in values:
            numbers.append(number)
            continue
        joint = float(np.clip(values[number.label], *number.bounds))
        draws = number.draws.copy()
        draws[::2] = np.clip(draws[::2] + joint - number.value, *number.bounds)
        numbers.append(replace(number, joint=joint, draws=draws))
    return replace(start, numbers=tuple(numbers))


def list_held(estimates: pl.DataFrame, vehicle: str, source: str) -> list[Effect]:
    """Effects in written models of a vehicle's runs, at the median of their parameters, most frequent first.

    Effects that start at one moment of a recording are excluded.
    """
    rows = take_numbers(estimates, source).filter("in_model", pl.col("vehicle") == vehicle)
    values: dict[str, dict[str, float]] = {}
    medians = rows.group_by("effect", "parameter").agg(pl.col("value").median(), pl.col("run").n_unique())
    for effect, parameter, value, _ in medians.sort("run", "effect", descending=[True, False]).iter_rows():
        if not is_of_one_run(find_effect(effect).parameters):
            values.setdefault(effect, {})[parameter] = value
    return [find_effect(name)().change(**own) for name, own in values.items()]


def _choose_effects(rows: pl.DataFrame, terrain: str, source: str) -> list[Effect]:
    """Effects of written models that can act on the input.

    Drivetrain effects need half of all runs of the vehicle; ground effects half of the runs on this terrain,
    or of all runs on a new terrain. Companions of a chosen effect need one run: gentle drives do not show the
    limits of a controller. Effects that start at one moment of a recording are excluded, and clock offsets,
    which differ in every run.
    """
    here = rows.filter(pl.col("terrain") == terrain)
    chosen: list[Effect] = []
    for effect in (find_effect(name)() for name in rows.filter("in_model")["effect"].unique().sort()):
        is_drive = effect.place <= Place.DRIVE
        if (is_drive and source != "command") or is_of_one_run(effect.parameters):
            continue
        asked = rows if is_drive or here.is_empty() else here
        holding = asked.filter("in_model", pl.col("effect") == effect.id)["run"].n_unique()
        if effect.late is not Late.POSES and holding >= _MOST * asked["run"].n_unique():
            chosen.append(effect)
    held = set(rows.filter("in_model")["effect"]) - {effect.id for effect in chosen}
    beside = held.intersection(name for effect in chosen for name in effect.companions)
    chosen += [find_effect(name)() for name in sorted(beside)]
    return [effect for effect in chosen if not any(effect.id in other.contains for other in chosen)]
