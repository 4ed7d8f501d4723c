"""Comparison of deployments: tables, page, JSON of `slip compare`, and features to share."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from pipeline.core import FEWEST_OF_SPREAD, read_version
from pipeline.core.arrays import Ints
from pipeline.fleet import (
    OVER_RUNS,
    THIS_RUN,
    add_measures,
    find_unrelated,
    gather_runs,
    measure_difficulty,
    pool_runs,
    spread_windows,
)
from pipeline.fleet.confidence import Interval, bound_typical
from pipeline.fleet.exchange import check_features, follow_published, read_limits
from pipeline.fleet.pairs import (
    Answer,
    Group,
    Pair,
    Samples,
    bound_run,
    compare_groups,
    compare_orders,
    tabulate_pairs,
    write_csv,
    write_latex,
)
from pipeline.job import ANALYZE_FIRST, FigureFormat, lack_runs
from pipeline.job.compared_runs import ComparedRuns, choose_runs, find_material, keep_runs, read_digest
from pipeline.report import Picture
from pipeline.stages.inputs import WINDOW_S
from pipeline.store import Store
from schemas import Features

_FEWEST = 2


def read_moduli(compared: ComparedRuns, input_name: str) -> dict[str, Samples]:
    """Slip moduli of every run on one input, without suspect samples.

    Args:
        compared: the runs.
        input_name: `command` or `measured`.
    """
    parts = _split_by_run(compared, "slip", input_name, time="t", value="modulus")
    return {run: _take_samples(part) for run, part in parts.items()}


def read_norms(compared: ComparedRuns, input_name: str) -> dict[str, Samples]:
    """2 s window norms of every run on one input, without suspect windows.

    Args:
        compared: the runs.
        input_name: `command` or `measured`.
    """
    parts = _split_by_run(compared, "windows", input_name, time="t_start", value="window_norm")
    return {run: _take_windows(part) for run, part in parts.items()}


def _split_by_run(
    compared: ComparedRuns, table: str, input_name: str, *, time: str, value: str
) -> dict[str, pl.DataFrame]:
    """Rows of a table on one input by run, without suspect, null and non-finite values."""
    frame = (
        compared.scan(table)
        .filter(pl.col("input") == input_name, ~pl.col("suspect"), pl.col(value).is_finite())
        .select("run", time, "segment", "step", value)
        .collect()
    )
    parts = frame.partition_by("run", as_dict=True, maintain_order=True)
    return {str(run): part for (run,), part in parts.items() if part.height >= _FEWEST}


def follow_published_runs(
    compared: ComparedRuns, runs: pl.DataFrame
) -> tuple[dict[str, Samples], pl.DataFrame, list[str]]:
    """Window norms of the published processing chain for every run that it applies to.

    Returns:
        Samples by run; the runs with ``published_norm`` in their rows of the command; notes on the fits.
    """
    samples: dict[str, Samples] = {}
    notes: list[str] = []
    for run, manifest in compared.manifests.items():
        findings = set(manifest.read("findings")["id"]) if "findings" in manifest.tables else set()
        followed = follow_published(
            manifest.read("slip"),
            manifest.read("poses"),
            limits=read_limits(manifest.part("vehicle")),
            command_is_scaled="command_scale" in findings,
        )
        if followed is None:
            continue
        samples[run] = _take_windows(followed.norms)
        scaled = f", command scaled by {followed.scale[0]:.2f} forward and {followed.scale[1]:.2f} in yaw" * (
            followed.scale != (1.0, 1.0)
        )
        notes.append(f"published chain, {run}: wheels lag with tau = {followed.tau_s:.2f} s{scaled}")
    medians = pl.DataFrame(
        {"run": list(samples), "published_norm": [own.median for own in samples.values()]},
        schema={"run": pl.String, "published_norm": pl.Float64},
    ).with_columns(pl.lit("command").cast(runs.schema["input"]).alias("input"))
    return samples, runs.update(medians, on=["run", "input"]), notes


def _take_samples(part: pl.DataFrame) -> Samples:
    times = part["t"].to_numpy()
    period = float(np.median(np.diff(times)))
    ticks = np.round((times - times[0]) / max(period, 1e-6)).astype(np.int64)
    return _as_samples(part, "modulus", ticks)


def _take_windows(norms: pl.DataFrame) -> Samples:
    """Windows as samples; windows that start within the same 2 s grid step get consecutive ticks."""
    order = norms.sort("t_start")
    times = order["t_start"].to_numpy()
    ticks = np.maximum.accumulate(np.round((times - times[0]) / WINDOW_S).astype(np.int64))
    # Windows start at steps, so two may round to the same tick: increment the later one.
    ticks = np.maximum.accumulate(ticks - np.arange(ticks.size)) + np.arange(ticks.size)
    return _as_samples(order, "window_norm", ticks)


def _as_samples(rows: pl.DataFrame, value: str, ticks: Ints) -> Samples:
    sizes = np.unique(rows["step"].to_numpy(), return_counts=True)[1]
    return Samples(
        values=rows[value].to_numpy(),
        ticks=ticks,
        pieces=rows["segment"].to_numpy().astype(np.int64),
        step=float(np.median(sizes)),
    )


def write_answer(store: Store, answer: Answer, figures: FigureFormat | None = None) -> dict[str, Path]:
    """Write `datasets.parquet`, `comparisons.parquet`, CSV and LaTeX tables and `comparison.html`.

    Args:
        store: the results.
        answer: result of `compare_results`.
        figures: also write the two figures to `figures/` in this format.

    Returns:
        The files by name.
    """
    from pipeline.report import write_page  # noqa: PLC0415 - heavy
    from pipeline.report.comparison_page import list_pictures, render_comparison  # noqa: PLC0415 - heavy

    store.write_results_table("datasets", answer.datasets)
    store.write_results_table("comparisons", answer.comparisons)
    written: dict[str, Path] = {}
    for name, frame in (("datasets", answer.datasets), ("comparisons", answer.comparisons)):
        written |= write_tables(store, name, frame, frame.filter(pl.col("input") == answer.input))
    page = render_comparison(answer, list_shown_notes(answer))
    written["comparison.html"] = write_page(store, "comparison.html", page)
    return written | write_figures(store, lambda: list_pictures(answer), figures)


def list_shown_notes(answer: Answer) -> list[str]:
    """The notes of an answer, less that on the plain test, which only the files have."""
    return [note for note in answer.notes if note != NOT_VALID]


def write_tables(store: Store, name: str, frame: pl.DataFrame, shown: pl.DataFrame) -> dict[str, Path]:
    """Write a table as CSV and the rows for a paper as LaTeX; return the files by name."""
    texts = {f"{name}.csv": write_csv(frame), f"{name}.tex": write_latex(name, shown)}
    return {file: store.write_results_text(file, text) for file, text in texts.items()}


def write_figures(
    store: Store, draw: Callable[[], Iterable[Picture]], figures: FigureFormat | None
) -> dict[str, Path]:
    """Write figures to `figures/` if a format is given; return the files by name."""
    if figures is None:
        return {}
    from pipeline.report.page import write_pictures  # noqa: PLC0415 - heavy

    return {path.name: path for path in write_pictures(draw(), store.root / "figures", figures)}


def summarize_answer(answer: Answer) -> dict[str, object]:
    """The JSON object of `slip compare`."""
    return {
        "input": answer.input,
        "quantity": answer.quantity,
        "datasets": _list_rows(answer.datasets.filter(pl.col("input") == answer.input)),
        "pairs": _list_rows(answer.comparisons.drop("run", "dataset", "vehicle", "terrain")),
        "orders": [
            vars(one) for one in compare_orders(answer.datasets.filter(pl.col("input") == answer.input))
        ],
        "notes": list(answer.notes),
    }


def _list_rows(frame: pl.DataFrame) -> list[dict[str, object]]:
    return frame.with_columns(pl.col(pl.Enum).cast(pl.String)).to_dicts()


_WINDOW_COLUMNS = {
    "run": pl.String,
    "input": pl.String,
    "suspect": pl.Boolean,
    "window_norm": pl.Float64,
}
NOT_VALID = (
    "plain p (p_uncorrected) is the Mann-Whitney test of published work over all samples; it is not valid "
    "here, because samples of one run are correlated"
)


ABOUT_UNIT = (
    "the norm of a 2 s window is sqrt(40) = 6.32 times the root mean square of its slip modulus (L = 1 m), "
    "in m/s; the paper prints the same number in m^2 rad/s^3, the product of the units of its three "
    "components, which is the unit of no norm"
)


@dataclass(frozen=True)
class Question:
    """Options of a comparison.

    Attributes:
        by: columns that define a dataset.
        input: input u; None: the command if every run has one, else the measured wheels.
        as_published: compare the window norms of the published chain instead of the median slip modulus.
        datasets: compare only these, each with every other; all if empty, and of those that differ in both
            vehicle and terrain no test.
        vehicle: compare only runs of this vehicle; of any if empty.
    """

    by: tuple[str, ...] = ("dataset",)
    input: str | None = None
    as_published: bool = False
    datasets: tuple[str, ...] = ()
    vehicle: str = ""


def compare_results(store: Store, question: Question) -> Answer:
    """Compare the datasets of the results; nothing is written.

    Raises:
        JobError: ``nothing_to_compare``.
        ComparisonError: ``no_such_column``, ``no_such_vehicle``, ``no_such_dataset``.
    """
    compared = find_material(store, question.by, trusted_only=True)
    compared = choose_runs(compared, question.vehicle, question.datasets)
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
        samples, runs, comments = follow_published_runs(compared, runs)
        notes += [ABOUT_UNIT, *comments]
    elif chosen == "command":
        notes += _doubt_commands(compared)
    missing = sorted(set(compared.manifests) - set(samples))
    if missing:
        notes.append(f"{', '.join(missing)} not compared: no {quantity.replace('_', ' ')} on {chosen}")
    groups = _group(compared, samples)
    untested = find_untested(compared, question)
    pairs = compare_groups(groups, untested=untested)
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
    all_notes = (*compared.notes, *notes, *_sum_up(pairs, groups), *note_untested(untested))
    intervals = _list_intervals(groups, datasets, chosen, quantity)
    return Answer(datasets, comparisons, runs, chosen, quantity, intervals, boxes, all_notes)


def find_untested(compared: ComparedRuns, question: Question) -> frozenset[frozenset[str]]:
    """Pairs of datasets without a test; none where datasets are named."""
    return frozenset() if question.datasets else find_unrelated(compared.labels)


def note_untested(untested: Collection[frozenset[str]]) -> list[str]:
    """The note on pairs of datasets without a test."""
    if not untested:
        return []
    first, second = sorted(min(untested, key=sorted))
    pairs = f"{len(untested)} pairs" if len(untested) > 1 else "1 pair"
    why = "with neither vehicle nor terrain in common"
    return [f"{pairs} of datasets {why}: no test, unless named, as in: slip compare {first} {second}"]


def measure_runs(compared: ComparedRuns) -> tuple[ComparedRuns, pl.DataFrame, list[str]]:
    """Comparable runs, all measures with one row per run and input, and notes."""
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
    """Exclude runs whose length scale differs from that of most runs: their moduli are not comparable."""
    if runs.is_empty():
        return compared, runs, []
    scales = runs.unique("run")["length_scale"]
    usual = float(np.min(scales.drop_nulls().mode().to_numpy()))
    valid = runs.filter(pl.col("length_scale") == usual)["run"].unique().to_list()
    compared = keep_runs(
        compared, valid, f"its length scale is not the {usual:g} m of most runs, or it has no slip"
    )
    return compared, runs.filter(pl.col("run").is_in(valid)), [NOT_VALID]


def choose_input(runs: pl.DataFrame) -> str:
    """Default input u: the command if every run has one, else the measured wheels."""
    on_command = runs.filter(pl.col("input") == "command")["run"].n_unique()
    return "command" if on_command == runs["run"].n_unique() else "measured"


def _doubt_commands(compared: ComparedRuns) -> list[str]:
    """Warn of runs whose recorded command was rescaled: their slip from commands rests on an estimate."""
    doubtful = compared.scan("findings").filter(pl.col("id") == "command_scale")
    runs = doubtful.select("run").unique().sort("run").collect()["run"].to_list()
    if not runs:
        return []
    text = "read with care, the recorded command had another scale, which was estimated and corrected"
    return [f"{text} (--input measured does without): {', '.join(runs)}"]


def _group(compared: ComparedRuns, samples: Mapping[str, Samples]) -> list[Group]:
    known = compared.labels.filter(pl.col("run").is_in(list(samples))).sort("group", "run")
    return [
        Group(str(name), tuple(samples[run] for run in rows["run"]))
        for (name,), rows in known.partition_by("group", as_dict=True, maintain_order=True).items()
    ]


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
    """Value and interval of the compared quantity, one row per dataset."""
    own = datasets.filter(pl.col("input") == chosen)
    if quantity == "median_modulus":
        return own.select("dataset", pl.col(quantity).alias("value"), "low", "high", "interval")
    rows = []
    for group in groups:
        interval, about = None, ""
        if len(group.runs) >= FEWEST_OF_SPREAD:
            interval, about = bound_typical(group.medians), OVER_RUNS
        elif len(group.runs) == 1:
            interval, about = bound_run(group.runs[0]), THIS_RUN
        ends = (None, None) if interval is None else (interval.low, interval.high)
        rows.append((group.name, float(np.median(group.medians)), *ends, about))
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
    hopeless: dict[str, list[str]] = {}
    for pair in pairs:
        if "cannot be significant" in pair.note:
            hopeless.setdefault(pair.note, []).append(f"{pair.a.name} and {pair.b.name}")
    single = sorted(group.name for group in groups if len(group.runs) == 1)
    sentences = []
    for note, (first, *others) in sorted(hopeless.items()):
        count_text = f", and {len(others)} more pair{'s' * (len(others) > 1)}" if others else ""
        sentences.append(f"{first}{count_text}: {note}")
    if single:
        sentences.append(
            f"one run only: {', '.join(single)}; their intervals describe the run, not the terrain"
        )
    return sentences


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


_HASH = 64


def gather_features(store: Store) -> tuple[pl.DataFrame, tuple[str, ...]]:
    """The table `features` of the results, and notes on excluded runs.

    Raises:
        JobError: ``nothing_to_share``.
        ComparisonError: ``bad_features``: a value is out of range.
    """
    compared, runs, comments = measure_runs(find_material(store, ("dataset",), trusted_only=True))
    digests = {run: read_digest(manifest) for run, manifest in compared.manifests.items()}
    nameless = sorted(run for run, digest in digests.items() if len(digest) != _HASH)
    notes = [*compared.notes, *comments[1:]]
    if nameless:
        notes.append(f"left out, the hash of the log is not known: {', '.join(nameless)}")
    known = runs.filter(~pl.col("run").is_in(nameless)) if not runs.is_empty() else runs
    if known.is_empty():
        raise lack_runs("nothing_to_share", "there is no run to share", store.root, ANALYZE_FIRST, notes)
    schema = Features.create_empty().schema
    shared = known.with_columns(
        pl.col("run").replace_strict(digests, return_dtype=pl.String).alias("sha256"),
        pl.col("input").cast(pl.String),
        pl.lit(read_version()).alias("made_by"),
        pl.col("key").alias("from_results"),
        (pl.col("mass") * pl.col("squared_gyration")).alias("inertia"),
    ).with_columns(pl.col("sha256").str.slice(0, 16).alias("run"))
    typed = shared.select(pl.col(name).cast(kind) for name, kind in schema.items())
    return check_features(typed.sort("sha256", "input"), str(store.root)), tuple(notes)
