"""Comparison of the datasets of the results: as driven, at equal driving, and as published."""

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from pipeline.core import FEWEST_OF_SPREAD, format_count, group_by, read_version
from pipeline.datasets.causes import find_carriers, find_level_names, name_causes, read_budgets
from pipeline.datasets.compared_runs import (
    ComparedRuns,
    Question,
    can_read,
    choose_input,
    choose_runs,
    find_material,
    find_untested,
    measure_runs,
    note_untested,
    read_digest,
)
from pipeline.datasets.equal_driving import Levelled, Overlap, find_overlap, level_runs, measure_bins
from pipeline.datasets.pairs import (
    ABOUT_UNIT,
    AS_DRIVEN,
    AS_PUBLISHED,
    BLOCKS,
    EQUAL_DRIVING,
    Answer,
    Group,
    Pair,
    Samples,
    View,
    bound_run,
    compare_groups,
    tabulate_pairs,
)
from pipeline.datasets.pooled_tests import bound_levels, level_groups
from pipeline.datasets.pooling import OVER_RUNS, THIS_RUN, pool_runs, spread_windows
from pipeline.datasets.published_chain import follow_published, read_limits
from pipeline.datasets.rank_tests import Interval, connect_groups
from pipeline.store import ANALYZE_FIRST, Store, lack_runs
from schemas import contract_of

_FEWEST = 2
_HASH = 64
"""Characters of a SHA-256 in hexadecimal."""

_NORMS = ("windows", "t_start", "window_norm")
"""Table and columns of the 2 s window norms."""

Bounds = dict[tuple[str, str], Interval]
"""Intervals by run and input."""
Overlaps = Mapping[frozenset[str], Overlap]
"""Driving in common by the datasets of a pair."""


def read_samples(
    compared: ComparedRuns, input_name: str, table: str = "slip", time: str = "t", value: str = "modulus"
) -> dict[str, Samples]:
    """Samples of every run on one input, without suspect, null and non-finite ones: slip moduli by default.

    Args:
        compared: the runs.
        input_name: `command` or `measured`.
        table: table to read.
        time: its column of times [s].
        value: its column of values.
    """
    frame = (
        compared.scan(table)
        .filter(pl.col("input") == input_name, ~pl.col("suspect"), pl.col(value).is_finite())
        .select("run", time, value)
        .collect()
    )
    parts = frame.partition_by("run", as_dict=True, maintain_order=True)
    return {
        str(run): _take_samples(part[time], part[value])
        for (run,), part in parts.items()
        if part.height >= _FEWEST
    }


def _take_samples(times: pl.Series, values: pl.Series) -> Samples:
    order = times.arg_sort()
    step = float(np.median(np.diff(times[order].to_numpy())))
    return Samples(values[order].to_numpy(), len(times) * step)


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
        samples[run] = _take_samples(followed.norms["t_start"], followed.norms["window_norm"])
        scaled = f", command scaled by {followed.scale[0]:.2f} forward and {followed.scale[1]:.2f} in yaw" * (
            followed.scale != (1.0, 1.0)
        )
        notes.append(f"published chain, {run}: wheels lag with tau = {followed.tau_s:.2f} s{scaled}")
    medians = pl.DataFrame(
        {"run": list(samples), "published_norm": [own.median for own in samples.values()]},
        schema={"run": pl.String, "published_norm": pl.Float64},
    ).with_columns(pl.lit("command").cast(runs.schema["input"]).alias("input"))
    return samples, runs.update(medians, on=["run", "input"]), notes


_WINDOW_COLUMNS = {
    "run": pl.String,
    "input": pl.String,
    "suspect": pl.Boolean,
    "window_norm": pl.Float64,
}


def compare_results(store: Store, question: Question) -> Answer:
    """Compare the datasets of the results; nothing is written.

    Raises:
        ComparisonError: ``nothing_to_compare``.
        ComparisonError: ``no_such_column``, ``no_such_vehicle``, ``no_such_dataset``.
    """
    compared = find_material(store, question.by, trusted_only=True, vehicle=question.vehicle)
    compared = choose_runs(compared, question.vehicle, question.datasets)
    compared, runs, notes = measure_runs(compared)
    if runs.is_empty():
        what = "there is no run whose numbers can be compared"
        raise lack_runs("nothing_to_compare", what, store.root, ANALYZE_FIRST, compared.notes)
    untested = find_untested(compared, question)
    material = _Material(compared, question, untested, _find_families(compared, untested), runs, notes)
    return material.compare_published() if question.as_published else material.compare_driving()


