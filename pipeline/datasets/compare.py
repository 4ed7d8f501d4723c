"""Comparison of the datasets of the results: as driven, at equal driving, and as published."""

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.core import FEWEST_OF_SPREAD, format_count, group_by, read_version
from pipeline.datasets.compared_runs import (
    ComparedRuns,
    Question,
    choose_input,
    choose_runs,
    find_material,
    find_untested,
    measure_runs,
    note_untested,
    read_digest,
)
from pipeline.datasets.equal_driving import Levelled, find_overlap, level_runs, measure_bins
from pipeline.datasets.pairs import (
    BLOCKS,
    THIS_RUN,
    Group,
    SlipSamples,
    bound_groups,
    compare_groups,
    connect_groups,
    level_groups,
    name_interval,
    tabulate_pairs,
)
from pipeline.datasets.pooling import pool_runs
from pipeline.datasets.published_chain import follow_published, read_limits
from pipeline.results import read_finding_table
from pipeline.store import ANALYZE_FIRST, Store, lack_runs
from schemas import contract_of
from schemas.run_tables import COUNTED

AS_DRIVEN, EQUAL_DRIVING, AS_PUBLISHED = "median_modulus", "equal_modulus", "published_norm"
"""Quantities that are compared."""
QUANTITIES = {AS_DRIVEN: "as driven", EQUAL_DRIVING: "at equal driving", AS_PUBLISHED: "as published"}
ABOUT_UNIT = (
    "the norm of a 2 s window is sqrt(40) = 6.32 times the root mean square of its slip modulus (L = 1 m), "
    "in m/s; the paper prints the same number in m^2 rad/s^3, the product of the units of its three "
    "components, which is the unit of no norm"
)
_FEWEST = 2
_HASH = 64
"""Characters of a SHA-256 in hexadecimal."""
_APPLIED = ("of the wheels", "without a unit")
"""Kinds of the finding `command_scale` with which commands are multiplied."""
_NORMS = ("windows", "t_start", "window_norm")
"""Table and columns of the 2 s window norms."""
Bounds = dict[tuple[str, str], tuple[float, float]]
"""Intervals by run and input."""


@dataclass(frozen=True)
class Answer:
    """Result of a comparison.

    Attributes:
        input, quantity: of the main comparison.
        views: inputs and quantities that were compared, the main ones first.
        datasets: table `datasets`, both inputs.
        levels: ``input``, ``quantity``, ``dataset``, ``value``, ``low``, ``high``, ``interval`` of every
            view.
        comparisons: table `comparisons` of every view.
        families: vehicles, and their datasets that are compared with each other.
        runs: one row per run and input with all its measures.
        features: table `features`: what can be given away of the runs.
        notes: excluded runs, pairs that cannot be told apart.
    """

    views: tuple[tuple[str, str], ...]
    datasets: pl.DataFrame
    levels: pl.DataFrame
    comparisons: pl.DataFrame
    families: Mapping[str, tuple[str, ...]]
    runs: pl.DataFrame
    features: pl.DataFrame
    notes: tuple[str, ...]

    @property
    def input(self) -> str:
        """Input u of the main comparison."""
        return self.views[0][0]

    @property
    def measure(self) -> str:
        """Name of the main quantity, its length scale included."""
        if self.views[0][1] == AS_PUBLISHED:
            return "2 s window norm as published (L = 1 m)"
        (scale,) = self.datasets["length_scale"].drop_nulls().unique().to_list() or (1.0,)
        return f"median slip modulus (L = {scale:g} m)"

    def take(self, table: pl.DataFrame, view: tuple[str, str]) -> pl.DataFrame:
        """Rows of `levels` or `comparisons` of one view."""
        source, quantity = view
        return table.filter(pl.col("input").cast(pl.String) == source, pl.col("quantity") == quantity)


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
    families = _find_families(compared, untested)
    return _Comparison(compared, question, untested, families, runs, notes).answer()


