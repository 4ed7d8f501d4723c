"""Comparison of deployments by cause: slip budgets, and the decomposition of their differences.

Runs are the unit. The mean square slip of a deployment is the mean over its runs, per cause. The difference
of two mean squares is the sum of the differences per cause. A difference of two roots is the difference of
their squares over the sum of the roots, so the difference of RMS slip is additive over causes as well.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import polars as pl

from pipeline.core import (
    FEWEST_OF_SPREAD,
    Floats,
    finite_or_none,
    format_share,
    format_two,
    group_by,
    name_first,
    pick,
    pick_finite,
)
from pipeline.datasets.compared_runs import (
    ComparedRuns,
    Question,
    choose_input,
    choose_runs,
    find_material,
    find_untested,
    keep_runs,
    note_untested,
)
from pipeline.datasets.pairs import ABOUT_BLOCKS, BLOCKS, NO_SPREAD, RUNS
from pipeline.datasets.pooled_tests import compare_means, pool_spread
from pipeline.datasets.prediction import fit_results
from pipeline.datasets.rank_tests import LEVEL, adjust_holm
from pipeline.estimation.apportion import jackknife_ratio
from pipeline.models import list_effects, name_effect
from pipeline.results import CAUSE_NAMES
from pipeline.store import NoRunsError, Store, lack_runs

_LEAST_SHOWN = 0.05
"""Minimum share of a difference for a cause to be reported; twice that share could omit a tenth of it."""
_JACKKNIFE = "jackknife over the blocks of each run"
_NO_PART = 0.01
"""Share of a difference below which a cause is reported as no contribution: it would round to 0 or 1 %."""


@dataclass(frozen=True)
class CausePart:
    """Share of a cause in a deployment's mean square slip; unknown bounds are NaN."""

    name: str
    kind: str
    share: float
    low: float
    high: float


@dataclass(frozen=True)
class Budget:
    """A deployment's mean square slip by cause.

    Attributes:
        dataset: its name.
        runs: number of runs.
        total: mean over the runs of their mean square slip [m^2/s^2].
        parts: effects in descending order, then disturbance and localization noise; shares add up to one.
        unit: whether intervals are over runs, or over blocks of a single run.
    """

    dataset: str
    runs: int
    total: float
    parts: tuple[CausePart, ...]
    unit: str


@dataclass(frozen=True)
class CauseDifference:
    """Contribution of a cause to the difference of two deployments [m/s].

    ``p`` is NaN if it is not tested; ``method`` is the test, or what the interval is made of, and empty
    without either.
    """

    name: str
    kind: str
    difference: float
    low: float
    high: float
    p: float
    p_adjusted: float
    method: str


@dataclass(frozen=True)
class Difference:
    """Difference of the RMS slip of ``b`` and ``a``, by cause.

    Attributes:
        a, b: datasets; b has the larger slip.
        total: difference of RMS slip [m/s].
        parts: causes in descending order; they add up to the total.
        unit: unit of the tests and of the intervals.
        note: what these numbers of runs cannot show; empty where there is no limitation.
    """

    a: str
    b: str
    total: float
    parts: tuple[CauseDifference, ...]
    unit: str
    note: str

    def describe(self, names: Mapping[str, str]) -> str:
        """Describe the difference in words, and which of its parts are significant.

        Args:
            names: display name of each cause.
        """
        largest = max((abs(part.difference) for part in self.parts), default=0.0)
        if largest == 0.0:
            return f"{self.b} and {self.a}: the same slip, and the same from each cause"
        start = f"{self.b} has {format_two(self.total)} m/s more RMS slip than {self.a}"
        untested = [names[part.name] for part in self.parts if not math.isfinite(part.p)]
        end = ""
        if len(untested) < len(self.parts):
            sure = [names[part.name] for part in self.parts if part.p_adjusted <= LEVEL]
            end = f"; significant: {', '.join(sure) or 'none'}"
            end += f"; not tested: {', '.join(untested)}" * bool(untested)
        if largest > self.total:
            # A single cause exceeds the total difference: shares would be meaningless.
            words = ", ".join(
                f"{'+' * (part.difference >= 0.0)}{format_two(part.difference)} {names[part.name]}"
                for part in self.parts
                if abs(part.difference) >= _LEAST_SHOWN * largest
            )
            return f"{start}; by cause in m/s: {words}{end}"
        main_parts = [part for part in self.parts if abs(part.difference) >= _LEAST_SHOWN * self.total]
        none = [names[part.name] for part in self.parts if abs(part.difference) < _NO_PART * self.total]
        words = ", ".join(
            f"{format_share(part.difference / self.total, 0)} {names[part.name]}" for part in main_parts
        )
        rest = f"; no contribution: {name_first(none)}" if none else ""
        return f"{start}: {words}{rest}{end}"

    def describe_tests(self, names: Mapping[str, str]) -> str:
        """By which tests the causes were compared; where none was possible, why, and what intervals are of.

        Args:
            names: display name of each cause.
        """
        judged = [part for part in self.parts if math.isfinite(part.p)]
        if not judged:
            methods = dict.fromkeys(part.method for part in self.parts if part.method)
            return "; ".join([self.note, *(f"intervals by {method}" for method in methods)])
        causes = group_by((part.method, names[part.name]) for part in judged)
        usual = max(causes, key=lambda method: len(causes[method]))
        others = [f"; {', '.join(own)} by {method}" for method, own in causes.items() if method != usual]
        return f"tested by {usual}{''.join(others)}; p after Holm over the causes of a pair"


