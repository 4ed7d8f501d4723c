"""Deployments compared by cause, on the map of the literature, and as trends over the dates of runs."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import polars as pl

from pipeline.core import INPUT_WORDS, finite_or_none, guess_names, pick, pick_finite
from pipeline.datasets import MEASURES, ComparisonError, gather_runs, pool_runs
from pipeline.datasets.causes import Budget, Causes, Difference, compare_causes
from pipeline.datasets.compare import (
    Question,
    choose_input,
    find_level_names,
    find_untested,
    measure_runs,
    note_untested,
    read_budgets,
)
from pipeline.datasets.compared_runs import ComparedRuns, choose_runs, find_material, keep_runs, read_digest
from pipeline.datasets.deployments import (
    DeploymentMap,
    find_own_table,
    rank_datasets,
    rank_deployments,
    read_deployments,
)
from pipeline.datasets.rank_tests import LEVEL
from pipeline.datasets.trend import (
    FEWEST_RUNS,
    ParameterTrend,
    Series,
    Trend,
    find_latest,
    follow_parameters,
    follow_quantities,
    format_power,
    format_step,
    raise_alerts,
    summarize_parameter,
)
from pipeline.models.catalogue import list_effects
from pipeline.store import Store
from pipeline.store.stored_runs import lack_runs

_EFFECT = "effect"


def find_causes(store: Store, question: Question) -> Causes:
    """Compare the datasets of the results by cause; nothing is written.

    Args:
        store: the results.
        question: what to compare; its input, if None, is the command if every run has a budget on it, else
            the measured wheels.

    Raises:
        ComparisonError: ``nothing_to_compare``.
        ComparisonError: ``no_such_column``, ``no_such_vehicle``, ``no_such_dataset``.
    """
    compared = find_material(store, question.by, trusted_only=True, tables=("budget", "estimates"))
    compared = choose_runs(compared, question.vehicle, question.datasets)
    rows = read_budgets(compared)
    if rows.is_empty():
        hint = "Analyze logs with their diagnosis: slip analyze LOG... --terrain NAME."
        what = "no run has a budget of its slip"
        raise lack_runs("nothing_to_compare", what, store.root, hint, compared.notes)
    on_command = rows.filter(pl.col("input") == "command")["run"].n_unique()
    source = question.input or ("command" if on_command == rows["run"].n_unique() else "measured")
    own = rows.filter(pl.col("input") == source)
    compared = keep_runs(compared, own["run"].unique().to_list(), f"no budget of its slip on {source}")
    if own.is_empty():
        what = f"no run has a budget of its slip on {source}"
        raise lack_runs("nothing_to_compare", what, store.root, "Choose the other input.")
    untested = find_untested(compared, question)
    budgets, differences = compare_causes(own, untested=untested)
    keys = tuple(f"{run}/{manifest.key}" for run, manifest in sorted(compared.manifests.items()))
    notes = (*compared.notes, *note_untested(untested))
    return Causes(budgets, differences, source, find_level_names(store), keys, notes)


def summarize_causes(causes: Causes) -> dict[str, object]:
    """The JSON object of `slip compare --causes`."""
    return {
        "input": causes.input,
        "budgets": [_summarize_budget(budget, causes.names) for budget in causes.budgets],
        "differences": [
            {
                **pick(one, "a", "b", "total"),
                "unit": "m/s",
                "by_effect": [
                    {
                        _EFFECT: part.name,
                        "name": causes.names.get(part.name, part.name),
                        "difference": part.difference,
                        **pick_finite(part, "low", "high", "p", "p_adjusted"),
                    }
                    for part in one.parts
                ],
                "unit_of_analysis": one.unit,
                "note": one.note or None,
                "sentence": format_difference(one, causes.names),
            }
            for one in causes.differences
        ],
        "notes": list(causes.notes),
    }


def _summarize_budget(budget: Budget, names: Mapping[str, str]) -> dict[str, object]:
    numbers = {part.name: {"share": part.share, **pick_finite(part, "low", "high")} for part in budget.parts}
    return {
        **pick(budget, "dataset", "runs", "total"),
        "unit": "m^2/s^2",
        "rms": math.sqrt(budget.total),
        "shares": [
            {_EFFECT: part.name, "name": names.get(part.name, part.name), **numbers[part.name]}
            for part in budget.parts
            if part.kind == _EFFECT
        ],
        **{part.name: numbers[part.name] for part in budget.parts if part.kind != _EFFECT},
        "unit_of_analysis": budget.unit,
    }


def format_difference(one: Difference, names: Mapping[str, str]) -> str:
    """Text of a difference, with effects named by their levels."""
    return one.describe({part.name: names.get(part.name, part.name) for part in one.parts})


def tabulate_budgets(causes: Causes) -> pl.DataFrame:
    """Shares of every cause in the slip of every dataset."""
    rows = [
        (one.dataset, one.runs, causes.names.get(part.name, part.name), part.share, finite_or_none(part.low),
         finite_or_none(part.high), math.sqrt(one.total))
        for one in causes.budgets
        for part in one.parts
    ]  # fmt: skip
    numbers = dict.fromkeys(("share", "low", "high", "rms"), pl.Float64)
    schema = {"dataset": pl.String, "runs": pl.Int64, "cause": pl.String, **numbers}
    return pl.DataFrame(rows, schema=schema, orient="row")


def tabulate_differences(causes: Causes) -> pl.DataFrame:
    """Differences of every pair of datasets by cause."""
    rows = [
        (one.a, one.b, causes.names.get(part.name, part.name), part.difference, finite_or_none(part.low),
         finite_or_none(part.high), finite_or_none(part.p), finite_or_none(part.p_adjusted), one.unit)
        for one in causes.differences
        for part in one.parts
    ]  # fmt: skip
    numbers = dict.fromkeys(("difference", "low", "high", "p", "p_adjusted"), pl.Float64)
    texts = dict.fromkeys(("a", "b", "cause"), pl.String)
    return pl.DataFrame(rows, schema={**texts, **numbers, "unit_of_analysis": pl.String}, orient="row")


_SHARED = " (shared)"


def draw_up_map(
    store: Store,
    table: Path | None = None,
    *,
    fed: str | None = None,
    show: str = "slip",
    shared: pl.DataFrame | None = None,
) -> DeploymentMap:
    """Map the deployments of the literature and the datasets of the results.

    Args:
        store: the results; may be empty.
        table: a table of deployments; by default the project's own.
        fed: input u; None: as `compare_results` chooses it.
        show: key of `MEASURES` for the colour of the datasets.
        shared: table `features` of others; runs of the results' own logs are dropped from it.

    Raises:
        ComparisonError: the table does not exist or violates its schema.
    """
    deployments = read_deployments(table or find_own_table())
    compared, runs, _ = measure_runs(find_material(store, ("dataset",), trusted_only=True))
    chosen = fed or ("command" if runs.is_empty() else choose_input(runs))
    own, notes = _empty_own(), list(compared.notes)
    keys: tuple[str, ...] = ()
    parts = [] if runs.is_empty() else [pool_runs(runs, ("dataset",))]
    own_logs = [read_digest(manifest) for manifest in compared.manifests.values()]
    if shared is not None:
        parts.append(_pool_shared(shared, own_logs))
    if parts:
        pooled = pl.concat(
            [part.with_columns(pl.col("input").cast(pl.String)) for part in parts], how="diagonal"
        )
        datasets = pooled.filter(pl.col("input") == chosen).sort("dataset")
        missing = sorted(set(pooled["dataset"]) - set(datasets["dataset"]))
        notes += (
            [f"not on the map, because there is no {chosen} input: {', '.join(missing)}"] if missing else []
        )
        own, comments = rank_datasets(datasets, MEASURES[show].column)
        notes += comments
        if shared is not None:
            notes.append(_count_shared(shared, own_logs, own))
        keys = tuple(f"{row['dataset']}: {row['keys']}" for row in datasets.iter_rows(named=True))
    return DeploymentMap(
        deployments, rank_deployments(deployments), own, keys, tuple(notes), chosen, MEASURES[show]
    )


def _pool_shared(features: pl.DataFrame, own: Sequence[str]) -> pl.DataFrame:
    others = features.filter(~pl.col("sha256").is_in(list(own))).with_columns(
        pl.format("{}" + _SHARED, "dataset").alias("group"),
        pl.col("from_results").alias("key"),
        pl.lit(None, pl.Float64).alias("published_norm"),
        pl.lit(None, pl.Float64).alias("equal_modulus"),
    )
    return pool_runs(others, ("dataset",))


def _count_shared(features: pl.DataFrame, own_logs: Sequence[str], placed: pl.DataFrame) -> str:
    """Text with the number of shared runs on the map."""
    digests = features["sha256"].unique()
    drawn = placed.filter(pl.col("dataset").str.ends_with(_SHARED))["runs"].sum()
    twice = digests.is_in(list(own_logs)).sum()
    known = f"; {twice} of them are of your own logs and count once" if twice else ""
    return f"{drawn} of {digests.len()} shared runs drawn{known}"


def _empty_own() -> pl.DataFrame:
    texts, numbers = ("dataset", "vehicle", "terrain", "zone"), ("energy", "complexity", "value")
    schema = dict.fromkeys(texts, pl.String()) | dict.fromkeys(numbers, pl.Float64()) | {"runs": pl.Int64()}
    return pl.DataFrame(schema=pl.Schema(schema))


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
    needs: dict[str, list[str]] = {}
    lost: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for number in parameters:
        if number.undetermined:
            lost.setdefault((number.vehicle, number.undetermined), []).append(number.label)
        if number.need:
            needs.setdefault(f"{number.vehicle}, {format_power(number)}", []).append(number.label)
        if number.odd:
            notes.append(f"{number.label} of {number.vehicle} stands apart in {', '.join(number.odd)}")
    notes += [
        f"{', '.join(labels)} of {vehicle}, left out where a run does not determine it: {', '.join(runs)}"
        for (vehicle, runs), labels in lost.items()
    ]
    return [*notes, *(f"{', '.join(labels)} of {need}" for need, labels in needs.items())]


def summarize_trend(trend: Trend) -> dict[str, object]:
    """The JSON object of `slip fleet trend`."""
    return {
        "alerts": [vars(alert) for alert in trend.alerts],
        "series": [
            {
                **pick(one, "group", "quantity", "unit"),
                "points": one.points.drop("order").to_dicts(),
                "changes": [step.describe(format_step(one, step)) for step in one.steps],
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
