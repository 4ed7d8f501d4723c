"""Trends of parameters and other quantities of a vehicle over the dates of its runs, and alerts."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress

import polars as pl

from pipeline.core import (
    INPUT_WORDS,
    NORMAL_95,
    finite_or_none,
    format_count,
    group_by,
    guess_names,
    name_first,
    pick,
    suffix_unit,
)
from pipeline.datasets.compared_runs import ComparedRuns, find_material
from pipeline.datasets.forecast import leave_out_odd, list_numbers
from pipeline.datasets.pooling import UNKNOWN, ComparisonError, gather_runs
from pipeline.datasets.rank_tests import LEVEL
from pipeline.datasets.steps import FEWEST_FREE, Shift, find_changes, find_shifts, guess_shift
from pipeline.models import UNDETERMINED, Level, cut_interval, find_effect, list_effects
from pipeline.store import Store, lack_runs

_PLACES = ("earliest", "latest")
_PERIOD = "period"


@dataclass(frozen=True)
class LevelChange:
    """Change of level of a quantity.

    Attributes:
        since: day of the first run of the new level; `run` is that run.
        earliest, latest: bounds of the change's index among all dated runs.
        before, after: levels.
        runs_before, runs_after: number of runs of these levels.
        p: probability of a change as large anywhere without a real one.
        likely: likely cause, in words; empty if unknown.
    """

    since: str
    run: str
    earliest: int
    latest: int
    before: float
    after: float
    runs_before: int
    runs_after: int
    p: float
    likely: str = ""

    @property
    def size(self) -> float:
        """Relative change from the level before; infinite if that is zero."""
        return abs(self.after - self.before) / abs(self.before) if self.before else math.inf

    def describe(self, text: str) -> dict[str, object]:
        """JSON object of a change with its ``text``; indices are omitted, as they have no meaning outside."""
        return {name: value for name, value in vars(self).items() if name not in _PLACES} | {"text": text}


@dataclass(frozen=True)
class ParameterTrend:
    """Trend of a parameter of an effect on one vehicle.

    Attributes:
        vehicle, effect, parameter, unit: identify the parameter.
        points: ``order``, ``day``, ``run``, ``terrain``, ``value``, ``low``, ``high`` (95 % of the estimate),
            ``level`` (expected on that terrain at that time), ``limit_low``, ``limit_high`` (simultaneous
            95 % band of all runs, from the spread between runs; null without), in the order of time.
        changes: changes of level, in the order of time.
        least: smallest detectable change; infinite if none is detectable.
        need: what is missing for a test; empty if it was tested.
        odd: outlying runs, excluded.
        undetermined: runs that do not determine the parameter, excluded: at a bound of its search, or with
            an interval that reaches one.
        named: number of runs whose diagnosis reports the effect.
        relevant: smallest change that raises an alert.
        latest: estimate of the last run, even if it is an outlier or undetermined; `last` is that run.
    """

    vehicle: str
    effect: str
    parameter: str
    unit: str
    points: pl.DataFrame
    changes: tuple[LevelChange, ...]
    least: float
    need: str
    odd: tuple[str, ...]
    undetermined: tuple[str, ...]
    named: int
    relevant: float
    latest: float
    last: str

    @property
    def label(self) -> str:
        """``effect.parameter``."""
        return f"{self.effect}.{self.parameter}"

    @property
    def title(self) -> str:
        """The parameter and its vehicle, in a sentence."""
        return f"{self.label} of {self.vehicle}"

    @property
    def shown_latest(self) -> str:
        """The estimate of the last run as text, marked if that run does not determine it."""
        mark = f" ({UNDETERMINED})" if self.last in self.undetermined else ""
        return f"{self.latest:.3g}{suffix_unit(self.unit)}{mark}"


@dataclass(frozen=True)
class Series:
    """One quantity of one group over time.

    Attributes:
        group: name of the group.
        quantity: for example `median_modulus (command)`.
        unit: unit of the values.
        points: ``order``, ``day``, ``run``, ``value``, in the order of time.
        changes: changes of level, in the order of time.
    """

    group: str
    quantity: str
    unit: str
    points: pl.DataFrame
    changes: tuple[LevelChange, ...]

    @property
    def title(self) -> str:
        """The quantity and its group, in a sentence."""
        return f"{name_quantity(self.quantity)} of {self.group}"

    @property
    def latest(self) -> float:
        """The last run's value."""
        return float(self.points["value"][-1])