@dataclass
class _Material:
    """What a comparison is made of.

    Attributes:
        compared: the runs.
        question: what is asked.
        untested: pairs of datasets without a test.
        families: datasets that are compared with each other, by their vehicles.
        runs: one row per run and input with all its measures.
        notes: grows with what is found.
    """

    compared: ComparedRuns
    question: Question
    untested: frozenset[frozenset[str]]
    families: dict[str, tuple[str, ...]]
    runs: pl.DataFrame
    notes: list[str]

    def compare_driving(self) -> Answer:
        """Compare slip moduli on the inputs, each as driven and at equal driving."""
        main = self.question.input or choose_input(self.runs)
        others = {"command", "measured"} & set(self.runs["input"].cast(pl.String)) - {main}
        inputs = [main, *(sorted(others) if self.question.input is None else ())]
        self.notes += _doubt_commands(self.compared) if "command" in inputs else []
        tables: dict[tuple[str, str], pl.DataFrame] = {}
        within: Bounds = {}
        norms_within: Bounds = {}
        for name in inputs:
            moduli = read_samples(self.compared, name)
            tables[name, AS_DRIVEN] = self._compare(self._group(moduli, name, AS_DRIVEN), name, AS_DRIVEN)
            within |= self._bound_single(moduli, name)
            norms_within |= self._bound_single(read_samples(self.compared, name, *_NORMS), name)
        labels = self.compared.labels.select("run", "group")
        bins = measure_bins(self.compared.scan("slip")).join(labels, on="run", maintain_order="left")
        driven = self._level_driving(bins, inputs)
        at_equal = []
        for name in inputs:
            levels = self.runs.filter(pl.col("input") == name, pl.col(EQUAL_DRIVING).is_not_null())
            groups = _group_levels(levels)
            overlaps = {
                frozenset((a.name, b.name)): find_overlap(driven[name][a.name].bins, a.names, b.names)
                for a, b in itertools.combinations(groups, 2)
            }
            tables[name, EQUAL_DRIVING] = self._compare(groups, name, EQUAL_DRIVING, overlaps, driven[name])
            at_equal.append(self._level_datasets(groups, name, driven[name]))
        datasets = pool_runs(self.runs, self.question.by, within=within, norms_within=norms_within)
        datasets = datasets.update(pl.concat(at_equal), on=["dataset", "input"])
        views = [View(*key, _list_levels(datasets, *key), table) for key, table in tables.items()]
        return self._answer(datasets, views, self.compared.scan("windows"), bins)

    def compare_published(self) -> Answer:
        """Compare the window norms of the published chain."""
        name = "command"
        samples, self.runs, comments = follow_published_runs(self.compared, self.runs)
        self.notes += [ABOUT_UNIT, *comments]
        groups = self._group(samples, name, AS_PUBLISHED)
        table = self._compare(groups, name, AS_PUBLISHED)
        datasets = pool_runs(
            self.runs,
            self.question.by,
            within=self._bound_single(read_samples(self.compared, name), name),
            norms_within=self._bound_single(read_samples(self.compared, name, *_NORMS), name),
        )
        view = View(name, AS_PUBLISHED, _bound_published(groups, self.families), table)
        return self._answer(datasets, [view], _tabulate_windows(samples, name), pl.DataFrame())

    def _group(self, samples: Mapping[str, Samples], name: str, quantity: str) -> list[Group]:
        if missing := sorted(set(self.compared.manifests) - set(samples)):
            what = f"no {quantity.replace('_', ' ')} on {name}"
            self.notes.append(f"{', '.join(missing)} not compared: {what}")
        return _group(self.compared, samples)

    def _compare(
        self,
        groups: Sequence[Group],
        name: str,
        quantity: str,
        overlaps: Overlaps | None = None,
        levelled: Mapping[str, Levelled] | None = None,
    ) -> pl.DataFrame:
        """Table `comparisons` of the groups by a quantity on an input."""
        pairs = compare_groups(groups, untested=self.untested, overlaps=overlaps, levelled=levelled)
        self.notes += _sum_up(pairs, groups, _WORDS[quantity])
        keys = _keys(self.compared)
        return tabulate_pairs(pairs, by=self.question.by, input_name=name, quantity=quantity, keys=keys)

    def _bound_single(self, samples: Mapping[str, Samples], name: str) -> Bounds:
        """Intervals of runs that are alone in their dataset."""
        alone = self.compared.labels.filter(pl.len().over("group") == 1)["run"]
        ends = {run: bound_run(samples[run]) for run in alone if run in samples}
        return {(run, name): one for run, one in ends.items() if one is not None}

    def _level_driving(self, bins: pl.DataFrame, inputs: Sequence[str]) -> dict[str, dict[str, Levelled]]:
        """Give runs their levels at equal driving; what they are of, by input and dataset."""
        driven: dict[str, dict[str, Levelled]] = {}
        for name in inputs:
            driven[name] = {}
            for datasets in self.families.values():
                own = bins.filter(pl.col("input") == name, pl.col("group").is_in(list(datasets)))
                levelled = level_runs(own)
                driven[name] |= dict.fromkeys(datasets, levelled)
                if levelled.apart:
                    runs = ", ".join(levelled.apart)
                    why = f"a cell of driving counts from {FEWEST_OF_SPREAD} runs on"
                    self.notes.append(f"no level at equal driving, too little in common ({why}): {runs}")
                levels = levelled.runs.select(
                    "run",
                    pl.lit(name).cast(self.runs.schema["input"]).alias("input"),
                    pl.col("level").alias(EQUAL_DRIVING),
                )
                self.runs = self.runs.update(levels, on=["run", "input"])
        if short := sorted(set(self.compared.manifests) - set(bins["run"])):
            runs = ", ".join(short)
            self.notes.append(f"no level at equal driving, too little driving on commands: {runs}")
        return driven

    def _level_datasets(
        self, groups: Sequence[Group], name: str, driven: Mapping[str, Levelled]
    ) -> pl.DataFrame:
        """Levels of the datasets at equal driving, with their intervals."""
        rows: list[tuple[str, float, float | None, float | None]] = []
        for datasets in self.families.values():
            if own := [group for group in groups if group.name in datasets]:
                errors = driven[own[0].name].find_errors([run for group in own for run in group.names])
                levels = level_groups([group.values for group in own], errors)
                for group, (level, ends) in zip(own, levels, strict=True):
                    rows.append((group.name, level, *((ends.low, ends.high) if ends else (None, None))))
        numbers = dict.fromkeys((EQUAL_DRIVING, "equal_low", "equal_high"), pl.Float64)
        return pl.DataFrame(rows, schema={"dataset": pl.String, **numbers}, orient="row").with_columns(
            pl.lit(name).cast(self.runs.schema["input"]).alias("input")
        )

    def _answer(
        self, datasets: pl.DataFrame, views: Sequence[View], windows: pl.LazyFrame, bins: pl.DataFrame
    ) -> Answer:
        labels = self.compared.labels.select("run", "group")
        return Answer(
            datasets=datasets,
            views=tuple(views),
            families=self.families,
            runs=self.runs,
            bins=bins,
            carriers=_find_carriers(self.compared, [view.input for view in views]),
            windows=spread_windows(windows, labels),
            features=_list_features(self.compared, self.runs),
            notes=(*self.compared.notes, *dict.fromkeys(self.notes), *note_untested(self.untested)),
        )


