"""Pairwise comparison of groups of runs, tables of comparisons, and agreement on the order of terrains."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl
import polars.selectors as cs

from pipeline.core import FEWEST_OF_SPREAD, ROUNDING_S, STRETCH_S, Floats, number_in, pick
from pipeline.datasets.equal_driving import Levelled, Overlap
from pipeline.datasets.pooled_tests import (
    Difference,
    Errors,
    MeansTest,
    bound_levels,
    compare_means,
    exponentiate,
    foresee_significant,
    pool_spread,
    take_logarithms,
)
from pipeline.datasets.pooling import MEASURES
from pipeline.datasets.rank_tests import (
    LEVEL,
    Interval,
    cliffs_delta,
    connect_groups,
    kendall_p,
    kendall_tau,
    mann_whitney,
    name_delta,
    shift_between,
)
from schemas import contract_of

RUNS = "runs"
BLOCKS = "blocks"
PARTS = 8
"""Most parts of a single run: medians of eight equal parts of 2 to 10 minutes are called different in 4 to
7 % of equal runs whose slip remembers 0.5 to 2.5 s; all labellings of eight and eight can be counted."""
ABOUT_BLOCKS = "a difference between two runs, not between terrains"
NOT_SHARED = "no driving in common, no number"
NO_SPREAD = "too few runs to know how much runs differ: no test"
NO_SCATTER = "neither side has any variation: no test"
TOO_SHORT = (
    f"{ABOUT_BLOCKS}; too short for a test, "
    f"which takes {FEWEST_OF_SPREAD} stretches of {STRETCH_S:g} s of each"
)


@dataclass(frozen=True)
class Samples:
    """Samples of one run.

    Attributes:
        values: the compared quantity, ascending in time, shape (n,).
        duration_s: time that they stand for [s]: their number times their usual step, without gaps.
    """

    values: Floats
    duration_s: float

    @property
    def median(self) -> float:
        """Median of the run."""
        return float(np.median(self.values))

    def cut(self, length_s: float) -> Floats:
        """Medians of parts of equal length, evenly over the run.

        Args:
            length_s: length of a part [s].

        Returns:
            Shape (k,), at most `PARTS`; the median of the run where no part fits.
        """
        count = min(PARTS, int((self.duration_s + ROUNDING_S) // length_s), self.values.size)
        if count == 0:
            return np.array([self.median])
        size = min(max(round(self.values.size * length_s / self.duration_s), 1), self.values.size // count)
        first = (
            np.linspace(0.0, self.values.size - size, count).astype(np.int64)
            if count > 1
            else np.zeros(1, np.int64)
        )
        return np.array([np.median(self.values[at : at + size]) for at in first.tolist()])


@dataclass(frozen=True)
class Group:
    """Dataset as an input of the tests.

    Attributes:
        name: its name.
        values: the compared quantity of each run, shape (runs,).
        runs: samples of each run; empty where only the values are known.
        names: the runs' names, where errors of their values are known.
    """

    name: str
    values: Floats
    runs: tuple[Samples, ...] = ()
    names: tuple[str, ...] = ()

    @classmethod
    def of_runs(cls, name: str, runs: Sequence[Samples]) -> Group:
        """Group whose runs are compared by their medians."""
        return cls(name, np.array([run.median for run in runs]), tuple(runs))


@dataclass(frozen=True)
class Pair:
    """Comparison of two groups, as a row of the table `comparisons`; what is not known is None.

    Attributes:
        a, b: the groups.
        shift: Hodges-Lehmann shift b - a, in the unit of the values; None without a number.
        low, high: ends of the differences that the test does not reject; None where it can reject none.
        cliffs_delta: Cliff's delta of the units, above zero if b is larger; `size` is it in a word.
        ratio: geometric mean of the units of b over that of a; None if a value is not positive.
        ratio_low, ratio_high: its 95 % interval; None where no spread is known.
        p: p of the pair alone.
        p_adjusted: p corrected over the family of pairs.
        smallest_p: smallest p possible with these counts, whatever the difference.
        unit: `RUNS` or `BLOCKS`.
        method: test and correction in words.
        spread: standard deviation of the logarithm between runs of a group, pooled over the groups; at equal
            driving between those that are known as well as the median one.
        freedom: its degrees of freedom.
        p_uncorrected: plain Mann-Whitney over all samples; not valid.
        note: remark on the interpretation; may be empty.
        bins, overlap: driving in common, for a comparison at equal driving: see `Overlap`.
    """

    a: Group
    b: Group
    shift: float | None = None
    low: float | None = None
    high: float | None = None
    cliffs_delta: float | None = None
    size: str = ""
    ratio: float | None = None
    ratio_low: float | None = None
    ratio_high: float | None = None
    p: float | None = None
    p_adjusted: float | None = None
    smallest_p: float | None = None
    unit: str = RUNS
    method: str = ""
    spread: float | None = None
    freedom: int | None = None
    p_uncorrected: float | None = None
    note: str = ""
    bins: int | None = None
    overlap: float | None = None


def compare_groups(
    groups: Sequence[Group],
    *,
    untested: Collection[frozenset[str]] = (),
    overlaps: Mapping[frozenset[str], Overlap] | None = None,
    levelled: Mapping[str, Levelled] | None = None,
) -> list[Pair]:
    """Compare pairs of groups.

    Groups that tested pairs connect are one family. Where its groups have several runs, its units are the
    runs. Where every group is one run, they are the parts of each, and the result applies to these runs only.
    `compare_means` tests the pairs of a family with the spread between its units.

    Args:
        groups: groups of at least one run each.
        untested: names of pairs that are not compared.
        overlaps: driving in common by the names of a pair; pairs without any get no number.
        levelled: where the values are levels, what they are of, by group; it is one for all of a family.
    """
    numbered = [
        (i, j)
        for i, j in itertools.combinations(range(len(groups)), 2)
        if frozenset((groups[i].name, groups[j].name)) not in untested
    ]
    compared: list[Pair] = []
    for family in connect_groups(numbered):
        own = [groups[i] for i in family]
        pairs = [(family.index(i), family.index(j)) for i, j in numbered if i in family]
        by_runs = any(group.values.size > 1 for group in own) or not all(group.runs for group in own)
        units = [group.values for group in own] if by_runs else _cut_alike([group.runs[0] for group in own])
        runs = [run for group in own for run in group.names]
        errors = levelled[own[0].name].find_errors(runs) if levelled else None
        compared += _compare_family(own, units, pairs, overlaps, errors, RUNS if by_runs else BLOCKS)
    return sorted(compared, key=lambda pair: (pair.a.name, pair.b.name))


def bound_run(run: Samples) -> Interval | None:
    """Interval of one run's median from its parts; it applies to this run, not to its terrain."""
    return bound_levels(_cut_alike([run]))[0]