def compare_causes(
    rows: pl.DataFrame, *, untested: Collection[frozenset[str]] = ()
) -> tuple[tuple[Budget, ...], tuple[Difference, ...]]:
    """Return the budgets of deployments and the decomposition of the difference of two, tested ones first.

    A cause that is absent from a run contributes zero there; its slip is part of that run's disturbance.

    Args:
        rows: rows of one input and quantity: ``group``, ``run``, ``name``, ``kind``, ``mean_square``,
            ``low``, ``high`` (bounds of the share).
        untested: pairs of deployments that are not compared.
    """
    groups = _gather(rows)
    pairs = [(a, b) for a, b in _pair(groups) if frozenset((a.name, b.name)) not in untested]
    differences = sorted((_compare(a, b) for a, b in pairs), key=lambda one: bool(one.note))
    return tuple(group.describe() for group in groups), tuple(differences)


@dataclass(frozen=True)
class Carrier:
    """The cause with the largest part in a difference of two deployments.

    Attributes:
        name: the cause.
        difference: its part of the difference of RMS slip [m/s], of the deployment with more over the other.
    """

    name: str
    difference: float


def find_carriers(rows: pl.DataFrame) -> dict[frozenset[str], Carrier]:
    """The cause that carries the difference of every two deployments, without a test.

    Args:
        rows: as for `compare_causes`.
    """
    carriers = {}
    for a, b in _pair(_gather(rows)):
        differences = _subtract(a, b)
        largest = max(differences, key=lambda cause: differences[cause])
        carriers[frozenset((a.name, b.name))] = Carrier(largest[0], _scale(a, b) * differences[largest])
    return carriers


@dataclass(frozen=True)
class _Group:
    """Runs of a deployment: mean squares by run and cause, shape (runs, causes), and their half-widths."""

    name: str
    causes: tuple[tuple[str, str], ...]
    table: Floats
    half: Floats

    @classmethod
    def gather(cls, name: str, rows: pl.DataFrame) -> _Group:
        """Build the group from its rows."""
        causes = tuple(dict.fromkeys(rows.select("name", "kind").iter_rows()))
        runs = rows["run"].unique(maintain_order=True).to_list()
        table, half = np.zeros((len(runs), len(causes))), np.full((len(runs), len(causes)), np.nan)
        totals = dict(rows.group_by("run").agg(pl.col("mean_square").sum()).iter_rows())
        for row in rows.iter_rows(named=True):
            cell = runs.index(row["run"]), causes.index((row["name"], row["kind"]))
            table[cell] = row["mean_square"]
            if row["low"] is not None and row["high"] is not None:
                half[cell] = 0.5 * (row["high"] - row["low"]) * totals[row["run"]]
        return cls(name, causes, table, half)

    @property
    def mean_square(self) -> float:
        """Mean over the runs of their mean square slip [m^2/s^2]."""
        return float(self.table.sum(axis=1).mean())

    def take(self, cause: tuple[str, str]) -> tuple[Floats, Floats]:
        """Mean squares of a cause in every run, and their half-widths; zeros where the cause is absent."""
        if cause not in self.causes:
            return np.zeros(self.table.shape[0]), np.zeros(self.table.shape[0])
        index = self.causes.index(cause)
        return self.table[:, index], self.half[:, index]

    def describe(self) -> Budget:
        """Return the budget."""
        whole = self.table.sum(axis=1)
        parts = []
        for index, (name, kind) in enumerate(self.causes):
            share, half = jackknife_ratio(self.table[:, index], whole)
            if whole.size == 1:
                half = float(self.half[0, index] / whole[0])
            elif whole.size < FEWEST_OF_SPREAD:
                half = math.nan
            parts.append(CausePart(name, kind, share, share - half, share + half))
        parts.sort(key=lambda part: (part.kind != "effect", part.kind, -part.share))
        unit = BLOCKS if whole.size == 1 else RUNS
        return Budget(self.name, whole.size, float(whole.mean()), tuple(parts), unit)