_WORDS = {
    AS_DRIVEN: "as driven",
    EQUAL_DRIVING: "at equal driving",
    AS_PUBLISHED: "as published",
}


def _find_families(
    compared: ComparedRuns, untested: Collection[frozenset[str]]
) -> dict[str, tuple[str, ...]]:
    """Datasets that are compared with each other, by their vehicles."""
    names = sorted(set(compared.labels["group"]))
    pairs = [
        (i, j)
        for i, j in itertools.combinations(range(len(names)), 2)
        if frozenset((names[i], names[j])) not in untested
    ]
    sets = connect_groups(pairs)
    alone = set(range(len(names))) - {i for one in sets for i in one}
    families: dict[str, tuple[str, ...]] = {}
    for members in sorted([*sets, *((i,) for i in alone)]):
        datasets = tuple(names[i] for i in members)
        own = compared.labels.filter(pl.col("group").is_in(list(datasets)))
        vehicle = ", ".join(sorted(set(own["vehicle"])))
        # Datasets of a vehicle that have nothing to be compared with would share its name.
        families[vehicle if vehicle not in families else f"{vehicle}: {datasets[0]}"] = datasets
    return families


def _group_levels(levels: pl.DataFrame) -> list[Group]:
    parts = levels.sort("group", "run").partition_by("group", as_dict=True, maintain_order=True)
    return [
        Group(str(name), rows[EQUAL_DRIVING].to_numpy(), names=tuple(rows["run"]))
        for (name,), rows in parts.items()
    ]