def _cut_alike(runs: Sequence[Samples]) -> list[Floats]:
    """Medians of parts of runs, of one length: those of shorter parts scatter more.

    The shortest run that can be tested has `PARTS`, or fewer as none is shorter than `STRETCH_S`.
    """
    long = [run.duration_s for run in runs if run.duration_s + ROUNDING_S >= FEWEST_OF_SPREAD * STRETCH_S]
    length_s = max(min(long, default=0.0) / PARTS, STRETCH_S)
    return [run.cut(length_s) for run in runs]


def _compare_family(
    groups: Sequence[Group],
    values: Sequence[Floats],
    pairs: Sequence[tuple[int, int]],
    overlaps: Mapping[frozenset[str], Overlap] | None,
    errors: Errors | None,
    unit: str,
) -> list[Pair]:
    """Pairs by units; without any spread between units only ratios."""
    units, positive = take_logarithms(values)
    known = [
        (i, j)
        for i, j in pairs
        if overlaps is None or overlaps[frozenset((groups[i].name, groups[j].name))].bins
    ]
    test, differences = _test_units(units, known, errors, unit)
    compared = []
    for i, j in pairs:
        a, b = groups[i], groups[j]
        pair = Pair(a, b, unit=unit)
        if overlaps is not None:
            shared = overlaps[frozenset((a.name, b.name))]
            pair = replace(pair, bins=shared.bins, overlap=shared.share)
        if (i, j) not in known:
            compared.append(replace(pair, note=NOT_SHARED))
            continue
        delta = cliffs_delta(values[i], values[j])
        pair = replace(
            pair, shift=shift_between(values[i], values[j]), cliffs_delta=delta, size=name_delta(delta)
        )
        difference = differences.get((i, j))
        if positive:
            usual = float(units[j].mean() - units[i].mean())
            pair = replace(pair, ratio=exponentiate(difference.value if difference else usual))
        if a.runs and b.runs:
            # Published work tests over all samples.
            every = [np.concatenate([run.values for run in group.runs]) for group in (a, b)]
            pair = replace(pair, p_uncorrected=mann_whitney(*every))
        if test is None or difference is None:
            compared.append(replace(pair, note=NO_SPREAD if unit == RUNS else TOO_SHORT))
            continue
        if math.isnan(difference.p):
            compared.append(replace(pair, note=NO_SCATTER))
            continue
        if (ends := difference.interval) is not None:
            pair = _bound_pair(pair, units[i], units[j], ends, positive=positive)
        if unit == RUNS:
            pair = replace(pair, spread=test.spread, freedom=test.freedom)
        notes = [*([ABOUT_BLOCKS] * (unit == BLOCKS)), *_note_scatter(values[i], values[j])]
        numbers = pick(difference, "p", "p_adjusted", "smallest_p")
        compared.append(replace(pair, method=test.method, note="; ".join(notes), **numbers))
    return compared


