"""What of a vehicle changed over its runs: slip, fitted parameters, and the health of its data."""

import contextlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import polars as pl

from pipeline.analysis.compared_runs import ComparedRuns, find_material
from pipeline.analysis.errors import JobError, lack_runs
from pipeline.core.numbers import pick
from pipeline.fleet.errors import ComparisonError
from pipeline.fleet.parameter_trend import (
    ParameterTrend,
    describe_parameter,
    find_latest,
    follow_parameters,
    say_power,
)
from pipeline.fleet.runs import gather_runs
from pipeline.fleet.trend import (
    FEWEST_RUNS,
    LEVEL,
    Series,
    Trend,
    describe_step,
    follow_quantities,
    raise_alerts,
)
from pipeline.store import Store

TREND = "trend.json"
_SLIP = {
    "median_modulus": "m/s",
    "median_window_norm": "m/s",
    "steady_median_modulus": "m/s",
    "transitory_median_modulus": "m/s",
}


def follow_trend(store: Store, by: Sequence[str], *, threshold: float, limits: Mapping[str, float]) -> Trend:
    """Follow every quantity of every group of the results, and every parameter of every vehicle, over dates.

    Slip comes from the tables `aggregates`, parameters from the diagnoses' tables `estimates`, the health of
    the data from findings (their values, and how many warnings a run has) and from the share of suspect
    samples.

    Args:
        store: the results.
        by: columns that make a group, for example `vehicle`; parameters are followed by vehicle.
        threshold: relative change of level of slip or health that raises an alert.
        limits: highest value allowed of the last run, by quantity.

    Raises:
        JobError: ``nothing_to_follow``: there is no run with a date.
        ComparisonError: ``no_such_column``.
    """
    compared = find_material(store, by, trusted_only=False, optional=("findings", "estimates"))
    dated = compared.labels.filter(pl.col("day").is_not_null()).sort("day", "start", "run")
    undated = sorted(set(compared.manifests) - set(dated["run"]))
    notes = list(compared.notes)
    if undated:
        notes.append(f"left out, because no date is known: {', '.join(undated)}")
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
    estimates = compared.scan("estimates").filter(pl.col("run").is_in(dated["run"].to_list())).collect()
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
    notes += [f"no run has the quantity {name!r} that a limit is for" for name in limits if name not in known]
    keys = tuple(f"{run}/{compared.manifests[run].key}" for run in dated["run"])
    asked = {"by": list(by), "threshold": threshold, "limits": dict(limits)}
    return Trend(tuple(series), parameters, tuple(alerts), keys, tuple(notes), asked)


def _find_vehicles(dated: pl.DataFrame) -> dict[str, str]:
    """The vehicle of each group that has one only."""
    groups = dated.group_by("group").agg(pl.col("vehicle").unique())
    return {group: vehicles[0] for group, vehicles in groups.iter_rows() if len(vehicles) == 1}


def _note_what_lacks(series: Sequence[Series], parameters: Sequence[ParameterTrend]) -> list[str]:
    """Groups and vehicles with too few runs to find a change, and runs that stand apart."""
    longest: dict[str, int] = {}
    for one in series:
        longest[one.group] = max(longest.get(one.group, 0), one.points.height)
    short = sorted(group for group, runs in longest.items() if runs < FEWEST_RUNS)
    notes = []
    if short:
        notes.append(f"too few runs to find a change of slip, {FEWEST_RUNS} are needed: {', '.join(short)}")
    needs: dict[str, list[str]] = {}
    for number in parameters:
        if number.need:
            needs.setdefault(f"{number.vehicle}, {say_power(number)}", []).append(number.label)
        if number.odd:
            notes.append(f"{number.label} of {number.vehicle} stands apart in {', '.join(number.odd)}")
    return [*notes, *(f"{', '.join(labels)} of {need}" for need, labels in needs.items())]


def write_trend(store: Store, trend: Trend) -> Path:
    """Write `trend.html` and `trend.json`; the path of the first."""
    content = {**describe_trend(trend), "asked": trend.asked}
    store.write_results_text(TREND, json.dumps(content, indent=1, allow_nan=False) + "\n")
    from pipeline.report.pages import write_page  # noqa: PLC0415 - heavy
    from pipeline.report.trend import render_trend  # noqa: PLC0415 - heavy

    return write_page(store, "trend.html", render_trend(trend))


def update_trend(store: Store) -> None:
    """Follow the trend anew, as it was asked for before, where it was; nothing else is done.

    Results without any run with a date keep the trend they have, and so do those whose question cannot be
    read.
    """
    path = store.root / TREND
    if not path.is_file():
        return
    try:
        asked = json.loads(path.read_text(encoding="utf-8"))["asked"]
        limits = {str(name): float(value) for name, value in asked["limits"].items()}
        by = [str(name) for name in asked["by"]]
        threshold = float(asked["threshold"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return
    if not all(math.isfinite(value) for value in (threshold, *limits.values())):
        return
    # No run with a date, or no such column to group by.
    with contextlib.suppress(JobError, ComparisonError):
        write_trend(store, follow_trend(store, by, threshold=threshold, limits=limits))


def describe_trend(trend: Trend) -> dict[str, object]:
    """The JSON object of `slip trend`."""
    return {
        "alerts": [vars(alert) for alert in trend.alerts],
        "series": [
            {
                **pick(one, "group", "quantity", "unit"),
                "points": one.points.drop("order").to_dicts(),
                "changes": [step.describe(describe_step(one, step)) for step in one.steps],
            }
            for one in trend.series
        ],
        "parameters": [describe_parameter(one) for one in trend.parameters],
        "notes": list(trend.notes),
    }


def _read_slip(compared: ComparedRuns) -> pl.DataFrame:
    runs = gather_runs(compared.scan("aggregates").collect(), compared.labels)
    long = runs.unpivot(list(_SLIP), index=["run", "input"], variable_name="quantity", value_name="value")
    return long.drop_nulls("value").select(
        "run",
        pl.format("{} ({})", "quantity", pl.col("input").cast(pl.String)).alias("quantity"),
        pl.col("quantity").replace_strict(_SLIP, return_dtype=pl.String).alias("unit"),
        "value",
    )


def _read_health(compared: ComparedRuns) -> pl.DataFrame:
    """Findings by their value, the number of warnings, and the share of suspect samples."""
    findings = compared.scan("findings").select("run", "id", "severity", "value").collect()
    told = (
        findings.drop_nulls("value")
        .group_by("run", "id")
        .agg(pl.col("value").mean())
        .select(
            "run",
            pl.concat_str(pl.lit("finding "), "id").alias("quantity"),
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
            pl.lit("warnings").alias("quantity"),
            pl.lit("1").alias("unit"),
            pl.col("len").fill_null(0).cast(pl.Float64).alias("value"),
        )
    )
    suspect = (
        compared.scan("slip")
        .group_by("run")
        .agg(pl.col("suspect").mean().alias("value"))
        .select("run", pl.lit("suspect share").alias("quantity"), pl.lit("1").alias("unit"), "value")
        .collect()
    )
    return pl.concat([told, counted, suspect])
