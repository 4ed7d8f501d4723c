"""Deployments compared by cause: budgets of their slip, and what the difference of two is made of.

Runs are the unit. The mean square slip of a deployment is the mean over its runs, per cause; the difference
of two is the sum of the differences per cause. The difference of two roots is that of their squares over the
sum of the roots, so that they add up over causes as well.
"""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.core import FEWEST_OF_SPREAD, Floats, finite_or_none, format_two
from pipeline.datasets.compared_runs import (
    Question,
    choose_input,
    choose_runs,
    find_material,
    find_untested,
    keep_runs,
    note_untested,
)
from pipeline.datasets.fleet import fit_results, name_levels
from pipeline.datasets.levels import LEVEL, adjust, fit_levels
from pipeline.datasets.pairs import BLOCKS, RUNS
from pipeline.estimation.apportion import jackknife_ratio
from pipeline.models import list_effects, name_effect
from pipeline.results import BUDGET_SLIP, CAUSE_NAMES
from pipeline.store import NoRunsError, Store, lack_runs

_LEAST_SHOWN = 0.05
"""Share of the largest part of a difference from which on a cause is named in a sentence."""
Ends = tuple[float | None, float | None]


@dataclass(frozen=True)
class CausePart:
    """A cause of a budget, with its share of the mean square; or of a difference, with its part [m/s].

    ``p_adjusted`` is over the causes of a pair (Benjamini and Hochberg); None of a budget, or where not
    tested.
    """

    name: str
    kind: str
    value: float
    low: float | None
    high: float | None
    p_adjusted: float | None = None


@dataclass(frozen=True)
class Budget:
    """A deployment's mean square slip [m^2/s^2] by cause, effects first; its unit is `RUNS` or `BLOCKS`."""

    dataset: str
    runs: int
    total: float
    parts: tuple[CausePart, ...]
    unit: str


@dataclass(frozen=True)
class CauseDifference:
    """Difference of `BUDGET_SLIP` of ``b``, which has more, and ``a`` [m/s], by cause, the largest first."""

    a: str
    b: str
    total: float
    parts: tuple[CausePart, ...]
    unit: str

    def describe(self, names: Mapping[str, str]) -> str:
        """The difference in words, and which of its parts are significant; causes by these names."""
        least = _LEAST_SHOWN * max((abs(part.value) for part in self.parts), default=0.0)
        texts = [
            f"{'+' * (part.value >= 0.0)}{format_two(part.value)} {names.get(part.name, part.name)}"
            for part in self.parts
            if abs(part.value) >= least > 0.0
        ]
        judged = [part for part in self.parts if part.p_adjusted is not None]
        sure = [names.get(one.name, one.name) for one in judged if (one.p_adjusted or 0.0) <= LEVEL]
        end = f"significant: {', '.join(sure) or 'none'}" if judged else "too few runs for a test"
        whole = f"{self.b} has {format_two(self.total)} m/s more {BUDGET_SLIP} than {self.a}"
        return f"{whole}; by cause in m/s: {', '.join(texts) or 'none'}; {end}"