def _test_units(
    units: Sequence[Floats], pairs: Sequence[tuple[int, int]], errors: Errors | None, unit: str
) -> tuple[MeansTest | None, dict[tuple[int, int], Difference]]:
    """Test of the pairs with enough units, and its differences by pair.

    A single run tells a spread by its own parts only, so that one with too few of them is not tested.
    """
    least = 1 if unit == RUNS else FEWEST_OF_SPREAD
    valid = [index for index, own in enumerate(units) if own.size >= least]
    asked = [pair for pair in pairs if {*pair} <= {*valid}]
    values = [units[index] for index in valid]
    if not asked or not pool_spread(values)[1]:
        return None, {}
    test = compare_means(
        values, [(valid.index(i), valid.index(j)) for i, j in asked], unit=unit, errors=errors
    )
    return test, dict(zip(asked, test.differences, strict=True))


def _bound_pair(pair: Pair, a: Floats, b: Floats, ends: Interval, *, positive: bool) -> Pair:
    """The pair with its intervals, whose ends are those of the mean of logarithms if all are positive."""
    if not positive:
        return replace(pair, low=ends.low, high=ends.high)
    low, high = (_spread_ratio(a, b, end) for end in (ends.low, ends.high))
    least, most = exponentiate(ends.low), exponentiate(ends.high)
    return replace(pair, low=low, high=high, ratio_low=least, ratio_high=most)


def _spread_ratio(a: Floats, b: Floats, difference: float) -> float:
    """Difference of the medians of two sides, from that of their logarithms and the mean of these."""
    mean, share = float(np.concatenate((a, b)).mean()), b.size / (a.size + b.size)
    return exponentiate(mean + (1.0 - share) * difference) - exponentiate(mean - share * difference)


def _note_scatter(a: Floats, b: Floats) -> list[str]:
    still = [values for values in (a, b) if values.size > 1 and float(np.ptp(values)) == 0.0]
    return ["one side has no variation"] if still else []


def tabulate_pairs(
    pairs: Sequence[Pair], *, by: Sequence[str], input_name: str, quantity: str, keys: Mapping[str, str]
) -> pl.DataFrame:
    """Table `comparisons`.

    Args:
        pairs: as from `compare_groups`.
        by: columns that define a dataset.
        input_name: input u.
        quantity: compared quantity.
        keys: run/generation of the runs of every group.
    """
    rows = [
        {
            "run": "*",
            "dataset": f"{pair.a.name} | {pair.b.name}",
            "vehicle": "*",
            "terrain": "*",
            "by": ",".join(by),
            "input": input_name,
            "quantity": quantity,
            "a": pair.a.name,
            "b": pair.b.name,
            "runs_a": pair.a.values.size,
            "runs_b": pair.b.values.size,
            "unit_of_analysis": pair.unit,
            **pick(pair, *_COLUMNS),
            "keys": f"{keys[pair.a.name]} {keys[pair.b.name]}",
        }
        for pair in pairs
    ]
    schema = contract_of("comparisons").schema.create_empty().schema
    frame = pl.DataFrame(rows, schema=schema)
    return frame.select(cs.string(), cs.float(), cs.integer(), cs.enum())


