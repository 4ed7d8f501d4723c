"""Deployments side by side: from the results to tables, one page, and the answer of `slip compare`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.analysis.compared_runs import ComparedRuns, find_material, keep_runs
from pipeline.analysis.errors import ANALYZE_FIRST, lack_runs
from pipeline.analysis.samples import follow_published_runs, read_moduli, read_norms
from pipeline.fleet.datasets import OVER_RUNS, THIS_RUN, pool_runs, spread_windows
from pipeline.fleet.pairs import Group, Pair, Samples, bound_run, compare_groups
from pipeline.fleet.runs import add_measures, gather_runs, measure_difficulty
from pipeline.fleet.statistics.intervals import Interval, bound_typical
from pipeline.fleet.tables import Answer, tabulate_pairs
from pipeline.store import Store

_WINDOW_COLUMNS = {
    "run": pl.String,
    "input": pl.String,
    "suspect": pl.Boolean,
    "window_norm": pl.Float64,
}
NOT_VALID = (
    "p_uncorrected is the plain Mann-Whitney test of published work over all samples; it is not valid here, "
    "because samples of one run are correlated"
)


@dataclass(frozen=True)
class Question:
    """What is to be compared.

    Attributes:
        by: columns that make a dataset.
        input: what u is; None: the command where every run has one, else the measured wheels.
        as_published: compare the published chain's window norms in place of the median modulus.
    """

    by: tuple[str, ...] = ("dataset",)
    input: str | None = None
    as_published: bool = False


def compare_results(store: Store, question: Question) -> Answer:
    """Compare the datasets of the results; nothing is written.

    Raises:
        JobError: ``nothing_to_compare``.
        ComparisonError: ``no_such_column``.
    """
    compared = find_material(store, question.by, trusted_only=True)
    compared, runs, notes = measure_runs(compared)
    if runs.is_empty():
        what = "there is no run whose numbers can be compared"
        raise lack_runs("nothing_to_compare", what, store.root, ANALYZE_FIRST, compared.notes)
    chosen = question.input or choose_input(runs)
    quantity = "median_modulus"
    if question.as_published:
        chosen, quantity = "command", "published_norm"
    moduli = samples = read_moduli(compared, chosen)
    if question.as_published:
        samples, runs, told = follow_published_runs(compared, runs)
        notes += told
    elif chosen == "command":
        notes += _doubt_commands(compared)
    missing = sorted(set(compared.manifests) - set(samples))
    if missing:
        notes.append(f"{', '.join(missing)} not compared: no {quantity.replace('_', ' ')} on {chosen}")
    groups = _group(compared, samples)
    pairs = compare_groups(groups)
    single = _find_single(compared)
    datasets = pool_runs(
        runs,
        question.by,
        within=_bound_single(moduli, single, chosen),
        norms_within=_bound_single(read_norms(compared, chosen), single, chosen),
    )
    comparisons = tabulate_pairs(
        pairs, by=question.by, input_name=chosen, quantity=quantity, keys=_keys(compared)
    )
    windows = _tabulate_windows(samples, chosen) if question.as_published else compared.scan("windows")
    boxes = spread_windows(windows, compared.labels.select("run", "group"))
    all_notes = (*compared.notes, *notes, *_sum_up(pairs, groups))
    intervals = _list_intervals(groups, datasets, chosen, quantity)
    return Answer(datasets, comparisons, runs, chosen, quantity, intervals, boxes, all_notes)


def measure_runs(compared: ComparedRuns) -> tuple[ComparedRuns, pl.DataFrame, list[str]]:
    """Runs that can be compared, one row a run and input with all measures, and what must be known."""
    compared, runs, notes = _agree_on_scale(compared, _gather(compared))
    if runs.is_empty():
        return compared, runs, notes
    scales = runs.unique("run").select("run", "length_scale")
    vehicles = compared.labels.select("run", "mass", "squared_gyration").join(scales, on="run")
    return compared, add_measures(runs, measure_difficulty(compared.scan("slip"), vehicles)), notes


def _gather(compared: ComparedRuns) -> pl.DataFrame:
    if not compared.manifests:
        return pl.DataFrame()
    return gather_runs(compared.scan("aggregates").collect(), compared.labels).filter(
        pl.col("median_modulus").is_not_null(), pl.col("median_modulus").is_finite()
    )


def _agree_on_scale(
    compared: ComparedRuns, runs: pl.DataFrame
) -> tuple[ComparedRuns, pl.DataFrame, list[str]]:
    """Leave out runs with another length scale than most: their moduli are other quantities."""
    if runs.is_empty():
        return compared, runs, []
    scales = runs.unique("run")["length_scale"]
    usual = float(np.min(scales.drop_nulls().mode().to_numpy()))
    kept = runs.filter(pl.col("length_scale") == usual)["run"].unique().to_list()
    compared = keep_runs(
        compared, kept, f"its length scale is not the {usual:g} m of most runs, or it has no slip"
    )
    return compared, runs.filter(pl.col("run").is_in(kept)), [NOT_VALID]


def choose_input(runs: pl.DataFrame) -> str:
    """What u is where nobody says: the command where every run has one, else the measured wheels."""
    on_command = runs.filter(pl.col("input") == "command")["run"].n_unique()
    return "command" if on_command == runs["run"].n_unique() else "measured"


def _doubt_commands(compared: ComparedRuns) -> list[str]:
    """Runs whose recorded command is known to be scaled wrongly: their slip on it is no slip."""
    found = compared.scan("findings").filter(pl.col("id") == "command_scale")
    runs = found.select("run").unique().sort("run").collect()["run"].to_list()
    if not runs:
        return []
    return [
        f"read with care, the recorded command is scaled wrongly (use --input measured): {', '.join(runs)}"
    ]


def _group(compared: ComparedRuns, samples: Mapping[str, Samples]) -> list[Group]:
    members: dict[str, list[Samples]] = {}
    for run, group in compared.labels.select("run", "group").sort("group", "run").iter_rows():
        if run in samples:
            members.setdefault(group, []).append(samples[run])
    return [Group(name, tuple(runs)) for name, runs in members.items()]


def _find_single(compared: ComparedRuns) -> list[str]:
    """Runs that are alone in their dataset."""
    alone = compared.labels.filter(pl.len().over("group") == 1)
    return alone["run"].to_list()


def _bound_single(
    samples: Mapping[str, Samples], single: Sequence[str], chosen: str
) -> dict[tuple[str, str], Interval]:
    """Intervals of runs that are alone in their dataset."""
    return {(run, chosen): bound_run(samples[run]) for run in single if run in samples}


def _list_intervals(
    groups: Sequence[Group], datasets: pl.DataFrame, chosen: str, quantity: str
) -> pl.DataFrame:
    """Value and interval of what was compared, one row a dataset."""
    own = datasets.filter(pl.col("input") == chosen)
    if quantity == "median_modulus":
        return own.select("dataset", pl.col(quantity).alias("value"), "low", "high", "interval")
    rows = []
    for group in groups:
        several = len(group.runs) > 1
        found = bound_typical(group.medians) if several else bound_run(group.runs[0])
        says = OVER_RUNS if several else THIS_RUN
        rows.append((group.name, float(np.median(group.medians)), found.low, found.high, says))
    kinds = {
        "dataset": pl.String,
        **dict.fromkeys(("value", "low", "high"), pl.Float64),
        "interval": pl.String,
    }
    return pl.DataFrame(rows, schema=kinds, orient="row")


def _keys(compared: ComparedRuns) -> dict[str, str]:
    """Run/generation of every run of a group, separated by spaces."""
    named = compared.labels.with_columns(pl.concat_str("run", "key", separator="/").alias("place"))
    joined = named.group_by("group").agg(pl.col("place").sort().str.join(" "))
    return dict(zip(joined["group"].to_list(), joined["place"].to_list(), strict=True))


def _sum_up(pairs: Sequence[Pair], groups: Sequence[Group]) -> list[str]:
    if len(groups) < 2:  # noqa: PLR2004 - a pair
        return ["there is one dataset only: nothing to compare it with"]
    hopeless = sorted({pair.note for pair in pairs if "cannot be significant" in pair.note})
    single = sorted(group.name for group in groups if len(group.runs) == 1)
    told = [f"{note}" for note in hopeless]
    if single:
        told.append(
            f"one run only: {', '.join(single)}; intervals there speak of this run, not of the terrain"
        )
    return told


def _tabulate_windows(samples: Mapping[str, Samples], input_name: str) -> pl.LazyFrame:
    """Window norms of the published chain in the columns of the table `windows`."""
    frames = [
        pl.DataFrame({"window_norm": own.values}).select(
            pl.lit(run).alias("run"),
            pl.lit(input_name).alias("input"),
            pl.lit(value=False).alias("suspect"),
            "window_norm",
        )
        for run, own in samples.items()
    ]
    return pl.concat(frames).lazy() if frames else pl.LazyFrame(schema=_WINDOW_COLUMNS)
