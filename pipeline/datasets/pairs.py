"""Datasets set side by side by one quantity: their levels, and each pair with its sizes and its test."""

import itertools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.core import (
    FEWEST_OF_SPREAD,
    ROUNDING_S,
    STRETCH_S,
    Floats,
    bound_median,
    finite_or_none,
    number_in,
)
from pipeline.datasets.equal_driving import Levelled, Overlap
from pipeline.datasets.levels import LEVEL, Levels, fit_levels
from schemas import contract_of

RUNS = "runs"
BLOCKS = "blocks"
OVER_RUNS = "over runs"
THIS_RUN = "this run only"
OTHERS_SPREAD = "one run, spread of the others"
"""What intervals say: over the runs of a dataset; of one run alone; or of one run, with the spread of
the runs of the vehicle's other datasets."""
PARTS = 8
"""Most parts of a single run: medians of eight equal parts of 2 to 10 minutes are called different in 4 to
7 % of equal runs whose slip remembers 0.5 to 2.5 s."""
ABOUT_BLOCKS = "a difference between two runs, not between terrains"
NOT_SHARED = "no driving in common, no number"
NO_SPREAD = "too few runs to know how much runs differ: no test"
TOO_SHORT = f"{ABOUT_BLOCKS}; too short for a test: {FEWEST_OF_SPREAD} stretches of {STRETCH_S:g} s of each"
_LEAST = 1e-9
"""Least slip [m/s], which keeps its logarithm finite."""
_WORDS = ((0.147, "negligible"), (0.33, "small"), (0.474, "medium"))
"""Upper limits of Cliff's delta for each word (Romano et al. 2006)."""