_COLUMNS = (
    "shift", "low", "high", "cliffs_delta", "size", "ratio", "ratio_low", "ratio_high", "p", "p_adjusted",
    "smallest_p", "method", "spread", "freedom", "p_uncorrected", "note", "bins", "overlap",
)  # fmt: skip
"""Attributes of a `Pair` that are columns of the table."""


DIFFERENT, OF_TWO_RUNS, ALIKE, UNTESTED = "different", "different runs", "alike", "untested"


def judge_pair(row: Mapping[str, object]) -> str:
    """What a row of `comparisons` says: `DIFFERENT`, `OF_TWO_RUNS`, `ALIKE` or `UNTESTED`."""
    adjusted, smallest = (number_in(row, key) for key in ("p_adjusted", "smallest_p"))
    if adjusted is None or smallest is None:
        return UNTESTED
    if adjusted <= LEVEL:
        return DIFFERENT if row["unit_of_analysis"] == RUNS else OF_TWO_RUNS
    return ALIKE if smallest <= LEVEL else UNTESTED


MOST_ADDED = 9
"""Most runs of each dataset that are foreseen: a season's; who needs more will not drive them."""


@dataclass(frozen=True)
class Foreseen:
    """What more runs would tell, if differences and the spread between runs stay as they are.

    Attributes:
        added: more runs of each dataset.
        pairs: pairs that would then be significant.
    """

    added: int
    pairs: tuple[tuple[str, str], ...]


def foresee_pairs(rows: Collection[Mapping[str, object]]) -> list[Foreseen]:
    """Numbers of runs that would make the first pair more significant, and half of the pairs.

    Args:
        rows: rows of `comparisons` of one family, of one view.

    Returns:
        At most two; none where no spread between runs is known, half of the pairs are significant, or
        `MOST_ADDED` runs are not enough.
    """
    judged = [
        row for row in rows if judge_pair(row) in (DIFFERENT, ALIKE) and row["unit_of_analysis"] == RUNS
    ]
    spread, freedom = next(((row["spread"], row["freedom"]) for row in judged), (None, None))
    if not isinstance(spread, float) or not isinstance(freedom, int):
        return []
    counts = {str(row[k]): int(str(row[f"runs_{k}"])) for row in judged for k in ("a", "b")}
    differences = [
        (str(row["a"]), str(row["b"]), math.log(ratio))
        for row in judged
        if (ratio := number_in(row, "ratio")) is not None
    ]
    significant = sum(judge_pair(row) == DIFFERENT for row in judged)
    foreseen: list[Foreseen] = []
    for added in range(1, MOST_ADDED + 1) if 2 * significant < len(judged) else ():
        sizes = {name: count + added for name, count in counts.items()}
        pairs = foresee_significant(differences, sizes, spread, freedom + added * len(counts))
        is_half = 2 * len(pairs) >= len(judged)
        if len(pairs) > significant and (is_half or not foreseen):
            foreseen.append(Foreseen(added, tuple(pairs)))
        if is_half:
            break
    return foreseen


ABOUT_UNIT = (
    "the norm of a 2 s window is sqrt(40) = 6.32 times the root mean square of its slip modulus (L = 1 m), "
    "in m/s; the paper prints the same number in m^2 rad/s^3, the product of the units of its three "
    "components, which is the unit of no norm"
)

AS_DRIVEN, EQUAL_DRIVING, AS_PUBLISHED = "median_modulus", "equal_modulus", "published_norm"
"""Quantities that are compared."""


@dataclass(frozen=True)
class View:
    """Comparison of all datasets by one quantity on one input.

    Attributes:
        input: input u.
        quantity: `AS_DRIVEN`, `EQUAL_DRIVING` or `AS_PUBLISHED`.
        levels: ``dataset``, ``value``, ``low``, ``high``, ``interval`` of the quantity.
        comparisons: table `comparisons`.
    """

    input: str
    quantity: str
    levels: pl.DataFrame
    comparisons: pl.DataFrame


