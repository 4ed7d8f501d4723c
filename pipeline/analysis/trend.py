"""What of a vehicle changed over its runs: slip, fitted parameters, and the health of its data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import polars as pl

from pipeline.analysis.compared_runs import ComparedRuns, find_material
from pipeline.analysis.errors import JobError
from pipeline.fleet import gather_runs
from pipeline.fleet.trend import (
    FEWEST_RUNS,
    Alert,
    Series,
    describe_step,
    follow_quantities,
    raise_alerts,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from pipeline.store import Store

_SLIP = {
    "median_modulus": "m/s",
    "median_window_norm": "m/s",
    "steady_median_modulus": "m/s",
    "transitory_median_modulus": "m/s",
}


@dataclass(frozen=True)
class Trend:
    """Series of every group, what to look at, and what must be known."""

    series: tuple[Series, ...]
    alerts: tuple[Alert, ...]
    keys: tuple[str, ...]
    notes: tuple[str, ...]


def follow_trend(store: Store, by: Sequence[str], *, threshold: float, limits: Mapping[str, float]) -> Trend:
    """Follow every quantity of every group of the results over the dates of its runs.

    Slip comes from the tables `aggregates`, parameters from the diagnoses' tables `parameters`, the health of
    the data from findings (their values, and how many warnings a run has) and from the share of suspect
    samples.

    Args:
        store: the results.
        by: columns that make a group, for example `vehicle`.
        threshold: relative change of level that raises an alert.
        limits: highest value allowed of the last run, by quantity.

    Raises:
        JobError: ``nothing_to_follow``: there is no run with a date.
        ComparisonError: ``no_such_column``.
    """
    compared = find_material(store, by, trusted_only=False)
    dated = compared.labels.filter(pl.col("day").is_not_null()).sort("day", "start", "run")
    undated = sorted(set(compared.manifests) - set(dated["run"]))
    notes = list(compared.notes)
    if undated:
        notes.append(f"left out, because no date is known: {', '.join(undated)}")
    if dated.is_empty():
        raise JobError(
            "nothing_to_follow",
            "there is no run with a date" + "".join(f"; {note}" for note in notes),
            where=str(store.root),
            hint="Analyze logs whose clock was set, or put the date into their names (2026-05-03).",
        )
    parameters = _read_parameters(compared)
    parts = [_read_slip(compared), _read_health(compared), parameters]
    values = (
        dated.select("run", "group", "day")
        .with_row_index("order")
        .join(pl.concat(parts), on="run")
        .filter(pl.col("value").is_finite())
        .sort("order")
    )
    series = follow_quantities(values)
    longest = {one.group: 0 for one in series}
    for one in series:
        longest[one.group] = max(longest[one.group], one.points.height)
    short = sorted(group for group, runs in longest.items() if runs < FEWEST_RUNS)
    if short:
        notes.append(f"too few runs to find a change, {FEWEST_RUNS} are needed: {', '.join(short)}")
    notes += _note_gaps(series, parameters, longest)
    alerts = raise_alerts(series, threshold=threshold, limits=limits)
    known = {quantity for one in series for quantity in (one.quantity, one.quantity.split(" (")[0])}
    notes += [f"no run has the quantity {name!r} that a limit is for" for name in limits if name not in known]
    keys = tuple(f"{run}/{compared.manifests[run].key}" for run in dated["run"])
    return Trend(tuple(series), tuple(alerts), keys, tuple(notes))


def _note_gaps(series: Sequence[Series], parameters: pl.DataFrame, runs: Mapping[str, int]) -> list[str]:
    """Parameters that the diagnoses of only some runs of a group name."""
    named = set(parameters["quantity"])
    gaps = [
        f"{one.quantity} in {one.points.height} of {runs[one.group]} runs of {one.group}"
        for one in series
        if one.quantity in named and one.points.height < runs[one.group]
    ]
    return [f"named in some runs only: {'; '.join(gaps)}"] if gaps else []


def write_trend(store: Store, trend: Trend) -> Path:
    """Write `trend.html`; its path."""
    from pipeline.report.pages import write_page  # noqa: PLC0415 - heavy
    from pipeline.report.trend import render_trend  # noqa: PLC0415 - heavy

    page = render_trend(trend.series, trend.alerts, notes=trend.notes, keys=trend.keys)
    return write_page(store, "trend.html", page)


def describe_trend(trend: Trend) -> dict[str, object]:
    """The JSON object of `slip trend`."""
    return {
        "alerts": [vars(alert) for alert in trend.alerts],
        "series": [
            {
                "group": one.group,
                "quantity": one.quantity,
                "unit": one.unit,
                "points": one.points.to_dicts(),
                "changes": [{**vars(step), "text": describe_step(one, step)} for step in one.steps],
            }
            for one in trend.series
        ],
        "notes": list(trend.notes),
    }


def _read_slip(compared: ComparedRuns) -> pl.DataFrame:
    names = list(compared.manifests)
    runs = gather_runs(
        compared.scan("aggregates").filter(pl.col("run").is_in(names)).collect(), compared.labels
    )
    long = runs.unpivot(list(_SLIP), index=["run", "input"], variable_name="quantity", value_name="value")
    return long.drop_nulls("value").select(
        "run",
        pl.format("{} ({})", "quantity", pl.col("input").cast(pl.String)).alias("quantity"),
        pl.col("quantity").replace_strict(_SLIP, return_dtype=pl.String).alias("unit"),
        "value",
    )


def _read_health(compared: ComparedRuns) -> pl.DataFrame:
    """Findings by their value, the number of warnings, and the share of suspect samples."""
    names = list(compared.manifests)
    findings = (
        compared.scan("findings")
        .filter(pl.col("run").is_in(names))
        .select("run", "id", "severity", "value")
        .collect()
    )
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
        pl.DataFrame({"run": names}, schema={"run": pl.String})
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
        .filter(pl.col("run").is_in(names))
        .group_by("run")
        .agg(pl.col("suspect").mean().alias("value"))
        .select("run", pl.lit("suspect share").alias("quantity"), pl.lit("1").alias("unit"), "value")
        .collect()
    )
    return pl.concat([told, counted, suspect])


def _read_parameters(compared: ComparedRuns) -> pl.DataFrame:
    return (
        compared.scan("parameters")
        .filter(pl.col("run").is_in(list(compared.manifests)))
        .select(
            "run",
            pl.format("{}.{} ({})", "effect", "parameter", pl.col("input").cast(pl.String)).alias("quantity"),
            "unit",
            "value",
        )
        .collect()
    )