@dataclass
class _Comparison:
    """A comparison in the making: the runs with their measures, and notes that grow with what is found."""

    compared: ComparedRuns
    question: Question
    untested: frozenset[frozenset[str]]
    families: dict[str, tuple[str, ...]]
    runs: pl.DataFrame
    notes: list[str]

    def answer(self) -> Answer:
        """Compare slip on the inputs, each as driven and at equal driving, or the norms as published."""
        tables: dict[tuple[str, str], pl.DataFrame] = {}
        levels: list[pl.DataFrame] = []
        if self.question.as_published:
            main, inputs = "command", ["command"]
            samples = self._follow_published()
            groups = self._group(samples, main, AS_PUBLISHED)
            tables[main, AS_PUBLISHED] = self._compare(groups, main, AS_PUBLISHED)
            levels.append(_bound_published(groups, self.families))
        else:
            main = self.question.input or choose_input(self.runs)
            others = {"command", "measured"} & set(self.runs["input"].cast(pl.String)) - {main}
            inputs = [main, *(sorted(others) if self.question.input is None else ())]
            self.notes += _doubt_commands(self.compared) if "command" in inputs else []
        within: Bounds = {}
        norms_within: Bounds = {}
        for name in inputs:
            moduli = _read_samples(self.compared, name)
            within |= self._bound_single(moduli, name)
            norms_within |= self._bound_single(_read_samples(self.compared, name, *_NORMS), name)
            if not self.question.as_published:
                groups = self._group(moduli, name, AS_DRIVEN)
                tables[name, AS_DRIVEN] = self._compare(groups, name, AS_DRIVEN)
        datasets = pool_runs(self.runs, self.question.by, within=within, norms_within=norms_within)
        if not self.question.as_published:
            at_equal = self._level_driving(inputs, tables)
            datasets = datasets.update(at_equal, on=["dataset", "input"])
            levels += [_list_levels(datasets, *view) for view in tables]
        return Answer(
            views=tuple(tables),
            datasets=datasets,
            levels=pl.concat(levels),
            comparisons=pl.concat(tables.values()),
            families=self.families,
            runs=self.runs,
            features=_list_features(self.compared, self.runs),
            notes=(
                *self.compared.count_omitted(self.runs["run"].n_unique()),
                *self.compared.notes,
                *dict.fromkeys(self.notes),
                *note_untested(self.untested),
            ),
        )

    def _follow_published(self) -> dict[str, SlipSamples]:
        """Window norms of the published processing chain for every run that it applies to."""
        samples: dict[str, SlipSamples] = {}
        self.notes.append(ABOUT_UNIT)
        scaled_runs = _find_scaled(self.compared)
        for run, manifest in self.compared.manifests.items():
            followed = follow_published(
                manifest.read("slip"),
                manifest.read("poses"),
                limits=read_limits(manifest.part("vehicle")),
                command_is_scaled=run in scaled_runs,
            )
            if followed is None:
                continue
            samples[run] = _take_samples(followed.norms["t_start"], followed.norms["window_norm"])
            forward, turning = followed.scale
            scaled = f", command scaled by {forward:.2f} forward and {turning:.2f} in yaw"
            text = f"published chain, {run}: wheels lag with tau = {followed.tau_s:.2f} s"
            self.notes.append(text + scaled * (followed.scale != (1.0, 1.0)))
        medians = pl.DataFrame(
            {"run": list(samples), AS_PUBLISHED: [float(np.median(own.values)) for own in samples.values()]},
            schema={"run": pl.String, AS_PUBLISHED: pl.Float64},
        ).with_columns(pl.lit("command").cast(self.runs.schema["input"]).alias("input"))
        self.runs = self.runs.update(medians, on=["run", "input"])
        return samples

    def _group(self, samples: Mapping[str, SlipSamples], name: str, quantity: str) -> list[Group]:
        if missing := sorted(set(self.compared.manifests) - set(samples)):
            what = f"no {quantity.replace('_', ' ')} on {name}"
            self.notes.append(f"{', '.join(missing)} not compared: {what}")
        known = self.compared.labels.filter(pl.col("run").is_in(list(samples))).sort("group", "run")
        return [
            Group.of_runs(str(group), [samples[run] for run in rows["run"]])
            for (group,), rows in known.partition_by("group", as_dict=True, maintain_order=True).items()
        ]

    def _compare(
        self,
        groups: Sequence[Group],
        name: str,
        quantity: str,
        levelled: Mapping[str, Levelled] | None = None,
        bins: pl.DataFrame | None = None,
    ) -> pl.DataFrame:
        """Table `comparisons` of the groups by a quantity on an input, and notes on what it cannot tell."""
        overlaps = None
        if bins is not None:
            # Of all that the two drove, whoever else is compared: a pair has one number.
            overlaps = {
                frozenset((a.name, b.name)): find_overlap(bins, a.names, b.names)
                for a, b in itertools.combinations(groups, 2)
            }
        rows = compare_groups(groups, untested=self.untested, overlaps=overlaps, levelled=levelled)
        if len(groups) == 1:
            self.notes.append("there is one dataset only: nothing to compare it with")
        silent = group_by(
            (str(row["note"]), f"{row['a']} and {row['b']}") for row in rows if row["p"] is None
        )
        for note, (first, *others) in sorted(silent.items()):
            others_text = f", and {format_count(len(others), 'more pair')}" if others else ""
            self.notes.append(f"{first}{others_text}, {QUANTITIES[quantity]}: {note}")
        single = sorted({str(row[k]) for row in rows if row["unit_of_analysis"] == BLOCKS for k in "ab"})
        if single:
            names = ", ".join(single)
            self.notes.append(f"one run only: {names}; their intervals describe the run, not the terrain")
        named = self.compared.labels.with_columns(pl.concat_str("run", "key", separator="/").alias("keyed"))
        keys = dict(named.group_by("group").agg(pl.col("keyed").sort().str.join(" ")).iter_rows())
        return tabulate_pairs(rows, by=self.question.by, input_name=name, quantity=quantity, keys=keys)

    def _bound_single(self, samples: Mapping[str, SlipSamples], name: str) -> Bounds:
        """Intervals of medians of runs that are alone in their dataset: of the run, not of its terrain."""
        alone = self.compared.labels.filter(pl.len().over("group") == 1)["run"]
        ends = {run: samples[run].bound() for run in alone if run in samples}
        return {(run, name): one for run, one in ends.items() if one is not None}

    def _level_driving(
        self, inputs: Sequence[str], tables: dict[tuple[str, str], pl.DataFrame]
    ) -> pl.DataFrame:
        """Compare levels at equal driving; those of the datasets, with their intervals."""
        labels = self.compared.labels.select("run", "group")
        bins = measure_bins(self.compared.scan("slip")).join(labels, on="run", maintain_order="left")
        source = self.runs.schema["input"]
        rows: list[tuple[str, str, float, float | None, float | None]] = []
        for name in inputs:
            driven: dict[str, Levelled] = {}
            groups: list[Group] = []
            for datasets in self.families.values():
                own = bins.filter(pl.col("input") == name, pl.col("group").is_in(list(datasets)))
                levelled = level_runs(own)
                if levelled.apart:
                    why = f"a cell of driving counts from {FEWEST_OF_SPREAD} runs on"
                    alone = ", ".join(levelled.apart)
                    self.notes.append(f"no level at equal driving, too little in common ({why}): {alone}")
                driven |= dict.fromkeys(datasets, levelled)
                known = levelled.runs.join(labels, on="run").sort("group", "run")
                family = [
                    Group(str(group), part["level"].to_numpy(), names=tuple(part["run"]))
                    for (group,), part in known.partition_by(
                        "group", as_dict=True, maintain_order=True
                    ).items()
                ]
                for group, (level, ends) in zip(
                    family, level_groups(family, levelled) if family else (), strict=True
                ):
                    rows.append((group.name, name, level, *(ends or (None, None))))
                groups += family
                levels = levelled.runs.select(
                    "run", pl.lit(name).cast(source).alias("input"), pl.col("level").alias(EQUAL_DRIVING)
                )
                self.runs = self.runs.update(levels, on=["run", "input"])
            groups.sort(key=lambda group: group.name)
            tables[name, EQUAL_DRIVING] = self._compare(
                groups, name, EQUAL_DRIVING, driven, bins.filter(pl.col("input") == name)
            )
        if short := sorted(set(self.compared.manifests) - set(bins["run"])):
            runs = ", ".join(short)
            self.notes.append(f"no level at equal driving, too little driving on commands: {runs}")
        kinds = {"dataset": pl.String, "input": pl.String}
        numbers = dict.fromkeys((EQUAL_DRIVING, "equal_low", "equal_high"), pl.Float64)
        return pl.DataFrame(rows, schema={**kinds, **numbers}, orient="row").with_columns(
            pl.col("input").cast(source)
        )