@dataclass(frozen=True)
class Causes:
    """Comparison of deployments by cause, on an input; effects have names by their levels."""

    budgets: tuple[Budget, ...]
    differences: tuple[CauseDifference, ...]
    input: str
    names: Mapping[str, str]
    keys: tuple[str, ...]
    notes: tuple[str, ...]

    def to_json(self) -> dict[str, object]:
        """The JSON object of `slip compare --causes`."""

        def show(part: CausePart, key: str) -> dict[str, object]:
            return {key: part.value, "low": part.low, "high": part.high}

        return {
            "input": self.input,
            "budgets": [
                {
                    "dataset": one.dataset,
                    "runs": one.runs,
                    "total": one.total,
                    "unit": "m^2/s^2",
                    "shares": [
                        {"effect": part.name, **show(part, "share")}
                        for part in one.parts
                        if part.kind == "effect"
                    ],
                    **{part.name: show(part, "share") for part in one.parts if part.kind != "effect"},
                    "unit_of_analysis": one.unit,
                }
                for one in self.budgets
            ],
            "differences": [
                {
                    "a": one.a,
                    "b": one.b,
                    "total": one.total,
                    "unit": "m/s",
                    "by_effect": [
                        {"effect": part.name, **show(part, "difference"), "p_adjusted": part.p_adjusted}
                        for part in one.parts
                    ],
                    "unit_of_analysis": one.unit,
                    "sentence": one.describe(self.names),
                }
                for one in self.differences
            ],
            "notes": list(self.notes),
        }

    def tabulate(self, *, differences: bool) -> pl.DataFrame:
        """All parts of the budgets, or of the differences, one row each."""
        kinds: dict[str, type[pl.DataType]] = {"dataset": pl.String, "cause": pl.String}
        numbers = ("difference", "low", "high", "p_adjusted") if differences else ("share", "low", "high")
        rows = [
            (name, self.names.get(part.name, part.name), part.value, part.low, part.high, part.p_adjusted)[
                : 2 + len(numbers)
            ]
            for name, parts in (
                [(f"{one.b} \u2212 {one.a}", one.parts) for one in self.differences]
                if differences
                else [(one.dataset, one.parts) for one in self.budgets]
            )
            for part in parts
        ]
        return pl.DataFrame(rows, schema=kinds | dict.fromkeys(numbers, pl.Float64), orient="row")


@dataclass(frozen=True)
class _Group:
    """Runs of a deployment: mean squares and half-widths of their intervals, shape (runs, causes)."""

    name: str
    table: Floats
    half: Floats

    @property
    def mean_square(self) -> float:
        return float(self.table.sum(axis=1).mean())

    @property
    def is_single(self) -> bool:
        return len(self.table) == 1


def compare_causes(
    rows: pl.DataFrame, *, untested: Collection[frozenset[str]] = ()
) -> tuple[tuple[Budget, ...], tuple[CauseDifference, ...]]:
    """The budgets of deployments, and what the differences of two are made of.

    A cause that is absent from a run contributes zero there; its slip is part of that run's disturbance.

    Args:
        rows: of one input and quantity: ``group``, ``run``, ``name``, ``kind``, ``mean_square``, ``low``,
            ``high`` (bounds of the share).
        untested: pairs of deployments that are not compared.
    """
    causes = sorted(set(rows.select("name", "kind").iter_rows()), key=lambda one: (one[1] != "effect", one))
    whole = rows.with_columns(
        half=0.5 * (pl.col("high") - pl.col("low")) * pl.col("mean_square").sum().over("run"),
        cause=pl.concat_str("name", "kind", separator="\n"),
    )
    columns = [f"{name}\n{kind}" for name, kind in causes]
    groups = []
    for (name,), own in (
        whole.sort("group", "run").partition_by("group", as_dict=True, maintain_order=True).items()
    ):
        tables = [
            own.pivot("cause", index="run", values=value)
            .select(
                pl.col(one) if one in set(own["cause"]) else pl.lit(None, pl.Float64).alias(one)
                for one in columns
            )
            .to_numpy()
            for value in ("mean_square", "half")
        ]
        absent = np.isnan(tables[0])
        halves = np.where(absent, 0.0, tables[1])
        groups.append(_Group(str(name), np.where(absent, 0.0, tables[0]), halves))
    pairs = [
        sorted(pair, key=lambda group: group.mean_square)
        for pair in itertools.combinations(groups, 2)
        if frozenset(group.name for group in pair) not in untested
    ]
    budgets = tuple(_describe(group, causes) for group in groups)
    return budgets, tuple(_compare(a, b, causes) for a, b in pairs)


def _describe(group: _Group, causes: Sequence[tuple[str, str]]) -> Budget:
    whole = group.table.sum(axis=1)
    parts = []
    for index, (name, kind) in enumerate(causes):
        if not group.table[:, index].any() and kind == "effect":
            continue
        share, half = jackknife_ratio(group.table[:, index], whole)
        if whole.size < FEWEST_OF_SPREAD:
            half = float(group.half[0, index] / whole[0]) if group.is_single else math.nan
        parts.append(CausePart(name, kind, share, finite_or_none(share - half), finite_or_none(share + half)))
    parts.sort(key=lambda part: (part.kind != "effect", part.kind, -part.value))
    return Budget(
        group.name, whole.size, float(whole.mean()), tuple(parts), BLOCKS if group.is_single else RUNS
    )