def find_latest(estimates: pl.DataFrame, dated: pl.DataFrame) -> pl.DataFrame:
    """Last estimate of every parameter that a run reports, even if it is an outlier or at a bound.

    Returns:
        ``vehicle``, ``effect``, ``parameter``, ``unit``, ``value``, ``run``; of two inputs the command's.
    """
    rows = estimates.join(dated, on="run").with_columns(pl.col("input").cast(pl.String))
    return (
        rows.sort("order", "input", descending=[False, True])
        .group_by("vehicle", "effect", "parameter", maintain_order=True)
        .agg(pl.col("unit", "value", "run").last(), pl.col("named").any())
        .filter("named")
        .drop("named")
    )


def follow_parameters(
    estimates: pl.DataFrame, dated: pl.DataFrame, *, level: float
) -> tuple[ParameterTrend, ...]:
    """Follow every parameter of the fleet model over the dates of its runs.

    A level for each terrain removes its contribution, so that runs on several terrains are comparable; runs
    on unknown terrain count as one terrain. All parameters of a vehicle share the probability of a false
    change. Excluded are runs that are outliers of both the runs before and after, and those that do not
    determine the parameter: their intervals are no measure of how runs scatter.

    Args:
        estimates: rows of the table `estimates`.
        dated: ``order``, ``run``, ``day`` of all runs with a date.
        level: probability of a false change on a vehicle.
    """
    followed = estimates.join(dated, on="run").sort("order")
    numbers = [
        (vehicle, effect, parameter, own.sort("order"))
        for vehicle, effect, parameter, rows in list_numbers(followed)
        if not (own := rows.filter(_find_determined(effect, parameter, rows))).is_empty()
    ]
    latest = {row[:3]: row[4:] for row in find_latest(estimates, dated).iter_rows()}
    counts = Counter(vehicle for vehicle, *_ in numbers)
    trends = []
    for vehicle, effect, parameter, own in numbers:
        asked = followed.filter(
            pl.col("vehicle") == vehicle, pl.col("effect") == effect, pl.col("parameter") == parameter
        )
        lost = dict.fromkeys(run for run in asked["run"].to_list() if run not in set(own["run"]))
        last = latest[vehicle, effect, parameter]
        trends.append(_follow(vehicle, effect, parameter, own, level / counts[vehicle], tuple(lost), last))
    return tuple(sorted(trends, key=lambda one: (one.vehicle, one.label)))


def _find_determined(effect: str, parameter: str, rows: pl.DataFrame) -> list[bool]:
    """Whether each run gives two limits of a parameter; see `Parameter.is_one_sided`."""
    number = find_effect(effect)().parameter(parameter)
    error = NORMAL_95 * rows["standard_error"]
    ends = zip(rows["value"] - error, rows["value"] + error, strict=True)
    return [not number.is_one_sided(*cut_interval(low, high, number.bounds)) for low, high in ends]