def _read_samples(
    compared: ComparedRuns, input_name: str, table: str = "slip", time: str = "t", value: str = "modulus"
) -> dict[str, SlipSamples]:
    """Sound samples of every run on one input: slip moduli by default."""
    frame = (
        compared.scan(table)
        .filter(pl.col("input") == input_name, COUNTED, pl.col(value).is_finite())
        .select("run", time, value)
        .collect()
    )
    return {
        str(run): _take_samples(part[time], part[value])
        for (run,), part in frame.partition_by("run", as_dict=True, maintain_order=True).items()
        if part.height >= _FEWEST
    }


def _take_samples(times: pl.Series, values: pl.Series) -> SlipSamples:
    order = times.arg_sort()
    return SlipSamples(values[order].to_numpy(), times[order].to_numpy())


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
    sets = connect_groups([*pairs, *((i, i) for i in range(len(names)))])
    families: dict[str, tuple[str, ...]] = {}
    for members in sets:
        datasets = tuple(names[i] for i in members)
        own = compared.labels.filter(pl.col("group").is_in(list(datasets)))
        vehicle = ", ".join(sorted(set(own["vehicle"])))
        # Datasets of a vehicle that have nothing to be compared with would share its name.
        families[vehicle if vehicle not in families else f"{vehicle}: {datasets[0]}"] = datasets
    return families