def _find_carriers(compared: ComparedRuns, inputs: Sequence[str]) -> dict[tuple[str, frozenset[str]], str]:
    """The effect that carries the difference of two datasets as driven, in words; of diagnosed runs."""
    diagnosed = {run: one for run, one in compared.manifests.items() if can_read(one, "budget")}
    rows = read_budgets(replace(compared, manifests=diagnosed))
    if rows.is_empty():
        return {}
    names = name_causes(find_level_names(compared.store))
    carriers = {}
    for name in inputs:
        for pair, one in find_carriers(rows.filter(pl.col("input") == name)).items():
            cause = names.get(one.name, one.name.replace("_", " "))
            carriers[name, pair] = f"{cause} {one.difference:+.2g} m/s"
    return carriers


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
        Group.of_runs(str(name), [samples[run] for run in rows["run"]])
        for (name,), rows in known.partition_by("group", as_dict=True, maintain_order=True).items()
    ]


def _list_levels(datasets: pl.DataFrame, input_name: str, quantity: str) -> pl.DataFrame:
    """Value and interval of a quantity, one row per dataset that has it."""
    low, high, about = ("low", "high", pl.col("interval"))
    if quantity == EQUAL_DRIVING:
        low, high, about = ("equal_low", "equal_high", pl.lit(OVER_RUNS))
    return datasets.filter(pl.col("input") == input_name, pl.col(quantity).is_not_null()).select(
        "dataset",
        pl.col(quantity).alias("value"),
        pl.col(low).alias("low"),
        pl.col(high).alias("high"),
        pl.when(pl.col(low).is_null()).then(pl.lit("")).otherwise(about).alias("interval"),
    )


def _bound_published(groups: Sequence[Group], families: Mapping[str, Sequence[str]]) -> pl.DataFrame:
    """Value and interval of the published norm, one row per dataset."""
    rows: list[tuple[str, float, float | None, float | None, str]] = []
    for datasets in families.values():
        own = [group for group in groups if group.name in datasets]
        for group, over_runs in zip(own, bound_levels([group.values for group in own]), strict=True):
            interval, about = over_runs, OVER_RUNS
            if interval is None and len(group.runs) == 1:
                interval, about = bound_run(group.runs[0]), THIS_RUN
            ends = (None, None) if interval is None else (interval.low, interval.high)
            value = float(np.median(group.values))
            rows.append((group.name, value, *ends, about if interval else ""))
    kinds = {
        "dataset": pl.String,
        **dict.fromkeys(("value", "low", "high"), pl.Float64),
        "interval": pl.String,
    }
    return pl.DataFrame(rows, schema=kinds, orient="row").sort("dataset")


def _keys(compared: ComparedRuns) -> dict[str, str]:
    """Run/generation of every run of a group, separated by spaces."""
    named = compared.labels.with_columns(pl.concat_str("run", "key", separator="/").alias("place"))
    joined = named.group_by("group").agg(pl.col("place").sort().str.join(" "))
    return dict(zip(joined["group"].to_list(), joined["place"].to_list(), strict=True))


def _sum_up(pairs: Sequence[Pair], groups: Sequence[Group], of: str) -> list[str]:
    """Notes on pairs without an answer, once for those alike, and on what intervals of single runs say."""
    if len(groups) < 2:  # noqa: PLR2004 - a pair
        return ["there is one dataset only: nothing to compare it with"] if groups else []
    silent = group_by((pair.note, f"{pair.a.name} and {pair.b.name}") for pair in pairs if pair.p is None)
    sentences = []
    for note, (first, *others) in sorted(silent.items()):
        count_text = f", and {format_count(len(others), 'more pair')}" if others else ""
        sentences.append(f"{first}{count_text}, {of}: {note}")
    single = sorted({group.name for pair in pairs if pair.unit == BLOCKS for group in (pair.a, pair.b)})
    if single:
        sentences.append(
            f"one run only: {', '.join(single)}; their intervals describe the run, not the terrain"
        )
    return sentences


def _list_features(compared: ComparedRuns, runs: pl.DataFrame) -> pl.DataFrame:
    """The table `features`: what can be given away of the runs, whose logs are known by their hash alone."""
    digests = {run: read_digest(manifest) for run, manifest in compared.manifests.items()}
    sha256 = pl.col("run").replace_strict(digests, return_dtype=pl.String)
    named = runs.with_columns(sha256.alias("sha256")).filter(pl.col("sha256").str.len_chars() == _HASH)
    given = named.with_columns(
        pl.col("sha256").str.slice(0, 16).alias("run"),
        pl.lit(read_version()).alias("made_by"),
        pl.col("key").alias("from_results"),
        (pl.col("mass") * pl.col("squared_gyration")).alias("inertia"),
    )
    schema = contract_of("features").schema.create_empty().schema
    return given.select(pl.col(name).cast(kind) for name, kind in schema.items()).sort("sha256", "input")


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