def _follow(
    vehicle: str,
    effect: str,
    parameter: str,
    rows: pl.DataFrame,
    level: float,
    undetermined: tuple[str, ...],
    last: tuple[float, str],
) -> ParameterTrend:
    used, odd = _leave_out_odd(rows)
    terrains = used["terrain"].to_list()
    search = find_shifts(used["value"], used["standard_error"], terrains, level=level)
    value, error = pl.col("value"), NORMAL_95 * pl.col("standard_error")
    number = find_effect(effect)().parameter(parameter)
    # An estimate that is not significant may itself lie outside its physical range.
    low = pl.min_horizontal(value, (value - error).clip(*number.bounds))
    high = pl.max_horizontal(value, (value + error).clip(*number.bounds))
    points = used.select(
        "order", "day", "run", "terrain", "value",
        low.alias("low"), high.alias("high"),
        pl.Series("level", search.level),
        pl.Series("limit_low", search.level - search.half).fill_nan(None).clip(*number.bounds),
        pl.Series("limit_high", search.level + search.half).fill_nan(None).clip(*number.bounds),
    )  # fmt: skip
    changes = _list_changes(
        used, search.shifts, lambda before, after: _find_likely(effect, terrains[before], terrains[after])
    )
    missing = FEWEST_FREE - search.freedom
    need = f"{format_count(missing, 'more run')} on a terrain driven before" if missing > 0 else ""
    return ParameterTrend(
        vehicle, effect, parameter, str(rows["unit"][0]), points, changes, search.least, need, odd,
        undetermined, int(rows["named"].sum()), 0.0 if number.least is None else number.least.size, *last,
    )  # fmt: skip


def _list_changes(
    points: pl.DataFrame,
    shifts: Sequence[Shift],
    find_likely: Callable[[slice, slice], str] = lambda _before, _after: "",
) -> tuple[LevelChange, ...]:
    """Changes of level with their days and runs; the likely cause is found from the rows before and after."""
    edges = [0, *(shift.index for shift in shifts), points.height]
    orders = points["order"].to_list()
    changes = []
    for i, shift in enumerate(shifts):
        before, after = slice(edges[i], edges[i + 1]), slice(edges[i + 1], edges[i + 2])
        changes.append(
            LevelChange(
                since=str(points["day"][shift.index]),
                run=str(points["run"][shift.index]),
                # The change itself lies after the previous run.
                earliest=orders[shift.earliest - 1] + 1,
                latest=orders[shift.latest],
                before=shift.before,
                after=shift.after,
                runs_before=before.stop - before.start,
                runs_after=after.stop - after.start,
                p=shift.p,
                likely=find_likely(before, after),
            )
        )
    return tuple(changes)


def _leave_out_odd(rows: pl.DataFrame) -> tuple[pl.DataFrame, tuple[str, ...]]:
    """As `leave_out_odd`, with separate terrains before and after the largest step, so no change is odd."""
    first = guess_shift(rows["value"], rows["standard_error"], rows["terrain"].to_list())
    period = (pl.int_range(pl.len()) >= first).cast(pl.String)
    parted = rows.with_columns(
        pl.col("terrain").alias(_PERIOD), pl.concat_str("terrain", period, separator="\n").alias("terrain")
    )
    used, odd = leave_out_odd(parted)
    return used.with_columns(pl.col(_PERIOD).alias("terrain")).drop(_PERIOD), odd


def _find_likely(effect: str, before: list[str], after: list[str]) -> str:
    """Likely causes: those at run level, and other terrain unless two terrains show the change."""
    causes = [reading.text for reading in find_effect(effect).readings if reading.level is Level.RUN]
    if len({*before} & {*after}) < 2 or UNKNOWN in after:  # noqa: PLR2004 - the ground may have changed
        causes.append("other terrain")
    return ", or ".join(causes)


def format_change(followed: ParameterTrend | Series, change: LevelChange) -> str:
    """Describe a change in a sentence: what, since when, significance and likely cause."""
    sure = f"p = {change.p:.2g}" if change.p > 1e-3 else "p < 0.001"  # noqa: PLR2004 - limit of the draws
    likely = f": likely {change.likely}" if change.likely else ""
    return (
        f"{shorten_change(followed, change)} since {change.since} ({change.runs_before} "
        f"run{'s' * (change.runs_before != 1)} before, {change.runs_after} since, {sure}){likely}"
    )


