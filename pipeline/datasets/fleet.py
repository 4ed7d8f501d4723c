"""Numbers of a fleet by level (vehicle, terrain, run), and the bands in which another run is expected."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import polars as pl

from pipeline.core import (
    FEWEST_OF_SPREAD,
    NORMAL_95,
    enumerate_texts,
    finite_or_none,
    format_count,
    format_interval,
    student_quantile,
)
from pipeline.datasets.compared_runs import find_material, read_digest
from pipeline.datasets.levels import Levels, Pooled, fit_levels
from pipeline.datasets.pooling import UNKNOWN, ComparisonError
from pipeline.models import Effect, Late, Level, Parameter, Place, cut_interval, find_effect, is_of_one_run
from pipeline.run import MotionRun
from pipeline.store import Store, lack_runs
from schemas import tabulate

SURE = 0.01
"""Significance level of a level: of fleets with ten parameters per vehicle, nine in ten show no false
difference."""
_MOST = 0.5
"""Share of the runs whose model must contain an effect for another run to be expected to have it: half of
them."""
_WHOSE = {Level.VEHICLE: "the vehicle's", Level.TERRAIN: "the ground's", Level.RUN: "the run's"}


@dataclass(frozen=True)
class Band:
    """A number with its 95 % interval, and the one of another run; unknown ends are None."""

    value: float
    low: float | None
    high: float | None
    another_low: float | None
    another_high: float | None
    runs: int


@dataclass(frozen=True)
class FleetNumber:
    """A parameter of an effect on one vehicle, over all its runs.

    Attributes:
        effect, parameter, unit, vehicle: identify the parameter.
        level: `vehicle`, `terrain` or `run`; None if these runs do not determine it.
        name: name at that level; all possible names if the level is open.
        candidates: possible names; one if every level has the same.
        because: reason for the level, or what is needed to determine it.
        whole: of the vehicle; another run is one on another terrain.
        spread_terrain, spread_run: standard deviations between terrains and between runs of a terrain.
        terrains: by name.
        named: number of runs whose diagnosis reports the effect.
        disagreeing: values of the runs, ascending, where they differ by more than their errors and the usual
            spread between runs explain; else empty.
    """

    effect: str
    parameter: str
    unit: str
    vehicle: str
    level: str | None
    name: str
    candidates: tuple[str, ...]
    because: str
    whole: Band
    spread_terrain: float | None
    spread_run: float | None
    terrains: dict[str, Band]
    named: int
    disagreeing: tuple[float, ...] = ()

    @property
    def label(self) -> str:
        """``effect.parameter``."""
        return f"{self.effect}.{self.parameter}"

    def to_json(self) -> dict[str, object]:
        """The row of `slip fleet show --json`."""
        own = {key: value for key, value in vars(self).items() if key not in {"whole", "candidates"}}
        return {
            **own,
            **vars(self.whole),
            "terrains": {name: vars(one) for name, one in self.terrains.items()},
        }


@dataclass(frozen=True)
class Fleet:
    """All numbers of a fleet.

    Attributes:
        numbers: by vehicle, those of most runs first.
        runs: names of the runs used, by vehicle.
        notes: what was left out, and why.
        keys: run/generation of every run.
    """

    numbers: tuple[FleetNumber, ...]
    runs: dict[str, tuple[str, ...]]
    notes: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()

    @property
    def summary(self) -> str:
        """How many numbers are of which level, and what would decide the open ones."""
        counts = Counter(number.level for number in self.numbers if not number.disagreeing)
        disagree = sum(bool(number.disagreeing) for number in self.numbers)
        runs = sum(map(len, self.runs.values()))
        fitted = f"{format_count(runs, 'run')} of {format_count(len(self.runs), 'vehicle')}"
        if not self.numbers:
            return f"No significant effect in {fitted}."
        parts = [
            f"{counts[level]} of the {level}" for level in ("vehicle", "terrain", "run") if counts[level]
        ]
        parts += [f"{disagree} on which runs disagree"] if disagree else []
        parts += [f"{counts[None]} open"] if counts[None] else []
        text = f"{format_count(len(self.numbers), 'parameter')} in {fitted}: {enumerate_texts(parts)}."
        advice = " To decide, diagnose more runs, several on each of two or more terrains."
        return text + advice * bool(counts[None] or disagree)

    def to_json(self) -> dict[str, object]:
        """The JSON object of `slip fleet show`."""
        return {
            "parameters": [number.to_json() for number in self.numbers],
            "resolved": [
                {
                    "vehicle": number.vehicle,
                    "parameter": number.label,
                    "candidates": list(number.candidates),
                    "answer": None if number.level is None else number.name,
                    "because": number.because,
                }
                for number in self.numbers
                if len(number.candidates) > 1
            ],
            "runs": {vehicle: list(runs) for vehicle, runs in self.runs.items()},
            "notes": list(self.notes),
            "summary": self.summary,
        }

    def tabulate(self) -> pl.DataFrame:
        """The table `fleet`: a row a number, then one for each of its terrains."""
        names = ("effect", "parameter", "unit", "vehicle", "name", "because", "spread_terrain", "spread_run")
        rows: list[dict[str, object]] = []
        for number in self.numbers:
            own = {name: getattr(number, name) for name in names} | {"level": number.level or "open"}
            for terrain, band in (("*", number.whole), *number.terrains.items()):
                rows.append({**own, **vars(band), "terrain": terrain, "named": number.named})
        frame = tabulate("fleet", rows)
        labels = pl.DataFrame(rows, schema={"vehicle": pl.String, "terrain": pl.String})
        every = [pl.lit("*").alias("run"), pl.lit("*").alias("dataset")]
        return frame.with_columns(*labels, *every, pl.lit(" ".join(self.keys)).alias("keys"))


def fit_results(store: Store) -> Fleet:
    """The numbers of a fleet from all diagnosed runs of the results.

    Raises:
        ComparisonError: ``nothing_to_fit``: no run has estimates.
    """
    compared = find_material(store, ("vehicle",), trusted_only=True, tables=("estimates",))
    if not compared.manifests:
        refused = len(compared.refusals) == len(compared.notes) > 0
        mend = "List what its log holds: slip inspect LOG; mend it, or drive again"
        hint = mend if refused else "Name the effects of its logs: slip batch LOGS --diagnosis"
        raise lack_runs("nothing_to_fit", "no run has estimates", store.root, hint, compared.notes)
    fleet = fit_fleet(compared.read_estimates())
    notes = (*compared.count_omitted(len(compared.keys)), *compared.notes, *fleet.notes)
    return Fleet(fleet.numbers, fleet.runs, notes, compared.keys)


def fit_fleet(estimates: pl.DataFrame) -> Fleet:
    """The numbers of every vehicle.

    A parameter is included if at least one run reports its effect, and of the runs whose model contains it.
    Of a run with both inputs the parameters from the command are used. Runs on unknown terrain, parameters
    at a search bound and estimates outside physics are left out, with a note.

    Args:
        estimates: rows of the table `estimates` of all runs.
    """
    known = estimates.filter(pl.col("terrain") != UNKNOWN)
    own = known.filter(pl.col("in_model") | pl.col("named"))
    label = pl.format("{}.{}", "effect", "parameter")
    omitted = {
        "terrain unknown": estimates.filter(pl.col("terrain") == UNKNOWN)["run"],
        "at a bound of the search": own.filter("at_bound").select(label).to_series(),
        "outside the physical range": own.filter(~pl.col("at_bound"), ~_find_physical(own))
        .select(label)
        .to_series(),
    }
    notes = [
        f"left out, {why}: {', '.join(which.unique().sort())}"
        for why, which in omitted.items()
        if which.len()
    ]
    numbers = [
        _fit_number(vehicle, effect, parameter, rows.filter(pl.col("in_model") | pl.col("named")))
        for vehicle, effect, parameter, rows in list_numbers(known)
    ]
    numbers.sort(key=lambda one: (one.vehicle, -one.named, one.label))
    runs = {
        str(vehicle): tuple(rows["run"].unique().sort())
        for (vehicle,), rows in known.sort("vehicle").partition_by("vehicle", as_dict=True).items()
    }
    return Fleet(tuple(numbers), runs, tuple(notes))


def list_numbers(estimates: pl.DataFrame) -> list[tuple[str, str, str, pl.DataFrame]]:
    """Vehicle, effect, parameter and rows of every parameter whose effect at least one run reports.

    Effects that start at one moment of a recording are left out: other recordings do not have them.
    """
    keys = ["vehicle", "effect", "parameter"]
    parts = _take_numbers(estimates).sort(*keys, "run").partition_by(keys, as_dict=True, maintain_order=True)
    return [
        (str(vehicle), str(effect), str(parameter), rows)
        for (vehicle, effect, parameter), rows in parts.items()
        if rows["named"].any() and not is_of_one_run(find_effect(str(effect)).parameters)
    ]


def _find_physical(estimates: pl.DataFrame) -> pl.Series:
    """Whether each row of `estimates` can be one of physics."""
    rows = estimates.select("effect", "parameter", "value", "standard_error").iter_rows()
    physical = [find_effect(effect)().parameter(name).is_physical(*number) for effect, name, *number in rows]
    return pl.Series(physical, dtype=pl.Boolean)


def _take_numbers(estimates: pl.DataFrame, source: str = "command") -> pl.DataFrame:
    """Valid rows of `estimates`: not at a bound, with an error, physical, one of two inputs."""
    sound = estimates.filter(~pl.col("at_bound"), pl.col("standard_error") > 0.0)
    return (
        sound.filter(_find_physical(sound))
        .with_columns(pl.col("input").cast(pl.String))
        .sort("run", "effect", "parameter", pl.col("input") != source)
        .unique(["run", "effect", "parameter"], keep="first", maintain_order=True)
    )


def _fit(rows: pl.DataFrame) -> Levels:
    errors = rows["standard_error"].to_numpy() ** 2
    return fit_levels(rows["value"].to_numpy(), rows["terrain"].to_list(), errors)


def _fit_number(vehicle: str, effect: str, parameter: str, rows: pl.DataFrame) -> FleetNumber:
    kind = find_effect(effect)
    number = kind().parameter(parameter)
    fit = _fit(rows)
    pooled = fit.pool()
    level, because = decide_level(fit, pooled, number)
    # Of what is the ground's or the run's own, values may differ.
    apart = [] if level in {Level.TERRAIN, Level.RUN} else _find_apart(rows, number)
    if apart:
        because = f"; {because}" if level is None else ""
        because = f"runs disagree by more than {number.spread.size:.2g}: {', '.join(apart)}{because}"
        level = None
    # A pose clock that gyros determine was corrected before the fit: it has no other name.
    dated = kind.late is Late.POSES and not rows["in_model"].any()
    readings = {} if dated else {reading.level: reading.name for reading in kind.readings}
    names = tuple(dict.fromkeys(readings.values())) or (effect,)
    spread = finite_or_none(pooled.spread)
    # Two grounds hardly show how much grounds differ.
    grounds = len(fit.names)
    further = math.hypot(pooled.spread, fit.spread, math.sqrt(pooled.variance))
    half = student_quantile(0.95, grounds - 1) * further if grounds >= FEWEST_OF_SPREAD else math.nan
    return FleetNumber(
        effect=effect,
        parameter=parameter,
        unit=str(rows["unit"][0]),
        vehicle=vehicle,
        level=None if level is None else level.value,
        name=" or ".join(names) if level is None else readings.get(level, effect),
        candidates=names,
        because=because,
        whole=Band(
            pooled.value,
            *_cut(number, (pooled.low, pooled.high)),
            *_cut(number, (pooled.value - half, pooled.value + half)),
            rows.height,
        ),
        spread_terrain=spread,
        spread_run=finite_or_none(fit.spread),
        terrains={
            name: Band(
                float(fit.means[i]),
                *_cut(number, fit.bound(i) if fit.counts[i] >= FEWEST_OF_SPREAD else (math.nan, math.nan)),
                *_cut(number, fit.bound(i, another_run=True)),
                int(fit.counts[i]),
            )
            for i, name in enumerate(fit.names)
        },
        named=int(rows["named"].sum()),
        disagreeing=tuple(rows["value"].sort()) if apart else (),
    )


def _find_apart(rows: pl.DataFrame, number: Parameter) -> list[str]:
    """Runs with their values, ascending, if they differ by more than errors and the usual spread explain."""
    errors = rows["standard_error"].to_numpy() ** 2 + number.spread.size**2
    fit = fit_levels(rows["value"].to_numpy(), ["*"] * rows.height, errors, fewest=1)
    if not fit.p_spread < SURE:
        return []
    return [f"{run} {value:.3g}" for run, value in rows.select("run", "value").sort("value").iter_rows()]


def _cut(number: Parameter, ends: tuple[float, float]) -> tuple[float | None, float | None]:
    """Ends of an interval within the bounds of a parameter; None for unknown ones."""
    if not all(map(math.isfinite, ends)):
        return None, None
    return cut_interval(*ends, number.bounds)


def decide_level(fit: Levels, pooled: Pooled, number: Parameter) -> tuple[Level | None, str]:
    """The level of a parameter, with the reason.

    It is the terrain's if terrains differ significantly by more than runs do, and open if they may differ.
    Otherwise it is the vehicle's if the common value differs significantly from neutral, and the run's if it
    does not but runs scatter by more than their errors explain.

    Args:
        fit: levels of the terrains on one vehicle.
        pooled: of the vehicle.
        number: the parameter, which may declare its level, as a controller's gain does.
    """
    if number.level is not None and fit.counts.sum() > 1.0:
        return number.level, f"by its nature {_WHOSE[number.level]}"
    if open_because := _find_open(fit, pooled):
        return None, open_because
    if pooled.p < SURE:
        means = ", ".join(
            f"{fit.names[i]} {fit.means[i]:.3g} ({format_count(int(fit.counts[i]), 'run')})"
            for i in np.argsort(fit.means)
        )
        return Level.TERRAIN, f"terrains differ by more than runs do (p = {pooled.p:.1g}): {means}"
    alike = f"{len(fit.names)} terrains not shown to differ by more than runs do (p = {pooled.p:.2g})"
    if not (math.isfinite(number.neutral) and pooled.low <= number.neutral <= pooled.high):
        return Level.VEHICLE, f"{alike}: {format_interval(pooled.value, pooled.low, pooled.high)}"
    if fit.p_spread < SURE:
        spread = f"scatter by {fit.spread:.2g} about {pooled.value:.3g}"
        return Level.RUN, f"{alike}, and runs {spread} (p = {fit.p_spread:.1g})"
    return None, f"{alike}, and the mean is not significantly different from neutral: more runs are needed"


def _find_open(fit: Levels, pooled: Pooled) -> str:
    """Why terrain and run cannot be separated, and which runs would separate them; empty if they can."""
    if fit.counts.sum() == 1.0:
        return "only one run determines it: others are needed to find its level"
    if len(fit.names) == 1:
        only = f"only runs on {fit.names[0]} determine it"
        return f"{only}: runs on another terrain separate vehicle and terrain"
    if not fit.is_known:
        return "too few runs repeat a terrain: more on each separate terrain and run"
    scatter = math.hypot(fit.spread, math.sqrt(float(np.median(np.diag(fit.covariance) * fit.counts))))
    if pooled.p < SURE or pooled.spread <= scatter:
        return ""
    differ = f"by {pooled.spread:.2g}, runs by {scatter:.2g}, p = {pooled.p:.2g}"
    return f"terrains may differ ({differ}): more runs on each are needed"


@dataclass(frozen=True)
class Expected:
    """What to expect of a vehicle on a terrain, by the table of its numbers.

    Attributes:
        effects: at their expected values, in the order of the signal path from the command.
        prior: mean and standard deviation of another run, of every parameter by label.
    """

    effects: tuple[Effect, ...]
    prior: dict[str, tuple[float, float]]


def expect_here(
    runs: Sequence[MotionRun], vehicle: str, source: Literal["command", "measured"], store: Store
) -> Expected:
    """Expect the parameters of a vehicle on the ground of runs, which themselves do not count.

    Effects are those in the models of half of its runs on this terrain, or of all where it has none there. A
    value is the level of the terrain, else that of the vehicle. Spreads that the runs do not tell are the
    usual ones.

    Args:
        runs: runs of the vehicle on one terrain, which need not have others.
        vehicle: id of the vehicle.
        source: input of the model.
        store: the results.

    Raises:
        ComparisonError: ``no_such_vehicle``: no other run of the vehicle on a known terrain has estimates;
            ``several_terrains``.
    """
    terrains = sorted({run.terrain for run in runs})
    if len(terrains) > 1:
        raise ComparisonError(
            "several_terrains",
            f"the runs are on {', '.join(terrains)}, and a prior applies to one terrain",
            where=", ".join(run.name for run in runs),
            hint="Fit the runs of each terrain separately.",
        )
    held = {run.sha256 for run in runs}
    compared = find_material(store, ("vehicle",), trusted_only=True, tables=("estimates",), vehicle=vehicle)
    others = [run for run, manifest in compared.manifests.items() if read_digest(manifest) not in held]
    estimates = compared.read_estimates() if others else tabulate("estimates", [])
    known = estimates.filter(pl.col("run").is_in(others)) if others else estimates
    return expect_numbers(known, vehicle, terrains[0], source)


def expect_numbers(
    estimates: pl.DataFrame, vehicle: str, terrain: str, source: Literal["command", "measured"] = "command"
) -> Expected:
    """As `expect_here`, from rows of the table `estimates`."""
    rows = (
        _take_numbers(estimates, source).filter(pl.col("vehicle") == vehicle, pl.col("terrain") != UNKNOWN)
        if estimates.height
        else estimates
    )
    if rows.is_empty():
        others = ", ".join(sorted(set(estimates["vehicle"]))) if estimates.height else ""
        what = f"no other run of {vehicle} on a known terrain has estimates"
        raise ComparisonError("no_such_vehicle", what, hint=f"There are runs of: {others or 'no vehicle'}.")
    there = rows.filter(pl.col("terrain") == terrain)
    effects: list[Effect] = []
    prior: dict[str, tuple[float, float]] = {}
    for effect in _choose_effects(rows if there.is_empty() else there, source):
        values = {}
        for number in effect.parameters:
            own = rows.filter(pl.col("effect") == effect.id, pl.col("parameter") == number.name)
            if own.is_empty():
                continue
            mean, deviation = _expect(own, terrain, number)
            values[number.name] = float(np.clip(mean, *number.bounds))
            prior[f"{effect.id}.{number.name}"] = (values[number.name], deviation)
        effects.append(effect.change(**values))
    return Expected(tuple(effects), prior)


def _expect(rows: pl.DataFrame, terrain: str, number: Parameter) -> tuple[float, float]:
    """Mean and standard deviation of a parameter in another run on a terrain."""
    if number.level is Level.VEHICLE:
        rows = rows.with_columns(pl.lit(terrain).alias("terrain"))
    fit = _fit(rows)
    run = fit.spread if fit.is_known else number.spread.size
    widened = student_quantile(0.95, fit.freedom) / NORMAL_95 if fit.is_known else 1.0
    if terrain in fit.names:
        index = fit.names.index(terrain)
        return float(fit.means[index]), widened * math.hypot(
            run, math.sqrt(float(fit.covariance[index, index]))
        )
    pooled = fit.pool()
    grounds = len(fit.names)
    between = pooled.spread if fit.is_known and grounds >= FEWEST_OF_SPREAD else number.usual_size
    return pooled.value, widened * math.hypot(run, between, math.sqrt(pooled.variance))


def _choose_effects(rows: pl.DataFrame, source: str) -> list[Effect]:
    """Effects in the models of half of these runs that can act on the input, in the order of the signal path.

    Clock offsets, which differ in every run, and effects that start at one moment of a recording are left
    out.
    """
    least = _MOST * rows["run"].n_unique()
    held = (
        rows.filter("in_model")
        .group_by("effect")
        .agg(pl.col("run").n_unique())
        .filter(pl.col("run") >= least)
    )
    chosen = [find_effect(name)() for name in held["effect"].sort()]
    able = [
        effect
        for effect in chosen
        if (source == "command" or effect.place > Place.DRIVE)
        and not is_of_one_run(effect.parameters)
        and effect.late is not Late.POSES
    ]
    able = [effect for effect in able if not any(effect.id in other.contains for other in able)]
    return sorted(able, key=lambda effect: (effect.place, effect.rank, effect.id))


def name_levels(numbers: Sequence[FleetNumber]) -> dict[str, str]:
    """Names of effects by their level, where they differ from the id and vehicles agree."""
    names: dict[str, set[str]] = {}
    for number in numbers:
        names.setdefault(number.effect, set()).add(number.name)
    return {effect: min(own) for effect, own in names.items() if len(own) == 1 and own != {effect}}