def _gather(rows: pl.DataFrame) -> list[_Group]:
    own = rows.sort("group", "run").partition_by("group", maintain_order=True)
    return [_Group.gather(str(one["group"][0]), one) for one in own]


def _pair(groups: Sequence[_Group]) -> Iterator[tuple[_Group, _Group]]:
    """Every two groups, the one with less slip first."""
    for pair in combinations(groups, 2):
        easier, harder = sorted(pair, key=lambda group: group.mean_square)
        yield easier, harder


def _subtract(a: _Group, b: _Group) -> dict[tuple[str, str], float]:
    """Difference of the mean squares of ``b`` and ``a`` by cause [m^2/s^2]."""
    causes = dict.fromkeys((*a.causes, *b.causes))
    return {cause: float(b.take(cause)[0].mean() - a.take(cause)[0].mean()) for cause in causes}


def _scale(a: _Group, b: _Group) -> float:
    """Factor from differences of mean squares to those of root mean squares [s/m]."""
    return 1.0 / max(math.sqrt(a.mean_square) + math.sqrt(b.mean_square), 1e-300)


def _compare(a: _Group, b: _Group) -> Difference:
    total, scale = math.sqrt(b.mean_square) - math.sqrt(a.mean_square), _scale(a, b)
    single = a.table.shape[0] == b.table.shape[0] == 1
    squares = _subtract(a, b)
    tests: list[tuple[float, float, float, str]] = []
    for cause, difference in squares.items():
        (first, half_first), (second, half_second) = a.take(cause), b.take(cause)
        low = high = p = math.nan
        method = ""
        if single:
            half = float(np.hypot(half_first[0], half_second[0]))
            low, high = difference - half, difference + half
            method = _JACKKNIFE * math.isfinite(half)
        elif pool_spread([first, second])[1]:
            test = compare_means([first, second], [(0, 1)], tests=len(squares))
            # Zeros of a cause that no run has do not scatter: they tell no spread of the other side.
            if not test.is_pooled or (first.any() and second.any()):
                (outcome,) = test.differences
                p, ends, method = outcome.p, outcome.interval, test.method
                low, high = (low, high) if ends is None else (ends.low, ends.high)
        tests.append((low, high, p, method))
    values = np.array([p for *_, p, _ in tests])
    known = np.isfinite(values)
    adjusted = np.full(known.size, np.nan)
    adjusted[known] = adjust_holm(values[known])
    parts = [
        CauseDifference(name, kind, scale * difference, scale * low, scale * high, p, q, method)
        for ((name, kind), difference), (low, high, p, method), q in zip(
            squares.items(), tests, adjusted.tolist(), strict=True
        )
    ]
    parts.sort(key=lambda part: -abs(part.difference))
    note = ABOUT_BLOCKS if single else "" if known.any() else NO_SPREAD
    return Difference(a.name, b.name, total, tuple(parts), BLOCKS if single else RUNS, note)