def shorten_change(followed: ParameterTrend | Series, change: LevelChange) -> str:
    """Format the levels before and after."""
    return f"{followed.title} {change.before:.3g} -> {change.after:.3g}{suffix_unit(followed.unit)}"


def format_power(trend: ParameterTrend) -> str:
    """Format the smallest detectable change, or what is missing for a test."""
    if trend.need:
        return f"not tested: {trend.need} needed"
    if not math.isfinite(trend.least):
        return "not tested: no terrain was driven on two dates"
    unit = suffix_unit(trend.unit)
    return f"a change by {trend.least:.2g}{unit} would be detected"


def summarize_parameter(trend: ParameterTrend) -> Mapping[str, object]:
    """JSON object of a parameter."""
    return {
        **pick(trend, "vehicle", "effect", "parameter", "unit"),
        "points": trend.points.drop("order").to_dicts(),
        "changes": [change.describe(format_change(trend, change)) for change in trend.changes],
        "least_change": finite_or_none(trend.least),
        "need": trend.need or None,
        "odd": list(trend.odd),
        "undetermined": list(trend.undetermined),
    }


FEWEST_RUNS = 9
"""Minimum number of runs for detecting a step of a series: with eight, even the rarest order has a
probability of 2 in 70, more than the half of `LEVEL` that all series share; with nine, of 2 in 126."""
_QUANTITIES = {
    "median_modulus": "median slip modulus",
    "median_window_norm": "median norm of slip over 2 s",
    "steady_median_modulus": "median steady slip modulus",
    "transitory_median_modulus": "median transitory slip modulus",
    "warnings": "number of warnings",
    "suspect share": "share of suspect samples",
}
_SLIP_FIRST = ("median_modulus (command)", "median_modulus (measured)")


@dataclass(frozen=True)
class Alert:
    """Change, since a date, or a last value that needs attention."""

    group: str
    quantity: str
    text: str
    since: str = ""


def name_quantity(quantity: str) -> str:
    """Name of the quantity of a series in words, as `median slip modulus from commands`."""
    name, _, source = quantity.partition(" (")
    words = _QUANTITIES.get(name, f"value of the {name}")
    return f"{words} {INPUT_WORDS[source.rstrip(')')]}" if source else words


def follow_quantities(values: pl.DataFrame) -> list[Series]:
    """Return every quantity of every group as a series, with its steps.

    `find_changes` detects steps if there are at least nine runs: with fewer, no order of the runs is rare
    enough. All series share the probability of a false step.

    Args:
        values: ``order`` (of all dated runs), ``group``, ``quantity``, ``unit``, ``day``, ``run``, ``value``
            in the order of time.
    """
    parts = values.partition_by("group", "quantity", as_dict=True, maintain_order=True)
    tests = sum(_can_step(rows) for rows in parts.values())
    series = []
    for (group, quantity), rows in parts.items():
        points = rows.select("order", "day", "run", "value")
        # Half of the false alarm probability is for the parameters of a vehicle, half for all other series.
        shifts = find_changes(points["value"].to_numpy(), level=LEVEL / 2 / tests) if _can_step(rows) else ()
        changes = _list_changes(points, shifts)
        series.append(Series(str(group), str(quantity), str(rows["unit"][0]), points, changes))
    return sorted(series, key=lambda one: (one.group, one.quantity))