@dataclass(frozen=True)
class SlipSamples:
    """Samples of one run.

    Attributes:
        values: the compared quantity, shape (n,).
        times: their times [s], ascending, shape (n,).
    """

    values: Floats
    times: Floats

    @property
    def duration_s(self) -> float:
        """Time that they stand for [s]: their number times their usual step, without gaps."""
        return self.values.size * float(np.median(np.diff(self.times)))

    def bound(self) -> tuple[float, float] | None:
        """95 % interval of their median, the same as of the run's analysis."""
        return bound_median(self.values, self.times)

    def cut(self, length_s: float) -> Floats:
        """Medians of at most `PARTS` parts of that length; the median of the run where none fits."""
        count = min(PARTS, int((self.duration_s + ROUNDING_S) // length_s), self.values.size)
        if count < 1:
            return np.array([np.median(self.values)])
        size = min(max(round(self.values.size * length_s / self.duration_s), 1), self.values.size // count)
        firsts = np.linspace(0.0, self.values.size - size, count).astype(np.int64).tolist()
        return np.array([np.median(self.values[at : at + size]) for at in firsts])


@dataclass(frozen=True)
class Group:
    """A dataset as an input of the tests.

    Attributes:
        name: its name.
        values: the compared quantity of each run, shape (runs,).
        runs: samples of each run; empty where only the values are known.
        names: the runs' names, where errors of their values are known.
    """

    name: str
    values: Floats
    runs: tuple[SlipSamples, ...] = ()
    names: tuple[str, ...] = ()

    @classmethod
    def of_runs(cls, name: str, runs: Sequence[SlipSamples]) -> "Group":
        """Group whose runs are compared by their medians."""
        return cls(name, np.array([np.median(run.values) for run in runs]), tuple(runs))


def name_interval(runs: int) -> str:
    """What an interval by a spread that datasets share says of a dataset of so many runs."""
    return OVER_RUNS if runs > 1 else OTHERS_SPREAD


def bound_groups(groups: Sequence[Floats]) -> list[tuple[float, float] | None]:
    """95 % intervals of the typical value of groups, by the spread of the logarithm that they share.

    Args:
        groups: values of the units of each group, each shape (n,), n >= 1.

    Returns:
        None where no spread is known.
    """
    if not groups:
        return []
    fit = _fit_logarithms(groups)
    ends = [tuple(map(_exponentiate, fit.bound(i))) for i in range(len(groups))]
    return [(low, high) if fit.is_known else None for low, high in ends]


def _fit_logarithms(groups: Sequence[Floats], errors: Floats | None = None) -> Levels:
    values = np.log(np.maximum(np.concatenate(groups), _LEAST))
    return fit_levels(values, [f"{i:06d}" for i, group in enumerate(groups) for _ in group], errors)


def level_groups(
    groups: Sequence[Group], levelled: Levelled
) -> list[tuple[float, tuple[float, float] | None]]:
    """Levels of groups at equal driving, with their intervals."""
    fit = _fit_levelled(groups, levelled)
    return [
        (
            math.exp(fit.means[i]),
            (math.exp(fit.bound(i)[0]), math.exp(fit.bound(i)[1])) if fit.is_known else None,
        )
        for i in range(len(groups))
    ]


def _fit_levelled(groups: Sequence[Group], levelled: Levelled) -> Levels:
    errors = levelled.find_errors([run for group in groups for run in group.names])
    return _fit_logarithms([group.values for group in groups], errors)


def _cut_alike(runs: Sequence[SlipSamples]) -> list[Floats]:
    """Medians of parts of runs, of one length: those of shorter parts scatter more.

    The shortest run that can be tested has `PARTS`, or fewer as none is shorter than `STRETCH_S`.
    """
    long = [run.duration_s for run in runs if run.duration_s + ROUNDING_S >= FEWEST_OF_SPREAD * STRETCH_S]
    length_s = max(min(long, default=0.0) / PARTS, STRETCH_S)
    return [run.cut(length_s) for run in runs]


def compare_groups(
    groups: Sequence[Group],
    *,
    untested: Collection[frozenset[str]] = (),
    overlaps: Mapping[frozenset[str], Overlap] | None = None,
    levelled: Mapping[str, Levelled] | None = None,
) -> list[dict[str, object]]:
    """Compare pairs of groups; what a pair has no number of is None.

    Groups that tested pairs connect are one family, with one spread of the logarithm between its units, and
    its pairs share a familywise error of 5 %. Its units are the runs; where every group is one run, they are
    the parts of each, and the result is of these runs only.

    Args:
        groups: groups of at least one run each.
        untested: names of pairs that are not compared.
        overlaps: driving in common by the names of a pair; pairs without any get no number.
        levelled: where the values are levels, what they are of, by group; it is one for all of a family.

    Returns:
        Rows with the columns of `comparisons` from ``a`` on.
    """
    pairs = [
        (i, j)
        for i, j in itertools.combinations(range(len(groups)), 2)
        if frozenset((groups[i].name, groups[j].name)) not in untested
    ]
    rows: list[dict[str, object]] = []
    for family in connect_groups(pairs):
        own = [groups[i] for i in family]
        unit = RUNS if any(one.values.size > 1 or not one.runs for one in own) else BLOCKS
        units = [one.values for one in own] if unit == RUNS else _cut_alike([one.runs[0] for one in own])
        # A single run tells a spread by its own parts only: one with too few of them is not tested.
        able = [k for k, one in enumerate(units) if unit == RUNS or one.size >= FEWEST_OF_SPREAD]
        fit = None
        if able:
            values = [units[k] for k in able]
            fit = _fit_levelled(own, levelled[own[0].name]) if levelled else _fit_logarithms(values)
        names = {k: f"{number:06d}" for number, k in enumerate(able)}
        for i, j in pairs:
            if i in family:
                k, m = family.index(i), family.index(j)
                row = _describe_pair(own[k], own[m], units[k], units[m], overlaps) | {
                    "unit_of_analysis": unit
                }
                if row["note"] != NOT_SHARED:
                    row |= _test_pair(fit, names, (k, m), units, unit)
                rows.append(row)
    return sorted(rows, key=lambda row: (str(row["a"]), str(row["b"])))


def _describe_pair(
    a: Group, b: Group, first: Floats, second: Floats, overlaps: Mapping[frozenset[str], Overlap] | None
) -> dict[str, object]:
    """Sizes of a difference, without its test."""
    row: dict[str, object] = dict.fromkeys(contract_of("comparisons").schema.column_names())
    row |= {"a": a.name, "b": b.name, "runs_a": a.values.size, "runs_b": b.values.size}
    row |= {"size": "", "method": "", "note": ""}
    if overlaps is not None:
        shared = overlaps[frozenset((a.name, b.name))]
        row |= {"bins": shared.bins, "overlap": shared.share}
        if not shared.bins:
            return row | {"note": NOT_SHARED}
    delta = cliffs_delta(first, second)
    row |= {"cliffs_delta": delta, "size": name_delta(delta), "shift": shift_between(first, second)}
    if a.runs and b.runs:
        # Published work tests over all samples.
        every = [np.concatenate([run.values for run in group.runs]) for group in (a, b)]
        row["p_uncorrected"] = mann_whitney(*every)
    return row


def _test_pair(
    fit: Levels | None, names: Mapping[int, str], pair: tuple[int, int], units: Sequence[Floats], unit: str
) -> dict[str, object]:
    """Ratio of a pair with its interval, and its p; only the ratio where no spread between units is known."""
    logarithms = [np.log(np.maximum(units[k], _LEAST)) for k in pair]
    if fit is None or not {*pair} <= {*names}:
        usual = float(logarithms[1].mean() - logarithms[0].mean())
        return {"ratio": _exponentiate(usual), "note": TOO_SHORT}
    one = fit.compare(names[pair[0]], names[pair[1]], len(names))
    ratio: dict[str, object] = {"ratio": _exponentiate(one.value)}
    if not math.isfinite(one.p):
        return ratio | {"note": NO_SPREAD if unit == RUNS else TOO_SHORT}
    mean, share = (
        float(np.concatenate(logarithms).mean()),
        units[pair[1]].size / sum(units[k].size for k in pair),
    )
    shifts = [
        _exponentiate(mean + (1.0 - share) * end) - _exponentiate(mean - share * end)
        for end in (one.low, one.high)
    ]
    over = f", Tukey and Kramer over {len(names)} datasets" if len(names) > 2 else ""  # noqa: PLR2004 - more than a pair
    return ratio | {
        "ratio_low": _exponentiate(one.low),
        "ratio_high": _exponentiate(one.high),
        "low": shifts[0],
        "high": shifts[1],
        "p": one.p,
        "p_adjusted": one.p_adjusted,
        "smallest_p": 0.0,
        "method": f"levels of {unit} with one spread of the logarithm{over}",
        "note": ABOUT_BLOCKS * (unit == BLOCKS),
        "spread": finite_or_none(fit.spread) if unit == RUNS else None,
        "freedom": int(fit.freedom) if unit == RUNS else None,
    }


_LARGEST_LOG = 700.0
"""Largest logarithm whose exponential is a double."""


def _exponentiate(value: float) -> float:
    """The exponential; of what has none, the largest or smallest that a double holds."""
    return math.exp(min(max(value, -_LARGEST_LOG), _LARGEST_LOG))


def connect_groups(pairs: Iterable[tuple[int, int]]) -> list[tuple[int, ...]]:
    """The sets of groups that pairs connect, in order; groups by their index."""
    sets: list[set[int]] = []
    for pair in pairs:
        joined = set(pair).union(*(one for one in sets if not one.isdisjoint(pair)))
        sets = [*(one for one in sets if one.isdisjoint(pair)), joined]
    return sorted(tuple(sorted(one)) for one in sets)


def shift_between(a: Floats, b: Floats) -> float:
    """Hodges-Lehmann shift: the median of all differences b - a, in the unit of the values."""
    return float(np.median(b[:, None] - a[None, :]))


def cliffs_delta(a: Floats, b: Floats) -> float:
    """Cliff's delta in [-1, 1]: how much more often a value of b is above one of a than below it."""
    from scipy.stats import mannwhitneyu  # noqa: PLC0415 - heavy

    return 2.0 * float(mannwhitneyu(b, a, method="asymptotic").statistic) / (a.size * b.size) - 1.0


def name_delta(delta: float) -> str:
    """Cliff's delta in a word: negligible, small, medium or large."""
    return next((word for limit, word in _WORDS if abs(delta) < limit), "large")


def mann_whitney(a: Floats, b: Floats) -> float:
    """Two-sided p of the Mann-Whitney test, which is not valid for samples that are correlated.

    Two equal runs of ten minutes are called different in two cases of three.
    """
    from scipy.stats import mannwhitneyu  # noqa: PLC0415 - heavy

    if np.ptp(np.concatenate((a, b))) == 0.0:
        return 1.0
    return float(mannwhitneyu(a, b, method="asymptotic").pvalue)


DIFFERENT, OF_TWO_RUNS, ALIKE, UNTESTED = "different", "different runs", "alike", "untested"


def judge_pair(row: Mapping[str, object]) -> str:
    """What a row of `comparisons` says: `DIFFERENT`, `OF_TWO_RUNS`, `ALIKE` or `UNTESTED`."""
    adjusted = number_in(row, "p_adjusted")
    if adjusted is None:
        return UNTESTED
    if adjusted > LEVEL:
        return ALIKE
    return DIFFERENT if row["unit_of_analysis"] == RUNS else OF_TWO_RUNS


def tabulate_pairs(
    rows: Sequence[Mapping[str, object]],
    *,
    by: Sequence[str],
    input_name: str,
    quantity: str,
    keys: Mapping[str, str],
) -> pl.DataFrame:
    """Table `comparisons`.

    Args:
        rows: as from `compare_groups`.
        by: columns that define a dataset.
        input_name: input u.
        quantity: compared quantity.
        keys: run/generation of the runs of every group.
    """
    alike = {
        "run": "*",
        "vehicle": "*",
        "terrain": "*",
        "by": ",".join(by),
        "input": input_name,
        "quantity": quantity,
    }
    whole = [
        {
            **row,
            **alike,
            "dataset": f"{row['a']} | {row['b']}",
            "keys": f"{keys[str(row['a'])]} {keys[str(row['b'])]}",
        }
        for row in rows
    ]
    return pl.DataFrame(whole, schema=contract_of("comparisons").schema.create_empty().schema)