def _find_scaled(compared: ComparedRuns) -> list[str]:
    """Runs whose recorded command was multiplied by a scale; one that is only told changes no command."""
    rows = compared.scan("findings").filter(pl.col("id") == "command_scale").collect()
    return sorted(
        str(run)
        for (run,), part in rows.partition_by("run", as_dict=True).items()
        if any(one.values.get("kind") in _APPLIED for one in read_finding_table(part))
    )


def _doubt_commands(compared: ComparedRuns) -> list[str]:
    """Warn of runs whose recorded command was rescaled: their slip from commands rests on an estimate."""
    runs = _find_scaled(compared)
    text = "read with care, the recorded command had another scale, which was estimated and corrected"
    return [f"{text} (--input measured does without): {', '.join(runs)}"] if runs else []


def _list_levels(datasets: pl.DataFrame, input_name: str, quantity: str) -> pl.DataFrame:
    """Value and interval of a quantity, one row per dataset that has it."""
    low, high, about = ("low", "high", pl.col("interval"))
    if quantity == EQUAL_DRIVING:
        about = pl.col("runs").map_elements(name_interval, return_dtype=pl.String)
        low, high = ("equal_low", "equal_high")
    return datasets.filter(pl.col("input") == input_name, pl.col(quantity).is_not_null()).select(
        pl.lit(input_name).alias("input"),
        pl.lit(quantity).alias("quantity"),
        "dataset",
        pl.col(quantity).alias("value"),
        pl.col(low).alias("low"),
        pl.col(high).alias("high"),
        pl.when(pl.col(low).is_null()).then(pl.lit("")).otherwise(about).alias("interval"),
    )


def _bound_published(groups: Sequence[Group], families: Mapping[str, Sequence[str]]) -> pl.DataFrame:
    """Value and interval of the published norm, one row per dataset."""
    rows = []
    for datasets in families.values():
        own = [group for group in groups if group.name in datasets]
        for group, ends in zip(own, bound_groups([group.values for group in own]), strict=True):
            single = group.runs[0].bound() if len(group.runs) == 1 and ends is None else None
            about = name_interval(len(group.runs)) if ends else THIS_RUN if single else ""
            low, high = ends or single or (None, None)
            rows.append(
                ("command", AS_PUBLISHED, group.name, float(np.median(group.values)), low, high, about)
            )
    texts = dict.fromkeys(("input", "quantity", "dataset"), pl.String)
    numbers = dict.fromkeys(("value", "low", "high"), pl.Float64)
    return pl.DataFrame(rows, schema={**texts, **numbers, "interval": pl.String}, orient="row").sort(
        "dataset"
    )


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