def raise_alerts(
    series: Sequence[Series],
    parameters: Sequence[ParameterTrend],
    latest: pl.DataFrame,
    *,
    vehicles: Mapping[str, str],
    threshold: float,
    limits: Mapping[str, float],
) -> list[Alert]:
    """One alert for each cause: the last change of a parameter or another quantity, with its consequences.

    Changes of one vehicle that may be of the same day are merged into that of the most significant parameter;
    its text lists the others, including slip. Last values beyond their limit are separate alerts.

    Args:
        series: as from `follow_quantities`.
        parameters: as from `follow_parameters`; only changes of at least the relevant size count.
        latest: as from `find_latest`.
        vehicles: vehicle of each group that has only one.
        threshold: relative change of a series that matters, for example 0.1.
        limits: largest allowed value, by quantity (with or without the input in brackets).
    """
    moved = [(one, one.changes[-1]) for one in parameters if one.changes]
    moved = [(one, last) for one, last in moved if abs(last.after - last.before) >= one.relevant]
    stepped = [(one, one.changes[-1]) for one in series if one.changes]
    stepped = [(one, last) for one, last in stepped if last.size >= threshold]
    # Vehicle or group, quantity, and the change of what was followed; the first is the cause of the others.
    events: list[tuple[str, str, ParameterTrend | Series, LevelChange]] = [
        *(
            (one.vehicle, one.label, one, last)
            for one, last in sorted(moved, key=lambda pair: (pair[1].p, -pair[0].named))
        ),
        *(
            (vehicles.get(one.group, one.group), one.quantity, one, last)
            for one, last in sorted(stepped, key=lambda pair: pair[0].quantity not in _SLIP_FIRST)
        ),
    ]
    alerts = []
    while events:
        group, quantity, head, change = events.pop(0)
        may_be_one = [
            owner == group and one.earliest <= change.latest and change.earliest <= one.latest
            for owner, _, _, one in events
        ]
        same = list(compress(events, may_be_one))
        others = "; ".join(shorten_change(followed, one) for _, _, followed, one in same)
        text = format_change(head, change) + (f"; with it: {others}" if others else "")
        alerts.append(Alert(group, quantity, text, change.since))
        events = [event for event, joined in zip(events, may_be_one, strict=True) if not joined]
    lasts = [
        (one.group, one.quantity, name_quantity(one.quantity), one.unit, one.latest, one.points["run"][-1])
        for one in series
    ]
    lasts += [
        (vehicle, label := f"{effect}.{parameter}", label, unit, value, run)
        for vehicle, effect, parameter, unit, value, run in latest.iter_rows()
    ]
    unsure = {(one.vehicle, one.label, run) for one in parameters for run in one.undetermined}
    for group, quantity, name, unit, value, run in lasts:
        limit = limits.get(quantity, limits.get(quantity.split(" (")[0]))
        if limit is not None and value > limit:
            shown = f"{value:.3g}{suffix_unit(unit)}"
            mark = ", which does not determine it" if (group, quantity, run) in unsure else ""
            text = f"{name} of {group} is {shown} in {run}{mark}, above the limit of {limit:g}"
            alerts.append(Alert(group, quantity, text))
    return alerts


def format_quiet(series: Sequence[Series], parameters: Sequence[ParameterTrend]) -> str:
    """Text if there is no alert: no significant change, or no test possible."""
    most = max((one.points.height for one in series), default=0)
    if most >= FEWEST_RUNS or any(not one.need for one in parameters):
        return "no change exceeds the threshold"
    largest = f"(the largest has {most})"
    return (
        f"no test is possible: a change of slip needs {FEWEST_RUNS} runs of a group {largest}, "
        "a change of a parameter four runs on one terrain"
    )


def _can_step(rows: pl.DataFrame) -> bool:
    return rows.height >= FEWEST_RUNS and rows["value"].n_unique() > 1


@dataclass(frozen=True)
class Trend:
    """Series of groups, parameters of vehicles, alerts, notes, and the options of the analysis."""

    series: tuple[Series, ...]
    parameters: tuple[ParameterTrend, ...]
    alerts: tuple[Alert, ...]
    keys: tuple[str, ...]
    notes: tuple[str, ...]
    asked: Mapping[str, object]


TREND = "trend.json"


_SLIP = {
    "median_modulus": "m/s",
    "median_window_norm": "m/s",
    "steady_median_modulus": "m/s",
    "transitory_median_modulus": "m/s",
}


_HEALTH = ("warnings", "suspect share")


_FINDING = "finding "