@dataclass(frozen=True)
class Causes:
    """Comparison of deployments by cause.

    Attributes:
        budgets: budget of every dataset.
        differences: comparison of every two datasets.
        input: input u of the model.
        names: display names of effects by level, where they differ from the id and vehicles agree.
        keys: run/generation of every run.
        notes: remarks for the reader.
    """

    budgets: tuple[Budget, ...]
    differences: tuple[Difference, ...]
    input: str
    names: Mapping[str, str]
    keys: tuple[str, ...]
    notes: tuple[str, ...]


def read_budgets(compared: ComparedRuns) -> pl.DataFrame:
    """Rows of the slip's budget of every run, with ``group``; no columns without runs."""
    if not compared.manifests:
        return pl.DataFrame()
    return (
        compared.scan("budget")
        .filter(pl.col("quantity").cast(pl.String) == "slip")
        .with_columns(pl.col("input", "kind").cast(pl.String))
        .collect()
        .join(compared.labels.select("run", "group"), on="run")
    )


def find_level_names(store: Store) -> dict[str, str]:
    """Names of effects that the fleet model labels by their level, or by all candidate levels."""
    names_by_effect: dict[str, set[str]] = {}
    # Without estimates effects have no levels.
    with contextlib.suppress(NoRunsError):
        for number in fit_results(store)[0].numbers:
            names_by_effect.setdefault(number.effect, set()).add(number.name)
    called = {
        effect: name
        for effect, names in names_by_effect.items()
        for name in names
        if names == {name} != {effect}
    }
    return called | CAUSE_NAMES


def name_causes(level_names: Mapping[str, str]) -> dict[str, str]:
    """What effects and the other causes of slip are called within a sentence, by their levels where known."""
    words = {effect.id: name_effect(effect.id) for effect in list_effects()}
    names = {effect: name[:1].lower() + name[1:] for effect, name in words.items()}
    return names | {effect: name.replace("_", " ") for effect, name in level_names.items()}


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
    compared = find_material(
        store, question.by, trusted_only=True, tables=("budget", "estimates"), vehicle=question.vehicle
    )
    compared = choose_runs(compared, question.vehicle, question.datasets)
    rows = read_budgets(compared)
    if rows.is_empty():
        hint = "Analyze logs with their diagnosis: slip analyze LOG... --terrain NAME."
        what = "no run has a budget of its slip"
        raise lack_runs("nothing_to_compare", what, store.root, hint, compared.notes)
    source = question.input or choose_input(rows)
    own = rows.filter(pl.col("input") == source)
    compared = keep_runs(compared, own["run"].unique().to_list(), f"no budget of its slip on {source}")
    if own.is_empty():
        what = f"no run has a budget of its slip on {source}"
        raise lack_runs("nothing_to_compare", what, store.root, "Choose the other input.")
    untested = find_untested(compared, question)
    budgets, differences = compare_causes(own, untested=untested)
    notes = (*compared.notes, *note_untested(untested))
    return Causes(budgets, differences, source, find_level_names(store), compared.keys, notes)


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
                        "method": part.method or None,
                    }
                    for part in one.parts
                ],
                "unit_of_analysis": one.unit,
                "note": one.note or None,
                "sentence": format_difference(one, causes.names),
                "tests": one.describe_tests(_name_parts(one, causes.names)),
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
    return one.describe(_name_parts(one, names))


def list_differences(differences: Sequence[Difference], names: Mapping[str, str]) -> list[str]:
    """Texts of differences, and after all those that were tested alike how they were."""
    by_tests = group_by(
        (one.describe_tests(_name_parts(one, names)), format_difference(one, names)) for one in differences
    )
    return [text for tests, texts in by_tests.items() for text in (*texts, tests[:1].upper() + tests[1:])]


def _name_parts(one: Difference, names: Mapping[str, str]) -> dict[str, str]:
    return {part.name: names.get(part.name, part.name) for part in one.parts}


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
         finite_or_none(part.high), finite_or_none(part.p), finite_or_none(part.p_adjusted), one.unit,
         part.method or None)
        for one in causes.differences
        for part in one.parts
    ]  # fmt: skip
    numbers = dict.fromkeys(("difference", "low", "high", "p", "p_adjusted"), pl.Float64)
    texts = dict.fromkeys(("a", "b", "cause"), pl.String)
    words = dict.fromkeys(("unit_of_analysis", "method"), pl.String)
    return pl.DataFrame(rows, schema={**texts, **numbers, **words}, orient="row")