@dataclass(frozen=True)
class Answer:
    """Result of a comparison.

    Attributes:
        datasets: table `datasets`, both inputs.
        views: the comparisons, the main one first.
        families: vehicles, and their datasets that are compared with each other.
        runs: one row per run and input with all its measures.
        bins: the driving of every dataset: as from `measure_bins`, with ``group`` in place of the run.
        carriers: the cause that carries the difference of a pair as driven, by input and pair.
        features: table `features`: what can be given away of the runs.
        windows: box plot statistics of the window norms, as from `spread_windows`.
        notes: excluded runs, pairs that cannot be distinguished.
    """

    datasets: pl.DataFrame
    views: tuple[View, ...]
    families: Mapping[str, tuple[str, ...]]
    runs: pl.DataFrame
    bins: pl.DataFrame
    carriers: Mapping[tuple[str, frozenset[str]], str]
    windows: pl.DataFrame
    features: pl.DataFrame
    notes: tuple[str, ...]

    @property
    def input(self) -> str:
        """Input u of the main comparison."""
        return self.views[0].input

    @property
    def quantity(self) -> str:
        """Quantity of the main comparison."""
        return self.views[0].quantity

    @property
    def comparisons(self) -> pl.DataFrame:
        """Rows of the main comparison."""
        return self.views[0].comparisons

    @property
    def inputs(self) -> tuple[str, ...]:
        """Inputs u, that of the main comparison first."""
        return tuple(dict.fromkeys(view.input for view in self.views))

    @property
    def measure(self) -> str:
        """Name of the quantity as driven, its length scale included."""
        if self.quantity == AS_PUBLISHED:
            return "2 s window norm as published (L = 1 m)"
        (scale,) = self.datasets["length_scale"].drop_nulls().unique().to_list() or (1.0,)
        return f"median slip modulus (L = {scale:g} m)"

    def find_view(self, input_name: str, *, equal: bool) -> View | None:
        """The comparison on an input, at equal driving or as driven; None if there is none."""
        matching = (
            view
            for view in self.views
            if view.input == input_name and (view.quantity == EQUAL_DRIVING) == equal
        )
        return next(matching, None)


@dataclass(frozen=True)
class Agreement:
    """Agreement of two vehicles on the order of the terrains that both were driven on.

    Attributes:
        measure: key of `MEASURES`.
        a, b: vehicles.
        terrains: common terrains, from easy to hard for `a`.
        tau: Kendall's tau-b; None with fewer than two terrains.
        p: two-sided probability of an order as strong if there were none.
        smallest_p: smallest p possible with this number of terrains.
        text: the result in words.
    """

    measure: str
    a: str
    b: str
    terrains: tuple[str, ...]
    tau: float | None
    p: float | None
    smallest_p: float | None
    text: str


def compare_orders(datasets: pl.DataFrame) -> list[Agreement]:
    """Compare every two vehicles by every measure that both have; a terrain has the median over its datasets.

    Args:
        datasets: table `datasets` of one input; rows over several vehicles or terrains are ignored.
    """
    known = datasets.filter(pl.col("vehicle") != "*", pl.col("terrain") != "*")
    comparisons = []
    for a, b in itertools.combinations(sorted(set(known["vehicle"])), 2):
        for key, measure in MEASURES.items():
            sides = [
                known.filter(pl.col("vehicle") == vehicle)
                .drop_nulls(measure.column)
                .group_by("terrain")
                .agg(pl.col(measure.column).median().alias(vehicle))
                for vehicle in (a, b)
            ]
            comparisons.append(_order(key, a, b, sides[0].join(sides[1], on="terrain").sort(a, "terrain")))
    return comparisons


def _order(key: str, a: str, b: str, both: pl.DataFrame) -> Agreement:
    terrains = tuple(both["terrain"].to_list())
    count = len(terrains)
    if count < 2:  # noqa: PLR2004 - an order takes two
        shared = f"share {terrains[0]} only" if terrains else "have no terrain in common"
        return Agreement(
            key, a, b, terrains, None, None, None, f"{a} and {b} {shared}: no order of terrains to compare"
        )
    tau = kendall_tau(both[a], both[b])
    p, smallest = kendall_p(tau, count)
    sure = (
        f"p = {p:.2g}"
        if smallest <= LEVEL
        else f"too few terrains for significance, p = {p:.2g}; at least 5 are needed"
    )
    text = f"{a} and {b} on {count} terrains by {MEASURES[key].name}: Kendall's tau {tau:.2f}, {sure}"
    return Agreement(key, a, b, terrains, tau, p, smallest, text)