def check_limits(limits: Mapping[str, float]) -> None:
    """Refuse limits on quantities that no run can have.

    Parameters of the catalogue and findings are accepted before a run has them, as a nightly check needs.

    Raises:
        ComparisonError: ``no_such_quantity``.
    """
    slip = [name + suffix for name in _SLIP for suffix in ("", *(f" ({source})" for source in INPUT_WORDS))]
    parameters = [f"{effect.id}.{one.name}" for effect in list_effects() for one in effect.parameters]
    known = [*slip, *_HEALTH, *parameters]
    for name in limits:
        if name not in known and not name.startswith(_FINDING):
            hint = (
                f"{guess_names(name, known)}There are {', '.join([*_SLIP, *_HEALTH])}, findings "
                "(as 'finding heading_skew') and parameters of effects (as effective_track.k)."
            )
            raise ComparisonError("no_such_quantity", f"{name!r} in --limit is not a quantity", hint=hint)


def follow_trend(store: Store, by: Sequence[str], *, threshold: float, limits: Mapping[str, float]) -> Trend:
    """Analyze trends over dates: of every quantity by group, and of every parameter by vehicle.

    Slip comes from the tables `aggregates`, parameters from the diagnoses' tables `estimates`, data health
    from findings (their values, and the number of warnings per run) and from the fraction of suspect samples.

    Args:
        store: the results.
        by: columns that define a group, for example `vehicle`; parameters are grouped by vehicle.
        threshold: relative step of slip or health that raises an alert.
        limits: largest allowed value of the last run, by quantity.

    Raises:
        ComparisonError: ``nothing_to_follow``: no run has a date.
        ComparisonError: ``no_such_column``.
    """
    compared = find_material(store, by, trusted_only=False, optional=("findings", "estimates"))
    dated = compared.labels.filter(pl.col("day").is_not_null()).sort("day", "start", "run")
    followed = set(dated["run"])
    undated = sorted(set(compared.manifests) - followed)
    notes = [*compared.notes, *(note for note in compared.date_notes if note not in compared.notes)]
    if undated:
        notes.append(f"left out, because no date is known: {', '.join(undated)}")
    refused = sorted(compared.refusals.items())
    notes += [f"slip of {run} left out, {why}" for run, why in refused if run in followed]
    if dated.is_empty():
        hint = "Analyze logs whose clock was set, or put the date into their names (2026-05-03)."
        raise lack_runs("nothing_to_follow", "there is no run with a date", store.root, hint, notes)
    dated = dated.with_row_index("order").with_columns(pl.col("order").cast(pl.Int64))
    values = (
        dated.select("run", "group", "day", "order")
        .join(pl.concat([_read_slip(compared), _read_health(compared)]), on="run")
        .filter(pl.col("value").is_finite())
        .sort("order")
    )
    series = follow_quantities(values)
    estimates = compared.read_estimates().filter(pl.col("run").is_in(dated["run"].to_list()))
    days = dated.select("order", "run", "day")
    parameters = follow_parameters(estimates, days, level=LEVEL / 2)
    latest = find_latest(estimates, days)
    notes += _note_what_lacks(series, parameters)
    alerts = raise_alerts(
        series, parameters, latest, vehicles=_find_vehicles(dated), threshold=threshold, limits=limits
    )
    numbers = latest.select(pl.format("{}.{}", "effect", "parameter")).to_series()
    names = [*(one.quantity for one in series), *numbers]
    known = {*names, *(name.split(" (")[0] for name in names)}
    missing = [name for name in limits if name not in known]
    notes[:0] = [f"the limit on {name} is not checked: no run has this quantity" for name in missing]
    keys = tuple(f"{run}/{compared.manifests[run].key}" for run in dated["run"])
    asked = {"by": list(by), "threshold": threshold, "limits": dict(limits)}
    return Trend(tuple(series), parameters, tuple(alerts), keys, tuple(notes), asked)