def _compare(a: _Group, b: _Group, causes: Sequence[tuple[str, str]]) -> CauseDifference:
    scale = 1.0 / max(math.sqrt(a.mean_square) + math.sqrt(b.mean_square), 1e-300)
    tests = [_test(a, b, index) for index in range(len(causes))]
    adjusted = adjust([p for *_, p in tests])
    parts = [
        CausePart(
            name,
            kind,
            scale * value,
            None if low is None else scale * low,
            None if high is None else scale * high,
            adjusted[index],
        )
        for index, ((name, kind), (value, low, high, _)) in enumerate(zip(causes, tests, strict=True))
        if a.table[:, index].any() or b.table[:, index].any()
    ]
    parts.sort(key=lambda part: -abs(part.value))
    total = math.sqrt(b.mean_square) - math.sqrt(a.mean_square)
    return CauseDifference(
        a.name, b.name, total, tuple(parts), BLOCKS if a.is_single and b.is_single else RUNS
    )


def _test(a: _Group, b: _Group, index: int) -> tuple[float, float | None, float | None, float | None]:
    """Difference of the mean squares of a cause, its interval, and p; of single runs without a test."""
    from scipy.stats import ttest_1samp  # noqa: PLC0415 - heavy

    first, second = a.table[:, index], b.table[:, index]
    value = float(second.mean() - first.mean())
    if a.is_single and b.is_single:
        half = math.hypot(a.half[0, index], b.half[0, index])
        return value, finite_or_none(value - half), finite_or_none(value + half), None
    if first.any() and second.any():
        groups = ["a"] * first.size + ["b"] * second.size
        one = fit_levels(np.concatenate((first, second)), groups).compare("a", "b")
        return value, finite_or_none(one.low), finite_or_none(one.high), finite_or_none(one.p)
    # Zeros of a cause that no run of a side has do not scatter, and tell no spread of the other side.
    present, sign = (second, 1.0) if second.any() else (first, -1.0)
    if present.size < FEWEST_OF_SPREAD or np.ptp(present) == 0.0:
        return value, None, None, None
    test = ttest_1samp(sign * present, 0.0)
    ends = test.confidence_interval()
    return value, float(ends.low), float(ends.high), float(test.pvalue)


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
    compared = find_material(
        store, question.by, trusted_only=True, tables=("budget", "estimates"), vehicle=question.vehicle
    )
    compared = choose_runs(compared, question.vehicle, question.datasets)
    if not compared.manifests:
        hint = "Analyze logs with their diagnosis: slip analyze LOG... --terrain NAME."
        raise lack_runs(
            "nothing_to_compare", "no run has a budget of its slip", store.root, hint, compared.notes
        )
    rows = (
        compared.scan("budget")
        .filter(pl.col("quantity").cast(pl.String) == "slip")
        .with_columns(pl.col("input", "kind").cast(pl.String))
        .collect()
        .join(compared.labels.select("run", "group"), on="run")
    )
    source = question.input or choose_input(rows)
    own = rows.filter(pl.col("input") == source)
    compared = keep_runs(compared, own["run"].unique().to_list(), f"no budget of its slip on {source}")
    if own.is_empty():
        what = f"no run has a budget of its slip on {source}"
        raise lack_runs("nothing_to_compare", what, store.root, "Choose the other input.")
    untested = find_untested(compared, question)
    budgets, differences = compare_causes(own, untested=untested)
    notes = (*compared.count_omitted(len(compared.keys)), *compared.notes, *note_untested(untested))
    return Causes(budgets, differences, source, name_causes(store), compared.keys, notes)


def name_causes(store: Store) -> dict[str, str]:
    """What effects and the other causes of slip are called within a sentence, by their levels where known."""
    words = {effect.id: name_effect(effect.id) for effect in list_effects()}
    names = {effect: name[:1].lower() + name[1:] for effect, name in words.items()}
    try:
        levels = name_levels(fit_results(store).numbers)
    except NoRunsError:
        levels = {}
    return names | {effect: name.replace("_", " ") for effect, name in (levels | CAUSE_NAMES).items()}