def _find_vehicles(dated: pl.DataFrame) -> dict[str, str]:
    """The vehicle of each group that has only one."""
    groups = dated.group_by("group").agg(pl.col("vehicle").unique())
    return {group: vehicles[0] for group, vehicles in groups.iter_rows() if len(vehicles) == 1}


def _note_what_lacks(series: Sequence[Series], parameters: Sequence[ParameterTrend]) -> list[str]:
    """Notes on groups and vehicles with too few runs to detect a change, and on outlying runs."""
    longest: dict[str, int] = {}
    for one in series:
        longest[one.group] = max(longest.get(one.group, 0), one.points.height)
    short = sorted(group for group, runs in longest.items() if runs < FEWEST_RUNS)
    notes = []
    if short:
        notes.append(f"too few runs to detect a change of slip, {FEWEST_RUNS} are needed: {', '.join(short)}")
    lost = group_by(((one.vehicle, one.undetermined), one.label) for one in parameters if one.undetermined)
    needs = group_by((f"{one.vehicle}, {format_power(one)}", one.label) for one in parameters if one.need)
    notes += [
        f"{one.label} of {one.vehicle} stands apart in {', '.join(one.odd)}" for one in parameters if one.odd
    ]
    notes += [
        f"{name_first(labels)} of {vehicle}, left out where a run does not determine it: {', '.join(runs)}"
        for (vehicle, runs), labels in lost.items()
    ]
    return [*notes, *(f"{name_first(labels)} of {need}" for need, labels in needs.items())]


def summarize_trend(trend: Trend) -> dict[str, object]:
    """The JSON object of `slip fleet trend`."""
    return {
        "alerts": [vars(alert) for alert in trend.alerts],
        "series": [
            {
                **pick(one, "group", "quantity", "unit"),
                "points": one.points.drop("order").to_dicts(),
                "changes": [change.describe(format_change(one, change)) for change in one.changes],
            }
            for one in trend.series
        ],
        "parameters": [summarize_parameter(one) for one in trend.parameters],
        "notes": list(trend.notes),
    }


def _read_slip(compared: ComparedRuns) -> pl.DataFrame:
    sound = compared.labels.filter(~pl.col("run").is_in(list(compared.refusals)))
    runs = gather_runs(compared.scan("aggregates").collect(), sound)
    long = runs.unpivot(list(_SLIP), index=["run", "input"], variable_name="quantity", value_name="value")
    return long.drop_nulls("value").select(
        "run",
        pl.format("{} ({})", "quantity", pl.col("input").cast(pl.String)).alias("quantity"),
        pl.col("quantity").replace_strict(_SLIP, return_dtype=pl.String).alias("unit"),
        "value",
    )


def _read_health(compared: ComparedRuns) -> pl.DataFrame:
    """Values of findings, number of warnings, and fraction of suspect samples of every run."""
    findings = compared.scan("findings").select("run", "id", "severity", "value").collect()
    counts = (
        findings.drop_nulls("value")
        .group_by("run", "id")
        .agg(pl.col("value").mean())
        .select(
            "run",
            pl.concat_str(pl.lit(_FINDING), "id").alias("quantity"),
            pl.lit("").alias("unit"),
            "value",
        )
    )
    warnings = findings.filter(pl.col("severity") != "info").group_by("run").len()
    counted = (
        pl.DataFrame({"run": list(compared.manifests)}, schema={"run": pl.String})
        .join(warnings, on="run", how="left")
        .select(
            "run",
            pl.lit(_HEALTH[0]).alias("quantity"),
            pl.lit("1").alias("unit"),
            pl.col("len").fill_null(0).cast(pl.Float64).alias("value"),
        )
    )
    suspect = (
        compared.scan("slip")
        .group_by("run")
        .agg(pl.col("suspect").mean().alias("value"))
        .select("run", pl.lit(_HEALTH[1]).alias("quantity"), pl.lit("1").alias("unit"), "value")
        .collect()
    )
    return pl.concat([counts, counted, suspect])
